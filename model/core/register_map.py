"""The registers and memory areas that behaviour depends on, by their names in the texts."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.model.core.values import bits_of
from ecatspec.spec.language.ir import Bool

if TYPE_CHECKING:
    from ecatspec.spec.language.ir import Protocol

SYNC_MANAGERS = ("sync_manager_0", "sync_manager_1")
"""The mailbox SyncManagers, the MainDevice's output first."""
PROCESS_DATA = ("sync_manager_2", "sync_manager_3")
"""The SyncManagers of process data, the MainDevice's output first."""
AREAS = dict(
    zip(
        SYNC_MANAGERS + PROCESS_DATA,
        ("mailbox_out", "mailbox_in", "process_data_out", "process_data_in"),
        strict=True,
    )
)
"""SyncManager -> the parameter that says where its memory usually lies."""
BOOTSTRAP = dict(zip(SYNC_MANAGERS, ("bootstrap_out", "bootstrap_in"), strict=True))
"""SyncManager -> the parameter that says where the mailbox lies in BOOT."""
AL_EVENTS = "al_event_request"
"""The register of the events that the device waits for."""
WATCHDOG = "watchdog_status"
"""The register that tells whether the watchdog of process data runs."""


def field_of(protocol: Protocol, register: str, field: str, raw: int) -> int:
    """Give one field of a register whose content is `raw`, a truth value where the text says so."""
    for bits in protocol.registers[register].fields:
        if bits.name == field:
            value = bits_of(raw, bits.low, bits.high)
            return bool(value) if isinstance(bits.type, Bool) else value
    raise LookupError(f"register {register} has no field {field}")


def field_mask(protocol: Protocol, register: str, field: str) -> int:
    """Give the bits that a field takes in its register."""
    bits = next(item for item in protocol.registers[register].fields if item.name == field)
    return ((1 << (bits.high - bits.low + 1)) - 1) << bits.low
