"""Gives stimuli to a virtual SubDevice whose answers are not judged."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ecatspec.generators.cases.case import (
    Happen,
    Hurry,
    ReadConfiguration,
    ReadInitial,
    SendFrame,
    SetUpProcessData,
    StopOutputs,
    Wait,
    WriteOutputs,
    WriteRegister,
    WriteRegisters,
)
from ecatspec.generators.cases.process_data import image, settings
from ecatspec.generators.cases.stimulus import frame_bytes, register_bytes, registers_bytes
from ecatspec.model.core.memo import once
from ecatspec.model.core.register_map import SYNC_MANAGERS
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.spec.language.functions import AREA_PARTS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from ecatspec.generators.cases.case import Stimulus
    from ecatspec.model.core.compilation import Model

_, MAIN_IN = SYNC_MANAGERS
_SECOND = 1_000_000
AWHILE = 0.05
"""Seconds after each stimulus: shorter than a watchdog, longer than what comes by itself."""


@dataclass(frozen=True, slots=True)
class Reached:
    """A virtual SubDevice where stimuli brought it, and the words that are written cyclically."""

    device: VirtualSubDevice
    words: Mapping[str, int] | None = None

    def by(self, model: Model, stimuli: Iterable[Stimulus]) -> Reached:
        """Give where more stimuli lead; this stays as it is, so that others can begin here too."""
        device = VirtualSubDevice(self.device.model.protocol)
        device.restore(self.device.snapshot())
        return Reached(device, play(model, device, stimuli, self.words))


@once
def at_power_on(model: Model) -> Reached:
    """Give a virtual SubDevice of these texts that was just switched on."""
    return Reached(VirtualSubDevice(model.protocol))


def play(
    model: Model,
    device: VirtualSubDevice,
    stimuli: Iterable[Stimulus],
    words: Mapping[str, int] | None = None,
) -> Mapping[str, int] | None:
    """Give stimuli, each with the time that it takes to settle; replies are read and dropped.

    `words` are written cyclically already, None: nothing is. Give what is written in the end.

    Raises:
        TypeError: A stimulus depends on what the device answers.

    """
    for stimulus in stimuli:
        match stimulus:
            case WriteRegister():
                device.write(*register_bytes(model, stimulus))
            case WriteRegisters():
                device.write(*registers_bytes(model, stimulus))
            case SetUpProcessData():
                for writes in settings(model, device.state, stimulus):
                    device.write(*registers_bytes(model, writes))
            case WriteOutputs(words=more):
                words = {**(words or {}), **more}
            case StopOutputs():
                words = None
            case Wait(microseconds=microseconds):
                device.advance(microseconds / _SECOND)
            case SendFrame():
                exchange(model, device, stimulus)
            case ReadConfiguration() | ReadInitial() | Hurry():
                continue
            case Happen(event=event):
                machine, _, name = event.partition(".")
                device.happen(machine, name, {})
            case _:
                raise TypeError(f"{stimulus} depends on what the device answers")
        _cycle(model, device, words)
        device.advance(AWHILE)
        _cycle(model, device, words)
    return words


def exchange(
    model: Model, device: VirtualSubDevice, stimulus: SendFrame, counter: int = 0
) -> list[bytes]:
    """Send a message and give all messages that come; with the counter 0 it is no duplicate."""
    start, length = (model.parameter("mailbox_out", part) for part in AREA_PARTS)
    data = frame_bytes(model, stimulus, counter)
    device.write(start, data.ljust(length, b"\0"))
    device.advance(AWHILE)
    found: list[bytes] = []
    while (box := device.esc.mailbox(MAIN_IN)) is not None and box.full:
        found.append(device.read(box.channel.start, box.channel.length)[1])
    return found


def _cycle(model: Model, device: VirtualSubDevice, words: Mapping[str, int] | None) -> None:
    data = None if words is None else image(model, device.state, words)
    if data is not None:
        device.write(model.parameter("process_data_out", "start"), data)
