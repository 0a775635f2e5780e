"""The only place for the virtual SubDevice of model/ as a device under test."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.conformance.adapter import Description, check_duration, check_span
from ecatspec.conformance.adapters import refuse_options
from ecatspec.conformance.devices import load
from ecatspec.model.subdevice import VirtualSubDevice

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ecatspec.conformance.adapter import Adapter
    from ecatspec.spec.language.ir import Protocol


def make(device: str, options: Mapping[str, str]) -> Adapter:
    """Return the virtual SubDevice of the text `device`."""
    refuse_options("model", options)
    return _Model(load(device))


class _Model:
    def __init__(self, protocol: Protocol) -> None:
        self._device = VirtualSubDevice(protocol)
        # Every machine of the texts, and every frame that one of them may carry, is its own.
        self._description = Description(
            name=f"virtual SubDevice {protocol.name}",
            protocols=frozenset(protocol.machines),
            virtual_time=True,
            closed_dictionary=True,
        )

    def reset(self) -> None:
        self._device.reset()

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        check_span(address, length)
        return self._device.read(address, length)

    def write(self, address: int, data: bytes) -> int:
        check_span(address, len(data))
        return self._device.write(address, data)

    def advance(self, seconds: float) -> None:
        check_duration(seconds)
        self._device.advance(seconds)

    def close(self) -> None:
        pass

    def describe(self) -> Description:
        return self._description
