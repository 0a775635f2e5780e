"""Writes test vectors as a C header: tables without repetition, and a runner."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import resources
from typing import TYPE_CHECKING, Final, assert_never

from ecatspec.generators.vectors.schema import Full, Local, Mail, Read, Send, Write

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from typing import IO

    from ecatspec.generators.vectors.schema import Allowed, Area, Effect, Expected, Head, Step, Test

_TABLES: Final = "@TABLES@\n"
_PER_LINE: Final = 20
_EFFECTS: Final = {
    None: "ECATSPEC_WRONG",
    "passes": "ECATSPEC_GOES_ON",
    "ends": "ECATSPEC_ENDS",
}
_COUNTERS: Final = {"any": "ECATSPEC_ANY", "new": "ECATSPEC_NEW", "same": "ECATSPEC_SAME"}


def write(head: Head, tests: Iterable[tuple[str, Test]], out: IO[bytes]) -> None:
    """Write one header: `#include` it in one file of a firmware test.

    Equal steps, expectations and bytes are there once, and are in memory meanwhile; the tests are
    not.
    """
    tables = _Tables(head)
    rows = [tables.test(test) for _, test in tests]
    runner = resources.files(__package__).joinpath("runner.h").read_text(encoding="utf-8")
    before, after = runner.split(_TABLES)
    out.write(_preamble(head).encode())
    out.write(before.encode())
    for line in tables.lines(rows):
        out.write(line.encode() + b"\n")
    out.write(after.encode())
    out.write(b"\n#endif\n")


def _preamble(head: Head) -> str:
    choices = "".join(f" *   {name} = {way}\n" for name, way in head.choices.items())
    choices = choices or " *   none\n"
    return (
        "#ifndef ECATSPEC_VECTORS_H\n#define ECATSPEC_VECTORS_H\n"
        f"/* Test vectors for {head.spec.name}, texts {head.spec.sha256}.\n"
        f" * Made by {head.generator.name} {head.generator.version}, depth {head.generator.depth}; "
        "do not edit.\n"
        f" * Choices that the tests take for granted:\n{choices} */\n"
    )


@dataclass(slots=True)
class _Pool:
    """Rows that are kept once."""

    rows: dict[str, int] = field(default_factory=dict)

    def place(self, row: str) -> int:
        return self.rows.setdefault(row, len(self.rows))


@dataclass(slots=True)
class _Tables:
    """The tables of a header while they grow."""

    head: Head
    data: bytearray = field(default_factory=bytearray)
    events: _Pool = field(default_factory=_Pool)
    steps: _Pool = field(default_factory=_Pool)
    order: list[int] = field(default_factory=list)
    longest: int = 1
    _bytes: dict[bytes, int] = field(default_factory=dict)
    _allowed: list[str] = field(default_factory=list)
    _expected: list[str] = field(default_factory=list)
    _groups: dict[tuple[str, ...], int] = field(default_factory=dict)

    def test(self, test: Test) -> str:
        """Give the row of a test, and keep what it needs."""
        first = len(self.order)
        self.order += (self.steps.place(self._step(step)) for step in test.steps)
        return f"{{{_text(test.id)}, {first}, {len(test.steps)}, {int(test.requires)}}}"

    def _step(self, step: Step) -> str:
        kind, counter, otherwise, address, size, data = "LOOK", 1, None, 0, 0, 0
        match step.given:
            case Write(at, content, _, wanted, other):
                kind, counter, otherwise, address = "WRITE", wanted, other, at
                size, data = self._content(content)
            case Send(at, content):
                kind, address = "SEND", at
                size, data = self._content(content)
            case Local(event):
                kind, data = "LOCAL", self.events.place(_text(event))
            case None:
                pass
            case _:
                assert_never(step.given)
        cycle = step.cycle
        cyclic = (0, 0, 0, 0)
        if cycle is not None:
            cyclic = (cycle.us, cycle.address, *self._content(cycle.data))
        expected = self._group(self._expected, tuple(map(self._look, step.expect)))
        clauses = sorted({c for rule in step.covers for c in self.head.rules.get(rule, [])})
        return (
            f"{{ECATSPEC_{kind}, {counter}, {_EFFECTS[otherwise]}, {address}, {size}, {data}, "
            f"{step.us}, {cyclic[0]}, {cyclic[1]}, {cyclic[2]}, {cyclic[3]}, "
            f"{expected}, {len(step.expect)}, {_text(' '.join(clauses)) if clauses else 'NULL'}}}"
        )

    def _look(self, expected: Expected) -> str:
        match expected:
            case Read():
                self.longest = max(self.longest, expected.length)
                return self._row(
                    "READ",
                    _EFFECTS[expected.refused],
                    expected.otherwise,
                    "any",
                    (expected.address, expected.length),
                    expected.anyOf,
                )
            case Mail():
                counter, none = expected.counter, _EFFECTS[expected.none]
                return self._row("MAIL", none, expected.otherwise, counter, (0, 0), expected.anyOf)
            case Full():
                full = str(int(expected.full))
                return self._row("FULL", full, expected.otherwise, "any", (0, 0), [])
            case _:
                assert_never(expected)

    def _row(
        self,
        kind: str,
        none: str,
        otherwise: Effect | None,
        counter: str,
        area: tuple[int, int],
        allowed: list[Allowed],
    ) -> str:
        first = self._group(self._allowed, tuple(map(self.allowed, allowed)))
        return (
            f"{{ECATSPEC_{kind}, {none}, {_EFFECTS[otherwise]}, {_COUNTERS[counter]}, "
            f"{area[0]}, {area[1]}, {first}, {len(allowed)}}}"
        )

    def allowed(self, allowed: Allowed) -> str:
        """Give the row of bytes that may be there."""
        size, value = self._content(allowed.value)
        _, mask = self._content(allowed.mask)
        return f"{{{value}, {mask}, {size}, {allowed.atLeast or 0}, {_EFFECTS[allowed.effect]}}}"

    def _group(self, rows: list[str], group: tuple[str, ...]) -> int:
        """Give where rows that follow each other begin."""
        if not group:
            return 0
        key = (str(id(rows)), *group)
        if key not in self._groups:
            self._groups[key] = len(rows)
            rows += group
        return self._groups[key]

    def _content(self, digits: str) -> tuple[int, int]:
        """Give the length of bytes, and where they lie."""
        content = bytes.fromhex(digits)
        if content not in self._bytes:
            self._bytes[content] = len(self.data)
            self.data += content
        return len(content), self._bytes[content]

    # --- text -------------------------------------------------------------------------------------

    def lines(self, tests: list[str]) -> Iterator[str]:
        """Yield the tables."""
        config = self.head.config
        areas = {
            "IN": config.mailboxIn,
            "FULL": config.mailboxFull,
        }
        places = {"LENGTH": config.mailboxLength, "COUNTER": config.mailboxCounter}
        numbers: dict[str, int] = {"TESTS": len(tests)}
        for name, area in areas.items():
            numbers |= {f"{name}_ADDRESS": area.address, f"{name}_LENGTH": area.length}
        for name, area in places.items():
            numbers |= {f"{name}_PLACE": area.address, f"{name}_SIZE": area.length}
        numbers |= {
            "OUT_LENGTH": config.mailboxOut.length,
            "HEAD": config.mailboxHead,
            "FULL_MASK": _mask(config.mailboxFullMask),
            "COUNTER_MASK": _mask(config.mailboxCounterMask),
            "REQUEST_US": config.requestUs,
            "PASS_OVER": len(config.passOver),
            "LONGEST": self._longest((config.mailboxIn, config.mailboxOut, config.mailboxFull)),
        }
        over = [self.allowed(each) for each in config.passOver]
        yield "enum {"
        yield from (f"    ECATSPEC_{name} = {number}," for name, number in numbers.items())
        yield "};\n"
        content = list(map(str, self.data)) or ["0"]
        yield from _table("uint8_t", "bytes", content, _PER_LINE)
        yield from _table("char *const", "events", list(self.events.rows) or ["NULL"])
        nothing = ["{0}"]
        yield from _table("struct ecatspec_allowed", "pass_over", over or nothing)
        yield from _table("struct ecatspec_allowed", "allowed", self._allowed or nothing)
        yield from _table("struct ecatspec_expected", "expected", self._expected or nothing)
        yield from _table("struct ecatspec_step", "steps", list(self.steps.rows) or nothing)
        yield from _table("uint32_t", "order", list(map(str, self.order)) or ["0"], _PER_LINE)
        yield from _table("struct ecatspec_test", "tests", tests or nothing)

    def _longest(self, areas: Iterable[Area]) -> int:
        return max(self.longest, *(area.length for area in areas))


def _table(kind: str, name: str, rows: list[str], together: int = 1) -> Iterator[str]:
    yield f"static const {kind} ecatspec_{name}[] = {{"
    for first in range(0, len(rows), together):
        yield f"    {', '.join(rows[first : first + together])},"
    yield "};\n"


def _mask(digits: str) -> int:
    return int.from_bytes(bytes.fromhex(digits), "little")


def _text(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'
