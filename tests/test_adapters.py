"""Tests of the table of adapters, the host and the package canopen."""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import shlex
import subprocess
import sys
import textwrap
from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

import pytest

from ecatspec.conformance import adapters
from ecatspec.conformance.adapters import ADAPTERS, FACTORIES, open_adapter, parse_options
from ecatspec.conformance.adapters.contract_test import check_adapter
from ecatspec.conformance.adapters.model import make
from ecatspec.conformance.adapters.process import ProcessAdapter
from ecatspec.conformance.base.adapter import (
    AdapterError,
    Description,
    DeviceCrash,
    check_duration,
    check_span,
)
from ecatspec.conformance.base.devices import load
from ecatspec.conformance.base.verdict import Outcome
from ecatspec.conformance.run.runner import Runner
from ecatspec.generators.cases.bringup import way_to
from ecatspec.generators.cases.case import Case, Probe
from ecatspec.model.core.compilation import Model
from ecatspec.spec.language.ir import Access, ObjectEntry, SInt, Text, UInt

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from ecatspec.conformance.base.adapter import Adapter
    from ecatspec.spec.language.ir import Protocol

DESCRIPTION = Description("a", frozenset({"sdo", "al"}), virtual_time=True, closed_dictionary=False)

# A hosted device that prints, fails on address 1, leaves on address 2 and refuses address 3.
HOSTED = """
import os, sys
from ecatspec.conformance import adapters
from ecatspec.conformance.adapters import host
from ecatspec.conformance.base.adapter import AdapterError, Description
class Device:
    def reset(self): print("reset", flush=True)
    def read(self, address, length):
        os.write(1, b"to descriptor 1")
        assert sys.stdin.read() == ""
        match address:
            case 1: raise KeyError("lost")
            case 2: sys.exit(0)
            case 3: raise AdapterError("not there")
        return 1, bytes(length)
    def write(self, address, data): return 1
    def advance(self, seconds): pass
    def close(self): pass
    def describe(self):
        return Description("d", frozenset(), virtual_time=True, closed_dictionary=True)
def make(device, options):
    if device == "bad": raise ValueError("device text is bad")
    return Device()
host.factory = {"d": make}.__getitem__
host.main(["d", '{"device": "%s", "options": {}}' % sys.argv[1]])
"""


def hosted(tmp_path: Path, device: str) -> ProcessAdapter:
    path = tmp_path / "hosted.py"
    path.write_text(textwrap.dedent(HOSTED))
    return ProcessAdapter([sys.executable, str(path), device])


def test_every_row_says_how_it_is_used() -> None:
    for name, entry in ADAPTERS.items():
        assert entry.example.partition(":")[0] == name
        assert entry.summary
    assert set(FACTORIES) <= set(ADAPTERS)


BROUGHT = """
from ecatspec.conformance.adapters.model import make as virtual
def make(device, options):
    '''The virtual SubDevice once more.'''
    return virtual(device, options)
"""


def brought(folder: Path, entry: str) -> dict[str, str]:
    """Lay a package beside, as pip installs it; give the environment that has it."""
    (folder / "my_bus.py").write_text(BROUGHT, "utf-8")
    known = folder / "my_bus-1.0.dist-info"
    known.mkdir()
    (known / "METADATA").write_text("Metadata-Version: 2.1\nName: my-bus\nVersion: 1.0\n", "utf-8")
    (known / "entry_points.txt").write_text(f"[ecatspec.adapters]\n{entry}\n", "utf-8")
    return {**os.environ, "PYTHONPATH": str(folder)}


def ecatspec(*arguments: str, env: dict[str, str]) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-P", "-m", "ecatspec.conformance.cli", *arguments]
    return subprocess.run(command, env=env, capture_output=True, text=True, check=False)


RUN = ("run", "reference", "--depth", "quick", "--only", "al", "--dut")


