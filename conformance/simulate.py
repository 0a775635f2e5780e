"""Puts virtual SubDevices on a network interface, for real MainDevices.

Their time is that of the clock. They act when a frame comes: what happened meanwhile by itself is
done before it is answered, so nobody can tell the difference.
"""

from __future__ import annotations

import errno
import gc
import signal
import time
from typing import TYPE_CHECKING, Final, Self

from ecatspec.conformance.adapters.model import planted
from ecatspec.conformance.adapters.raw_socket import FrameReader, failed, open_interface
from ecatspec.conformance.base.devices import load
from ecatspec.generators.cases.bringup import way_to
from ecatspec.generators.cases.play import play
from ecatspec.generators.cases.stimulus import frame_bytes
from ecatspec.generators.cases.transfers import download, upload
from ecatspec.generators.covers.mailbox_cover import probe_entry
from ecatspec.model.core.register_map import AREAS, SYNC_MANAGERS
from ecatspec.model.esc.data_link import LinkedSubDevice, linked
from ecatspec.model.esc.wire import Wire, wire_format
from ecatspec.spec.language.load import load_link

if TYPE_CHECKING:
    from collections.abc import Callable

    Progress = Callable[[int, int, str], None]

_MICROSECOND: Final = 1000
"""Nanoseconds of one."""
_SHOWN: Final = 200_000
"""Microseconds between two lines of progress."""


def _rehearse(segment_device: LinkedSubDevice) -> None:
    """Let a device do once what it will do often: no first answer may take longer than others.

    A MainDevice gives up after milliseconds, and rules are compiled when they are needed.
    """
    device = segment_device.device
    model = device.model
    for machine in model.protocol.machines.values():
        for source in machine.inputs:
            model.rules(machine.name, source.name)
    way = way_to(model, "PREOP")
    play(model, device, way)
    areas = [AREAS[name] for name in SYNC_MANAGERS]
    out, back = ([model.parameter(area, part) for part in ("start", "length")] for area in areas)
    if entry := probe_entry(model):
        key = entry.index, entry.subindex
        for counter, request in enumerate((upload(*key), download(*key, b"\0")), 1):
            message = frame_bytes(model, request, counter)
            device.write(out[0], message.ljust(out[1], b"\0"))
            device.read(*back)
    play(model, device, way_to(model, "OP")[len(way) :])
    segment_device.reset()


class Segment:
    """Virtual SubDevices one behind the other, on an open interface."""

    def __init__(
        self,
        device: str,
        interface: str,
        *,
        fault: str | None = None,
        mailbox: str = "",
        count: int = 1,
        virtual_time: bool = False,
    ) -> None:
        """Make them and open the interface; AdapterError or UserError where that cannot be."""
        own, quirks = planted(load(device, mailbox), fault)
        protocol = linked(own, load_link())
        self.name = protocol.name if count == 1 else f"{protocol.name}, {count} times,"
        self._devices = [
            LinkedSubDevice(protocol, quirks, follower=number < count, commanded=virtual_time)
            for number in range(1, count + 1)
        ]
        for each in self._devices:
            _rehearse(each)
        self._wire = Wire(wire_format(self._devices[0].device.model))
        self._interface, self._virtual_time = interface, virtual_time
        self._socket = open_interface(interface, self._wire.format.ethertype, tags=True)
        self._began = time.monotonic_ns()
        self._switched = False
        gc.freeze()  # what is here stays: to look through it again takes longer than an answer may

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def serve(self, progress: Progress | None, ready: Callable[[], None]) -> None:
        """Answer until Ctrl-C or SIGTERM; SIGHUP switches all SubDevices off and on again.

        `ready` is called once all three have this meaning.
        """
        before = {
            signal.SIGHUP: signal.signal(signal.SIGHUP, self._switch),
            signal.SIGTERM: signal.signal(signal.SIGTERM, signal.default_int_handler),
        }
        try:
            ready()
            self._serve(progress)
        except KeyboardInterrupt:
            return
        except OSError as error:
            failed(self._interface, error)
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _sent(self, frame: bytearray) -> bool:
        """Send a frame back; False: the interface went down meanwhile."""
        try:
            self._socket.send(frame)
        except OSError as error:
            if error.errno != errno.ENETDOWN:
                raise
            return False
        return True

    def _switch(self, *_: object) -> None:
        """Remember that the power goes off and on; it may be in the middle of a frame."""
        self._switched = True

    def _serve(self, progress: Progress | None) -> None:
        frames, shown = 0, 0
        take, answered = FrameReader(self._socket, self._wire.format), self._wire.pass_on
        visits = [device.visit for device in self._devices]
        while True:
            try:
                frame = take()
            except OSError as error:
                if error.errno != errno.ENETDOWN:
                    raise
                continue  # the next call waits until the interface is up again
            if self._switched:
                self._switched = False
                for device in self._devices:
                    device.reset()
            now = (time.monotonic_ns() - self._began) // _MICROSECOND
            if not self._virtual_time:
                for device in self._devices:
                    device.advance(now)
            if answered(frame, visits):
                frames += self._sent(frame)
            if progress is not None and now > shown + _SHOWN:
                shown = now
                states = {device.al_state for device in self._devices}
                progress(frames, 0, f"frames, {' and '.join(sorted(states))}")
