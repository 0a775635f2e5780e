"""Mismatches beside what an exchange leaves: what should be otherwise, and what values say."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ecatspec.model.analysis.citations import object_name
from ecatspec.model.core.observables import advised
from ecatspec.model.core.register_map import field_of
from ecatspec.model.core.state import RuleName
from ecatspec.model.core.values import admits, bits_of
from ecatspec.model.core.wording import bytes_words, register_words
from ecatspec.model.oracle.alternatives import last_rules
from ecatspec.model.oracle.diagnosis import mismatch
from ecatspec.model.oracle.knowledge import demanded
from ecatspec.spec.language.ir import InputKind

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.model.core.codec import Message
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.oracle.explanations import Exchange, Mismatch
    from ecatspec.model.oracle.knowledge import Knowledge
    from ecatspec.spec.language.ir import ObjectEntry, Register

_OWN_REASON: Final = RuleName("sdo", "value_refused")
"""The rule by which a device refuses a value for a reason of its own."""
_REASONS: Final = "told_reason"
"""The table of the abort codes that say of themselves why a value is refused."""


# --- advice: the device goes on -------------------------------------------------------------------


def of_register(
    known: Knowledge, register: Register, raw: int, exchange: Exchange
) -> Iterator[Mismatch]:
    """Yield fields that are not what they should be, whichever explanation holds."""
    model = known.model
    found: list[set[str]] = []
    for candidate in known.candidates:
        shown = advised(model, register.name, candidate.state)
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
            register_words(model, register.name, {name: value}): None
            for candidate in known.candidates
            for view, value in advised(model, register.name, candidate.state)
            if view.name == name
        }
        held = {name: field_of(model.protocol, register.name, name, raw)}
        observed = register_words(model, register.name, held)
        clauses = bits.shows.advised.clauses
        yield mismatch(model, exchange, register.name, tuple(expected), observed, (), clauses)


def of_inputs(known: Knowledge, exchange: Exchange) -> Mismatch | None:
    """Give that there are inputs where there should be none."""
    if not exchange.working_counter or not _all_demand(known, "inputs_denied"):
        return None
    clauses = known.model.protocol.definitions["inputs_denied"].clauses
    wanted = "no inputs: working counter 0"
    return mismatch(known.model, exchange, "inputs", (wanted,), "inputs", (), clauses)


def of_default(
    known: Knowledge, exchange: Exchange, entry: ObjectEntry, default: bytes, held: bytes
) -> Mismatch | None:
    """Give that an entry does not hold its default, where the texts expect that it does."""
    if not _all_demand(known, "defaults_expected"):
        return None
    clauses = known.model.protocol.definitions["defaults_expected"].clauses
    subject = object_name((entry.index, entry.subindex))
    expected = (f"{subject} {entry.name}: {bytes_words(default)}",)
    return mismatch(known.model, exchange, "default", expected, bytes_words(held), (), clauses)


def _all_demand(known: Knowledge, definition: str) -> bool:
    return all(demanded(known.model, candidate, definition) for candidate in known.candidates)


# --- findings of several exchanges ----------------------------------------------------------------


def unreadable(model: Model, name: str, exchange: Exchange) -> Mismatch | None:
    """Judge a read that brought no register: one on which a machine rests can be read."""
    register = model.protocol.registers[name]
    written = (
        source.origin
        for machine in model.protocol.machines.values()
        for source in machine.inputs
        if source.kind == InputKind.WRITE
    )
    if not model.views[name] and not any(name in origin for origin in written):
        return None  # what is there beside these depends on the controller
    expected, observed = f"{name}: a value", f"{name}: working counter 0"
    return mismatch(model, exchange, name, (expected,), observed, (), register.clauses)


def unreasoned(known: Knowledge, abort: Message) -> bool:
    """Tell whether an abort refused a value, and neither a text nor its code says why."""
    saying = {row.value for row in known.model.protocol.tables[_REASONS].rows}
    return last_rules(known.candidates, {_OWN_REASON.machine}) == (_OWN_REASON,) and (
        abort.fields["code"] not in saying
    )


def takes_nothing(model: Model, exchange: Exchange, entry: ObjectEntry, count: int) -> Mismatch:
    """Give the mismatch of an entry that can be written and refuses every value."""
    rows = model.protocol.tables[_REASONS].rows
    clauses = dict.fromkeys(clause for row in rows for clause in row.clauses)
    expected = (f"{entry.name} takes what it holds, or another value",)
    observed = f"refused: each of {count} values"
    return mismatch(model, exchange, "writes", expected, observed, (), tuple(clauses))
