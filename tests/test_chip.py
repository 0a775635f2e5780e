"""Tests the chip of level B in C: it does what the one in Python does, whatever comes."""

from __future__ import annotations

import ctypes
import shutil
from dataclasses import replace
from random import Random
from typing import TYPE_CHECKING, Final, TypeAlias

import pytest
from c_device import SOURCES, build, library

from ecatspec.conformance.adapters import lib, open_adapter
from ecatspec.conformance.adapters.chip_header import BEGIN, END, header
from ecatspec.conformance.adapters.shared_library import HEADERS
from ecatspec.conformance.base.adapter import AdapterError
from ecatspec.conformance.base.devices import load
from ecatspec.conformance.base.verdict import BLAMING
from ecatspec.conformance.run.runner import Runner
from ecatspec.generators.cases.case import NO_LIMITS
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from ecatspec.conformance.base.adapter import Adapter, Description

    Call: TypeAlias = tuple[object, ...]

HEADER: Final = HEADERS / "ecatspec_chip.h"
EXAMPLE: Final = SOURCES.parent / "c_level_b"
ONLY_CHIP: Final = "#include <ecatspec_chip.h>\nint none;\n"
DEVICES: Final = ("standard", "afag-se-power")
"""The second has less memory, and registers of its own."""
SIZE: Final = 0x2000
"""Bytes of memory that both devices have."""
EACH: Final = 29
"""Of the cases of a quick run one in this number is played, with both chips."""

# A stack that reads and writes as its local events say, and tells of that and of each poll.
PUPPET: Final = r"""
#include <ecatspec_chip.h>
#include <stdio.h>
#include <string.h>

static const struct ecatspec_esc *esc;
static char told[1 << 20], order[1 << 17];
static size_t length;

const char *tell(void);
const char *tell(void) { length = 0; return told; }

static void say(const char *what, unsigned number)
{
    length += (size_t)sprintf(told + length, "%s %x %x\n", what, number,
                              (unsigned)esc->al_event(esc->context));
}

static void *create(const struct ecatspec_esc *given) { esc = given; return told; }
static void destroy(void *stack) { (void)stack; }

static void obey(void)
{
    static uint8_t data[0x10000];
    unsigned address, byte;
    int wanted, place, n;
    if (sscanf(order, "read %x %d", &address, &wanted) == 2) {
        esc->pdi_read(esc->context, (uint16_t)address, data, (size_t)wanted);
        for (n = 0; n < wanted; n++) length += (size_t)sprintf(told + length, "%x ", data[n]);
        say("read", (unsigned)n);
    } else if (sscanf(order, "write %x %n", &address, &place) == 1) {
        for (n = 0; sscanf(order + place + 2 * n, "%2x", &byte) == 1; n++) data[n] = (uint8_t)byte;
        esc->pdi_write(esc->context, (uint16_t)address, data, (size_t)n);
        say("written", (unsigned)n);
    }
    order[0] = 0;
}

static void init(void *stack) { (void)stack; order[0] = 0; say("init", 0); }

static void poll(void *stack, uint32_t microseconds)
{
    (void)stack;
    say("poll", microseconds);
    if (strncmp(order, "later ", 6) == 0) memmove(order, order + 6, strlen(order) - 5);
    else obey();
}

static int local(void *stack, const char *event)
{
    (void)stack;
    strcpy(order, event);
    return 0;
}

const struct ecatspec_dut *ecatspec_dut(void)
{
    static const struct ecatspec_stack stack = { create, destroy, init, poll, local };
    static const struct ecatspec_dut dut = { .abi = ECATSPEC_DUT_ABI, .stack = &stack };
    return &dut;
}
"""


