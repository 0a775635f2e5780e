"""What is known of a device at one moment: queries over every explanation of the exchanges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ecatspec.model.core import observables
from ecatspec.model.core.expressions import Environment
from ecatspec.model.core.interpreter import step
from ecatspec.model.core.memo import once
from ecatspec.model.core.wording import reason_words
from ecatspec.model.oracle.expansion import is_alive
from ecatspec.model.oracle.havoc import is_open

if TYPE_CHECKING:
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.state import RuleName, State
    from ecatspec.model.core.values import Value
    from ecatspec.model.oracle.expansion import Explanations
    from ecatspec.model.oracle.explanations import Candidate, Exchange


@dataclass(frozen=True, slots=True)
class Knowledge:
    """The explanations at one moment, each with the rules that it went by; what they agree on."""

    model: Model
    candidates: Explanations

    # --- states -----------------------------------------------------------------------------------

    def example(self) -> State:
        """Give one state that the device may be in."""
        return next(iter(self.candidates)).state

    def al_states(self) -> frozenset[str]:
        """Give the AL states that the device may be in now (settled or not)."""
        names = self.model.state_names("al")
        slot = self.model.slots["al.state"]
        return frozenset(
            names[value]
            for candidate in self.candidates
            if isinstance(value := candidate.state.slots[slot], int)
        )

    def may_be(self, machine: str, state: str) -> bool:
        """Tell whether a machine may be in a state, by its name."""
        slot = self.model.slots[f"{machine}.state"]
        names = {name: value for value, name in self.model.state_names(machine).items()}
        return any(c.state.slots[slot] == names[state] for c in self.candidates)

    def most(self, slot: str) -> int:
        """Give the greatest number that a variable may hold, 0 where it is not known."""
        values = (each.state.slots[self.model.slots[slot]] for each in self.candidates)
        return max((value for value in values if isinstance(value, int)), default=0)

    def broken(self) -> tuple[str, ...]:
        """Give the properties of the texts that some explanation breaks: the texts are wrong."""
        found = (_broken(self.model, candidate.state) for candidate in self.candidates)
        return tuple(dict.fromkeys(name for names in found for name in names))

    # --- choices ----------------------------------------------------------------------------------

    def choices(self) -> dict[str, str]:
        """Give the choices on which all explanations agree."""
        ways = ((name, self._ways(name)) for name in self.model.protocol.choices)
        return {name: str(found.pop()) for name, found in ways if len(found) == 1 and all(found)}

    def untold(self) -> frozenset[str]:
        """Give the choices that the device had to make, and nothing showed how it did."""
        names = self.model.protocol.choices
        return frozenset(name for name in names if len(self._ways(name) - {None}) > 1)

    def met(self) -> frozenset[str]:
        """Give the choices that some explanation needs decided to say what the device does."""
        names = self.model.protocol.choices
        return frozenset(name for name in names if self._ways(name) - {None})

    def _ways(self, choice: str) -> set[Value | None]:
        slot = self.model.slots[f"choice {choice}"]
        return {candidate.state.slots[slot] for candidate in self.candidates}

    # --- areas ------------------------------------------------------------------------------------

    def area(self, name: str) -> tuple[int, int] | None:
        """Give start and length in bytes of a mailbox as far as all explanations agree."""
        areas = {observables.mailbox_area(self.model, each.state, name) for each in self.candidates}
        return areas.pop() if len(areas) == 1 else None

    def process_area(self, name: str) -> tuple[int, int] | None:
        """Give start and length in bytes of process data that are switched on, if all agree."""
        areas = {observables.process_area(self.model, each.state, name) for each in self.candidates}
        return areas.pop() if len(areas) == 1 else None

    def concerned(self, name: str, exchange: Exchange) -> bool:
        """Tell whether an access is one to process data, which nothing but a write moves."""
        span = exchange.span()
        return any(
            observables.process_area(self.model, c.state, name) == span for c in self.candidates
        )

    def words_in(self, image: bytes) -> tuple[tuple[str, str], ...]:
        """Give the words that inputs hold, by name and in words."""
        return observables.words_in(self.model, self.example(), image)

    # --- what happened ----------------------------------------------------------------------------

    def surprises(self) -> tuple[str, ...]:
        """Give the unrequested events that explain the device; empty if it may be none."""
        if not all(candidate.spontaneous for candidate in self.candidates):
            return ()
        return tuple(sorted({name for each in self.candidates for name in each.spontaneous}))

    def certain_rules(self) -> frozenset[RuleName]:
        """Give the rules that fired in every explanation's history.

        What fired after something that the texts leave open is not sure.
        """
        gaps = self.model.open_gaps
        histories = [
            set(history[: next((n for n, rule in enumerate(history, 1) if rule in gaps), None)])
            for history in self.candidates.values()
        ]
        return frozenset(set.intersection(*histories)) if histories else frozenset()

    def gone_by(self) -> int:
        """Count the rules that every explanation went by at least."""
        return min(map(len, self.candidates.values()), default=0)

    def reasons(self) -> tuple[str, ...]:
        """Give why the device refused what it was asked last, as far as all explanations agree."""
        (first, rules), *others = self.candidates.items()
        return tuple(
            text
            for text in reasons_of(self.model, first.state, rules)
            if all(text in reasons_of(self.model, other.state, own) for other, own in others)
        )

    # --- what is to come --------------------------------------------------------------------------

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

    def judges_mail(self) -> bool:
        """Tell whether a message is judged: some explanation says what may come."""
        return any(judges_mail(self.model, candidate) for candidate in self.candidates)


def judges_mail(model: Model, candidate: Candidate) -> bool:
    """Tell whether an explanation says what may come out of the mailbox."""
    return not candidate.loose and is_alive(model, candidate.state)


def demanded(model: Model, candidate: Candidate, definition: str) -> bool:
    """Tell whether the texts demand it of a device that has nothing else to do."""
    if any(not pending.timer for pending in candidate.inbox):
        return False
    state = candidate.state
    environment = Environment(state.slots, state.objects, {})
    return model.definition(definition)(environment) is True


def reasons_of(model: Model, state: State, history: tuple[RuleName, ...]) -> tuple[str, ...]:
    """Give why the last rules of each machine refused, in words."""
    last = {rule.machine: rule for rule in history}
    own = tuple(rule for rule in last.values() if rule in model.reasons)
    return _reasons_of(model, state, own) if own else ()


@once
def _reasons_of(model: Model, state: State, rules: tuple[RuleName, ...]) -> tuple[str, ...]:
    environment = Environment(state.slots, state.objects, {})
    return tuple(
        reason_words(reason.wording, [value(environment) for value in reason.values])
        for rule in rules
        for reason in model.reasons[rule]
        if reason.guard(environment) is True
    )


@once
def _broken(model: Model, state: State) -> tuple[str, ...]:
    return model.broken(state)
