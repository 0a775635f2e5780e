"""Judges a capture, with one oracle for each SubDevice in it."""

from __future__ import annotations

import time
from collections import Counter, deque
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from ecatspec.conformance.base.devices import load
from ecatspec.conformance.base.verdict import (
    ADVISED,
    MAIN_DEVICE,
    REASON,
    SUB_DEVICE,
    UNEXPLAINED,
    Outcome,
    Result,
    TraceLine,
    Verdict,
)
from ecatspec.conformance.capture.transactions import Capture
from ecatspec.conformance.run.coverage import extent_of
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.memo import once
from ecatspec.model.core.register_map import SYNC_MANAGERS, field_of
from ecatspec.model.core.wording import message_words, register_words, typed_words
from ecatspec.model.esc.wire import wire_format
from ecatspec.model.oracle.explanations import Exchange, Loose, Mismatch
from ecatspec.model.oracle.oracle import Oracle
from ecatspec.spec.language.ir import Level

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from ecatspec.conformance.capture.segment import Transaction
    from ecatspec.model.core.state import RuleName
    from ecatspec.model.oracle.expansion import Explanations

_MICROSECONDS = 1_000_000
_REMEMBERED = 12
_LONGEST = ("safeop_timeout", "preop_timeout", "back_timeout", "response_timeout")
"""Parameters: the longest that a device may take for what it was asked."""
_TOO_MANY = 64
"""Explanations after a gap; beyond, each exchange takes long and tells little."""
_REMEMBERED_TO_ALL = 64
"""Maximum number of earlier broadcast writes that a newly seen SubDevice is given."""


