"""Judges exchanges: keeps the states that explain all that was exchanged so far.

The oracle sees bus exchanges only (a read or a write of ESC memory with its working counter), so
it judges a test run and a capture alike. It keeps every state that the texts allow; an observation
that none of them allows is a mismatch.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

from msgspec import structs

from ecatspec.model.core.interpreter import afterwards
from ecatspec.model.core.observables import mailbox_area
from ecatspec.model.core.register_map import field_of
from ecatspec.model.core.state import Event
from ecatspec.model.oracle import advice
from ecatspec.model.oracle.cyclic_outputs import fed, widened
from ecatspec.model.oracle.deviations import deviated, is_mail, shown_anywhere
from ecatspec.model.oracle.diagnosis import diagnosed
from ecatspec.model.oracle.expansion import Grown, grown
from ecatspec.model.oracle.explanations import Candidate, Exchange, Loose
from ecatspec.model.oracle.havoc import any_states, unset, warm
from ecatspec.model.oracle.judged import (
    InputsRead,
    MailboxFound,
    MailRefused,
    MessageRead,
    ProcessDataRefused,
    RegisterRead,
)
from ecatspec.model.oracle.knowledge import Knowledge
from ecatspec.model.oracle.reads import (
    left,
    read_full,
    read_inputs,
    read_message,
    read_register,
    registers_inside,
    surprised,
)
from ecatspec.model.oracle.waiting import to_come
from ecatspec.model.oracle.writes import (
    DATA_IN,
    DATA_OUT,
    MAIN_IN,
    MAIN_OUT,
    covers_end,
    having,
    hold_registers,
    write_mailbox,
    write_outputs,
    write_registers,
    written_registers,
)
from ecatspec.spec.language.functions import IMAGE

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.values import ObjectKey
    from ecatspec.model.oracle.expansion import Explanations
    from ecatspec.model.oracle.explanations import Mismatch
    from ecatspec.model.oracle.judged import Contradiction
    from ecatspec.spec.language.ir import Register

_LOOKS: Final = 1024
"""Most looks that showed nothing new that are remembered: inputs may be others in each cycle."""
_SURPRISES: Final = 2
"""How much a device may do by itself, or may happen to it, between two looks."""


@dataclass(slots=True)
class Oracle:
    """The set of candidates for one device and its history of rules."""

    model: Model
    candidates: Explanations = field(default_factory=dict)
    raised: frozenset[str] = frozenset()
    """Local events (`machine.input`) that happen to the device only when they are raised."""
    lost: bool = False
    """Whether there was too much to follow since power-on: next to nothing is known."""
    advice: dict[str, Mismatch] = field(default_factory=dict)
    """What should have been otherwise since power-on, by signature; the device goes on."""
    _written: int = 0
    """When (us) the MainDevice last wrote what the device may still be busy with."""
    _outputs: tuple[Event, ...] = ()
    _suspicion: Mismatch | None = None
    """The first observation since a request that only an accident explains."""
    _grown: Grown | None = None
    """What the candidates grew to when they were looked at last."""
    _overlooking: Explanations | None = None
    """What is left where the last mismatch is overlooked."""
    _right: dict[tuple[int, int], int] = field(default_factory=dict)
    """Rules that every explanation had gone by when a place was last read and right."""
    _idle: set[tuple[int, bytes, int]] = field(default_factory=set)
    """Reads (address, data, working counter) that showed nothing new of the `_idle_of`."""
    _idle_of: Explanations = field(default_factory=dict)

    @property
    def known(self) -> Knowledge:
        """Give what is known of the device now."""
        return Knowledge(self.model, self.candidates)

    def fork(self) -> Oracle:
        """Give an oracle that goes its own way from here; what it comes to changes nothing here."""
        # looks that showed nothing new are the same for all that have these candidates
        return replace(self, advice=self.advice.copy(), _right=self._right.copy())

    # --- beginnings -------------------------------------------------------------------------------

    def power_on(
        self,
        choices: dict[str, str] | None = None,
        objects: Mapping[ObjectKey, bytes] | None = None,
        *,
        cold: bool = True,
    ) -> None:
        """Begin with a device that was just switched on.

        `choices` are known ways it goes, `objects` values that it is known to have then. One that
        is not `cold` came back to INIT, and what its objects hold is not known.
        """
        state = self.model.initial if cold else warm(self.model)
        for key, value in (objects or {}).items():
            state = state.keeping(key, value)
        for name, alternative in (choices or {}).items():
            state = state.having(self.model.slots[f"choice {name}"], alternative)
        self.candidates = {Candidate(state): ()}
        self.lost = False
        self.advice = {}
        self._suspicion = None
        self._right = {}
        self._written = 0

    def unknown(self, *, keep: bool = False, missed: bool = False) -> None:
        """Go on knowing only the choices of the device; `keep` its registers too.

        After exchanges that were `missed` the mailbox is not taken for the usual one.
        """
        kept = next(iter(self.candidates)).state if keep and self.candidates else None
        if missed:
            kept, self._outputs, self._right = unset(self.model), (), {}
        states = any_states(self.model, self.known.choices() if self.candidates else {}, kept)
        self.candidates = {Candidate(state, loose=Loose.ALL): () for state in states}
        self._suspicion = None

    def expanded(self, time: int, *, surprised: bool = False) -> Explanations:
        """Give all explanations, with inputs served or, until their deadline, not yet.

        With `surprised` also those by which the device did something by itself.
        """
        if surprised:
            other = self.fork()
            other._surprise(time)  # noqa: SLF001  it is one of these
            return other.expanded(time)
        if self._grown is not None and self._grown.of(self.candidates, time):
            return self._grown.found
        found = grown(self.model, self.candidates, time)
        if found is None:
            # too many explanations to follow: nothing is known, so the device is not blamed
            inputs = {
                (*pending.target(), pending.deadline): structs.replace(pending, optional=True)
                for candidate in self.candidates
                for pending in candidate.inbox
            }
            self.unknown(keep=True)
            self.lost = True
            self.candidates = {
                candidate.expecting(tuple(inputs.values())): () for candidate in self.candidates
            }
            # to serve the inputs at once again would show nothing more
            self._grown = Grown(self.candidates, self.candidates, time, time + 1)
            return self.candidates
        self._grown = found if time >= 0 else None
        return found.found

    def to_come(self, time: int, *, unread: bool = False) -> tuple[int, ...]:
        """Give by when (us), from `time` on, each thing must have come that may still come.

        With `unread` replies may lie in the mailbox, and requests behind them.
        """
        return to_come(self.model, self.expanded(time), time, unread=unread)

    # --- one exchange -----------------------------------------------------------------------------

    def observe(self, exchange: Exchange) -> Mismatch | None:
        """Take one exchange into account; give the mismatch, if there is one."""
        self._overlooking = None
        if exchange.write:
            found = self._write(exchange)
            return None if found is None else self._diagnosed(exchange, found)
        look = exchange.address, exchange.data, exchange.working_counter
        grown = self._grown
        if (
            look in self._idle
            and self._idle_of is self.candidates
            and grown is not None
            and grown.of(self.candidates, exchange.time)
        ):
            return None
        mismatch = self._read(exchange)
        if mismatch is None:
            self._right[exchange.span()] = self.known.gone_by()
        if self._grown is not None and self._grown.found is self.candidates and mismatch is None:
            if self._idle_of is not self.candidates or len(self._idle) >= _LOOKS:
                self._idle, self._idle_of = set(), self.candidates
            # only how long a reply may take depends on the time of a look
            if not any(candidate.outbox for candidate in self.candidates):
                self._idle.add(look)
        return mismatch

    def allows(self, exchange: Exchange) -> bool:
        """Take one exchange into account; tell whether it is allowed, without saying why not."""
        if exchange.write:
            return self._write(exchange) is None
        return self._judge(exchange) is None or self._allowed_by_accident(exchange)

    def _diagnosed(self, exchange: Exchange, found: Contradiction) -> Mismatch:
        since = self._right.get(exchange.span(), max(self._right.values(), default=0))
        mismatch, self._overlooking = diagnosed(self.model, exchange, found, since)
        return mismatch

    def _note(self, found: Mismatch | None) -> None:
        """Keep what should have been otherwise."""
        if found is not None:
            self.advice.setdefault(found.signature, found)

    # --- writes -----------------------------------------------------------------------------------

    def _write(self, exchange: Exchange) -> Contradiction | None:
        touched = written_registers(self.model, *exchange.span())
        if touched:
            if exchange.working_counter:
                self._take_written(exchange)
                before = self.expanded(exchange.time)
                self.candidates = write_registers(self.model, before, touched, exchange)
            return None
        return self._write_outputs(exchange) or self._write_mailbox(exchange)

    def _take_written(self, exchange: Exchange) -> None:
        self._written = exchange.time
        self._suspicion = None

    def _write_outputs(self, exchange: Exchange) -> Contradiction | None:
        if not self.known.concerned(DATA_OUT, exchange):
            return None
        before, outputs = self.expanded(exchange.time), self._outputs_of(exchange.data)
        found = write_outputs(self.model, before, exchange, outputs)
        if not found.after:
            return ProcessDataRefused(found.refused, write=True)
        self.candidates = found.after
        return None

    def _outputs_of(self, image: bytes) -> tuple[Event, ...]:
        """Give the inputs that process data are; the same again for the same data."""
        if not self._outputs or self._outputs[0].parameters[IMAGE] != image:
            self._outputs = tuple(
                Event(source.machine, source.input, {IMAGE: image}) for source in self.model.outputs
            )
        return self._outputs

    def _write_mailbox(self, exchange: Exchange) -> Contradiction | None:
        areas = {mailbox_area(self.model, c.state, MAIN_OUT) for c in self.candidates}
        if not any(area and covers_end(area, exchange) for area in areas):
            return None
        recent = exchange.time - self._written <= self.model.parameter("request_timeout")
        before = self.expanded(exchange.time)
        found = write_mailbox(self.model, before, exchange, recent=recent)
        if found.concerned and not found.after:
            return MailRefused(found.refused)
        if found.concerned and exchange.working_counter:
            self._take_written(exchange)
        self.candidates = found.after
        return None

    # --- reads ------------------------------------------------------------------------------------

    def _read(self, exchange: Exchange) -> Mismatch | None:
        found = self._judge(exchange)
        if found is None:
            return None
        if self._allowed_by_accident(exchange):
            if self.known.surprises() and self._suspicion is None:
                self._suspicion = self._diagnosed(exchange, found)
                self._overlooking = None
            return None
        # what was taken for an accident at first was the deviation
        suspicion = self._suspicion if self.known.surprises() else None
        mismatch = self._diagnosed(exchange, found)
        return mismatch if suspicion is None else replace(suspicion, clear=False)

    def _allowed_by_accident(self, exchange: Exchange) -> bool:
        """Tell whether a read is allowed once something happened by itself; go on with that."""
        kept, lost = self.candidates, self.lost
        for _ in range(_SURPRISES):
            self._surprise(exchange.time)
            if self._judge(exchange) is None:
                return True
        self.candidates, self.lost = kept, lost
        return False

    def _surprise(self, time: int) -> None:
        """Go on with what the device may have done by itself too; forks work it out once."""
        before, known = self.expanded(time), self._grown
        if known is None or known.found is not before:
            self.candidates = surprised(self.model, before, time, self.raised)
            return
        if time not in known.surprised:
            self.candidates = surprised(self.model, before, time, self.raised)
            self.expanded(time)
            if self._grown is None or self._grown.source is not self.candidates:
                return  # too many to follow
            known.surprised[time] = self._grown
        self._grown = known.surprised[time]
        self.candidates = self._grown.source

    def _judge(self, exchange: Exchange) -> Contradiction | None:
        """Judge a read by what was asked of the device; it did nothing by itself."""
        found = self._judge_inputs(exchange)
        if found is not None:
            return found
        if not exchange.working_counter:
            area = self.known.area(MAIN_IN)
            if area is None or not covers_end(area, exchange):
                return None
            return self._judge_full(exchange.time, full=False)
        inside = registers_inside(self.model, *exchange.span())
        for register in inside:
            found = self._judge_register(register, exchange)
            if found is not None:
                return found
        return None if inside else self._judge_mailbox(exchange)

    def _judge_inputs(self, exchange: Exchange) -> Contradiction | None:
        if not self.known.concerned(DATA_IN, exchange):
            return None
        found, words = read_inputs(self.model, self.expanded(exchange.time), exchange)
        if not found.after:
            if not exchange.working_counter:
                return ProcessDataRefused(found.refused, write=False)
            return InputsRead(found.refused, words)
        self.candidates = found.after
        self._note(advice.of_inputs(self.known, exchange))
        return None

    def _judge_register(self, register: Register, exchange: Exchange) -> Contradiction | None:
        offset = register.address - exchange.address
        raw = int.from_bytes(exchange.data[offset : offset + register.size], "little")
        if register.name == f"{MAIN_IN}_status":
            full = bool(field_of(self.model.protocol, register.name, "full", raw))
            return self._judge_full(exchange.time, full=full)
        if not self.model.views[register.name]:
            return None
        before = self.expanded(exchange.time)
        after = read_register(self.model, before, register, raw)
        if not after:
            return RegisterRead(before, register, raw)
        self.candidates = after
        for each in advice.of_register(self.known, register, raw, exchange):
            self._note(each)
        return None

    def _judge_full(self, time: int, *, full: bool) -> Contradiction | None:
        before = self.expanded(time)
        after = read_full(self.model, before, time, full=full)
        if not after:
            return MailboxFound(before, full)
        self.candidates = after
        return None

    def _judge_mailbox(self, exchange: Exchange) -> Contradiction | None:
        area = self.known.area(MAIN_IN)
        if area is None or not covers_end(area, exchange):
            return None
        data = exchange.data[max(0, area[0] - exchange.address) :][: area[1]]
        message = self.model.decode(data)
        before = self.expanded(exchange.time)
        after = read_message(self.model, before, data, message, exchange.time)
        if not after:
            return MessageRead(before, message)
        self.candidates = after
        return None

    # --- beside the exchanges ---------------------------------------------------------------------

    def happened(self, machine: str, event: str, time: int) -> None:
        """Take it that somebody made this local event happen to the device."""
        self.candidates = {
            having(self.model, candidate, Event(machine, event, {}), time): history
            for candidate, history in self.expanded(time).items()
        }

    def holding(self, exchange: Exchange) -> None:
        """Take it that registers hold what was written; what the device made of it is not known."""
        self.candidates = hold_registers(self.model, self.candidates, exchange)

    def perhaps(self, exchange: Exchange) -> None:
        """Take it that the device may have got this, and nobody saw what it answered.

        A reply that was perhaps read may be gone; of a write but for outputs nothing is known.
        """
        if not exchange.write:
            self._perhaps_read(exchange)
        elif self.known.concerned(DATA_OUT, exchange):
            outputs = self._outputs_of(exchange.data)
            unfed = list(self.expanded(exchange.time).items())
            with_them = [(fed(self.model, c, outputs, exchange.time), h) for c, h in unfed]
            self.candidates = widened((*self.candidates.items(), *unfed, *with_them))
        else:
            self.unknown()

    def _perhaps_read(self, exchange: Exchange) -> None:
        area = self.known.area(MAIN_IN)
        if area is None or not covers_end(area, exchange):
            return
        after = dict(self.candidates)
        for candidate, history in self.expanded(-1).items():
            after.setdefault(candidate, history)
            if candidate.outbox:
                # the reply is gone, and with it what its fields would have shown
                due, *rest = candidate.outbox
                for taken in afterwards(self.model, candidate.state, due, {}):
                    gone = left(self.model, candidate, taken, tuple(rest), 0)
                    after.setdefault(structs.replace(gone, last=None), history + taken.rules)
        self.candidates = after

    def forget_history(self) -> None:
        """Keep the last rule of each machine, and no accidents: some runs have no end."""
        if not any(
            c.spontaneous or len(h) > len({r.machine for r in h})
            for c, h in self.candidates.items()
        ):
            return
        self._right = {}
        last = {c: {rule.machine: rule for rule in h} for c, h in self.candidates.items()}
        self.candidates = {
            structs.replace(candidate, spontaneous=()): tuple(rules.values())
            for candidate, rules in last.items()
        }

    # --- past a mismatch --------------------------------------------------------------------------

    def overlook(self) -> None:
        """Go on as if the last mismatch, which was clear, had been right."""
        assert self._overlooking is not None
        self.candidates = self._overlooking

    def mismatches(self, exchange: Exchange) -> Iterator[Mismatch]:
        """Yield what each explanation alone makes of an exchange that none of them allows."""
        every, overlooking = self.candidates, self._overlooking
        for candidate, history in every.items():
            self.candidates = {candidate: history}
            found = self._write(exchange) if exchange.write else self._judge(exchange)
            if found is not None:
                yield self._diagnosed(exchange, found)
        self.candidates, self._overlooking = every, overlooking

    def accept(self, exchange: Exchange) -> None:
        """Go on with what the last mismatch showed as what this device does there.

        It may have gone by any rule of what it was asked, or have left it undone, and whatever it
        answered takes the place of the answer that was due. Where none of this leads to what was
        seen, it is in the state that it shows, and at last nothing else is known of it.
        """
        before = {**self.candidates, **self.expanded(exchange.time)}
        self._suspicion = None
        if exchange.write:
            return
        mail = is_mail(self.known, exchange)
        self.candidates = deviated(self.model, before, mail=mail)
        if mail or not exchange.working_counter or self._judge(exchange) is None:
            return
        self.candidates = shown_anywhere(self.known, exchange)
        if self._judge(exchange) is not None:
            self.unknown(keep=True)
            self._judge(exchange)