class Puppet:
    """One chip with the puppet above it."""

    def __init__(self, file: Path, device: str, poll: str) -> None:
        adapter = lib.make(device, {"path": str(file), "poll": poll})
        assert isinstance(adapter, lib.WholeDevice | lib.BareStack)
        self.adapter = adapter
        self._tell = ctypes.CDLL(str(file)).tell
        self._tell.restype = ctypes.c_char_p
        self._tell()

    def does(self, call: Call) -> tuple[object, bytes]:
        """Give what a call gave, and what the stack told meanwhile."""
        name, *arguments = call
        given = getattr(self.adapter, str(name))(*arguments)
        return given, self._tell()


@pytest.fixture(scope="module")
def puppets(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], tuple[Puppet, ...]]:
    """Both chips for each device, the one in C first, polled at two intervals."""
    folder = tmp_path_factory.mktemp("puppets")
    files = []
    for number in range(len(DEVICES) * 2):  # each has what is static for itself
        made = library(PUPPET, folder / f"c{number}.so")
        other = library(PUPPET, folder / f"python{number}.so", "-DECATSPEC_PYTHON_CHIP")
        files.append((made, other))
    ways = [(device, poll) for device in DEVICES for poll in ("0.001", "0.0003")]
    return {
        way: tuple(Puppet(file, *way) for file in pair)
        for way, pair in zip(ways, files, strict=True)
    }


# --- accesses by chance ---------------------------------------------------------------------------

STARTS: Final = (0x1000, 0x1003, 0x1006, 0x1010, 0x1020, 0x0F80)
REGISTERS: Final = (
    (0x0120, 2),
    (0x0204, 4),
    (0x0220, 4),
    (0x0400, 2),
    (0x0420, 2),
    (0x0440, 2),
    (0x0442, 1),
    (0x0600, 13),
    (0x0805, 27),
    *((0x0800 + 8 * number, 8) for number in range(4)),
    *((0x0800 + 8 * number + at, 1) for number in range(4) for at in (5, 6, 7)),
)
CONTROLS: Final = ((0x26, 0x22), (0x22, 0x26), (0x64, 0x24, 0x20), (0x20, 0x64))


class Chance:
    """Calls by chance: most of them meet the areas that are set up, or their edges."""

    def __init__(self, seed: int) -> None:
        self._random = Random(seed)
        self._areas = [(start, 4) for start in STARTS[:4]]

    def calls(self, count: int) -> Iterator[Call]:
        for number in range(4):
            yield self._set_up(number)
        for _ in range(count):
            yield self._random.choices(self._kinds, (30, 8, 4, 6, 3, 3, 1))[0](self)

    def _set_up(self, number: int) -> Call:
        """Set a SyncManager up as a MainDevice does; settings are taken only while it is off."""
        draw = self._random
        start, length = draw.choice(STARTS), draw.choice((1, 2, 3, 4, 4, 5, 6))
        self._areas[number] = start, length
        control = draw.choice(CONTROLS[number]) if draw.random() < 0.9 else draw.randrange(256)
        data = start.to_bytes(2, "little") + length.to_bytes(2, "little") + bytes((control, 0, 1))
        return "write", 0x0800 + 8 * number, data

    def _change(self) -> Call:
        """Switch a SyncManager off, from either side, or set it up."""
        draw, number = self._random, self._random.randrange(4)
        match draw.randrange(5):
            case 0 | 1:
                return "write", 0x0806 + 8 * number, bytes((draw.randrange(2),))
            case 2 | 3:
                return "local", f"write {0x0807 + 8 * number:x} {draw.randrange(2):02x}"
            case _:
                return self._set_up(number)

    def _area(self) -> Call:
        """Read or write all of an area, a piece at its edges, or somewhat too much."""
        draw = self._random
        start, length = draw.choice(self._areas)
        low = draw.choice((0, 0, 0, 0, draw.randrange(length), length, 2 * length, -1))
        high = draw.choice((length, length, length, length + 1, 3 * length + 1, low + 1))
        return self._access(start + low, max(high - low, 1))

    def _register(self) -> Call:
        at, size = self._random.choice(REGISTERS)
        return self._access(at, size if self._random.random() < 0.7 else 1)

    def _anywhere(self) -> Call:
        return self._access(self._random.randrange(SIZE + 4), self._random.randint(1, 80))

    def _access(self, address: int, length: int) -> Call:
        draw = self._random
        data = draw.randbytes(length)
        if draw.random() < 0.5:
            write = draw.random() < 0.5
            return ("write", address, data) if write else ("read", address, length)
        if address + length > SIZE:  # which is a crash
            return ("reset",)
        order = draw.choice((f"write {address:x} {data.hex()}", f"read {address:x} {length}"))
        return "local", f"later {order}" if draw.random() < 0.1 else order

    def _watchdog(self) -> Call:
        at, most = self._random.choice(((0x0420, 30), (0x0420, 30), (0x0400, 5000)))
        return "write", at, self._random.randrange(most).to_bytes(2, "little")

    def _time(self) -> Call:
        return "advance", self._random.randrange(5000) / 1e6

    def _look(self) -> Call:
        return "read", 0x0800, 32

    _kinds = (_area, _register, _change, _time, _watchdog, _look, _anywhere)