def test_a_package_brings_an_adapter(tmp_path: Path) -> None:
    env = brought(tmp_path, "mybus = my_bus:make")
    listed = ecatspec("adapters", env=env)
    assert "an adapter of the package my-bus" in listed.stdout
    done = ecatspec(*RUN, "mybus:fault=init_ignored", env=env)
    assert done.returncode == 2
    assert "init_ignored" in done.stderr
    done = ecatspec(*RUN, "mybus", env=env)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_package_replaces_no_adapter(tmp_path: Path) -> None:
    env = brought(tmp_path, "model = my_bus:lost")
    assert "my-bus" not in ecatspec("adapters", env=env).stdout
    assert ecatspec(*RUN, "model", env=env).returncode == 0


def test_an_adapter_that_cannot_be_loaded_is_one_line(tmp_path: Path) -> None:
    env = brought(tmp_path, "mybus = my_bus:lost")
    done = ecatspec(*RUN, "mybus", env=env)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "'mybus' (my_bus:lost) cannot be loaded: AttributeError" in line


def test_every_factory_has_its_file() -> None:
    for name in FACTORIES:
        assert importlib.util.find_spec(f"{adapters.__name__}.{name}") is not None


def test_an_unknown_adapter_is_told_the_nearest() -> None:
    with pytest.raises(AdapterError, match=r"mean .canopen.*canopen, eth, exec, lib, model"):
        open_adapter("canopne", "akd")


def test_options_are_read_or_refused() -> None:
    assert parse_options("") == {}
    assert parse_options("a=1,b=x=y") == {"a": "1", "b": "x=y"}
    for text in ("a", "=1", "a=1,a=2"):
        with pytest.raises(AdapterError, match="cannot read the option"):
            parse_options(text)


def test_a_missing_package_is_told_before_anything_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: None)
    with pytest.raises(AdapterError, match=r'pip install "ecatspec\[canopen\]"'):
        open_adapter("canopen", "akd")


def test_a_command_that_does_not_come_up_is_a_matter_of_set_up() -> None:
    command = shlex.join([sys.executable, "-c", "import sys; sys.exit('no card')"])
    with pytest.raises(AdapterError, match=r"does not come up: .*exit status 1; it said: no card"):
        open_adapter(f"exec:{command}", "akd")
    with pytest.raises(AdapterError, match="cannot read the command"):
        open_adapter("exec:'", "akd")
    with pytest.raises(AdapterError, match="empty"):
        open_adapter("exec:", "akd")


def test_an_unknown_device_is_a_matter_of_set_up() -> None:
    with pytest.raises(AdapterError, match=r"^cannot set up 'model': no device text is"):
        open_adapter("model", "no-such-device")


def test_the_host_keeps_the_protocol_apart_from_prints(tmp_path: Path) -> None:
    with hosted(tmp_path, "good") as adapter:
        adapter.reset()
        assert adapter.read(0, 2) == (1, b"\x00\x00")
        with pytest.raises(AdapterError, match="not there"):
            adapter.read(3, 1)
        assert adapter.describe().name == "d"


def test_the_host_answers_a_batch(tmp_path: Path) -> None:
    with hosted(tmp_path, "good") as adapter:
        assert adapter.describe().batch
        assert adapter.reads([(5, 1), (6, 2)]) == [(1, b"\0"), (1, b"\0\0")]
        with pytest.raises(AdapterError, match="not there"):
            adapter.reads([(5, 1), (3, 1)])
        assert adapter.read(5, 1) == (1, b"\0")


def test_an_exception_of_a_hosted_device_is_a_crash(tmp_path: Path) -> None:
    with hosted(tmp_path, "good") as adapter:
        with pytest.raises(
            DeviceCrash, match="exit status 70; it said: KeyError: 'lost'"
        ) as caught:
            adapter.read(1, 1)
        assert "Traceback" in caught.value.stderr_tail
        adapter.reset()
        with pytest.raises(DeviceCrash, match="exit status 70"):
            adapter.read(2, 1)


def test_a_set_up_that_fails_is_not_a_crash(tmp_path: Path) -> None:
    with hosted(tmp_path, "bad") as adapter, pytest.raises(AdapterError, match="text is bad"):
        adapter.describe()


def test_a_description_survives_json_and_wrong_ones_are_refused() -> None:
    data = DESCRIPTION.to_json()
    assert Description.from_json(data) == DESCRIPTION
    for field, wrong in (
        ("name", 1),
        ("protocols", "al"),
        ("notes", [1]),
        ("virtual_time", 1),
        ("batch", 1),
        ("extra", 1),
    ):
        with pytest.raises(ValueError, match=field):
            Description.from_json({**data, field: wrong})


