"""The only place for judging: which states explain all that was exchanged with a device so far.

The oracle sees bus exchanges only (a read or a write of ESC memory with its working counter), so
it judges a test run and a capture alike. It keeps every state that the texts allow; an observation
that none of them allows is a mismatch.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import product
from typing import TYPE_CHECKING

from ecatspec.model.blame import Alternative, blame, sizing, strongest_first
from ecatspec.model.candidates import (
    Candidate,
    Exchange,
    Loose,
    Mismatch,
    Pending,
    with_alarms,
)
from ecatspec.model.citations import object_name
from ecatspec.model.compiled import MAILBOX, timers_of
from ecatspec.model.dictionary import size_varies
from ecatspec.model.esc import PROCESS_DATA, SYNC_MANAGERS, field_of
from ecatspec.model.evaluate import Environment
from ecatspec.model.feeding import fed, widened
from ecatspec.model.interpreter import (
    afterwards,
    differing,
    expected_fields,
    fields_with_before,
    forgotten,
    later_fields,
    matches,
    row_of,
    step,
)
from ecatspec.model.once import once
from ecatspec.model.serving import (
    Grown,
    grown,
    is_alive,
    is_idle,
    is_shut,
    may_hold_anything,
    served,
)
from ecatspec.model.shown import (
    advised,
    decided,
    definitely,
    enabled,
    fields_in,
    machines_of,
    mailbox_area,
    odd_words,
    process_area,
    seen,
    shown_fields,
    shown_register,
    words_in,
)
from ecatspec.model.state import Event, Output, RuleName, State
from ecatspec.model.unknowns import any_states, is_open, warm
from ecatspec.model.values import UNKNOWN, Pattern, Value, admits, bits_of, is_any
from ecatspec.model.words import (
    bytes_words,
    fields_words,
    message_words,
    reason_words,
    register_words,
)
from ecatspec.spec.language.ir import Access, Named, Rule
from ecatspec.spec.language.scope import IMAGE, names_in

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
    from collections.abc import Set as AbstractSet

    from ecatspec.model.codec import Message
    from ecatspec.model.compiled import Model
    from ecatspec.model.serving import Explanations
    from ecatspec.model.state import Step
    from ecatspec.model.values import ObjectKey
    from ecatspec.spec.language.ir import Expression, ObjectEntry, Register, Word

MAIN_OUT, MAIN_IN = SYNC_MANAGERS
DATA_OUT, DATA_IN = PROCESS_DATA
MANAGERS = (*SYNC_MANAGERS, *PROCESS_DATA)
_ROUNDS = 16
"""So many things in a row are awaited at most, each of which begins with the one before."""
_LOOKS = 1024
"""So many looks that told nothing are remembered: inputs may be others in each cycle."""
_OWN_REASON = RuleName("sdo", "value_refused")
"""The rule by which a device refuses a value for a reason of its own."""
_REASONS = "told_reason"
"""The table of the abort codes that say of themselves why a value is refused."""
"""Kinds of inputs that come from the MainDevice."""
_VALUE = "value"
_REFUSING = frozenset({"code", "detail"})
"""Fields of frames that refuse what was asked."""
_SURPRISES = 2
"""How much a device may do by itself, or may befall it, between two looks."""


@dataclass(slots=True)
class Oracle:
    """The set of candidates for one device and its history of rules."""

    model: Model
    candidates: Explanations = field(default_factory=dict)
    written: int = 0
    """When the MainDevice last wrote what the device may still be busy with."""
    raised: frozenset[str] = frozenset()
    """Local events (`machine.input`) that befall the device only when they are raised."""
    lost: bool = False
    """Whether there was too much to follow since power-on: next to nothing is known."""
    advice: dict[str, Mismatch] = field(default_factory=dict)
    """What should have been otherwise since power-on, by signature; the device goes on."""
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
    """Reads (address, data, working counter) that told nothing of the candidates `_idle_of`."""
    _idle_of: Explanations = field(default_factory=dict)

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
        self.written = 0

    def unknown(self, *, keep: bool = False) -> None:
        """Go on with a device of which only its choices are known; `keep` its registers too."""
        kept = next(iter(self.candidates)).state if keep and self.candidates else None
        states = any_states(self.model, self.choices() if self.candidates else {}, kept)
        self.candidates = {Candidate(state, loose=Loose.ALL): () for state in states}
        self._suspicion = None

    # --- one exchange -----------------------------------------------------------------------------

    def observe(self, exchange: Exchange) -> Mismatch | None:
        """Take one exchange into account; tell the mismatch, if there is one."""
        self._overlooking = None
        if exchange.write:
            return self._write(exchange)
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
            self._right[exchange.span()] = self._gone_by()
        if self._grown is not None and self._grown.found is self.candidates and mismatch is None:
            if self._idle_of is not self.candidates or len(self._idle) >= _LOOKS:
                self._idle, self._idle_of = set(), self.candidates
            # only how long a reply may take depends on the time of a look
            if not any(candidate.outbox for candidate in self.candidates):
                self._idle.add(look)
        return mismatch

    def _gone_by(self) -> int:
        return min(map(len, self.candidates.values()), default=0)

    def unreadable(self, name: str, exchange: Exchange) -> Mismatch | None:
        """Judge a read that brought no register: one on which a machine rests can be read."""
        register = self.model.protocol.registers[name]
        written = (
            source.origin
            for machine in self.model.protocol.machines.values()
            for source in machine.inputs
            if source.kind == "write"
        )
        if not self.model.views[name] and not any(name in origin for origin in written):
            return None  # what is there beside these depends on the controller
        expected, observed = f"{name}: a value", f"{name}: working counter 0"
        return self._mismatch(exchange, name, (expected,), observed, (), register.clauses)

    def to_come(self, time: int, *, unread: bool = False) -> tuple[int, ...]:
        """Give by when, none of it before `time`, each thing must have come that may still come.

        What should have come before and was not missed when it was looked for cannot come any more.
        With `unread` replies may lie in the mailbox, and requests behind them.
        """
        found: list[int] = []
        for candidate in self.expanded(time):
            if candidate.outbox and not unread:
                found.append(candidate.ready)
            due = self._due(candidate, time)
            behind = bool(candidate.outbox) and unread
            found += [p.deadline for p in due if not (behind and p.event.trail)]
        return tuple(deadline for deadline in found if deadline >= time)

    def settled(self, time: int, *, unread: bool = False) -> bool:
        """Tell whether nothing is to come at `time`."""
        return not self.to_come(time, unread=unread)

    def busy_until(self, time: int) -> int:
        """Give the time by which all is done that a device may be busy with; `time`: nothing is."""
        for _ in range(_ROUNDS):
            deadlines = self.to_come(time)
            if not deadlines:
                break
            time = max(deadlines) + 1
        return time

    def unseen(self, time: int) -> bool:
        """Tell whether a reply must lie in the mailbox since before `time`, and no look missed it.

        So it is where the mailbox cannot be looked at.
        """
        return all(
            candidate.outbox and candidate.ready < time and self._judges_mail(candidate)
            for candidate in self.expanded(time)
        )

    def judges_mail(self) -> bool:
        """Tell whether a message is judged: some explanation says what may come."""
        return any(map(self._judges_mail, self.candidates))

    def _judges_mail(self, candidate: Candidate) -> bool:
        return not candidate.loose and self._alive(candidate.state)

    def open_until(self, time: int) -> int:
        """Give the time by which the AL has done what the texts leave open; `time`: nothing is."""
        return max(
            (
                pending.deadline
                for candidate in self.candidates
                for pending in candidate.inbox
                for taken in step(self.model, candidate.state, pending.event)
                if is_open(self.model, taken)
            ),
            default=time,
        )

    def _due(self, candidate: Candidate, time: int) -> list[Pending]:
        """Give the inputs that may be served now, without what would make no difference."""
        return [
            pending
            for pending in candidate.inbox
            if pending.since <= time
            and not pending.optional
            and not (pending.timer and is_idle(self.model, candidate.state, pending.event))
        ]

    def may_be(self, machine: str, state: str) -> bool:
        """Tell whether a machine may be in a state, by its name."""
        slot = self.model.slots[f"{machine}.state"]
        names = {name: value for value, name in self.model.state_names(machine).items()}
        return any(c.state.slots[slot] == names[state] for c in self.candidates)

    def due_rules(self) -> tuple[RuleName, ...]:
        """Give the rules that may serve the inputs that the device has."""
        return tuple(
            dict.fromkeys(
                rule
                for candidate in self.candidates
                for pending in candidate.inbox
                for taken in step(self.model, candidate.state, pending.event)
                for rule in taken.rules
            )
        )

    def attempted(self, exchange: Exchange) -> tuple[RuleName, ...]:
        """Give the rules that were to serve a write during which the device died."""
        self.observe(exchange)
        return self.due_rules()

    def happened(self, machine: str, event: str, time: int) -> None:
        """Take it that somebody made this local event befall the device."""
        self.candidates = {
            self._having(candidate, Event(machine, event, {}), time): history
            for candidate, history in self.expanded(time).items()
        }

    def reasons(self) -> tuple[str, ...]:
        """Give why the device refused what it was asked last, as far as all explanations agree."""
        return self._reasons(self.candidates)

    def _reasons(self, candidates: Explanations) -> tuple[str, ...]:
        (first, rules), *others = candidates.items()
        return tuple(
            text
            for text in self._reasons_of(first.state, rules)
            if all(text in self._reasons_of(other.state, own) for other, own in others)
        )

    def _reasons_of(self, state: State, history: tuple[RuleName, ...]) -> tuple[str, ...]:
        last = {rule.machine: rule for rule in history}
        own = tuple(rule for rule in last.values() if rule in self.model.reasons)
        return _reasons_of(self.model, state, own) if own else ()

    def example(self) -> State:
        """Give one state that the device may be in."""
        return next(iter(self.candidates)).state

    def process_area(self, name: str) -> tuple[int, int] | None:
        """Give start and length of process data that are switched on, as all candidates agree."""
        areas = {process_area(self.model, candidate.state, name) for candidate in self.candidates}
        return areas.pop() if len(areas) == 1 else None

    def words_in(self, image: bytes) -> tuple[tuple[str, str], ...]:
        """Give the words that inputs hold, by name and in words."""
        return words_in(self.model, self.example(), image)

    def surprises(self) -> tuple[str, ...]:
        """Give what may have befallen the device by itself; nothing: it may be none of it."""
        if not all(candidate.befell for candidate in self.candidates):
            return ()
        return tuple(sorted({name for candidate in self.candidates for name in candidate.befell}))

    def perhaps_read(self, address: int, length: int) -> None:
        """Take it that the MainDevice may have read here: a reply may be gone."""
        area = self.area(MAIN_IN)
        if area is None or not address < area[0] + area[1] <= address + length:
            return
        after = dict(self.candidates)
        for candidate, history in self.expanded(-1).items():
            after.setdefault(candidate, history)
            if candidate.outbox:
                # the reply is gone, and with it what its fields would have told
                due, *rest = candidate.outbox
                for taken in afterwards(self.model, candidate.state, due, {}):
                    left = replace(self._left(candidate, taken, tuple(rest), 0), last=None)
                    after.setdefault(left, history + taken.rules)
        self.candidates = after

    def perhaps_written(self, exchange: Exchange) -> None:
        """Take it that the MainDevice may have written here; but for outputs nothing is known."""
        if not self._concerned(DATA_OUT, exchange):
            self.unknown()
            return
        outputs = self._outputs_of(exchange.data)
        unfed = list(self.expanded(exchange.time).items())
        with_them = [(fed(self.model, c, outputs, exchange.time), h) for c, h in unfed]
        self.candidates = widened((*self.candidates.items(), *unfed, *with_them))

    def forget_history(self) -> None:
        """Keep the last rule of each machine, and no accidents: some runs have no end."""
        if not any(
            c.befell or len(h) > len({r.machine for r in h}) for c, h in self.candidates.items()
        ):
            return
        self._right = {}
        self.candidates = {
            replace(candidate, befell=()): tuple({rule.machine: rule for rule in history}.values())
            for candidate, history in self.candidates.items()
        }

    def area(self, name: str) -> tuple[int, int] | None:
        """Give start and length of a mailbox as far as all candidates agree."""
        areas = {mailbox_area(self.model, candidate.state, name) for candidate in self.candidates}
        return areas.pop() if len(areas) == 1 else None

    def certain_rules(self) -> frozenset[RuleName]:
        """Give the rules that fired in every candidate's history.

        What fired after something that the texts leave open is not sure.
        """
        gaps = self.model.open_gaps
        histories = [
            set(history[: next((n for n, rule in enumerate(history, 1) if rule in gaps), None)])
            for history in self.candidates.values()
        ]
        return frozenset(set.intersection(*histories)) if histories else frozenset()

    def choices(self) -> dict[str, str]:
        """Give the choices on which all candidates agree."""
        ways = ((name, self._ways(name)) for name in self.model.protocol.choices)
        return {name: str(found.pop()) for name, found in ways if len(found) == 1 and all(found)}

    def untold(self) -> frozenset[str]:
        """Give the choices that the device had to make, and nothing told how it did."""
        names = self.model.protocol.choices
        return frozenset(name for name in names if len(self._ways(name) - {None}) > 1)

    def met(self) -> frozenset[str]:
        """Give the choices of which some explanation needs to know how the device goes there."""
        names = self.model.protocol.choices
        return frozenset(name for name in names if self._ways(name) - {None})

    def _ways(self, choice: str) -> set[Value | None]:
        slot = self.model.slots[f"choice {choice}"]
        return {candidate.state.slots[slot] for candidate in self.candidates}

    def most(self, slot: str) -> int:
        """Give the greatest number that a variable may hold, 0 where it is not known."""
        values = (candidate.state.slots[self.model.slots[slot]] for candidate in self.candidates)
        return max((value for value in values if isinstance(value, int)), default=0)

    def broken(self) -> tuple[str, ...]:
        """Give the properties of the texts that some explanation breaks: the texts are wrong."""
        found = (_broken(self.model, candidate.state) for candidate in self.candidates)
        return tuple(dict.fromkeys(name for names in found for name in names))

    def al_states(self) -> frozenset[str]:
        """Give the AL states that the device may be in now (settled or not)."""
        names = self.model.state_names("al")
        slot = self.model.slots["al.state"]
        return frozenset(
            names[value]
            for candidate in self.candidates
            if isinstance(value := candidate.state.slots[slot], int)
        )

    # --- writes -----------------------------------------------------------------------------------

    def _write(self, exchange: Exchange) -> Mismatch | None:
        touched = _written(self.model, *exchange.span())
        if touched:
            if exchange.working_counter:
                self.written = exchange.time
                self._suspicion = None
                self._write_registers(touched, exchange)
            return None
        return self._write_outputs(exchange) or self._write_mailbox(exchange)

    def _write_registers(self, touched: tuple[Register, ...], exchange: Exchange) -> None:
        inputs = [
            (machine.name, source)
            for machine in self.model.protocol.machines.values()
            for source in machine.inputs
            if source.kind == "write" and any(r.name in source.origin for r in touched)
        ]
        glances = _glances(self.model, *exchange.span())
        after: Explanations = {}
        for candidate, history in self.expanded(exchange.time).items():
            state = candidate.state
            parameters: dict[str, Value] = {}
            for register in touched:
                slot = self.model.slots[f"register {register.name}"]
                raw = self._merged(register, state.slots[slot], exchange)
                if register.name in MANAGERS and enabled(
                    self.model, candidate.state, register.name
                ):
                    raw = state.slots[slot] or 0
                parameters |= fields_with_before(register.fields, raw, state.slots[slot])
                state = state.having(slot, raw)
            changed = candidate.having(state)
            if self._alive(state) != self._alive(candidate.state):
                # a mailbox that went, or came back, without a start: nothing is known of it
                lost = forgotten(self.model, state, MAILBOX)
                changed = replace(changed, state=lost, outbox=(), loose=Loose.ALL, last=None)
            looks = tuple(Event(machine, source.name, parameters) for machine, source in inputs)
            for events in _orders(looks, glances):
                found = [changed]
                for event in events:
                    found = self._looking(found, event, exchange.time, spare=event in glances)
                after |= dict.fromkeys(found, history)
        self.candidates = after

    def _looking(
        self, found: list[Candidate], event: Event, time: int, *, spare: bool
    ) -> list[Candidate]:
        """Give the explanations in which the device looks there; it may `spare` itself the look."""
        looking = [
            each
            if spare and any(pending.event == event for pending in each.inbox)
            else self._having(each, event, time)
            for each in found
        ]
        return list(dict.fromkeys((*looking, *found))) if spare else looking

    def _having(self, candidate: Candidate, event: Event, time: int) -> Candidate:
        """Give the explanation in which the device has one input more."""
        pending = self._pending(candidate.state, event, time)
        return candidate if pending is None else candidate.expecting((*candidate.inbox, pending))

    def _pending(self, state: State, event: Event, time: int) -> Pending | None:
        """Give the input with its deadline; None when it changes nothing and has no deadline."""
        steps = step(self.model, state, event)
        within = max(taken.within for taken in steps)
        if any(is_open(self.model, taken) for taken in steps):
            within = max(within, self.model.parameter("settle_time"))
        idle = not within and is_idle(self.model, state, event)
        return None if idle else Pending(event, time + within, within, time)

    def holding(self, exchange: Exchange) -> None:
        """Take it that registers hold what was written; what the device made of it is not known."""
        for register in _written(self.model, *exchange.span()):
            slot = self.model.slots[f"register {register.name}"]
            self.candidates = {
                c.having(
                    c.state.having(slot, self._merged(register, c.state.slots[slot], exchange))
                ): h
                for c, h in self.candidates.items()
            }

    def _merged(self, register: Register, before: Value | None, exchange: Exchange) -> Value:
        covered = range(
            max(register.address, exchange.address),
            min(register.address + register.size, exchange.address + len(exchange.data)),
        )
        if not isinstance(before, int):
            if len(covered) < register.size and register.name.startswith(SYNC_MANAGERS):
                return UNKNOWN
            before = 0
        raw = bytearray(before.to_bytes(register.size, "little"))
        for address in covered:
            raw[address - register.address] = exchange.data[address - exchange.address]
        return int.from_bytes(raw, "little")

    def _concerned(self, name: str, exchange: Exchange) -> bool:
        """Tell whether an access is one to process data, which nothing but a write moves."""
        span = exchange.span()
        return any(process_area(self.model, c.state, name) == span for c in self.candidates)

    def _write_outputs(self, exchange: Exchange) -> Mismatch | None:
        if not self._concerned(DATA_OUT, exchange):
            return None
        after: list[tuple[Candidate, tuple[RuleName, ...]]] = []
        refused: Explanations = {}
        outputs = self._outputs_of(exchange.data)
        for candidate, history in self.expanded(exchange.time).items():
            if process_area(self.model, candidate.state, DATA_OUT) != exchange.span():
                after.append((candidate, history))
            elif exchange.working_counter:
                after.append((fed(self.model, candidate, outputs, exchange.time), history))
            elif self._demanded(candidate, "outputs_demanded"):
                refused[candidate] = history
            else:
                after.append((candidate, history))
        if not after:
            expected = ("the device takes the outputs",)
            clauses = self.model.protocol.definitions["outputs_demanded"].clauses
            observed = "refused: working counter 0"
            by = _alternatives(refused, {"process_data", "al"})
            return self._mismatch(exchange, "outputs", expected, observed, by, clauses)
        self.candidates = widened(after)
        return None

    def _outputs_of(self, image: bytes) -> tuple[Event, ...]:
        """Give the inputs that process data are; the same again for the same data."""
        if not self._outputs or self._outputs[0].parameters[IMAGE] != image:
            self._outputs = tuple(
                Event(source.machine, source.input, {IMAGE: image}) for source in self.model.outputs
            )
        return self._outputs

    def _demanded(self, candidate: Candidate, definition: str) -> bool:
        """Tell whether the texts demand it of a device that has nothing else to do."""
        if any(not pending.timer for pending in candidate.inbox):
            return False
        state = candidate.state
        environment = Environment(state.slots, state.known(), {})
        return self.model.definition(definition)(environment) is True

    def _write_mailbox(self, exchange: Exchange) -> Mismatch | None:
        areas = {mailbox_area(self.model, c.state, MAIN_OUT) for c in self.candidates}
        if not any(area and _covers_end(area, exchange) for area in areas):
            return None
        after: Explanations = {}
        refused: Explanations = {}
        concerned = False
        patience = self.model.parameter("request_timeout")
        recent = exchange.time - self.written <= patience
        for candidate, history in self.expanded(exchange.time).items():
            area = mailbox_area(self.model, candidate.state, MAIN_OUT)
            if area is None or not _covers_end(area, exchange):
                after[candidate] = history
                continue
            concerned = True
            if not exchange.working_counter:
                busy = recent or candidate.inbox or candidate.outbox or candidate.loose
                (after if busy or not self._alive(candidate.state) else refused)[candidate] = (
                    history
                )
                continue
            message = self.model.decode(exchange.data)
            if message is None:
                after[replace(candidate, loose=Loose.ALL)] = history
                continue
            waiting = any(pending.event.trail for pending in candidate.inbox)
            event = self.model.mail(message, crowded=bool(candidate.outbox or waiting))
            pending = self._pending(candidate.state, event, exchange.time)
            inbox = candidate.inbox if pending is None else (*candidate.inbox, pending)
            after[candidate.expecting(inbox)] = history
        if concerned and not after:
            expected = ("the mailbox takes the request",)
            by = _alternatives(refused, {MAILBOX})
            return self._mismatch(
                exchange, "mailbox write", expected, "refused: working counter 0", by
            )
        if concerned and exchange.working_counter:
            self.written = exchange.time
            self._suspicion = None
        self.candidates = after
        return None

    # --- reads ------------------------------------------------------------------------------------

    def _read(self, exchange: Exchange) -> Mismatch | None:
        mismatch = self.judge(exchange)
        if mismatch is None:
            return None
        kept, lost, overlooking = self.candidates, self.lost, self._overlooking
        for _ in range(_SURPRISES):
            self.candidates = self.befallen(exchange.time)
            if self.judge(exchange) is None:
                if self.surprises():
                    self._suspicion = self._suspicion or mismatch
                return None
        self.candidates, self.lost, self._overlooking = kept, lost, overlooking
        # what was taken for an accident at first was the deviation
        if self._suspicion and self.surprises():
            return replace(self._suspicion, clear=False)
        return mismatch

    def befallen(self, time: int) -> Explanations:
        """Give the explanations in which something happened by itself, and those before."""
        found = dict(self.expanded(time))
        for candidate, history in list(found.items()):
            for event in (*self.model.own, *self.model.locals):
                name = f"{event.machine}.{event.input}"
                if name in self.raised or self.model.signature(event):
                    continue
                befell = replace(candidate, befell=(*candidate.befell, name))
                if event in self.model.own:
                    befell = candidate
                pending = Pending(event, time, since=time)
                for left, rules in served(self.model, befell, pending, candidate.inbox):
                    if rules and left.state != candidate.state:
                        found.setdefault(left, history + rules)
        return found

    def judge(self, exchange: Exchange) -> Mismatch | None:
        """Judge a read by what was asked of the device; nothing befell it, nor did it by itself."""
        mismatch = self._read_inputs(exchange)
        if mismatch is not None:
            return mismatch
        if not exchange.working_counter:
            return self._read_empty(exchange)
        inside = _inside(self.model, *exchange.span())
        for register in inside:
            mismatch = self._read_register(register, exchange)
            if mismatch is not None:
                return mismatch
        return None if inside else self._read_mailbox(exchange)

    def _read_register(self, register: Register, exchange: Exchange) -> Mismatch | None:
        offset = register.address - exchange.address
        raw = int.from_bytes(exchange.data[offset : offset + register.size], "little")
        if register.name == f"{MAIN_IN}_status":
            return self._read_full(register, raw, exchange)
        views = self.model.views[register.name]
        if not views:
            return None
        before = self.expanded(exchange.time)
        after: Explanations = {}
        for candidate, history in before.items():
            for state in seen(self.model, register.name, candidate.state, raw):
                after.setdefault(candidate.having(state), history)
        if after:
            self.candidates = _kept(before, after)
            self._advise(register, raw, exchange)
            return None
        allowed = [shown_register(self.model, register, candidate.state) for candidate in before]
        expected = {register_words(self.model, register.name, each): None for each in allowed}
        fields: dict[str, Value] = {
            v.name: field_of(self.model.protocol, register.name, v.name, raw) for v in views
        }
        observed = register_words(self.model, register.name, fields)
        machines = machines_of(self.model, register.name)

        def shown(state: State) -> Mapping[str, Value]:
            return shown_register(self.model, register, state)

        blank = {view.name for view in views if not view.truth and not fields[view.name]}
        # there is no other state of the machine, while a device may have codes of its own
        alien = {
            view.name
            for view in views
            if _shows_state(view.expression)
            for bits in register.fields
            if bits.name == view.name and isinstance(bits.type, Named)
            if fields[view.name]
            not in {row.value for row in self.model.protocol.tables[bits.type.table].rows}
        }
        by = [
            Alternative(
                c,
                led,
                odd,
                register.name,
                blank=blank.issuperset(odd),
                stuck=stuck,
                alien=not alien.isdisjoint(odd),
            )
            for c, h in before.items()
            for odd in [_differing(shown(c.state), fields)]
            for led, stuck in [self._led(c, h, exchange.span(), machines, shown, fields)]
        ]
        refused = {c: h for c, h in before.items() if self._reasons_of(c.state, h)}
        found = self._mismatch(
            exchange, register.name, tuple(expected), observed, by, layouts=(register,)
        )
        odd = [view for view in views if view.name in found.differing]
        if not any(view.truth or _shows_state(view.expression) for view in odd):
            self._overlooking = before
        return replace(
            found,
            reasons=self._reasons(refused) if refused else (),
            clear=self._overlooking is not None,
        )

    def _advise(self, register: Register, raw: int, exchange: Exchange) -> None:
        """Note fields that are not what they should be, whichever explanation holds."""
        found: list[set[str]] = []
        for candidate in self.candidates:
            shown = advised(self.model, register.name, candidate.state)
            odd = {
                view.name
                for view, value in shown
                if not admits(value, bits_of(raw, view.low, view.low + view.width - 1))
            }
            if not odd:
                return
            found.append(odd)
        for name in sorted(set.intersection(*found)):
            bits = next(item for item in register.fields if item.name == name)
            assert bits.shows is not None
            assert bits.shows.advised is not None
            expected = {
                register_words(self.model, register.name, {name: value}): None
                for candidate in self.candidates
                for view, value in advised(self.model, register.name, candidate.state)
                if view.name == name
            }
            shown_ = {name: field_of(self.model.protocol, register.name, name, raw)}
            observed = register_words(self.model, register.name, shown_)
            self._note(
                exchange, register.name, tuple(expected), observed, bits.shows.advised.clauses
            )

    def advise_default(
        self, exchange: Exchange, entry: ObjectEntry, default: bytes, held: bytes
    ) -> None:
        """Note that an entry does not hold its default, where the texts expect that it does."""
        if all(self._demanded(candidate, "defaults_expected") for candidate in self.candidates):
            clauses = self.model.protocol.definitions["defaults_expected"].clauses
            subject = object_name((entry.index, entry.subindex))
            expected = (f"{subject} {entry.name}: {bytes_words(default)}",)
            self._note(exchange, "default", expected, bytes_words(held), clauses)

    def unreasoned(self, abort: Message) -> bool:
        """Tell whether an abort refused a value, and neither a text nor its code says why."""
        told = {row.value for row in self.model.protocol.tables[_REASONS].rows}
        return _last(self.candidates, {_OWN_REASON.machine}) == (_OWN_REASON,) and (
            abort.fields["code"] not in told
        )

    def takes_nothing(self, exchange: Exchange, entry: ObjectEntry, count: int) -> Mismatch:
        """Give the mismatch of an entry that can be written and refuses every value."""
        rows = self.model.protocol.tables[_REASONS].rows
        clauses = dict.fromkeys(clause for row in rows for clause in row.clauses)
        expected = (f"{entry.name} takes what it holds, or another value",)
        observed = f"refused: each of {count} values"
        return self._mismatch(exchange, "writes", expected, observed, (), tuple(clauses))

    def _note(
        self,
        exchange: Exchange,
        subject: str,
        expected: tuple[str, ...],
        observed: str,
        clauses: tuple[str, ...],
    ) -> None:
        found = self._mismatch(exchange, subject, expected, observed, (), clauses)
        self.advice.setdefault(found.signature, found)

    def _read_inputs(self, exchange: Exchange) -> Mismatch | None:
        if not self._concerned(DATA_IN, exchange):
            return None
        after: Explanations = {}
        wrong: Explanations = {}
        words: dict[str, Word] = {}
        before = self.expanded(exchange.time)
        for candidate, history in before.items():
            if process_area(self.model, candidate.state, DATA_IN) != exchange.span():
                after[candidate] = history
            elif exchange.working_counter and not self._keeps_inputs(candidate.state):
                after[candidate] = history  # what lies there is old
            elif exchange.working_counter:
                for state in decided(self.model, candidate.state, exchange.data):
                    odd = odd_words(self.model, state, exchange.data)
                    (wrong if odd else after)[candidate.having(state)] = history
                    words |= odd
            else:
                demanded = self._demanded(candidate, "inputs_demanded")
                (wrong if demanded else after)[candidate] = history
        if after:
            self.candidates = _kept(before, after)
            if exchange.working_counter and all(self._demanded(c, "inputs_denied") for c in after):
                clauses = self.model.protocol.definitions["inputs_denied"].clauses
                self._note(exchange, "inputs", ("no inputs: working counter 0",), "inputs", clauses)
            return None
        if not exchange.working_counter:
            clauses = self.model.protocol.definitions["inputs_demanded"].clauses
            expected = ("the inputs can be read",)
            observed = "refused: working counter 0"
            stopped = _alternatives(wrong, {"process_data", "al"})
            return self._mismatch(exchange, "inputs", expected, observed, stopped, clauses)
        told = (
            register_words(self.model, name, shown_fields(self.model, candidate.state, name))
            for candidate in wrong
            for name in words
        )
        observed = "; ".join(
            said
            for name, said in words_in(self.model, self.example(), exchange.data)
            if name in words
        )
        found = dict(fields_in(self.model, self.example(), exchange.data))
        by = []
        for name in words:
            machines = machines_of(self.model, name)

            def shown(state: State, name: str = name) -> Mapping[str, Value]:
                return shown_fields(self.model, state, name)

            by += [
                Alternative(c, led, odd, name, stuck=stuck)
                for c, h in wrong.items()
                for odd in [_differing(shown(c.state), found[name])]
                if odd
                for led, stuck in [self._led(c, h, exchange.span(), machines, shown, found[name])]
            ]
        return self._mismatch(
            exchange,
            "inputs",
            tuple(dict.fromkeys(told)),
            observed,
            by,
            layouts=tuple(words.values()),
        )

    def _read_full(self, register: Register, raw: int, exchange: Exchange) -> Mismatch | None:
        full = bool(field_of(self.model.protocol, register.name, "full", raw))
        before = self.expanded(exchange.time)
        own = bool(self.model.own)
        after = {
            self._owing(candidate, exchange.time, full=full): history
            for candidate, history in before.items()
            if not (full and self._absent(candidate.state))
            and (
                may_hold_anything(self.model, candidate)
                or (full and bool(candidate.outbox or (own and not self._shut(candidate))))
                or (not full and (not candidate.outbox or exchange.time <= candidate.ready))
            )
        }
        if after:
            self.candidates = _kept(before, after)
            return None
        observed = "mailbox full" if full else "mailbox empty: no reply"
        by = [
            replace(self._due_reply(candidate, output), silent=not full)
            for candidate in before
            for output in candidate.outbox[:1]
        ]
        replies = self._expected_replies(before)
        return self._mismatch(
            exchange, "reply", replies, observed, by or _alternatives(before, {MAILBOX})
        )

    def _owing(self, candidate: Candidate, time: int, *, full: bool) -> Candidate:
        """Give the explanation without what did not come, and did not have to."""
        if full or not candidate.loose:
            return candidate
        if candidate.loose is Loose.ONE and self._shut(candidate):
            return replace(candidate, loose=Loose.NONE)
        gone = candidate.outbox and time > candidate.ready
        return replace(candidate, outbox=()) if gone else candidate

    def _read_empty(self, exchange: Exchange) -> Mismatch | None:
        area = self.area(MAIN_IN)
        if area is None or not _covers_end(area, exchange):
            return None
        register = self.model.protocol.registers[f"{MAIN_IN}_status"]
        return self._read_full(register, 0, exchange)

    def _read_mailbox(self, exchange: Exchange) -> Mismatch | None:
        area = self.area(MAIN_IN)
        if area is None or not _covers_end(area, exchange):
            return None
        data = exchange.data[max(0, area[0] - exchange.address) :]
        data = data[: area[1]]
        message = self.model.decode(data)
        before = self.expanded(exchange.time)
        after: Explanations = {}
        for candidate, history in before.items():
            if message is not None and self._absent(candidate.state):
                continue
            nothing = message is None and self._shut(candidate)
            if nothing or may_hold_anything(self.model, candidate):
                loose = Loose.NONE if candidate.loose is Loose.ONE else candidate.loose
                left = replace(candidate, outbox=candidate.outbox[1:], loose=loose, last=data)
                after[left] = history
            elif message is not None:
                for left, rules in self._taken(candidate, message, exchange.time):
                    after[replace(left, last=data)] = history + rules
        if after:
            self.candidates = after
            return None
        observed = "no message" if message is None else message_words(self.model, message)
        due = [(candidate, candidate.outbox[0]) for candidate in before if candidate.outbox]
        wrong: list[str] = []
        by: list[Alternative] = []
        for candidate, output in due:
            fields: tuple[str, ...] = ()
            if message is not None:
                wrong += self._clauses_of_fields(candidate.state, output, message)
                fields = differing(self.model, candidate.state, output, message)
            each = self._due_reply(candidate, output)
            if message is not None:
                each = replace(
                    each,
                    alien=_is_alien(self.model, output, message),
                    refusing=_refuses(self.model, output.frame)
                    and not _refuses(self.model, message.frame),
                )
            resized = _VALUE in fields and not self._fits(candidate.state, output, message)
            sized = self._holds_any_size(candidate.state, each.entry)
            if sized and _VALUE in fields:
                sizes = sizing(self.model, output.frame, _VALUE)
                fields = tuple(name for name in fields if name not in sizes)
            by.append(replace(each, fields=fields, resized=resized and not sized, sized=sized))
        expected = self._expected_replies(before)
        found = self._mismatch(
            exchange, "reply", expected, observed, by or _alternatives(before, {MAILBOX}), (*wrong,)
        )
        if message is None:
            return found
        beside: list[Mismatch] = []
        if len(found.differing) > 1:
            # each field may have a cause of its own
            found, *beside = (
                self._mismatch(
                    exchange,
                    "reply",
                    expected,
                    observed,
                    [replace(each, fields=(name,)) for each in by if name in each.fields],
                    tuple(wrong),
                )
                for name in found.differing
            )
        if found.differing:
            least = min(len(each.fields) or len(message.fields) for each in by)
            self._overlooking = {
                self._left(each.candidate, taken, each.candidate.outbox[1:], exchange.time): (
                    before[each.candidate] + taken.rules
                )
                for each in by
                if len(each.fields) == least
                for taken in afterwards(
                    self.model, each.candidate.state, each.candidate.outbox[0], message.fields
                )
            }
        return replace(
            found,
            differing=found.differing or (message.frame,),
            clear=bool(self._overlooking),
            beside=tuple(beside),
        )

    def overlook(self) -> None:
        """Go on as if the last mismatch, which was clear, had been right."""
        assert self._overlooking is not None
        self.candidates = self._overlooking

    def mismatches(self, exchange: Exchange) -> Iterator[Mismatch]:
        """Yield what each explanation alone makes of an exchange that none of them allows."""
        every, overlooking = self.candidates, self._overlooking
        for candidate, history in every.items():
            self.candidates = {candidate: history}
            found = self.judge(exchange)
            if found is not None:
                yield found
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
        inside = _inside(self.model, *exchange.span())
        mail = not inside and not self._concerned(DATA_IN, exchange)
        ways = self._answered if mail else self._strayed
        self.candidates = widened(way for each in before.items() for way in ways(*each))
        if mail or not exchange.working_counter or self.judge(exchange) is None:
            return
        self.candidates = {
            candidate.having(state): history
            for candidate, history in self.candidates.items()
            for state in self._shown_in(candidate.state, exchange)
        }
        if self.judge(exchange) is not None:
            self.unknown(keep=True)
            self.judge(exchange)

    def _shown_in(self, state: State, exchange: Exchange) -> Iterator[State]:
        """Yield the states in which machines that an exchange shows may be anywhere."""
        names = [register.name for register in _inside(self.model, *exchange.span())]
        if self._concerned(DATA_IN, exchange):
            names = [name for name, _ in words_in(self.model, state, exchange.data)]
        machines = sorted({each for name in names for each in machines_of(self.model, name)})
        slots = [self.model.slots[f"{machine}.state"] for machine in machines]
        for values in product(*map(self.model.state_names, machines)):
            found = state
            for slot, value in zip(slots, values, strict=True):
                found = found.having(slot, value)
            if not self.model.broken(found):
                yield found

    def _strayed(
        self, candidate: Candidate, history: tuple[RuleName, ...]
    ) -> Iterator[tuple[Candidate, tuple[RuleName, ...]]]:
        """Yield what a device may be that goes on otherwise than an explanation has it."""
        yield from self._answered(candidate, history)
        yield replace(candidate, loose=Loose.ONE), history
        yield candidate.expecting(()), history
        for position, pending in enumerate(candidate.inbox):
            rest = candidate.inbox[:position] + candidate.inbox[position + 1 :]
            for left, rules in served(self.model, candidate, pending, rest, guarded=False):
                yield left, history + rules

    def _answered(
        self, candidate: Candidate, history: tuple[RuleName, ...]
    ) -> Iterator[tuple[Candidate, tuple[RuleName, ...]]]:
        """Yield what a device may be that answered otherwise, or not at all."""
        if not candidate.outbox:
            yield candidate, history
        for output in candidate.outbox[:1]:
            for taken in afterwards(self.model, candidate.state, output, {}):
                left = self._left(candidate, taken, candidate.outbox[1:], 0)
                state = left.state
                for _, into in self.model.replies[output.frame].values():
                    if into is not None:
                        state = state.having(self.model.slots[into], UNKNOWN)
                yield left.having(state), history + taken.rules
                # a refusal may have ended what the answer was a part of
                for name, slot in self.model.slots.items():
                    if name.startswith(f"{output.rule.machine}."):
                        state = state.having(slot, self.model.initial.slots[slot])
                state = self._unsure(state, dict(output.asked).get("index"))
                yield left.having(state), history + taken.rules

    def _unsure(self, state: State, index: Value | None) -> State:
        """Give the state in which it is not known what an object holds."""
        for key in self.model.dictionary.entries:
            if key[0] == index:
                state = state.forgetting(key)
                word = self.model.words.get(key)
                if word is not None:
                    state = state.having(self.model.slots[f"word {word.name}"], UNKNOWN)
        return state

    def _due_reply(self, candidate: Candidate, output: Output) -> Alternative:
        """Give the explanation that a reply is due, with the entry that it speaks of."""
        fields = dict(output.fields)
        index, subindex = fields.get("index"), fields.get("subindex")
        entry = None
        if isinstance(index, int) and isinstance(subindex, int):
            entry = self.model.dictionary.entries.get((index, subindex))
        rules = tuple(dict.fromkeys((*output.chain, output.rule)))
        return Alternative(candidate, rules, layout=output.frame, entry=entry, asked=output.asked)

    def _holds_any_size(self, state: State, entry: ObjectEntry | None) -> bool:
        """Tell whether it is known what an entry holds, and that may be of any size."""
        known = entry is not None and (entry.index, entry.subindex) in state.known()
        return known and entry is not None and size_varies(entry)

    def _fits(self, state: State, output: Output, message: Message | None) -> bool:
        """Tell whether the value of a message is as long as it is to be."""
        expected = expected_fields(self.model, state, output).get(_VALUE)
        held = None if message is None else message.fields.get(_VALUE)
        if not isinstance(held, bytes):
            return True
        if isinstance(expected, bytes):
            return len(held) == len(expected)
        lengths = expected.lengths if isinstance(expected, Pattern) else None
        return lengths is None or lengths[0] <= len(held) <= lengths[1]

    def _led(
        self,
        candidate: Candidate,
        history: tuple[RuleName, ...],
        span: tuple[int, int],
        machines: AbstractSet[str],
        shown: Callable[[State], Mapping[str, Value]],
        observed: Mapping[str, Value],
    ) -> tuple[tuple[RuleName, ...], bool]:
        """Give the rule that the device did not go by, if it shows the state before; else the last.

        And whether it shows that state. It is looked for back to when this was read last and right,
        or anything was. Where these machines did nothing since, it is what became of the outputs.
        """
        recent = history[self._right.get(span, max(self._right.values(), default=0)) :]
        odd = _differing(shown(candidate.state), observed)
        told = False
        for rule in reversed(recent):
            row = row_of(self.model, rule)
            if rule.machine not in machines or not isinstance(row, Rule):
                continue
            asked = _is_asked(self.model, rule)
            if row.target is None or (told and not asked):
                # what it was asked after it had gone by itself tells more
                told = told or asked
                continue
            slot = self.model.slots[f"{rule.machine}.state"]
            names = {name: value for value, name in self.model.state_names(rule.machine).items()}
            for source in row.sources:
                before = shown(candidate.state.having(slot, names[source]))
                demanded = any(not is_any(before[name]) for name in odd)
                if source != row.target and demanded and not _differing(before, observed):
                    return (rule,), True
        own = [rule for rule in history if rule.machine in machines]
        if machines.isdisjoint(rule.machine for rule in recent):
            own = [rule for rule in recent if _takes_outputs(self.model, rule)] or own
        return tuple(own[-1:]), False

    def _clauses_of_fields(self, state: State, output: Output, message: Message) -> Iterator[str]:
        """Give the clauses of the layouts and choices that fields of a reply break."""
        for name in differing(self.model, state, output, message):
            for frame in self.model.codec.trail(output.frame):
                for item in self.model.protocol.frames[frame].fields:
                    if item.name == name:
                        yield from self.model.protocol.frames[frame].clauses
                        for path in () if item.reply is None else names_in(item.reply):
                            choice = self.model.protocol.choices.get(path)
                            yield from () if choice is None else choice.clauses

    def _taken(
        self, candidate: Candidate, message: Message, time: int
    ) -> Iterator[tuple[Candidate, tuple[RuleName, ...]]]:
        """Yield what may be left after the MainDevice read `message`, and the rules that fired."""
        state, outbox = candidate.state, candidate.outbox
        if outbox:
            for taken in matches(self.model, state, outbox[0], message):
                yield self._left(candidate, taken, outbox[1:], time), taken.rules
        # what happens inside the device shows at any time, before what is due
        for source in self.model.own:
            for cause in step(self.model, state, source):
                for output in cause.outputs[:1]:
                    for taken in matches(self.model, cause.state, output, message):
                        left = self._left(candidate, taken, outbox, time)
                        yield left, cause.rules + taken.rules

    def _left(
        self, candidate: Candidate, taken: Step, rest: tuple[Output, ...], time: int
    ) -> Candidate:
        state = step(self.model, taken.state, self.model.fetched)[0].state
        outbox = rest + taken.outputs
        inbox = with_alarms(candidate.inbox, taken, time, time)
        if outbox:
            ready = time + (outbox[0].within or self.model.parameter("response_timeout"))
        else:
            ready = 0
            inbox = tuple(
                replace(p, deadline=max(p.deadline, time + p.within)) if p.event.trail else p
                for p in inbox
            )
        return replace(candidate, state=state, inbox=inbox, outbox=outbox, ready=ready)

    def _expected_replies(self, candidates: Explanations) -> tuple[str, ...]:
        expected: dict[str, None] = {}
        for candidate in candidates:
            if candidate.outbox:
                output = candidate.outbox[0]
                fields = expected_fields(self.model, candidate.state, output)
                fields |= later_fields(self.model, candidate.state, output, fields)[0]
                stated = {n: v for n, v in fields.items() if not is_any(v)}
                expected[fields_words(self.model, output.frame, stated)] = None
            elif not candidate.inbox:
                expected["no reply"] = None
        return tuple(expected)

    # --- helpers ----------------------------------------------------------------------------------

    def expanded(self, time: int) -> Explanations:
        """Give all explanations, with inputs served or, until their deadline, not yet."""
        if self._grown is not None and self._grown.of(self.candidates, time):
            return self._grown.found
        found = grown(self.model, self.candidates, time)
        if found is None:
            # too many explanations to follow: nothing is known, so nobody is blamed
            inputs = {
                (*pending.target(), pending.deadline): replace(pending, optional=True)
                for candidate in self.candidates
                for pending in candidate.inbox
            }
            self.unknown(keep=True)
            self.lost = True
            self.candidates = {
                candidate.expecting(tuple(inputs.values())): () for candidate in self.candidates
            }
            # to serve the inputs at once again would not tell more
            self._grown = Grown(self.candidates, self.candidates, time, time + 1)
            return self.candidates
        self._grown = found if time >= 0 else None
        return found.found

    def _alive(self, state: State) -> bool:
        return is_alive(self.model, state)

    def _shut(self, candidate: Candidate) -> bool:
        return is_shut(self.model, candidate.state)

    def _keeps_inputs(self, state: State) -> bool:
        return definitely(self.model, state, "inputs_valid") is not False

    def _absent(self, state: State) -> bool:
        return definitely(self.model, state, "mailbox_absent") is True

    def _mismatch(
        self,
        exchange: Exchange,
        subject: str,
        expected: tuple[str, ...],
        observed: str,
        alternatives: Iterable[Alternative] = (),
        more: tuple[str, ...] = (),
        layouts: tuple[Register | Word, ...] = (),
    ) -> Mismatch:
        """Give the mismatch, with what was broken.

        `more` clauses are involved too, and those of the `layouts` in which the fields lie.
        """
        found = blame(self.model, alternatives)
        own, fields = ((), ()) if found is None else (found.clauses, found.fields)
        shown = (clause for layout in layouts for clause in _clauses_of(layout, fields))
        clauses = dict.fromkeys(strongest_first(self.model, (*own, *more, *shown)))
        if not clauses:
            # before any rule fired it is the power-on value or the register itself that is broken
            register = subject if subject in self.model.views else f"{MAIN_IN}_status"
            clauses = dict.fromkeys(self.model.protocol.registers[register].clauses)
        if found is None:
            cause: tuple[str, ...] = (subject, *clauses)
            shared = [subject, *clauses]
        else:
            # what a register shows hangs together; where no reply is due, any is one too many
            whole = subject in self.model.views
            due = any(each.layout for each in found.nearest)
            kind = () if whole or fields or not due else (self._kind(observed),)
            cause = (subject, found.demand, *(() if whole else fields), *kind)
            shared = [f"{subject} {found.demand}", *(f"{subject} {c}" for c in found.clauses[:1])]
            if found.by_rule:
                # the same rule, the same fields, the same kind: it went the same way
                odd = " ".join((*fields, *kind))
                shared += [f"{subject} {rule} {odd}" for rule in found.rules[:1]]
        return Mismatch(
            exchange,
            subject,
            expected,
            observed,
            () if found is None else found.rules,
            tuple(clauses),
            " ".join(dict.fromkeys(cause)),
            tuple(dict.fromkeys(shared)),
            differing=fields,
            silent=found is not None and found.nearest[0].silent,
        )

    def _kind(self, observed: str) -> str:
        """Tell of what kind an observation is that is something else altogether."""
        name = observed.partition(":")[0]
        if name not in self.model.protocol.frames:
            return name
        return "refused" if _refuses(self.model, name) else "served"


def _shows_state(shown: Expression) -> bool:
    return any(path.endswith(".state") for path in names_in(shown))


def _kept(before: Explanations, after: Explanations) -> Explanations:
    """Give `after`; where an observation changed nothing, `before`, of which more is known."""
    return before if before.keys() == after.keys() else after


def _differing(expected: Mapping[str, Value], observed: Mapping[str, Value]) -> tuple[str, ...]:
    """Give the fields that are not as expected."""
    return tuple(name for name, value in expected.items() if not admits(value, observed[name]))


def _clauses_of(layout: Register | Word, names: Collection[str]) -> tuple[str, ...]:
    """Give the clauses of a layout and of some of its fields."""
    fields = (field.clauses for field in layout.fields if field.name in names)
    return (*layout.clauses, *(clause for clauses in fields for clause in clauses))


def _alternatives(candidates: Explanations, machines: AbstractSet[str]) -> tuple[Alternative, ...]:
    """Give the explanations that the observation was not, by the last rule of these machines."""
    return tuple(
        Alternative(candidate, _last({candidate: history}, machines))
        for candidate, history in candidates.items()
    )


def _last(candidates: Explanations, machines: AbstractSet[str]) -> tuple[RuleName, ...]:
    """Give the last rule of these machines in each history."""
    own = ([r for r in history if r.machine in machines] for history in candidates.values())
    return tuple(dict.fromkeys(history[-1] for history in own if history))


@once
def _reasons_of(model: Model, state: State, rules: tuple[RuleName, ...]) -> tuple[str, ...]:
    environment = Environment(state.slots, state.known(), {})
    return tuple(
        reason_words(reason.wording, [value(environment) for value in reason.values])
        for rule in rules
        for reason in model.reasons[rule]
        if reason.guard(environment) is True
    )


@once
def _broken(model: Model, state: State) -> tuple[str, ...]:
    return model.broken(state)


@once
def _written(model: Model, address: int, length: int) -> tuple[Register, ...]:
    """Give the registers that a write of the MainDevice touches."""
    return tuple(
        register
        for register in model.protocol.registers.values()
        if register.main is Access.BOTH
        and register.address < address + length
        and address < register.address + register.size
    )


@once
def _glances(model: Model, address: int, length: int) -> tuple[Event, ...]:
    """Give looks at SyncManagers that a write does not touch: one event is there for all."""
    touched = {register.name for register in _written(model, address, length)}
    if not any(name.startswith(MANAGERS) for name in touched):
        return ()
    return tuple(
        Event(machine.name, source.name, {})
        for machine in model.protocol.machines.values()
        for source in machine.inputs
        if source.kind == "write"
        and any(name.startswith(MANAGERS) for name in source.origin)
        and touched.isdisjoint(source.origin)
    )


@once
def _takes_outputs(model: Model, rule: RuleName) -> bool:
    """Tell whether a rule says what becomes of outputs."""
    row = row_of(model, rule)
    return row is not None and any(
        (event.machine, event.input) == (rule.machine, row.input) for event in model.outputs
    )


@once
def _is_asked(model: Model, rule: RuleName) -> bool:
    """Tell whether the MainDevice had it done, or the device did it by itself."""
    row = row_of(model, rule)
    alone = {(event.machine, event.input) for event in (*model.own, *model.locals)}
    return (
        row is not None
        and f"{rule.machine}.{row.input}" not in timers_of(model.protocol)
        and (rule.machine, row.input) not in alone
    )


def _refuses(model: Model, frame: str) -> bool:
    """Tell whether a frame refuses what was asked."""
    return not _REFUSING.isdisjoint(field.name for field in model.protocol.frames[frame].fields)


def _is_alien(model: Model, output: Output, message: Message) -> bool:
    """Tell whether a message is of the service of a response, and none to that request at all."""
    return (
        message.trail[:-1] == model.codec.trail(output.frame)[:-1]
        and not _refuses(model, output.frame)
        and message.frame not in _answers(model, output.rule)
    )


@once
def _answers(model: Model, rule: RuleName) -> frozenset[str]:
    """Give the frames that any rule for the same input, and any refusal, sends."""
    row = row_of(model, rule)
    rules = () if row is None else model.rules(rule.machine, row.input)
    refusing = (name for name in model.protocol.frames if _refuses(model, name))
    return frozenset((*(frame for each in rules for frame, _ in each.sends), *refusing))


@once
def _inside(model: Model, address: int, length: int) -> tuple[Register, ...]:
    """Give the registers that lie wholly in an area."""
    return tuple(
        register
        for register in model.protocol.registers.values()
        if address <= register.address and register.address + register.size <= address + length
    )


def _orders(looks: tuple[Event, ...], glances: tuple[Event, ...]) -> tuple[tuple[Event, ...], ...]:
    """Give the orders in which a device may look at what was written, and at what was not."""
    return ((*looks, *glances), (*glances, *looks)) if glances else (looks,)


def _covers_end(area: tuple[int, int], exchange: Exchange) -> bool:
    end = area[0] + area[1]
    return exchange.address < end <= exchange.address + len(exchange.data)