@pytest.mark.parametrize("poll", ["0.001", "0.0003"])
@pytest.mark.parametrize("device", DEVICES)
def test_both_chips_do_the_same(
    device: str, poll: str, puppets: dict[tuple[str, str], tuple[Puppet, ...]]
) -> None:
    for seed in range(60):
        compare(puppets[device, poll], [*Chance(seed).calls(150), ("local", f"read 0 {SIZE}")])


def compare(puppets: tuple[Puppet, ...], calls: Sequence[Call]) -> None:
    """Let both do the same from power-on; an assertion would draw up a comparison for minutes."""
    for call in [("reset",), *calls, ("read", 0, SIZE)]:
        ours, reference = (puppet.does(call) for puppet in puppets)
        if ours != reference:
            pytest.fail(f"{call} gives {ours!r:.200} in C and {reference!r:.200} in Python")


MAIL: Final = ("write", 0x0800, bytes.fromhex("0010060026000100"))
ANSWERS: Final = ("write", 0x0808, bytes.fromhex("1010060022000100"))
OUTPUTS: Final = ("write", 0x0810, bytes.fromhex("0011040064000100"))
INPUTS: Final = ("write", 0x0818, bytes.fromhex("2011050020000100"))
WAYS: Final[dict[str, Sequence[Call]]] = {
    "mailboxes": (
        MAIL,
        ANSWERS,
        ("local", "read 800 20"),
        ("write", 0x1000, b"abcdef"),
        ("write", 0x1000, b"second"),
        ("local", "read 1000 1"),
        ("local", "read 1001 5"),
        ("local", "write 1010 010203040506"),
        ("local", "write 1010 ff"),
        ("read", 0x1010, 6),
        ("read", 0x1010, 6),
        ("local", "write 1010 010203040506"),
        ("local", "write 80f 1"),
        ("read", 0x1010, 6),
        ("local", "write 80f 0"),
        ("read", 0x080D, 1),
        ("write", 0x0806, b"\0"),
        ("write", 0x0806, b"\1"),
        ("write", 0x1000, b"a"),
        ("write", 0x1005, b"f"),
        ("local", "read 1000 6"),
        ("local", "write 804 22"),
        ("local", "write 807 0"),
        ("local", "write 1000 010203040506"),
    ),
    "process data": (
        OUTPUTS,
        INPUTS,
        *(("write", 0x1100, bytes((number,) * 4)) for number in range(5)),
        ("local", "read 1100 2"),
        *(("write", 0x1100, bytes((number,) * 4)) for number in range(7, 10)),
        ("local", "read 1102 2"),
        ("local", "read 1100 4"),
        ("local", "write 1120 0102030405"),
        ("read", 0x1120, 3),
        ("read", 0x0815, 16),
        ("local", "write 1120 0a0b0c0d0e"),
        ("read", 0x1123, 2),
        ("read", 0x1120, 5),
        ("write", 0x1104, b"hidden"),
        ("read", 0x0815, 16),
    ),
    "watchdog": (
        ("write", 0x0420, b"\x0a\0"),
        OUTPUTS,
        ("read", 0x0440, 2),
        ("write", 0x1100, b"outs"),
        ("advance", 0.0009),
        ("write", 0x1100, b"outs"),
        ("read", 0x0440, 2),
        ("advance", 0.0025),
        ("read", 0x0440, 2),
        ("local", "read 220 4"),
        ("local", "read 440 2"),
        ("write", 0x1100, b"outs"),
        ("write", 0x0400, b"\0\0"),
        ("write", 0x1100, b"outs"),
        ("advance", 0.002),
        ("write", 0x0420, b"\0\0"),
        ("read", 0x0440, 2),
        ("write", 0x0420, b"\x0a\0"),
        ("write", 0x0400, b"\xc2\x09"),
        ("write", 0x1100, b"outs"),
        ("write", 0x0420, b"\0\0"),
        ("write", 0x0420, b"\x0a\0"),
        ("read", 0x0440, 2),
        ("advance", 0.002),
    ),
    "power cycle": (
        ("read", 0x0440, 2),
        MAIL,
        OUTPUTS,
        ("write", 0x1000, b"abcdef"),
        ("write", 0x1100, b"outs"),
        ("write", 0x0120, b"\x02\0"),
        ("reset",),
        ("read", 0x0440, 2),
        ("read", 0x1000, 6),
        ("write", 0x1002, b"plain"),
        ("advance", 0.2),
        ("write", 0x0120, b"\x02\0"),
    ),
    "the end of the memory": (
        ("write", SIZE - 1, b"a"),
        ("write", SIZE - 1, b"bc"),
        ("read", SIZE - 1, 1),
        ("read", SIZE - 1, 2),
        ("read", SIZE, 1),
    ),
    "AL Control": (
        ("write", 0x0120, b"\x02\0"),
        ("write", 0x0120, b"\x04\0"),
        ("local", "read 120 2"),
        ("write", 0x0120, b"\x01"),
        ("local", "write 130 0200"),
        ("read", 0x0130, 2),
    ),
    "an area over registers": (
        ("write", 0x0800, bytes.fromhex("800f060026000100")),
        ("write", 0x0F80, b"abcdef"),
        ("local", "read f80 6"),
    ),
    "FMMU": (("write", 0x0600, bytes(range(1, 17))), ("read", 0x0600, 16)),
}


