"""The only place where a stimulus becomes the bytes that the MainDevice writes."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ecatspec.generators.case import SendFrame, WriteRegister
    from ecatspec.model.compiled import Model


def register_bytes(model: Model, stimulus: WriteRegister) -> tuple[int, bytes]:
    """Give the address and the bytes of a register write."""
    register = model.protocol.registers[stimulus.register]
    raw = 0
    for field in register.fields:
        raw |= stimulus.fields.get(field.name, 0) << field.low
    return register.address, raw.to_bytes(register.size, "little")


def frame_bytes(model: Model, stimulus: SendFrame, counter: int) -> bytes:
    """Give the bytes of a message, from the mailbox header to its end."""
    return model.codec.encode(stimulus.frame, {"counter": counter, **stimulus.fields})