@dataclass(slots=True)
class Follower:
    """What is known of one SubDevice of the capture."""

    model: Model
    oracle: Oracle
    verdicts: list[Verdict] = field(default_factory=list)
    rules: set[RuleName] = field(default_factory=set)
    recent: deque[TraceLine] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))
    path: list[str] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)
    """Why requests were refused, with the frame that showed it."""
    accidents: list[str] = field(default_factory=list)
    """What happened in the device without a request, with the frame that showed it."""
    messages: Counter[str] = field(default_factory=Counter)
    exchanges: int = 0
    lost: int = 0
    """Accesses whose return was not captured: a request has working counter 0."""
    unclear: int = 0
    """Accesses that came back with a working counter that does not say whose part was done."""
    first_unclear: str = ""
    """The frame and the working counter of the first of them."""
    gaps: list[int] = field(default_factory=list)
    """Frames before which others are missing."""
    settled: int = -1
    """Until when (us) the device may still do what it was asked in the last gap."""
    unfollowed: int = 0
    """Exchanges after a gap before the state and the mailbox were known again."""
    _advised: set[str] = field(default_factory=set)
    """The signatures of the advice that was given already."""
    _shown: str = ""
    _failed: bool = False
    """Whether the state seen last has an error: only then the AL status code says something."""
    _code: str = ""
    """The AL status code seen last in that state."""
    _told: tuple[str, ...] = ()
    """The reasons after the last look."""
    _starts: dict[str, int | None] = field(default_factory=dict)
    _starts_of: Explanations | None = None
    """The explanations by which the mailboxes begin there."""
    _known: Explanations | None = None
    """The explanations after the last look: the same again tell nothing new."""

    def begin_after(self, transaction: Transaction) -> None:
        """Take in what was written to all before anything was seen of this one."""
        if transaction.confirmed and transaction.done:
            self.oracle.holding(_exchange(transaction))

    def miss(self, frames: list[int], time: float) -> None:
        """Take it that anything may have been exchanged before these frames, until then (s)."""
        self.gaps += frames
        self._lose(round(time * _MICROSECONDS))

    def _lose(self, moment: int) -> None:
        """Go on without what was known until then (us)."""
        longest = max(map(self.model.parameter, _LONGEST))
        self.settled = moment + longest
        self.oracle.unknown(missed=True)
        self._known = None
        self._told = ()

    def _is_open(self) -> bool:
        candidates = self.oracle.candidates
        return len(self.oracle.known.al_states()) > 1 or any(
            each.loose is Loose.ALL for each in candidates
        )

    def follow(self, transaction: Transaction) -> None:
        """Judge one access; after a mismatch go on from what it showed."""
        exchange = _exchange(transaction)
        if not transaction.confirmed:
            if transaction.working_counter:
                self.unclear += 1
                counter = f"{transaction.working_counter} in {exchange.reference}"
                self.first_unclear = self.first_unclear or counter
            else:
                self.lost += 1
            self.oracle.perhaps(exchange)
            return
        self.exchanges += 1
        self.unfollowed += bool(self.gaps) and self._is_open()
        self._remember(exchange)
        mismatch = self.oracle.observe(exchange)
        if mismatch is not None and exchange.time <= self.settled:
            # it may be what was asked in the gap
            self.oracle.unknown(missed=True)
            mismatch = self.oracle.observe(exchange)
        for signature in self.oracle.advice.keys() - self._advised:
            self._advised.add(signature)
            self.verdicts.append(self._verdict(self.oracle.advice[signature], ADVISED))
        if mismatch is None and self.oracle.candidates is self._known:
            return
        self.rules |= self.oracle.known.certain_rules()
        reasons = self.oracle.known.reasons() if mismatch is None else mismatch.reasons
        for reason in reasons:
            if reason not in self._told:
                self.reasons.append(f"{reason} ({exchange.reference})")
                self.recent.append(TraceLine(exchange.time, REASON, reason))
        if mismatch is not None:
            self.verdicts.append(self._verdict(mismatch))
            self.oracle.unknown(keep=True)
            self.oracle.observe(exchange)
        else:
            if surprises := self.oracle.known.surprises():
                what = f"{' or '.join(surprises)} by itself ({exchange.reference})"
                self.accidents.append(what)
                self.recent.append(TraceLine(exchange.time, SUB_DEVICE, what))
            self.oracle.forget_history()
        self._known = self.oracle.candidates
        self._told = self.oracle.known.reasons()
        if self.gaps and len(self.oracle.candidates) > _TOO_MANY:
            self._lose(exchange.time)

    def _remember(self, exchange: Exchange) -> None:
        if not exchange.working_counter:
            return
        words, data = self._words(exchange)
        if words and words != self._shown:
            self._shown = words
            who = MAIN_DEVICE if exchange.write else SUB_DEVICE
            said = f"{words} ({exchange.reference})"
            self.recent.append(TraceLine(exchange.time, who, said, data))

    def _words(self, exchange: Exchange) -> tuple[str, bytes]:
        """Give what an exchange says, and the bytes of a message."""
        said, state = _said(self.model, exchange.write, exchange.address, exchange.data)
        self._follow_path(state, exchange.reference)
        if exchange.address != self._start(SYNC_MANAGERS[0 if exchange.write else 1]):
            return said, b""
        message = self.model.decode(exchange.data)
        if message is None:
            return said, b""
        self.messages[message.frame] += 1
        words = message_words(self.model, message)
        return f"{said}; {words}" if said else words, exchange.data[
            : self.model.codec.length(message)
        ]

    def _follow_path(self, seen: _Seen, reference: str) -> None:
        """Take in a state, and the AL status code where the state has an error."""
        if seen.status:
            self._failed = seen.error
            if not (self.path and self.path[-1].startswith(seen.status)):
                self.path.append(f"{seen.status} ({reference})")
                self._code = ""
        if self._failed and seen.code and seen.code != self._code:
            self._code = seen.code
            self.path[-1] += f", AL status code {seen.code} ({reference})"

    def _start(self, name: str) -> int | None:
        """Give where a mailbox begins."""
        if self._starts_of is not self.oracle.candidates:
            areas = {name: self.oracle.known.area(name) for name in SYNC_MANAGERS}
            self._starts = {name: area and area[0] for name, area in areas.items()}
            self._starts_of = self.oracle.candidates
        return self._starts[name]

    def _verdict(self, mismatch: Mismatch, reason: str = UNEXPLAINED) -> Verdict:
        clauses = self.model.protocol.clauses
        cited = [clauses[name] for name in mismatch.clauses]
        blames = any(clause.level is Level.MUST for clause in cited)
        return Verdict(
            f"monitor/{mismatch.exchange.reference.replace(' ', '_')}",
            Outcome.FAIL if blames else Outcome.WARNING,
            f"{mismatch.subject} at {mismatch.exchange.reference}",
            reason,
            mismatch.expected,
            mismatch.observed,
            mismatch.clauses,
            tuple(dict.fromkeys(claim for clause in cited for claim in clause.claims)),
            tuple(self.recent),
            mismatch.exchange.reference,
            mismatch.signature,
            mismatch.causes,
            differing=mismatch.differing,
            blamed=tuple(map(str, mismatch.rules)),
        )


