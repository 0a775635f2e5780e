"""Writes test vectors as a document for people."""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Final, assert_never

from ecatspec.generators.vectors.schema import Full, Local, Mail, Read, Send, Write
from ecatspec.generators.vectors.symbols import words_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from typing import IO

    from ecatspec.generators.vectors.schema import Effect, Expected, Head, Input, Step, Test
    from ecatspec.generators.vectors.symbols import Words

_HOW_TO_READ: Final = """\
- **after** a time: look when it has passed; **within** a time: look again and again, and go on as
  soon as everything expected is there.
- What is not said of a register or message may be anything; `??` is a byte that may be anything,
  of `40/6F` only the bits of 6F count, and bytes behind a message are never compared.
- **ends**: the device went another way that is allowed; the test ends, and counts as passed.
  Anything that is not named is a failure.
- The mailbox counts its messages: a reply has another counter than the one before, unless it says
  **any counter** or **same counter**.
- What follows is said of every form of these tests; names like `in` are those of JSON."""
_UNITS: Final = ((1_000_000, "s"), (1000, "ms"))
_SPECIAL: Final = re.compile(r"([\\`*|\[\]<>])")
"""What means something in Markdown; names with underscores inside stay as they are."""


def write(head: Head, tests: Iterable[tuple[str, Test]], out: IO[bytes]) -> None:
    """Write a document; a test is in memory at a time."""
    words = words_of(head)
    for line in _preamble(head, words):
        out.write(f"{line}\n".encode())
    for layer, group in groupby(tests, key=lambda each: each[0]):
        out.write(f"\n## {_plain(layer)}\n".encode())
        for _, test in group:
            for line in _test(words, test):
                out.write(f"{line}\n".encode())
    for line in _clauses(head):
        out.write(f"{line}\n".encode())


# --- around the tests -----------------------------------------------------------------------------


def _preamble(head: Head, words: Words) -> Iterator[str]:
    made, spec, config = head.generator, head.spec, head.config
    full, mask = config.mailboxFull, config.mailboxFullMask
    yield f"# Test vectors for {_plain(spec.name)}"
    yield f"\n{_plain(spec.title)}\n"
    only = ", ".join(made.only) or "all layers"
    facts = {
        "made by": f"{made.name} {made.version}",
        "depth": f"{made.depth}, {only}, seed {made.seed}",
        "texts": spec.sha256,
        "tests": str(head.numberOfTests),
        "mailbox out": f"{config.mailboxOut.length} bytes at {_address(config.mailboxOut.address)}",
        "mailbox in": f"{config.mailboxIn.length} bytes at {_address(config.mailboxIn.address)}",
        "a message waits": f"bits {mask} at {_address(full.address)}",
        "a request is taken within": _time(config.requestUs),
    }
    if made.mailbox:
        facts["mailbox size"] = made.mailbox
    yield from (f"- {name}: {_plain(fact)}" for name, fact in facts.items())
    yield "\n## How to read this\n"
    yield _HOW_TO_READ
    yield from (f"- {line}" for line in head.header)
    yield from _ways("Choices that the tests take for granted", head.choices)
    yield from _ways("Open choices, and the way that the tests go where they can", head.open)
    if head.guarantee:
        yield "\n## What complete suites promise\n"
        yield from _table("tests", "method", "m", "k", "how it was checked")
        for each in head.guarantee:
            numbers = str(each.m), str(each.k)
            yield _row(*map(_plain, (each.tests, each.method, *numbers, each.checked)))
    if head.notes:
        yield "\n## Flags\n"
        for name, note in head.notes.items():
            yield f"- **{_plain(name)}**: {_plain(note.description)}"
    if config.passOver:
        yield "\n## Messages that may come unasked\n"
        for allowed in config.passOver:
            yield f"- {_plain(words.say_allowed('bytes', allowed))}"


def _ways(title: str, ways: Mapping[str, str]) -> Iterator[str]:
    yield f"\n## {title}\n"
    yield from (f"- {_plain(name)} = {_plain(way)}" for name, way in ways.items())
    if not ways:
        yield "None."


def _clauses(head: Head) -> Iterator[str]:
    if head.clauses:
        yield "\n## Clauses\n"
        yield from _table("clause", "level", "says", "source")
        for name, clause in head.clauses.items():
            yield _row(*map(_plain, (name, clause.level.value, clause.says, clause.source)))


