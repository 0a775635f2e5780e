"""The only place for the cover of the ESC's registers: the MainDevice can read what it may read."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.generators.case import Case, Limits, ReadRegister
from ecatspec.spec.language.ir import Access

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.model.compiled import Model


def register_cover(model: Model, _: Limits) -> Iterator[Case]:
    """Yield a case for each register: after power-on it is there, and shows what it must."""
    for register in model.protocol.registers.values():
        if register.main in {Access.READ, Access.BOTH}:
            name = f"al/register/{register.name}"
            title = f"{register.name.replace('_', ' ')} read after power-on"
            yield Case(name, title, "al", (ReadRegister(register.name),))
