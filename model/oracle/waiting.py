"""What may still come from a device, and by when."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.model.oracle.expansion import is_idle
from ecatspec.model.oracle.knowledge import judges_mail

if TYPE_CHECKING:
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.oracle.expansion import Explanations
    from ecatspec.model.oracle.explanations import Candidate, Pending


def to_come(model: Model, known: Explanations, time: int, *, unread: bool) -> tuple[int, ...]:
    """Give by when (us), none of it before `time`, each thing must have come that may still come.

    What should have come before and was not missed when it was looked for cannot come any more.
    With `unread` replies may lie in the mailbox, and requests behind them.
    """
    found: list[int] = []
    for candidate in known:
        if candidate.outbox and not unread:
            found.append(candidate.ready)
        due = _due(model, candidate, time)
        behind = bool(candidate.outbox) and unread
        found += [p.deadline for p in due if not (behind and p.event.trail)]
    return tuple(deadline for deadline in found if deadline >= time)


def unseen(model: Model, known: Explanations, time: int) -> bool:
    """Tell whether a reply must lie in the mailbox since before `time`, and no look missed it.

    So it is where the mailbox cannot be looked at.
    """
    return all(
        candidate.outbox and candidate.ready < time and judges_mail(model, candidate)
        for candidate in known
    )


def _due(model: Model, candidate: Candidate, time: int) -> list[Pending]:
    """Give the inputs that may be served now, without what would make no difference."""
    return [
        pending
        for pending in candidate.inbox
        if pending.since <= time
        and not pending.optional
        and not (pending.timer and is_idle(model, candidate.state, pending.event))
    ]