# --- a test ---------------------------------------------------------------------------------------


def _test(words: Words, test: Test) -> Iterator[str]:
    yield f"\n### {test.tcId}. {_plain(test.id)}\n"
    yield f"{_plain(test.comment)}\n"
    facts = {
        "flags": test.flags,
        "needs": test.needs,
        "requires": ["test 1 must have passed"] if test.requires else [],
        "clauses": test.clauses,
    }
    said = [f"- {name}: {_plain(', '.join(every))}" for name, every in facts.items() if every]
    if said:
        yield from said
        yield ""
    yield from _table("step", "what is done", "when to look", "what is expected")
    teller = _Teller(words)
    for number, step in enumerate(test.steps, 1):
        expected = "<br>".join(map(teller.expected, step.expect))
        yield _row(str(number), teller.given(step.given), teller.wait(step), expected)


@dataclass(frozen=True, slots=True)
class _Teller:
    """Says the parts of a step."""

    words: Words

    def given(self, given: Input | None) -> str:
        match given:
            case Write(address, data, symbol, counter, otherwise):
                said = f"write {_address(address)}: {self._data(symbol, data)}"
                wanted = "taken" if counter else "refused"
                if otherwise is None:
                    return said if counter else f"{said}; must be {wanted}"
                other = "refused" if counter else "taken"
                return f"{said}; may be {other}{_effect(otherwise)}"
            case Send(_, data, symbol):
                return f"send {self._data(symbol, data)}"
            case Local(event):
                return f"make {_plain(event)} happen"
            case None:
                return "only look"
            case _:
                assert_never(given)

    def wait(self, step: Step) -> str:
        said = "at once"
        if step.us:
            said = f"{'within' if step.early else 'after'} {_time(step.us)}"
        if step.cycle is None:
            return said
        data = self._data("process_data", step.cycle.data)
        every = f"{data} written to {_address(step.cycle.address)} every {_time(step.cycle.us)}"
        return f"{said}, with {every}"

    def expected(self, expected: Expected) -> str:
        match expected:
            case Read():
                said = f"**read {_address(expected.address)}, {expected.length} bytes**: "
                ways = self._ways(expected)
                if expected.refused is not None:
                    ways.append(f"refused{_effect(expected.refused)}")
            case Mail():
                said = "**message**: "
                ways = self._ways(expected)
                if expected.none is not None:
                    ways.append(f"none{_effect(expected.none)}")
                if expected.anyOf and expected.counter != "new":
                    said = f"**message, {expected.counter} counter**: "
            case Full(full, otherwise):
                said = "**mailbox, not read**: "
                ways = ["full" if full else "empty"]
                if otherwise is not None:
                    ways.append(f"{'empty' if full else 'full'}{_effect(otherwise)}")
            case _:
                assert_never(expected)
        if isinstance(expected, Read | Mail) and expected.otherwise is not None:
            ways.append(f"anything else{_effect(expected.otherwise)}")
        return said + "<br>or ".join(ways)

    def _ways(self, expected: Read | Mail) -> list[str]:
        said = (
            f"{_plain(self.words.say_allowed(expected.symbol, each))}{_effect(each.effect)}"
            for each in expected.anyOf
        )
        return list(dict.fromkeys(said))

    def _data(self, symbol: str, digits: str) -> str:
        return _plain(self.words.say(symbol, bytes.fromhex(digits)))


# --- text -----------------------------------------------------------------------------------------


def _effect(effect: Effect) -> str:
    return " (**ends**)" if effect == "ends" else ""


def _table(*names: str) -> Iterator[str]:
    yield _row(*names)
    yield _row(*("---" for _ in names))


def _row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def _plain(text: str) -> str:
    """Give text that means nothing to Markdown."""
    return _SPECIAL.sub(r"\\\1", " ".join(text.split()))


def _time(microseconds: int) -> str:
    for size, unit in _UNITS:
        if microseconds >= size:
            return f"{microseconds / size:.6f}".rstrip("0").rstrip(".") + f" {unit}"
    return f"{microseconds} us"


def _address(address: int) -> str:
    return f"0x{address:04X}"
