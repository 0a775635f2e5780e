"""Cases of defaults: the values of entries before anybody wrote to them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.generators.cases.bringup import case_in
from ecatspec.generators.cases.case import ReadInitial
from ecatspec.generators.covers.sdo_cover import entry_name
from ecatspec.spec.language.ir import Access

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.generators.cases.case import Case, Limits
    from ecatspec.model.core.compilation import Model


def initial_cover(model: Model, _: Limits) -> Iterator[Case]:
    """Yield a case for each entry that is written, has a default and loses what was written."""
    for entry in model.protocol.objects:
        lasts = not entry.volatile and not entry.stored
        if entry.access is Access.BOTH and entry.default is not None and lasts:
            state = entry.read_states[0] if entry.read_states else "PREOP"
            look = [ReadInitial(entry.index, entry.subindex)]
            title = "read the default after power-on"
            yield case_in(model, f"sdo/default/{entry_name(entry)}", title, look, state=state)
