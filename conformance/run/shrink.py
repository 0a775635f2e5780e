"""Shortens and simplifies a case that fails, as long as it still fails."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final, assert_never

from ecatspec.generators.cases.case import (
    Case,
    Happen,
    Hurry,
    Probe,
    ReadConfiguration,
    ReadInitial,
    ReadRegister,
    Repeat,
    SendFrame,
    SendSegments,
    SetUpProcessData,
    Stimulus,
    StopOutputs,
    Wait,
    WriteOutputs,
    WriteRegister,
    WriteRegisters,
    WriteUntilTaken,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from ecatspec.model.core.values import Value

TRIES: Final = 600
"""Runs of cases at most, the first one among them: some seconds with a virtual device."""


def shortest(case: Case, fails: Callable[[Case], bool], tries: int = TRIES) -> Case:
    """Give a case that fails too, with fewer stimuli after its prelude and simpler values.

    When the tries suffice, leaving out any one stimulus more, or making any one value simpler,
    lets it pass. The same arguments give the same case, as long as `fails` says the same.

    Args:
        case: a case that fails.
        fails: runs a case and tells whether it fails in the same way.
        tries: calls of `fails` at most, 1 or more.

    Raises:
        ValueError: The case does not fail.

    """
    search = _Search(case, fails, tries)
    if not search.fails(case.stimuli):
        raise ValueError(f"the case {case.name} does not fail, so it cannot be made shorter")
    before: tuple[Stimulus, ...] = ()
    while search.best != before and search.left:
        before = search.best
        search.leave_out()
        search.simplify()
    return replace(case, stimuli=search.best)


class _Search:
    """The shortest case so far, and how many tries are left."""

    def __init__(self, case: Case, fails: Callable[[Case], bool], tries: int) -> None:
        self._case = case
        self._fails = fails
        self.left = tries
        self.best = case.stimuli

    def fails(self, stimuli: tuple[Stimulus, ...]) -> bool:
        """Try stimuli, and keep them if they fail; without a try left nothing does."""
        if not self.left:
            return False
        self.left -= 1
        if not self._fails(replace(self._case, stimuli=stimuli)):
            return False
        self.best = stimuli
        return True

    def leave_out(self) -> None:
        """Leave out what can be spared: the later half, the other one, then smaller parts."""
        start = self._case.prelude
        size = max(1, (len(self.best) - start + 1) // 2)
        while size:
            end = len(self.best)
            while end > start:
                begin = max(start, end - size)
                self.fails(self.best[:begin] + self.best[end:])
                end = begin
            size //= 2

    def simplify(self) -> None:
        """Make one stimulus after the other simpler, as far as it goes."""
        for place in range(self._case.prelude, len(self.best)):
            while any(
                self.fails((*self.best[:place], simpler, *self.best[place + 1 :]))
                for simpler in _simpler(self.best[place])
            ):
                pass


def _simpler(stimulus: Stimulus) -> Iterator[Stimulus]:
    """Yield what is like a stimulus and simpler, the simplest first."""
    match stimulus:
        case WriteRegister(fields=fields):
            yield from (replace(stimulus, fields=less) for less in _fewer(fields))
        case WriteRegisters(writes):
            if len(writes) > 1:
                yield from (replace(stimulus, writes=(write,)) for write in writes)
            for place, write in enumerate(writes):
                for less in _fewer(write.fields):
                    one = replace(write, fields=less)
                    yield replace(stimulus, writes=(*writes[:place], one, *writes[place + 1 :]))
        case SendFrame(fields=fields, same_counter=same_counter, unread=unread):
            if same_counter:
                yield replace(stimulus, same_counter=False)
            if unread:
                yield replace(stimulus, unread=False)
            for name, value in fields.items():
                yield from (replace(stimulus, fields={**fields, name: v}) for v in _smaller(value))
        case SetUpProcessData(changes, longer):
            for name in changes:
                yield replace(stimulus, changes={n: c for n, c in changes.items() if n != name})
            yield from (replace(stimulus, longer=less) for less in _fewer(longer))
        case WriteOutputs(words):
            yield from (replace(stimulus, words=less) for less in _fewer(words))
        case Wait(microseconds):
            yield from (Wait(less) for less in _smaller_numbers(microseconds))
        case (
            ReadRegister()
            | SendSegments()
            | Repeat()
            | Probe()
            | ReadInitial()
            | WriteUntilTaken()
            | ReadConfiguration()
            | StopOutputs()
            | Hurry()
            | Happen()
        ):
            pass
        case _:
            assert_never(stimulus)


def _fewer(numbers: Mapping[str, int]) -> Iterator[dict[str, int]]:
    """Yield numbers by name with one left out, or with one smaller."""
    for name, number in numbers.items():
        yield {n: v for n, v in numbers.items() if n != name}
        yield from ({**numbers, name: less} for less in _smaller_numbers(number))


def _smaller(value: Value) -> Iterator[Value]:
    match value:
        case bytes():
            yield from _smaller_bytes(value)
        case int():
            yield from _smaller_numbers(int(value))
        case _:
            pass


def _smaller_numbers(number: int) -> Iterator[int]:
    """Yield numbers nearer to 0: 0, the half, each bit left out, the next one."""
    if number < 0:
        yield from (-less for less in _smaller_numbers(-number))
        return
    found = [
        0,
        number // 2,
        *(number & ~(1 << bit) for bit in reversed(range(number.bit_length()))),
    ]
    yield from (less for less in dict.fromkeys((*found, number - 1)) if 0 <= less < number)


def _smaller_bytes(data: bytes) -> Iterator[bytes]:
    """Yield fewer bytes, then as many with zeros for some."""
    lengths = (0, len(data) // 2, len(data) - 1)
    yield from (data[:length] for length in dict.fromkeys(lengths) if 0 <= length < len(data))
    zeros = (bytes(len(data)), *(data[:at] + b"\0" + data[at + 1 :] for at in range(len(data))))
    yield from (simpler for simpler in dict.fromkeys(zeros) if simpler != data)
