"""A virtual drive on the desk of tests: its AL state and its mailbox."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ecatspec.generators.cases.bringup import mailbox_settings, request, way_to
from ecatspec.generators.cases.play import play
from ecatspec.model.esc.subdevice import VirtualSubDevice

if TYPE_CHECKING:
    from ecatspec.generators.cases.case import Stimulus
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.values import Value

STATES: Final = ("INIT", "PREOP", "SAFEOP", "OP")
WAYS: Final = frozenset(
    {
        ("INIT", "PREOP"),
        ("PREOP", "INIT"),
        ("PREOP", "SAFEOP"),
        ("SAFEOP", "PREOP"),
        ("SAFEOP", "OP"),
        ("OP", "SAFEOP"),
        ("OP", "PREOP"),
        ("SAFEOP", "INIT"),
        ("OP", "INIT"),
    }
)
"""The changes of a device without BOOT."""


def shown(model: Model, device: VirtualSubDevice) -> tuple[str, bool]:
    """Give AL state and error indication as AL Status has them."""
    status = device.esc.register("al_status")
    names = {r.value: r.name for r in model.protocol.tables["al_state"].rows}
    return names[status & 0xF], bool(status & 0x10)


def to(model: Model, state: str) -> Stimulus:
    return request(model.row("al_state", state))


def way(model: Model, state: str) -> tuple[Stimulus, ...]:
    return mailbox_settings(model) if state == "INIT" else way_to(model, state)


class Desk:
    """A virtual drive in PREOP, and its mailbox."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.device = VirtualSubDevice(model.protocol)
        play(model, self.device, way(model, "PREOP"))
        self.counter = 0

    def ask(self, frame: str, **fields: Value) -> tuple[str, dict[str, Value]]:
        """Send a message; give the frame and the fields of what comes back, nothing of silence."""
        self.counter = self.counter % 7 + 1
        out, back = (
            (self.model.parameter(name, "start"), self.model.parameter(name, "length"))
            for name in ("mailbox_out", "mailbox_in")
        )
        data = self.model.codec.encode(frame, {"counter": self.counter, **fields})
        assert self.device.write(out[0], data.ljust(out[1], b"\0")) == 1
        self.device.advance(0.05)
        counter, answer = self.device.read(*back)
        message = self.model.decode(answer) if counter else None
        return ("", {}) if message is None else (message.frame, dict(message.fields))

    def read(self, index: int, subindex: int = 0) -> tuple[str, Value]:
        """Upload an entry; give the frame of the answer, and value or abort code."""
        frame, fields = self.ask("sdo_upload_request", index=index, subindex=subindex)
        return frame, fields["code" if frame == "sdo_abort" else "value"]

    def write(self, index: int, subindex: int, value: bytes) -> Value:
        """Download an entry expedited; give the abort code, 0 where the value was taken."""
        fields: dict[str, Value] = {"index": index, "subindex": subindex, "value": value}
        frame, answer = self.ask("sdo_download_expedited", **fields)
        return answer["code"] if frame == "sdo_abort" else 0
