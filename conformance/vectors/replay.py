"""Replays test vectors on a device, without the texts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Literal, assert_never

from ecatspec.conformance.base.adapter import (
    AdapterError,
    DeviceCrash,
    DeviceHang,
    DeviceRubbish,
    raise_local,
)
from ecatspec.conformance.base.verdict import Outcome, TraceLine, Verdict
from ecatspec.generators.vectors.schema import Full, Local, Mail, Read, Send, Write

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from ecatspec.conformance.base.adapter import Adapter, Description
    from ecatspec.generators.vectors.schema import (
        Allowed,
        Area,
        Effect,
        Expected,
        Head,
        Input,
        Step,
        Test,
    )

_SECOND: Final = 1_000_000
_FIRST: Final = 500
_SLOWER: Final = 4
"""Each wait for the same is so much longer than the one before."""
_FLOOD: Final = 64
"""More unsolicited messages than a device can have reason for."""


class _End(Exception):  # noqa: N818
    """The test is over: the device went another way that is allowed."""


class _NoEnd(Exception):  # noqa: N818
    """The test is over: message after message comes, and never the one that is waited for."""


class _Fault(Exception):  # noqa: N818
    """The device did what is not allowed: what was expected, what was seen, and of what."""

    def __init__(self, symbol: str, expected: tuple[str, ...], observed: str) -> None:
        super().__init__(observed)
        self.symbol, self.expected, self.observed = symbol, expected, observed


@dataclass(slots=True)
class Player:
    """Plays tests on one device, and judges them by what the file says."""

    head: Head
    adapter: Adapter
    description: Description
    say: Callable[[str, bytes], str]
    """Puts bytes into words, by the name of what they are."""
    configured: bool | None = None
    """Whether the first test showed the configuration that others take for granted."""
    _time: int = 0
    _counter: int | None = None
    _number: int = 0
    _trace: list[TraceLine] = field(default_factory=list)

    def judge(self, test: Test) -> Verdict:
        """Play one test from power-on."""
        reason = self._untried(test)
        skipped = Verdict(test.id, Outcome.SKIPPED, test.comment, reason)
        verdict = skipped if reason else self._judge(test)
        if self.configured is None:
            self.configured = verdict.outcome is Outcome.PASS and not verdict.reason
        return verdict

    def _untried(self, test: Test) -> str:
        if missing := sorted(set(test.needs) - self.description.locals):
            return f"{self.description.name} cannot raise {', '.join(missing)}"
        if test.requires and self.configured is False:
            return "the device is configured in another way than the test takes for granted"
        return ""

    def _judge(self, test: Test) -> Verdict:
        self._time, self._counter, self._trace = 0, None, []
        last: list[str] = []
        try:
            self.adapter.reset()
            for self._number, step in enumerate(test.steps, 1):
                last = step.covers or last
                self._take(step)
        except _End:
            reason = f"went another way in step {self._number}, which is allowed: not tried further"
            return Verdict(test.id, Outcome.PASS, test.comment, reason)
        except _NoEnd:
            reason = f"sends messages without end in step {self._number}: {_FLOOD} were unsolicited"
            return Verdict(test.id, Outcome.INCONCLUSIVE, test.comment, reason)
        except _Fault as fault:
            return self._failure(test, last, fault)
        except (DeviceCrash, DeviceHang, DeviceRubbish) as death:
            died = _Fault(type(death).__name__, ("a device that lives",), str(death))
            return self._failure(test, last, died, Outcome.CRASH)
        except AdapterError as trouble:
            return Verdict(test.id, Outcome.ERROR, test.comment, str(trouble))
        return Verdict(test.id, Outcome.PASS, test.comment)

    def _failure(
        self,
        test: Test,
        rules: Iterable[str],
        fault: _Fault,
        outcome: Outcome | None = None,
    ) -> Verdict:
        names = (*rules, *fault.symbol.split())
        cited = tuple(dict.fromkeys(c for name in names for c in self.head.rules.get(name, [])))
        clauses = cited or tuple(test.clauses)
        levels = {self.head.clauses[name].level for name in clauses if name in self.head.clauses}
        blames = "must" in levels or not levels
        self._told("SubDevice", f"shows {fault.observed}")
        return Verdict(
            test.id,
            outcome or (Outcome.FAIL if blames else Outcome.WARNING),
            test.comment,
            f"step {self._number} of {len(test.steps)}",
            fault.expected,
            fault.observed,
            clauses,
            (),
            tuple(self._trace),
            f"{self._time / 1000:.1f} ms",
            f"{fault.symbol} {' '.join(sorted(clauses))}",
            flag="".join(test.flags[:1]),
        )

    # --- one step ---------------------------------------------------------------------------------

    def _take(self, step: Step) -> None:
        if step.given is not None:
            self._do(step.given)
        waited, wait = 0, _FIRST
        if step.early and not self.description.virtual_time:
            while waited < step.us and not self._is_there(step.expect):
                part = min(wait, step.us - waited)
                self._advance(part, step)
                waited, wait = waited + part, wait * _SLOWER
        else:
            self._advance(step.us, step)
        for expected in step.expect:
            self._look(expected)

    def _do(self, given: Input) -> None:
        match given:
            case Write():
                data = bytes.fromhex(given.data)
                self._told("MainDevice", f"writes {self.say(given.symbol, data)}")
                counter = min(1, self.adapter.write(given.address, data))
                if counter != given.counter:
                    if given.otherwise is None:
                        wanted, seen = (f"working counter {n}" for n in (given.counter, counter))
                        raise _Fault(given.symbol, (wanted,), seen)
                    self._allow(given.otherwise)
            case Send():
                self._send(given)
            case Local():
                self._told("SubDevice", f"has the local event {given.event}")
                raise_local(self.adapter, given.event)
            case _:
                assert_never(given)

    def _send(self, given: Send) -> None:
        data = bytes.fromhex(given.data)
        self._told("MainDevice", f"sends {self.say(given.symbol, data)}")
        whole = data.ljust(self.head.config.mailboxOut.length, b"\0")
        wait, limit = _FIRST, self._time + self.head.config.requestUs
        while not self.adapter.write(given.address, whole):
            if self._time > limit:
                raise _Fault(given.symbol, ("the mailbox takes the request",), "working counter 0")
            self._advance(wait, None)
            wait *= _SLOWER

    def _advance(self, microseconds: int, step: Step | None) -> None:
        cycle = None if step is None else step.cycle
        left = microseconds
        while left > 0:
            part = left if cycle is None else min(cycle.us, left)
            self.adapter.advance(part / _SECOND)
            self._time += part
            left -= part
            if cycle is not None:
                self.adapter.write(cycle.address, bytes.fromhex(cycle.data))

    # --- looking ----------------------------------------------------------------------------------

    def _is_there(self, every: Iterable[Expected]) -> bool:
        """Tell whether all is there that is expected, without taking anything away."""
        for expected in every:
            match expected:
                case Read():
                    counter, data = self.adapter.read(expected.address, expected.length)
                    found = _found(expected.anyOf, data) if counter else None
                    if found is None or found.effect != "passes":
                        return False
                case Mail():
                    return self._is_full() or expected.none == "passes"
                case Full():
                    return self._is_full() == expected.full
                case _:
                    assert_never(expected)
        return True

    def _look(self, expected: Expected) -> None:
        match expected:
            case Read():
                counter, data = self.adapter.read(expected.address, expected.length)
                if counter:
                    self._judge_bytes(expected, data)
                elif expected.refused is None:
                    raise _Fault(expected.symbol, self._words(expected), "working counter 0")
                else:
                    self._allow(expected.refused)
            case Mail():
                self._look_for_mail(expected)
            case Full(full, otherwise):
                seen = self._is_full()
                if seen != full and otherwise is None:
                    words = {True: "mailbox full", False: "mailbox empty"}
                    raise _Fault("reply", (words[full],), words[seen])
                self._allow("passes" if seen == full else otherwise)
            case _:
                assert_never(expected)

    def _look_for_mail(self, expected: Mail) -> None:
        for _ in range(_FLOOD):
            data = self._fetch()
            if data is None:
                effect = expected.none or expected.otherwise
                if effect is None:
                    raise _Fault("reply", self._words(expected), "no reply")
                self._allow(effect)
                return
            asked = _found(expected.anyOf, data) is not None
            counter, before = self._counter_of(data), self._counter
            self._counter = counter
            if not asked and _found(self.head.config.passOver, data) is not None:
                continue
            self._judge_bytes(expected, data)
            if not expected.anyOf:
                continue  # whatever was there is taken away
            if not _counts(expected.counter, counter, before):
                seen = f"counter {counter} after {before}"
                raise _Fault("counter", (f"{expected.counter} counter",), seen)
            return
        if expected.anyOf:
            raise _NoEnd

    def _judge_bytes(self, expected: Read | Mail, data: bytes) -> None:
        found = _found(expected.anyOf, data)
        effect = expected.otherwise if found is None else found.effect
        if effect is None:
            seen = self.say(expected.symbol, data)
            raise _Fault(expected.symbol, self._words(expected), seen)
        self._allow(effect)

    def _allow(self, effect: Effect | None) -> None:
        if effect == "ends":
            raise _End

    def _words(self, expected: Read | Mail) -> tuple[str, ...]:
        every = (self.say(expected.symbol, bytes.fromhex(a.value)) for a in expected.anyOf)
        nothing = ("no reply",) if isinstance(expected, Mail) and expected.none else ()
        return (*dict.fromkeys(every), *nothing)

    def _fetch(self) -> bytes | None:
        if not self._is_full():
            return None
        area = self.head.config.mailboxIn
        counter, data = self.adapter.read(area.address, area.length)
        if not counter:
            return None
        length = self.head.config.mailboxLength
        announced = _number(data[length.address : length.address + length.length])
        return data[: self.head.config.mailboxHead + announced]

    def _is_full(self) -> bool:
        return bool(self._bits(self.head.config.mailboxFull, self.head.config.mailboxFullMask))

    def _bits(self, area: Area, mask: str) -> int:
        counter, data = self.adapter.read(area.address, area.length)
        return _number(data) & _number(bytes.fromhex(mask)) if counter else 0

    def _counter_of(self, data: bytes) -> int:
        area = self.head.config.mailboxCounter
        part = data[area.address : area.address + area.length]
        return _number(part) & _number(bytes.fromhex(self.head.config.mailboxCounterMask))

    def _told(self, who: str, what: str) -> None:
        self._trace.append(TraceLine(self._time, who, what))


def _counts(wanted: Literal["any", "new", "same"], counter: int, before: int | None) -> bool:
    """Tell whether a counter may follow another: a device sends 0 always, or never."""
    if before is None:
        return True
    if bool(counter) is not bool(before):
        return False
    return {"any": True, "new": counter != before or not counter, "same": counter == before}[wanted]


def _number(data: bytes) -> int:
    return int.from_bytes(data, "little")


def _found(every: Iterable[Allowed], data: bytes) -> Allowed | None:
    """Give the first that the bytes are."""
    return next((allowed for allowed in every if allowed.admits(data)), None)