def _exchange(transaction: Transaction) -> Exchange:
    return Exchange(
        round(transaction.time * _MICROSECONDS),
        transaction.write,
        transaction.address,
        transaction.data,
        transaction.working_counter if transaction.done else 0,
        f"frame {transaction.frame}",
    )


@dataclass(frozen=True, slots=True)
class _Seen:
    """What an access shows of the state of the AL; empty where it shows nothing."""

    status: str = ""
    error: bool = False
    code: str = ""


@once
def _said(model: Model, write: bool, address: int, data: bytes) -> tuple[str, _Seen]:  # noqa: FBT001
    """Give what an access to registers of the AL says in words, and what it shows of the state."""
    parts, seen = [], _Seen()
    for name in ("al_control", "al_status", "al_status_code"):
        register = model.protocol.registers[name]
        offset = register.address - address
        content = data[offset : offset + register.size] if offset >= 0 else b""
        if not content or write != (name == "al_control"):
            continue
        raw = int.from_bytes(content, "little")
        fields = {
            bits.name: field_of(model.protocol, name, bits.name, raw) for bits in register.fields
        }
        parts.append(register_words(model, name, fields))
        if name == "al_status":
            seen = replace(seen, status=parts[-1], error=bool(fields["error"]))
        elif name == "al_status_code" and raw and len(content) == register.size:
            kinds = {bits.name: bits.type for bits in register.fields}
            seen = replace(seen, code=typed_words(model, kinds["code"], fields["code"]))
    return "; ".join(parts), seen


class _Judge:
    """The SubDevices of a capture, each with its follower."""

    def __init__(self, model: Model, capture: Capture) -> None:
        self._model = model
        self._capture = capture
        self.followers: dict[int, Follower] = {}
        self._to_all: deque[Transaction] = deque(maxlen=_REMEMBERED_TO_ALL)
        self._gaps = 0

    def _follower(self, identity: int) -> Follower:
        if identity not in self.followers:
            oracle = Oracle(self._model)
            oracle.unknown()
            self.followers[identity] = new = Follower(self._model, oracle)
            for earlier in self._to_all:
                new.begin_after(earlier)
        return self.followers[identity]

    def follow(self, transaction: Transaction) -> None:
        """Give an access to the followers of the SubDevices that it reaches."""
        gaps, segment = self._capture.gaps, self._capture.segment
        if len(gaps) > self._gaps:
            for each in self.followers.values():
                each.miss(gaps[self._gaps :], transaction.time)
            self._to_all.clear()
            self._gaps = len(gaps)
        if transaction.device is not None:
            identity = segment.canonical(transaction.device)
            if identity in self.followers or segment.has_answered(transaction.device):
                self._follower(identity).follow(transaction)
        elif transaction.write or len(self.followers) == 1 == segment.size:
            if transaction.write:
                self._to_all.append(transaction)
            for each in self.followers.values():
                each.follow(transaction)


