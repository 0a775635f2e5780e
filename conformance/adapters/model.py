"""Tests the virtual SubDevice of model/."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.conformance.adapters import refuse_options
from ecatspec.conformance.base.adapter import (
    AdapterError,
    Description,
    check_duration,
    check_span,
)
from ecatspec.conformance.base.devices import load, nearest
from ecatspec.model.esc.subdevice import Quirk, Snapshot, VirtualSubDevice
from ecatspec.spec.language.ir import InputKind
from ecatspec.spec.language.load import load_faults, plant

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from ecatspec.spec.language.ir import Protocol


def make(device: str, options: Mapping[str, str]) -> SnapshotAdapter:
    """Return the virtual SubDevice of the text `device`, with a planted fault if one is named."""
    refuse_options("model", options, known=("mailbox", "fault"))
    loaded = load(device, options.get("mailbox", ""))
    protocol, quirks = planted(loaded, options.get("fault"))
    return SnapshotAdapter(VirtualSubDevice(protocol, quirks=quirks), described(protocol))


def planted(protocol: Protocol, name: str | None) -> tuple[Protocol, frozenset[Quirk]]:
    """Give what a device with the fault `name` goes by; None is a device without one."""
    if name is None:
        return protocol, frozenset()
    faults = load_faults()
    if name not in faults:
        raise AdapterError(str(nearest("fault", name, tuple(faults))))
    fault = faults[name]
    return plant(protocol, fault), frozenset({Quirk(fault.quirk)} if fault.quirk else ())


def described(protocol: Protocol) -> Description:
    """Describe a virtual SubDevice: every machine of the texts is its own."""
    return Description(
        name=f"virtual SubDevice {protocol.name}",
        protocols=frozenset(protocol.machines),
        virtual_time=True,
        closed_dictionary=True,
        locals=frozenset(
            f"{machine.name}.{source.name}"
            for machine in protocol.machines.values()
            for source in machine.inputs
            if source.kind == InputKind.LOCAL
        ),
    )


class VirtualAdapter:
    """The contract over a virtual SubDevice; `power_off` is done before each reset."""

    def __init__(
        self,
        device: VirtualSubDevice,
        description: Description,
        power_off: Callable[[], None] | None = None,
    ) -> None:
        self._device = device
        self._description = description
        self._power_off = power_off

    def reset(self) -> None:
        """Power cycle."""
        if self._power_off is not None:
            self._power_off()
        self._device.reset()

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Read as the MainDevice."""
        check_span(address, length)
        return self._device.read(address, length)

    def write(self, address: int, data: bytes) -> int:
        """Write as the MainDevice."""
        check_span(address, len(data))
        return self._device.write(address, data)

    def advance(self, seconds: float) -> None:
        """Let virtual time pass."""
        check_duration(seconds)
        self._device.advance(seconds)

    def local(self, event: str) -> None:
        """Raise a local event in the device."""
        machine, _, name = event.partition(".")
        self._device.happen(machine, name, {})

    def close(self) -> None:
        """Nothing to release."""

    def describe(self) -> Description:
        """What was given."""
        return self._description


class SnapshotAdapter(VirtualAdapter):
    """The contract over a virtual SubDevice that is all that there is of the device."""

    def snapshot(self) -> object:
        """Give what the device is now."""
        return self._device.snapshot()

    def restore(self, snapshot: object) -> None:
        """Let the device be as it was then."""
        if not isinstance(snapshot, Snapshot):
            message = "this is no snapshot of a virtual SubDevice"
            raise TypeError(message)
        self._device.restore(snapshot)
