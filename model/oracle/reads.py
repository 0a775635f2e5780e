"""What a read of the MainDevice leaves of the explanations."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import structs

from ecatspec.model.core.interpreter import matches, step
from ecatspec.model.core.memo import once
from ecatspec.model.core.observables import decided, definitely, odd_words, process_area, seen
from ecatspec.model.oracle.expansion import is_shut, may_hold_anything, served
from ecatspec.model.oracle.explanations import Loose, Pending, with_alarms
from ecatspec.model.oracle.judged import Judged
from ecatspec.model.oracle.knowledge import demanded
from ecatspec.model.oracle.writes import DATA_IN

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from ecatspec.model.core.codec import Message
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.state import Output, RuleName, State, Step
    from ecatspec.model.oracle.expansion import Explanations
    from ecatspec.model.oracle.explanations import Candidate, Exchange
    from ecatspec.spec.language.ir import Register, Word


def kept(before: Explanations, after: Explanations) -> Explanations:
    """Give `after`; where an observation changed nothing, `before`, which knows more."""
    return before if before.keys() == after.keys() else after


@once
def registers_inside(model: Model, address: int, length: int) -> tuple[Register, ...]:
    """Give the registers that lie wholly in an area."""
    return tuple(
        register
        for register in model.protocol.registers.values()
        if address <= register.address and register.address + register.size <= address + length
    )


def read_register(model: Model, before: Explanations, register: Register, raw: int) -> Explanations:
    """Give the explanations in which a register holds `raw`."""
    after: Explanations = {}
    for candidate, history in before.items():
        for state in seen(model, register.name, candidate.state, raw):
            after.setdefault(candidate.having(state), history)
    return kept(before, after)


def read_inputs(
    model: Model, before: Explanations, exchange: Exchange
) -> tuple[Judged, dict[str, Word]]:
    """Give the explanations that allow what inputs hold, and the words that others do not."""
    after: Explanations = {}
    wrong: Explanations = {}
    words: dict[str, Word] = {}
    for candidate, history in before.items():
        if process_area(model, candidate.state, DATA_IN) != exchange.span():
            after[candidate] = history
        elif not exchange.working_counter:
            wanted = demanded(model, candidate, "inputs_demanded")
            (wrong if wanted else after)[candidate] = history
        elif definitely(model, candidate.state, "inputs_valid") is False:
            after[candidate] = history  # what lies there is old
        else:
            for state in decided(model, candidate.state, exchange.data):
                odd = odd_words(model, state, exchange.data)
                (wrong if odd else after)[candidate.having(state)] = history
                words |= odd
    return Judged(kept(before, after), wrong), words


# --- mailbox --------------------------------------------------------------------------------------


def read_full(model: Model, before: Explanations, time: int, *, full: bool) -> Explanations:
    """Give the explanations in which the mailbox may be full, or empty."""
    own = bool(model.own)
    after = {
        _owing(model, candidate, time, full=full): history
        for candidate, history in before.items()
        if not (full and _is_absent(model, candidate.state))
        and (
            may_hold_anything(model, candidate)
            or (full and bool(candidate.outbox or (own and not is_shut(model, candidate.state))))
            or (not full and (not candidate.outbox or time <= candidate.ready))
        )
    }
    return kept(before, after)


def read_message(
    model: Model, before: Explanations, data: bytes, message: Message | None, time: int
) -> Explanations:
    """Give the explanations that are left after the MainDevice read `data` from the mailbox."""
    after: Explanations = {}
    for candidate, history in before.items():
        if message is not None and _is_absent(model, candidate.state):
            continue
        nothing = message is None and is_shut(model, candidate.state)
        if nothing or may_hold_anything(model, candidate):
            loose = Loose.NONE if candidate.loose is Loose.ONE else candidate.loose
            rest = structs.replace(candidate, outbox=candidate.outbox[1:], loose=loose, last=data)
            after[rest] = history
        elif message is not None:
            for rest, rules in _taken(model, candidate, message, time):
                after[structs.replace(rest, last=data)] = history + rules
    return after


def left(
    model: Model, candidate: Candidate, taken: Step, rest: tuple[Output, ...], time: int
) -> Candidate:
    """Give the explanation after a reply was read, with the replies that are left."""
    state = step(model, taken.state, model.fetched)[0].state
    outbox = rest + taken.outputs
    inbox = with_alarms(candidate.inbox, taken, time, time)
    if outbox:
        ready = time + (outbox[0].within or model.parameter("response_timeout"))
    else:
        ready = 0
        inbox = tuple(
            structs.replace(p, deadline=max(p.deadline, time + p.within)) if p.event.trail else p
            for p in inbox
        )
    return structs.replace(candidate, state=state, inbox=inbox, outbox=outbox, ready=ready)


def _is_absent(model: Model, state: State) -> bool:
    return definitely(model, state, "mailbox_absent") is True


def _owing(model: Model, candidate: Candidate, time: int, *, full: bool) -> Candidate:
    """Give the explanation without what did not come, and did not have to."""
    if full or not candidate.loose:
        return candidate
    if candidate.loose is Loose.ONE and is_shut(model, candidate.state):
        return structs.replace(candidate, loose=Loose.NONE)
    gone = candidate.outbox and time > candidate.ready
    return structs.replace(candidate, outbox=()) if gone else candidate


def _taken(
    model: Model, candidate: Candidate, message: Message, time: int
) -> Iterator[tuple[Candidate, tuple[RuleName, ...]]]:
    """Yield what may be left after the MainDevice read `message`, and the rules that fired."""
    state, outbox = candidate.state, candidate.outbox
    if outbox:
        for taken in matches(model, state, outbox[0], message):
            yield left(model, candidate, taken, outbox[1:], time), taken.rules
    # what happens inside the device shows at any time, before what is due
    for source in model.own:
        for cause in step(model, state, source):
            for output in cause.outputs[:1]:
                for taken in matches(model, cause.state, output, message):
                    rest = left(model, candidate, taken, outbox, time)
                    yield rest, cause.rules + taken.rules


# --- what happens by itself -----------------------------------------------------------------------


def surprised(
    model: Model, before: Explanations, time: int, raised: Collection[str]
) -> Explanations:
    """Give the explanations in which something happened by itself, and those before.

    The local events `raised` (`machine.input`) happen only when somebody makes them happen.
    """
    found = dict(before)
    for candidate, history in before.items():
        for event in (*model.own, *model.locals):
            name = f"{event.machine}.{event.input}"
            if name in raised or model.signature(event):
                continue
            hit = candidate
            if event not in model.own:
                hit = structs.replace(candidate, spontaneous=(*candidate.spontaneous, name))
            pending = Pending(event, time, since=time)
            for rest, rules in served(model, hit, pending, candidate.inbox):
                if rules and rest.state != candidate.state:
                    found.setdefault(rest, history + rules)
    return found