def test_the_limits_of_a_description_survive_json() -> None:
    limited = replace(
        DESCRIPTION, limits={"initiate_data": 0, "segment_data": 7}, without=("malformed",)
    )
    data = json.loads(json.dumps(limited.to_json()))
    assert data["limits"] == {"initiate_data": 0, "segment_data": 7}
    assert Description.from_json(data) == limited
    assert Description.from_json(data) != DESCRIPTION
    for field in ("limits", "without", "notes"):
        del data[field]
    assert Description.from_json(data) == DESCRIPTION


@pytest.mark.parametrize(
    "wrong",
    [
        {"segment": 7},
        {"segment_data": 0},
        {"initiate_data": -1},
        {"initiate_data": "7"},
        {"initiate_data": 7.0},
        {"initiate_data": True},
        {"initiate_data": None},
        7,
        [],
    ],
)
def test_wrong_limits_are_refused_in_one_line(wrong: object) -> None:
    with pytest.raises(ValueError, match=r"^field 'limits' of a description has .*; it may have"):
        Description.from_json({**DESCRIPTION.to_json(), "limits": wrong})


def test_wrong_limits_of_a_program_are_rubbish() -> None:
    data = {**DESCRIPTION.to_json(), "limits": {"segment_data": -7}}
    code = f"print({json.dumps({'ok': True, 'description': data})!r})"
    command = shlex.join([sys.executable, "-c", f"input(); {code}; input()"])
    with pytest.raises(AdapterError, match=r"does not come up: .*'segment_data': -7"):
        open_adapter(f"exec:{command}", "standard")


@pytest.mark.parametrize(
    ("dut", "words"),
    [
        ("model:fault=nonsense", "no fault is called 'nonsense'; did you mean"),
        ("model:nonsense=1", "has no option 'nonsense'; it takes mailbox, fault"),
        ("model:mailbox=5", "cannot set up 'model': '5' is no mailbox size; give"),
        ("model:mailbox=big", "cannot set up 'model': 'big' is no mailbox size; give"),
        ("canopen:fault=toggle_ignored", "has no option 'fault'; it takes mailbox"),
    ],
)
def test_a_wrong_option_is_one_clear_line(dut: str, words: str) -> None:
    if dut.startswith("canopen"):
        pytest.importorskip("canopen")
    with pytest.raises(AdapterError) as caught:
        open_adapter(dut, "standard")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def probed(dut: str, mailbox: str) -> Outcome:
    """Bring the device up over mailboxes of that length, and ask it something."""
    model = Model(load("standard", mailbox))
    adapter = open_adapter(dut, "standard")
    try:
        runner = Runner(model, adapter, adapter.describe())
        return runner.executor.judge(
            Case("probe", "", "sdo", (*way_to(model, "PREOP"), Probe()))
        ).outcome
    finally:
        adapter.close()


def test_the_mailbox_of_a_virtual_device_has_the_length_that_was_asked_for() -> None:
    assert probed("model:mailbox=64", "64") is Outcome.PASS
    assert probed("model", "64") is Outcome.FAIL
    assert probed("model:mailbox=64", "") is Outcome.FAIL


def test_accesses_outside_the_contract_are_refused() -> None:
    check_span(0, 1 << 16)
    for address, length in ((-1, 1), (0, 0), (1 << 16, 1), (65535, 2)):
        with pytest.raises(AdapterError):
            check_span(address, length)
    for seconds in (-1.0, float("nan"), float("inf")):
        with pytest.raises(AdapterError):
            check_duration(seconds)


@pytest.mark.parametrize("name", sorted(set(FACTORIES) - {"lib"}))  # test_library.py has libraries
def test_every_hosted_adapter_passes_the_kit(name: str) -> None:
    if name == "canopen":
        pytest.importorskip("canopen")
    complaints = check_adapter(
        lambda: open_adapter(name, "standard"),
        spans=[(0, 2), (0x130, 2), (0x1000, 256)],
        write=(0x120, b"\x01\x00"),
    )
    assert complaints == []


