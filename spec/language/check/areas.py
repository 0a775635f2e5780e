"""Checks the memory areas of a device text: their place, their length, what has to fit in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from ecatspec.spec.language.check.findings import Findings
from ecatspec.spec.language.diagnostics import Code
from ecatspec.spec.language.ir import Literal

if TYPE_CHECKING:
    from collections.abc import Callable

    from ecatspec.spec.language.ir import Protocol, Span

_MAILBOXES: Final = ("mailbox_out", "mailbox_in")
_IMAGES: Final = (
    ("process_data_out", "output_assignment"),
    ("process_data_in", "input_assignment"),
)
_BITS: Final = 8


@dataclass(frozen=True, slots=True)
class _Area:
    name: str
    start: int
    length: int
    at: Span

    def meets(self, other: _Area) -> bool:
        return self.start < other.start + other.length and other.start < self.start + self.length


class AreaChecker(Findings):
    """Compares the areas that a device text sets with each other and with what they hold."""

    def __init__(self, protocol: Protocol, file: str, bits: Callable[[str], int]) -> None:
        """Check the areas set in `file`; `bits` gives the size of the image of an assignment."""
        super().__init__(protocol)
        self._file = file
        self._bits = bits

    def areas(self) -> None:
        """Note areas that overlap, and those that are too small.

        What the standard sets is no statement of the device: it overlaps nothing.
        """
        pin = self._protocol.pins.get("mailbox_support")
        mailboxes = () if pin is not None and pin.alternative == "absent" else _MAILBOXES
        names = (*mailboxes, *(name for name, _ in _IMAGES))
        areas = {name: area for name in names if (area := self._area(name)) is not None}
        found = list(areas.values())
        for position, area in enumerate(found):
            for other in found[:position]:
                both = area.at.file == other.at.file == self._file
                if both and area.meets(other):
                    what = f"areas `{other.name}` and `{area.name}` overlap"
                    at = max(area.at, other.at)
                    self._note(Code.ECS511, at, what, "move one of them or make it shorter")
        least = self._protocol.parameters.get("minimal_mailbox")
        for name in mailboxes:
            if name in areas and least is not None and isinstance(least.value[0], Literal):
                self._small(areas[name], int(least.value[0].value), "a mailbox has at least")
        for name, assignment in _IMAGES:
            if name in areas:
                needed = -(-self._bits(assignment) // _BITS)
                self._small(areas[name], needed, "the assigned PDOs have")

    def _small(self, area: _Area, least: int, why: str) -> None:
        if area.at.file == self._file and area.length < least:
            what = f"area `{area.name}` has {area.length} bytes, and {why} {least}"
            self._note(Code.ECS512, area.at, what, "make it longer")

    def _area(self, name: str) -> _Area | None:
        found = self._protocol.parameters.get(name)
        if found is None:
            return None
        match found.value:
            case (Literal(start), Literal(length)):
                return _Area(name, int(start), int(length), found.at)
            case _:
                return None
