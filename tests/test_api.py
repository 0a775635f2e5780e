"""Tests of the stable interface, ecatspec.api."""

from __future__ import annotations

import inspect
import io
import json
import re
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from ecatspec import api
from ecatspec.model.esc.wire import COMMANDS, Datagram, Wire, wire_format

if TYPE_CHECKING:
    from collections.abc import Callable

ROOT = Path(__file__).resolve().parent.parent
USERS = ("docs/own-tests.md", "docs/pytest.md", "docs/api.md", "examples/test_my_slave.py")
DEVICE = "reference"


def test_every_name_is_there_and_documented() -> None:
    text = (ROOT / "docs" / "api.md").read_text("utf-8")
    missing = [name for name in api.__all__ if f"`{name}" not in text]
    assert not missing, "docs/api.md lists what is stable"
    assert sorted(api.__all__) == sorted(set(api.__all__))
    own = {
        name
        for name, value in vars(api).items()
        if inspect.isfunction(value) and value.__module__ == api.__name__ and name[0] != "_"
    }
    assert own <= set(api.__all__)


@pytest.mark.parametrize("page", USERS)
def test_users_are_shown_nothing_else(page: str) -> None:
    text = (ROOT / page).read_text("utf-8")
    used = set(re.findall(r"(?:from|import) (ecatspec[\w.]*)", text))
    assert used <= {"ecatspec", "ecatspec.api"}
    names = set(re.findall(r"\bapi\.(\w+)", text))
    for group in re.findall(r"from ecatspec\.api import ([\w, ]+)", text):
        names |= set(re.split(r",\s*", group))
    assert names <= set(api.__all__)
    assert used


def test_no_package_needs_it() -> None:
    found = [
        path
        for folder in ("spec", "model", "generators", "conformance")
        for path in (ROOT / folder).rglob("*.py")
        if re.search(r"ecatspec\.api|from ecatspec import", path.read_text("utf-8"))
    ]
    assert not found


def test_a_run_and_its_report() -> None:
    seen: list[str] = []
    result = api.run(
        DEVICE,
        depth="quick",
        only=["al"],
        progress=lambda _done, _all, what: seen.append(what),
    )
    assert {verdict.outcome for verdict in result.verdicts} <= {
        api.Outcome.PASS,
        api.Outcome.SKIPPED,
    }
    assert seen
    protocol = api.load(DEVICE)
    data = json.loads(api.report([result], protocol, "json"))
    assert data["results"][0]["device"]
    assert "<testsuite" in api.report([result], protocol, "junit")


def test_one_case_by_its_name_and_by_its_token() -> None:
    model = api.Model(api.load(DEVICE))
    case = next(each for each in api.cases(model, depth="quick") if each.layer == "al")
    token = api.token_of(case)
    assert api.case_of(token).stimuli == case.stimuli
    for replay in (case.name, token):
        (verdict,) = api.run(DEVICE, replay=replay).verdicts
        assert verdict.outcome is api.Outcome.PASS


def test_known_deviations_and_choices_are_taken(tmp_path: Path) -> None:
    name, choice = next(iter(api.load(DEVICE).choices.items()))
    way = choice.alternatives[-1].name
    known = tmp_path / "known.toml"
    known.write_text('schema = "ecatspec-known/1"\ndevice = "another"\n')
    result = api.run(DEVICE, depth="quick", only=["al"], choices={name: way})
    assert result.verdicts
    with pytest.raises(api.UserError, match="known"):
        api.run(DEVICE, known=str(known))


def test_vectors_are_written_and_played(tmp_path: Path) -> None:
    file = tmp_path / "vectors.json"
    with file.open("wb") as out:
        api.export_vectors(DEVICE, out, depth="quick", only=["al"])
    result = api.replay_vectors(file)
    assert {verdict.outcome for verdict in result.verdicts} == {api.Outcome.PASS}


def test_a_capture_is_judged(tmp_path: Path) -> None:
    import dpkt  # noqa: PLC0415  only this test needs it

    wire = Wire(wire_format(api.Model(api.load(DEVICE))))
    sent = wire.frame(
        bytes.fromhex("020000000001"), [Datagram(COMMANDS["APRD"], 1, 0, 0x130, bytes(2), 0)]
    )
    back = wire.frame(
        wire.marked(bytes.fromhex("020000000001")),
        [Datagram(COMMANDS["APRD"], 1, 1, 0x130, b"\1\0", 1)],
    )
    file = tmp_path / "one.pcap"
    with file.open("wb") as out:
        writer = dpkt.pcap.Writer(out)
        for number, frame in enumerate((sent, back)):
            writer.writepkt(frame.ljust(60, b"\0"), ts=number / 1000)
    (result,) = api.monitor(file, DEVICE)
    assert api.Outcome.FAIL not in {verdict.outcome for verdict in result.verdicts}
    file.write_bytes(b"no capture")
    with pytest.raises(api.UserError, match="capture"):
        api.monitor(file)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: api.run("refrence"), "reference"),
        (lambda: api.run(DEVICE, depth="fast"), "no depth is called 'fast'"),
        (lambda: list(api.cases(api.Model(api.load(DEVICE)), depth="all")), "no depth"),
        (lambda: api.report([], api.load(DEVICE), "pdf"), "no form of report is called 'pdf'"),
        (lambda: api.export_vectors(DEVICE, io.BytesIO(), form="xml"), "no form of vectors"),
        (lambda: api.export_vectors(DEVICE, io.BytesIO(), depth="no"), "no depth"),
    ],
)
def test_what_is_wrong_is_one_line(call: Callable[[], object], words: str) -> None:
    with pytest.raises(api.UserError, match=words) as raised:
        call()
    assert "\n" not in str(raised.value)