MAY = "it may have initiate_data from 0 and segment_data from 1, in bytes"


class Described:
    """The virtual SubDevice with another description."""

    def __init__(self, **changes: object) -> None:
        self._device = make("standard", {})
        self._changes = changes

    def __getattr__(self, name: str) -> object:
        return getattr(self._device, name)

    def describe(self) -> Description:
        return replace(self._device.describe(), **self._changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "complaints"),
    [
        ({}, []),
        ({"limits": {"segment_data": 7}, "notes": ("limits: frames of eight bytes",)}, []),
        ({"without": ("malformed",), "notes": ("without malformed: cut",)}, []),
        (
            {"limits": {"segment_data": 0}, "notes": ("limits: none",)},
            [f"describe: field 'limits' of a description has 'segment_data': 0; {MAY}"],
        ),
        (
            {"limits": {"segment_data": 7}, "without": ("malformed",)},
            [
                "describe: no note of the description says why there is 'limits'",
                "describe: no note of the description says why there is 'malformed'",
            ],
        ),
    ],
)
def test_the_kit_looks_at_limits(changes: dict[str, object], complaints: list[str]) -> None:
    def described() -> Adapter:
        return cast("Adapter", Described(**changes))

    write = (0x120, b"\x01\x00")
    assert check_adapter(described, spans=[(0x130, 2)], write=write) == complaints


OBJECTS = (
    ObjectEntry(0x2000, 0, "plain", UInt(16), Access.BOTH, default=0x2211),
    ObjectEntry(0x2001, 0, "count", UInt(8), Access.READ, constant=True, default=2),
    ObjectEntry(0x2001, 1, "signed", SInt(32), Access.BOTH, default=-2),
    ObjectEntry(0x2001, 2, "secret", UInt(8), Access.WRITE),
    ObjectEntry(0x2002, 0, "text", Text(20), Access.BOTH, default="hello world"),
    ObjectEntry(0x2003, 0, "bits", UInt(2), Access.BOTH),
    ObjectEntry(0x1017, 0, "heartbeat", UInt(16), Access.BOTH),
)


@pytest.fixture
def canopen_server() -> Callable[[str], list[str]]:
    pytest.importorskip("canopen")
    module = importlib.import_module("ecatspec.conformance.adapters.canopen")
    server = module.SdoServer(cast("Protocol", SimpleNamespace(objects=OBJECTS)))
    return lambda request: [reply.hex(" ") for reply in server(bytes.fromhex(request))]


@pytest.mark.parametrize(
    ("requests", "reply"),
    [
        (["40 00 20 00 00000000"], "4b 00 20 00 11 22 00 00"),
        (["40 01 20 00 00000000"], "4f 01 20 00 02 00 00 00"),
        (["40 01 20 01 00000000"], "43 01 20 01 fe ff ff ff"),
        (["40 01 20 02 00000000"], "80 01 20 02 01 00 01 06"),
        (["40 01 20 03 00000000"], "80 01 20 03 11 00 09 06"),
        (["40 03 20 00 00000000"], "4f 03 20 00 00 00 00 00"),
        (["40 99 20 00 00000000"], "80 99 20 00 00 00 02 06"),
        (["40 02 20 00 00000000"], "41 02 20 00 0b 00 00 00"),
        (["40 02 20 00 00000000", "60 00000000000000"], "00 68 65 6c 6c 6f 20 77"),
        (["2b 00 20 00 34120000", "40 00 20 00 00000000"], "4b 00 20 00 34 12 00 00"),
        (["2f 01 20 00 01000000"], "80 01 20 00 02 00 01 06"),
        (["2b 17 10 00 64000000"], "60 17 10 00 00 00 00 00"),
    ],
)
def test_the_mapping_to_canopen_adds_nothing(
    canopen_server: Callable[[str], list[str]], requests: list[str], reply: str
) -> None:
    assert [canopen_server(request) for request in requests][-1] == [reply]


def test_an_exception_of_canopen_is_not_caught(
    canopen_server: Callable[[str], list[str]],
) -> None:
    with pytest.raises(Exception, match="required argument is not an integer"):
        canopen_server("60 00000000000000")
