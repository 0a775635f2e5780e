"""The only place for leaving out explanations of which another one knows less, and else the same.

What the first allows the other allows too, so no verdict changes. Without this, explanations
become twice as many with each answer that one of them learned from and another did not.
"""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, Final

from ecatspec.model.values import UNKNOWN

if TYPE_CHECKING:
    from ecatspec.model.candidates import Candidate
    from ecatspec.model.serving import Explanations
    from ecatspec.model.state import State

_FEW: Final = 8
"""So many explanations are cheaper to follow than to compare."""


def widest(explanations: Explanations) -> Explanations:
    """Give the explanations that no other one covers, each with the rules that all agree on."""
    if len(explanations) <= _FEW:
        return explanations
    alike: defaultdict[object, list[Candidate]] = defaultdict(list)
    histories = dict(explanations)
    for candidate in sorted(explanations, key=_known):
        wide = alike[candidate.beside_state()]
        over = [other for other in wide if _covers(other.state, candidate.state)]
        if not over:
            wide.append(candidate)
            continue
        history = histories.pop(candidate)
        for other in over:
            histories[other] = tuple(rule for rule in histories[other] if rule in history)
    return histories


def _known(candidate: Candidate) -> tuple[int, int]:
    """Give how much is known: who covers another one knows less."""
    state = candidate.state
    return len(state.objects), sum(value != UNKNOWN for value in state.slots)


def _covers(wide: State, narrow: State) -> bool:
    return wide.known().items() <= narrow.known().items() and all(
        value in (other, UNKNOWN) for value, other in zip(wide.slots, narrow.slots, strict=True)
    )
