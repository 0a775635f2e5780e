"""A contradiction in words: what was expected, what was observed, and which clause it breaks."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final, assert_never

from ecatspec.model.core.compilation import MAILBOX
from ecatspec.model.core.interpreter import afterwards, differing, expected_fields, later_fields
from ecatspec.model.core.observables import fields_in, shown_fields, shown_register, words_in
from ecatspec.model.core.register_map import SYNC_MANAGERS, field_of
from ecatspec.model.core.values import Unknown
from ecatspec.model.core.wording import fields_words, message_words, register_words
from ecatspec.model.oracle.alternatives import (
    of_machines,
    of_message,
    of_register,
    of_reply,
    of_word,
    refuses,
    shows_state,
)
from ecatspec.model.oracle.blame import blame, strongest_first
from ecatspec.model.oracle.explanations import Mismatch
from ecatspec.model.oracle.judged import (
    InputsRead,
    MailboxFound,
    MailRefused,
    MessageRead,
    ProcessDataRefused,
    RegisterRead,
)
from ecatspec.model.oracle.knowledge import Knowledge, reasons_of
from ecatspec.model.oracle.reads import left
from ecatspec.spec.language.nodes import names_in

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator

    from ecatspec.model.core.codec import Message
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.state import Output, State
    from ecatspec.model.core.values import Value
    from ecatspec.model.oracle.blame import Alternative
    from ecatspec.model.oracle.expansion import Explanations
    from ecatspec.model.oracle.explanations import Exchange
    from ecatspec.model.oracle.judged import Contradiction
    from ecatspec.spec.language.ir import Register, Word

_STATUS: Final = f"{SYNC_MANAGERS[1]}_status"
"""The register that says whether there is a reply."""
_REFUSED: Final = "refused: working counter 0"
_STOPPING: Final = frozenset({"process_data", "al"})
"""The machines by whose rules there are process data, or none."""


def diagnosed(
    model: Model, exchange: Exchange, found: Contradiction, since: int
) -> tuple[Mismatch, Explanations | None]:
    """Put a contradiction into words; give what is left where it is overlooked, if that is clear.

    `since`: rules that each explanation had gone by when the same was read last and right.
    """
    match found:
        case RegisterRead():
            return _register(model, exchange, found, since)
        case MessageRead(before=before, message=message):
            if message is not None:
                return _message(model, exchange, before, message)
            return _reply(model, exchange, before, "no message", _due(model, before)), None
        case InputsRead():
            return _inputs(model, exchange, found, since), None
        case MailboxFound(before=before, full=full):
            observed = "mailbox full" if full else "mailbox empty: no reply"
            by = [replace(each, silent=not full) for each in _due(model, before)]
            return _reply(model, exchange, before, observed, by), None
        case ProcessDataRefused(before=before, write=write):
            wanted = "the device takes the outputs" if write else "the inputs can be read"
            subject = "outputs" if write else "inputs"
            clauses = model.protocol.definitions[f"{subject}_demanded"].clauses
            stopped = of_machines(before, _STOPPING)
            return mismatch(model, exchange, subject, (wanted,), _REFUSED, stopped, clauses), None
        case MailRefused(before=before):
            wanted = "the mailbox takes the request"
            served = of_machines(before, {MAILBOX})
            return mismatch(model, exchange, "mailbox write", (wanted,), _REFUSED, served), None
        case _:
            assert_never(found)


def mismatch(
    model: Model,
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
    found = blame(model, alternatives)
    own, fields = ((), ()) if found is None else (found.clauses, found.fields)
    shown = (clause for layout in layouts for clause in _clauses_of(layout, fields))
    clauses = dict.fromkeys(strongest_first(model, (*own, *more, *shown)))
    if not clauses:
        # before any rule fired it is the power-on value or the register itself that is broken
        register = subject if subject in model.views else _STATUS
        clauses = dict.fromkeys(model.protocol.registers[register].clauses)
    if found is None:
        cause: tuple[str, ...] = (subject, *clauses)
        shared = [subject, *clauses]
    else:
        # what a register shows hangs together; where no reply is due, any is one too many
        whole = subject in model.views
        due = any(each.layout for each in found.nearest)
        kind = () if whole or fields or not due else (_kind(model, observed),)
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


def _kind(model: Model, observed: str) -> str:
    """Give the kind of an observation that is something else altogether."""
    name = observed.partition(":")[0]
    if name not in model.protocol.frames:
        return name
    return "refused" if refuses(model, name) else "served"


def _clauses_of(layout: Register | Word, names: Collection[str]) -> tuple[str, ...]:
    """Give the clauses of a layout and of some of its fields."""
    fields = (field.clauses for field in layout.fields if field.name in names)
    return (*layout.clauses, *(clause for clauses in fields for clause in clauses))


# --- registers and process data -------------------------------------------------------------------


def _register(
    model: Model, exchange: Exchange, found: RegisterRead, since: int
) -> tuple[Mismatch, Explanations | None]:
    register, before = found.register, found.before
    views = model.views[register.name]
    allowed = [shown_register(model, register, candidate.state) for candidate in before]
    expected = {register_words(model, register.name, each): None for each in allowed}
    fields: dict[str, Value] = {
        v.name: field_of(model.protocol, register.name, v.name, found.raw) for v in views
    }
    made = mismatch(
        model,
        exchange,
        register.name,
        tuple(expected),
        register_words(model, register.name, fields),
        of_register(model, before, register, fields, since),
        layouts=(register,),
    )
    refused = {c: h for c, h in before.items() if reasons_of(model, c.state, h)}
    odd = [view for view in views if view.name in made.differing]
    clear = not any(view.truth or shows_state(view.expression) for view in odd)
    reasons = Knowledge(model, refused).reasons() if refused else ()
    return replace(made, reasons=reasons, clear=clear), before if clear else None


def _inputs(model: Model, exchange: Exchange, found: InputsRead, since: int) -> Mismatch:
    state = next(iter(found.before)).state
    expected = {
        register_words(model, name, shown_fields(model, candidate.state, name)): None
        for candidate in found.before
        for name in found.words
    }
    said = words_in(model, state, exchange.data)
    held = dict(fields_in(model, state, exchange.data))
    return mismatch(
        model,
        exchange,
        "inputs",
        tuple(expected),
        "; ".join(words for name, words in said if name in found.words),
        [
            each
            for name in found.words
            for each in of_word(model, found.before, name, held[name], since)
        ],
        layouts=tuple(found.words.values()),
    )


# --- replies --------------------------------------------------------------------------------------


def _due(model: Model, before: Explanations) -> list[Alternative]:
    return [
        of_reply(model, candidate, output)
        for candidate in before
        for output in candidate.outbox[:1]
    ]


def _reply(
    model: Model,
    exchange: Exchange,
    before: Explanations,
    observed: str,
    due: Collection[Alternative],
    more: tuple[str, ...] = (),
) -> Mismatch:
    replies = _expected_replies(model, before)
    by = due or of_machines(before, {MAILBOX})
    return mismatch(model, exchange, "reply", replies, observed, by, more)


def _message(
    model: Model, exchange: Exchange, before: Explanations, message: Message
) -> tuple[Mismatch, Explanations | None]:
    due = [(candidate, candidate.outbox[0]) for candidate in before if candidate.outbox]
    by = [of_message(model, candidate, output, message) for candidate, output in due]
    more = tuple(
        clause
        for candidate, output in due
        for clause in _clauses_of_fields(model, candidate.state, output, message)
    )
    observed = message_words(model, message)
    found = _reply(model, exchange, before, observed, by, more)
    beside: list[Mismatch] = []
    if len(found.differing) > 1:
        # each field may have a cause of its own
        found, *beside = (
            _reply(
                model,
                exchange,
                before,
                observed,
                [replace(each, fields=(name,)) for each in by if name in each.fields],
                more,
            )
            for name in found.differing
        )
    overlooking: Explanations = {}
    if found.differing:
        least = min(len(each.fields) or len(message.fields) for each in by)
        overlooking = {
            left(model, candidate, taken, candidate.outbox[1:], exchange.time): (
                before[candidate] + taken.rules
            )
            for (candidate, output), each in zip(due, by, strict=True)
            if len(each.fields) == least
            for taken in afterwards(model, candidate.state, output, message.fields)
        }
    found = replace(
        found,
        differing=found.differing or (message.frame,),
        clear=bool(overlooking),
        beside=tuple(beside),
    )
    return found, overlooking or None


def _expected_replies(model: Model, candidates: Explanations) -> tuple[str, ...]:
    expected: dict[str, None] = {}
    for candidate in candidates:
        if candidate.outbox:
            output = candidate.outbox[0]
            fields = expected_fields(model, candidate.state, output)
            fields |= later_fields(model, candidate.state, output, fields)[0]
            stated = {n: v for n, v in fields.items() if not isinstance(v, Unknown)}
            expected[fields_words(model, output.frame, stated)] = None
        elif not candidate.inbox:
            expected["no reply"] = None
    return tuple(expected)


def _clauses_of_fields(
    model: Model, state: State, output: Output, message: Message
) -> Iterator[str]:
    """Give the clauses of the layouts and choices that fields of a reply break."""
    for name in differing(model, state, output, message):
        for frame in model.codec.trail(output.frame):
            for item in model.protocol.frames[frame].fields:
                if item.name == name:
                    yield from model.protocol.frames[frame].clauses
                    for path in () if item.reply is None else names_in(item.reply):
                        choice = model.protocol.choices.get(path)
                        yield from () if choice is None else choice.clauses
