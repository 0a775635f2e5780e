"""The only place that judges a capture: one oracle for each SubDevice of it."""

from __future__ import annotations

import time
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ecatspec.conformance.capture.transactions import Capture
from ecatspec.conformance.devices import load
from ecatspec.conformance.verdict import (
    MAIN_DEVICE,
    REASON,
    SUB_DEVICE,
    Outcome,
    Result,
    TraceLine,
    Verdict,
)
from ecatspec.model.candidates import Exchange, Mismatch
from ecatspec.model.compiled import Model
from ecatspec.model.esc import SYNC_MANAGERS, field_of
from ecatspec.model.interpreter import rule_clauses
from ecatspec.model.oracle import Oracle
from ecatspec.model.wire import wire_format
from ecatspec.model.words import message_words, register_words
from ecatspec.spec.language.ir import Level

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from ecatspec.conformance.capture.segment import Transaction
    from ecatspec.model.state import RuleName

_MICROSECONDS = 1_000_000
_REMEMBERED = 12


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
    """What befell the device without a request, with the frame that showed it."""
    messages: Counter[str] = field(default_factory=Counter)
    exchanges: int = 0
    lost: int = 0
    _shown: str = ""

    def follow(self, transaction: Transaction) -> None:
        """Judge one access; after a mismatch go on from what it showed."""
        exchange = Exchange(
            round(transaction.time * _MICROSECONDS),
            transaction.write,
            transaction.address,
            transaction.data,
            transaction.working_counter if transaction.done else 0,
            f"frame {transaction.frame}",
        )
        if not transaction.confirmed:
            self.lost += 1
            if transaction.write:
                self.oracle.perhaps_written(exchange)
            else:
                self.oracle.perhaps_read(transaction.address, len(transaction.data))
            return
        self.exchanges += 1
        self._remember(exchange)
        told = self.oracle.reasons()
        mismatch = self.oracle.observe(exchange)
        self.rules |= self.oracle.certain_rules()
        reasons = self.oracle.reasons() if mismatch is None else mismatch.reasons
        for reason in reasons:
            if reason not in told:
                self.reasons.append(f"{reason} ({exchange.reference})")
                self.recent.append(TraceLine(exchange.time, REASON, reason))
        if mismatch is not None:
            self.verdicts.append(self._verdict(mismatch))
            self.oracle.unknown(keep=True)
            self.oracle.observe(exchange)
        else:
            if surprises := self.oracle.surprises():
                what = f"{' or '.join(surprises)} by itself ({exchange.reference})"
                self.accidents.append(what)
                self.recent.append(TraceLine(exchange.time, SUB_DEVICE, what))
            self.oracle.forget_history()

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
        registers = self.model.protocol.registers
        parts = []
        for name in ("al_control", "al_status", "al_status_code"):
            register = registers[name]
            offset = register.address - exchange.address
            content = exchange.data[offset : offset + register.size] if offset >= 0 else b""
            if not content or exchange.write != (name == "al_control"):
                continue
            raw = int.from_bytes(content, "little")
            fields = {
                bits.name: field_of(self.model.protocol, name, bits.name, raw)
                for bits in register.fields
            }
            parts.append(register_words(self.model, name, fields))
            if name == "al_status" and (not self.path or not self.path[-1].startswith(parts[-1])):
                self.path.append(f"{parts[-1]} ({exchange.reference})")
        data = b""
        start = self.oracle.area(SYNC_MANAGERS[0 if exchange.write else 1])
        if start is not None and exchange.address == start[0]:
            message = self.model.decode(exchange.data)
            if message is not None:
                self.messages[message.frame] += 1
                parts.append(message_words(self.model, message))
                data = exchange.data[: self.model.codec.length(message)]
        return "; ".join(parts), data

    def _verdict(self, mismatch: Mismatch) -> Verdict:
        clauses = self.model.protocol.clauses
        cited = [clauses[name] for name in mismatch.clauses]
        blames = any(clause.level is Level.MUST for clause in cited)
        return Verdict(
            f"monitor/{mismatch.exchange.reference.replace(' ', '_')}",
            Outcome.FAIL if blames else Outcome.WARNING,
            f"{mismatch.subject} at {mismatch.exchange.reference}",
            "no state that the texts allow explains the observation",
            mismatch.expected,
            mismatch.observed,
            mismatch.clauses,
            tuple(dict.fromkeys(claim for clause in cited for claim in clause.claims)),
            tuple(self.recent),
            mismatch.exchange.reference,
            mismatch.signature,
            differing=mismatch.differing,
            blamed=tuple(map(str, mismatch.rules)),
        )


def monitor_file(
    path: Path,
    device: str,
    progress: Callable[[int, int, str], None] | None = None,
) -> tuple[Result, ...]:
    """Judge every SubDevice of a capture against a device text; one result each."""
    began = time.monotonic()
    protocol = load(device)
    model = Model(protocol)
    capture = Capture(path, wire_format(model))
    followers: dict[int, Follower] = {}

    def follower(identity: int) -> Follower:
        if identity not in followers:
            oracle = Oracle(model)
            oracle.unknown()
            followers[identity] = Follower(model, oracle)
        return followers[identity]

    for number, transaction in enumerate(capture):
        if progress is not None and number % 500 == 0:
            progress(number, 0, f"frame {transaction.frame}")
        if transaction.device is not None:
            follower(capture.segment.canonical(transaction.device)).follow(transaction)
        elif transaction.write or len(followers) == 1 == capture.segment.size:
            for each in followers.values():
                each.follow(transaction)
    seconds = time.monotonic() - began
    notes = [] if capture.truncated is None else [capture.truncated]
    return tuple(
        _result(model, capture.segment.name(identity), path, each, seconds, notes)
        for identity, each in sorted(followers.items())
    )


def _result(
    model: Model, name: str, path: Path, follower: Follower, seconds: float, notes: list[str]
) -> Result:
    machines = model.protocol.machines.values()
    rules = [rule for machine in machines for rule in machine.rules]
    cited = {c for rule in follower.rules for c in rule_clauses(model, rule)}
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
    refused = [f"refused: {reason}" for reason in dict.fromkeys(follower.reasons)]
    shown = (
        f"{follower.exchanges} exchanges",
        states,
        f"mailbox: {messages or 'nothing'}",
        *refused,
        *follower.accidents,
        lost,
    )
    return Result(
        model.protocol.name,
        f"{name} in {path.name}",
        tuple(verdicts),
        tuple(sorted(str(rule) for rule in follower.rules)),
        len(rules),
        tuple(sorted(cited)),
        len({clause for rule in rules for clause in rule.clauses}),
        seconds,
        follower.oracle.choices(),
        (*filter(None, shown), *notes),
    )