@pytest.mark.parametrize("way", WAYS)
def test_both_chips_do_the_same_on_purpose(
    way: str, puppets: dict[tuple[str, str], tuple[Puppet, ...]]
) -> None:
    """What chance does not come to in each run."""
    for device in DEVICES:
        compare(puppets[device, "0.001"], WAYS[way])


# --- the example ----------------------------------------------------------------------------------


class Kept:
    """An adapter with all that was asked of it, and what it gave."""

    def __init__(self, adapter: Adapter) -> None:
        self._adapter = adapter
        self.calls: list[Call] = []

    def describe(self) -> Description:
        return replace(self._adapter.describe(), batch=False, advance_until=False)

    def reset(self) -> None:
        self.calls.append(("reset",))
        self._adapter.reset()

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        given = self._adapter.read(address, length)
        self.calls.append(("read", address, length, given))
        return given

    def write(self, address: int, data: bytes) -> int:
        given = self._adapter.write(address, data)
        self.calls.append(("write", address, data, given))
        return given

    def advance(self, seconds: float) -> None:
        self.calls.append(("advance", seconds))
        self._adapter.advance(seconds)

    def local(self, event: str) -> None:
        self.calls.append(("local", event))
        self._adapter.local(event)  # type: ignore[attr-defined]

    def close(self) -> None:
        self._adapter.close()


