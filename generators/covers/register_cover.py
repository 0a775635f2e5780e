"""Cases of the ESC's registers: the MainDevice can read each readable one."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.generators.cases.bringup import request, way_to
from ecatspec.generators.cases.case import Case, Limits, ReadRegister, WriteRegister
from ecatspec.generators.cases.transfers import upload
from ecatspec.spec.language.ir import Access, Name
from ecatspec.spec.language.nodes import nodes_in

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.generators.cases.case import Stimulus
    from ecatspec.model.core.compilation import Model

_RESERVED = ("identification", "reserved", "application")
"""The fields of AL Control that mean nothing, but for devices that say so."""


def register_cover(model: Model, _: Limits) -> Iterator[Case]:
    """Yield a case for each register: after power-on it is there, and shows what it must."""
    for register in model.protocol.registers.values():
        if register.main in {Access.READ, Access.BOTH}:
            name = f"al/register/{register.name}"
            title = f"{register.name.replace('_', ' ')} read after power-on"
            yield Case(name, title, "al", (ReadRegister(register.name),))
    for register in model.protocol.registers.values():
        if register.main is Access.READ and model.views[register.name]:
            fields = {
                field.name: (1 << field.high - field.low + 1) - 1 for field in register.fields
            }
            name = f"read_only/{register.name}"
            title = f"{register.name.replace('_', ' ')} written by the MainDevice, without effect"
            yield _in_preop(model, name, title, (WriteRegister(register.name, fields),))
    yield from _reserved_bits(model)
    yield from _shown_by_entries(model)


def _shown_by_entries(model: Model) -> Iterator[Case]:
    """Yield a value of each register that an entry shows, and the entry after it."""
    for word in model.protocol.words.values():
        if word.key not in model.dictionary.entries:
            continue
        paths = {node.path for node in nodes_in(word.fields) if isinstance(node, Name)}
        for path in sorted(paths):
            name, _, shown = path.partition(".")
            register = model.protocol.registers.get(name)
            if register is None or register.main is not Access.BOTH:
                continue
            if any(model.views[name]) or name == "al_control":
                continue
            field = next(field for field in register.fields if field.name == shown)
            # every second bit: no default, nor what any other register holds
            value = ((1 << field.high - field.low + 1) - 1) // 3
            done = (WriteRegister(name, {shown: value}), upload(*word.key))
            title = f"{shown.replace('_', ' ')} given, which {word.name.replace('_', ' ')} shows"
            yield _in_preop(model, f"shown/{word.name}/{path}", title, done)


def _reserved_bits(model: Model) -> Iterator[Case]:
    """Yield requests with reserved bits of AL Control, which have no effect."""
    for field in model.protocol.registers["al_control"].fields:
        if field.name not in _RESERVED:
            continue
        every = (1 << field.high - field.low + 1) - 1
        for name in ("PREOP", "INIT"):
            asked = request(model.row("al_state", name))
            odd = WriteRegister(asked.register, {**asked.fields, field.name: every})
            title = f"{name} requested with reserved bits of AL Control ({field.name})"
            yield _in_preop(model, f"reserved_bits/{field.name}/{name}", title, (odd,))


def _in_preop(model: Model, name: str, title: str, stimuli: tuple[Stimulus, ...]) -> Case:
    way = way_to(model, "PREOP")
    return Case(f"al/{name}", title, "al", (*way, *stimuli), "PREOP", len(way))
