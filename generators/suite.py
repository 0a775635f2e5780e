"""The only place for the list of generators: what a run consists of, in its order."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from ecatspec.generators.complete_cover import complete_cover
from ecatspec.generators.family_cover import family_cover
from ecatspec.generators.information_cover import information_cover
from ecatspec.generators.mailbox_cover import mailbox_cover
from ecatspec.generators.sdo_cover import sdo_cover
from ecatspec.generators.transfer_cover import transfer_cover
from ecatspec.generators.transition_cover import transition_cover

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from ecatspec.generators.case import Case, Limits
    from ecatspec.model.compiled import Model

GENERATORS: Final[Mapping[str, Callable[[Model, Limits], Iterator[Case]]]] = MappingProxyType(
    {
        "transitions": transition_cover,
        "mailbox": mailbox_cover,
        "sdo": sdo_cover,
        "transfers": transfer_cover,
        "complete": complete_cover,
        "information": information_cover,
        "families": family_cover,
    }
)


def all_cases(model: Model, limits: Limits) -> Iterator[Case]:
    """Yield all fixed cases of a protocol in the order in which they run."""
    for generate in GENERATORS.values():
        yield from generate(model, limits)
