"""Encodes a stimulus as the bytes that the MainDevice writes."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ecatspec.generators.cases.case import SendFrame, WriteRegister, WriteRegisters
    from ecatspec.model.core.compilation import Model


def register_bytes(model: Model, stimulus: WriteRegister) -> tuple[int, bytes]:
    """Give the address and the bytes of a register write."""
    register = model.protocol.registers[stimulus.register]
    raw = 0
    for field in register.fields:
        raw |= stimulus.fields.get(field.name, 0) << field.low
    return register.address, raw.to_bytes(register.size, "little")


def registers_bytes(model: Model, stimulus: WriteRegisters) -> tuple[int, bytes]:
    """Give the address and the bytes of one write over neighbouring registers, gaps zero."""
    parts = [register_bytes(model, write) for write in stimulus.writes]
    start = parts[0][0]
    data = b""
    for address, content in parts:
        data = data.ljust(address - start, b"\0") + content
    return start, data


def frame_bytes(model: Model, stimulus: SendFrame, counter: int) -> bytes:
    """Give the bytes of a message, from the mailbox header to its end."""
    return model.codec.encode(stimulus.frame, {"counter": counter, **stimulus.fields})