def judged(dut: str, device: str) -> tuple[list[object], list[Call]]:
    adapter = Kept(open_adapter(dut, device))
    try:
        runner = Runner(Model(load(device)), adapter, adapter.describe())
        cases = list(all_cases(runner.model, NO_LIMITS, "quick"))[::EACH]
        verdicts = [runner.executor.judge(case) for case in cases]
    finally:
        adapter.close()
    assert len(verdicts) > 20
    assert not [verdict for verdict in verdicts if verdict.outcome in BLAMING]
    return [*verdicts], adapter.calls


@pytest.mark.parametrize(
    ("file", "sources", "device"),
    [
        ("libthermostat.so", EXAMPLE, str(EXAMPLE / "thermostat.ecs")),
        ("libstack.so", SOURCES, str(SOURCES / "slave.ecs")),
    ],
)
def test_the_examples_behave_alike_with_both_chips(
    file: str, sources: Path, device: str, tmp_path: Path
) -> None:
    goal = "all" if sources == EXAMPLE else "library"
    found = {}
    for chip in ("c", "python"):
        folder = build(tmp_path / chip, goal, f"CHIP={chip}", sources=sources)
        adapter = lib.make(device, {"path": str(folder / file)})
        assert isinstance(adapter, lib.WholeDevice) is (chip == "c")
        adapter.close()
        found[chip] = judged(f"lib:{folder / file}", device)
    assert found["c"] == found["python"]


# --- the header -----------------------------------------------------------------------------------


def test_the_header_has_the_numbers_of_the_texts() -> None:
    """After a change of the texts: `make chip`."""
    text = HEADER.read_text(encoding="utf-8")
    assert header(text) == text
    before, _, rest = text.partition(BEGIN)
    assert "0x0" not in before + rest.partition(END)[2]


@pytest.mark.parametrize("program", ["gcc", "clang"])
@pytest.mark.parametrize("standard", ["c99", "c11", "c++11", "c++17"])
def test_the_header_compiles_without_a_warning(program: str, standard: str, tmp_path: Path) -> None:
    if "++" in standard:
        program = {"gcc": "g++", "clang": "clang++"}[program]
    if shutil.which(program) is None:
        pytest.skip(f"needs {program}")
    strict = ("-Wpedantic", "-Wconversion")
    for options in ((), ("-O2",), ("-DECATSPEC_PYTHON_CHIP",)):
        file = tmp_path / "chip.so"
        library(ONLY_CHIP, file, *strict, *options, standard=standard, program=program)


def test_a_chip_of_other_texts_is_one_line(tmp_path: Path) -> None:
    number = "ECATSPEC_CHIP_ABI, ECATSPEC_CHIP_NUMBERS"
    text = HEADER.read_text(encoding="utf-8")
    for wrong, words in (
        ("ECATSPEC_CHIP_ABI, 1u", "has other registers than 'standard'; build it with the header"),
        ("99, ECATSPEC_CHIP_NUMBERS", "was built with version 99 of ecatspec_chip.h"),
    ):
        chip = text.replace(number, wrong)
        source = PUPPET.replace("#include <ecatspec_chip.h>", chip)
        file = library(source, tmp_path / "lib.so")
        with pytest.raises(AdapterError, match=words) as caught:
            open_adapter(f"lib:{file}", "standard")
        assert "\n" not in str(caught.value)


def test_a_stack_that_cannot_be_created_is_one_line(tmp_path: Path) -> None:
    source = PUPPET.replace("esc = given; return told;", "esc = given; return NULL;")
    file = library(source, tmp_path / "lib.so")
    with pytest.raises(AdapterError, match="`create` of the library gives a null pointer"):
        open_adapter(f"lib:{file}", "standard")
