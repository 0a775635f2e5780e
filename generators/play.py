"""The only place where stimuli are given to a virtual SubDevice that nobody judges."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.generators.case import (
    Happen,
    Hurry,
    SetUpProcessData,
    StopOutputs,
    Wait,
    WriteOutputs,
    WriteRegister,
    WriteRegisters,
)
from ecatspec.generators.process_data import image, settings
from ecatspec.generators.stimulus import register_bytes, registers_bytes

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from ecatspec.generators.case import Stimulus
    from ecatspec.model.compiled import Model
    from ecatspec.model.subdevice import VirtualSubDevice

_SECOND = 1_000_000
AWHILE = 0.05
"""Seconds after each stimulus: shorter than a watchdog, longer than what comes by itself."""


def play(
    model: Model,
    device: VirtualSubDevice,
    stimuli: Iterable[Stimulus],
    words: Mapping[str, int] | None = None,
) -> Mapping[str, int] | None:
    """Give stimuli that need no mailbox, each with the time that it takes to settle.

    `words` are written cyclically already, None: nothing is. Give what is written in the end.

    Raises:
        TypeError: A stimulus needs the mailbox.

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
            case Hurry():
                continue
            case Happen(event=event):
                machine, _, name = event.partition(".")
                device.happen(machine, name, {})
            case _:
                raise TypeError(f"{stimulus} needs the mailbox")
        _cycle(model, device, words)
        device.advance(AWHILE)
        _cycle(model, device, words)
    return words


def _cycle(model: Model, device: VirtualSubDevice, words: Mapping[str, int] | None) -> None:
    data = None if words is None else image(model, device.state, words)
    if data is not None:
        device.write(model.parameter("process_data_out", "start"), data)