def monitor_file(
    path: Path,
    device: str,
    progress: Callable[[int, int, str], None] | None = None,
) -> tuple[Result, ...]:
    """Judge every SubDevice of a capture against a device text; one result each.

    Where no SubDevice answers, one result says so. A KeyboardInterrupt ends the capture early: the
    results are those of what was read, and `interrupted`.
    """
    began = time.monotonic()
    protocol = load(device)
    model = Model(protocol)
    capture = Capture(path, wire_format(model))
    judge = _Judge(model, capture)
    interrupted = False
    try:
        for number, transaction in enumerate(capture):
            if progress is not None and number % 500 == 0:
                progress(number, 0, f"frame {transaction.frame}")
            judge.follow(transaction)
    except KeyboardInterrupt:
        interrupted = True
    seconds = time.monotonic() - began
    notes = [] if capture.truncated is None else [capture.truncated]
    results = tuple(
        _result(model, capture.segment.name(identity), path, each, seconds, notes)
        for identity, each in sorted(judge.followers.items())
    )
    results = results or (_nothing(model, path, seconds, notes),)
    return tuple(replace(result, interrupted=interrupted) for result in results)


def _nothing(model: Model, path: Path, seconds: float, notes: list[str]) -> Result:
    """Give the result of a capture in which no SubDevice answers."""
    extent = extent_of(model, set(), {})
    reason = "no SubDevice answers in the capture; record the frames after they came back"
    return Result(
        model.protocol.name,
        path.name,
        (Verdict("monitor/nothing", Outcome.INCONCLUSIVE, path.name, reason),),
        extent.rules_covered,
        extent.rules_total,
        extent.clauses_covered,
        extent.clauses_total,
        seconds,
        notes=tuple(notes),
        rules_beyond=extent.rules_beyond,
        clauses_beyond=extent.clauses_beyond,
    )


def _result(
    model: Model, name: str, path: Path, follower: Follower, seconds: float, notes: list[str]
) -> Result:
    extent = extent_of(model, follower.rules, {})
    verdicts = list(follower.verdicts)
    if not verdicts:
        seen = bool(follower.rules)
        verdicts.append(
            Verdict(
                f"monitor/{name}",
                Outcome.PASS if seen else Outcome.INCONCLUSIVE,
                f"SubDevice {name}",
                "" if seen else "the capture shows nothing that a rule speaks of",
            )
        )
    states = "AL: " + " -> ".join(follower.path)
    messages = ", ".join(f"{count} {frame}" for frame, count in sorted(follower.messages.items()))
    lost = f"{follower.lost} accesses whose return was not captured" if follower.lost else ""
    unclear = (
        f"{follower.unclear} accesses whose working counter does not say which SubDevices carried "
        f"them out, first {follower.first_unclear}"
        if follower.unclear
        else ""
    )
    gaps = ""
    if follower.gaps:
        share = follower.unfollowed / max(follower.exchanges, 1)
        count = len(follower.gaps)
        gaps = (
            f"frames are missing at {count} place{'s' if count > 1 else ''}, first before frame "
            f"{follower.gaps[0]}: {share:.0%} of the exchanges could not be followed"
        )
    refused = [f"refused: {reason}" for reason in dict.fromkeys(follower.reasons)]
    shown = (
        f"{follower.exchanges} exchanges",
        states,
        f"mailbox: {messages or 'nothing'}",
        *refused,
        *follower.accidents,
        lost,
        unclear,
        gaps,
    )
    return Result(
        model.protocol.name,
        f"{name} in {path.name}",
        tuple(verdicts),
        extent.rules_covered,
        extent.rules_total,
        extent.clauses_covered,
        extent.clauses_total,
        seconds,
        follower.oracle.known.choices(),
        (*filter(None, shown), *notes),
        rules_beyond=extent.rules_beyond,
        clauses_beyond=extent.clauses_beyond,
    )
