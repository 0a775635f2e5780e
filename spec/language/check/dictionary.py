"""Checks the object dictionary of a device text: objects, PDOs and what they map."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ecatspec.spec.language.check.findings import Findings
from ecatspec.spec.language.diagnostics import Code
from ecatspec.spec.language.ir import Access, Literal
from ecatspec.spec.language.kinds import width_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.spec.language.ir import ObjectEntry, Protocol, Word

_BITS: Final = 8
_Key = tuple[int, int]


class DictionaryChecker(Findings):
    """Compares the objects of a device text with each other and with the words of the standard."""

    def __init__(self, protocol: Protocol, own: frozenset[_Key], identity: int | None) -> None:
        """Check the objects of `own`: index and subindex of each that the device text declares.

        `identity` is the index of the identity, where the standard has one.
        """
        super().__init__(protocol)
        self._own = own
        self._identity_index = identity
        self._objects = {(entry.index, entry.subindex): entry for entry in protocol.objects}
        self._last: dict[int, int] = {}
        for index, subindex in self._objects:
            self._last[index] = max(subindex, self._last.get(index, 0))

    def dictionary(self) -> None:
        """Note what contradicts itself among the objects."""
        names: dict[str, ObjectEntry] = {}
        for key in sorted(self._own, key=lambda key: self._objects[key].at):
            entry = self._objects[key]
            if not entry.clauses:
                what = f"{_called(entry)} cites no clause"
                self._note(Code.ECS501, entry.at, what, "add the clause that it comes from: [X-01]")
            if entry.name in names:
                what = f"{_called(entry)} has the name of {_called(names[entry.name])}"
                self._note(Code.ECS502, entry.at, what, "give each object a name of its own")
            names.setdefault(entry.name, entry)
            self._whole(entry)
            if entry.subindex == 0:
                self._count(entry)
        self._words()
        self._identity()
        for name, first in (
            ("output_assignment", "first_rx_pdo"),
            ("input_assignment", "first_tx_pdo"),
        ):
            self._direction(name, first)

    def _whole(self, entry: ObjectEntry) -> None:
        """Types of less than a byte (BIT2 to BIT7) are carried in one."""
        width = width_of(self._protocol, entry.type)
        if width is not None and width > _BITS and width % _BITS:
            what = f"{_called(entry)} has {width} bits, and an SDO carries bytes"
            remedy = f"take a number of {width + _BITS - width % _BITS} bits"
            self._note(Code.ECS503, entry.at, what, remedy)

    def _count(self, entry: ObjectEntry) -> None:
        """Subindex 0 counts entries only where there are others."""
        last, count = self._last[entry.index], entry.default
        known = self._protocol.dictionary.closed or self._lists_pdos(entry.index)
        if last and known and isinstance(count, int) and count > last:
            what = f"{_called(entry)} counts {count} entries, and {last} are declared"
            self._note(Code.ECS504, entry.at, what, "declare the others or correct the number")

    def _lists_pdos(self, index: int) -> bool:
        if index in {key[0] for key in map(self._key, ("output_assignment", "input_assignment"))}:
            return True
        return any(index in self._pdos(name) for name in ("first_rx_pdo", "first_tx_pdo"))

    def _words(self) -> None:
        for word in self._protocol.words.values():
            entry = self._objects.get(word.key) if word.key is not None else None
            if entry is None or word.key not in self._own:
                continue
            width, wanted = width_of(self._protocol, entry.type), word.size * _BITS
            if width != wanted:
                has = "no fixed length" if width is None else f"{width} bits"
                what = f"{_called(entry)} has {has}, and word `{word.name}` has {wanted}"
                self._note(Code.ECS505, entry.at, what, f"take a number of {wanted} bits")
        self._pair("control_word", "status_word")

    def _pair(self, name: str, other: str) -> None:
        entry, missing = self._objects.get(self._key(name)), self._key(other)
        if entry is not None and missing not in self._objects and missing != _NO_KEY:
            what = f"a drive has {_called(entry)}, and no {other} {_place(*missing)}"
            self._note(Code.ECS506, entry.at, what, "declare it")

    def _identity(self) -> None:
        """The number of entries is that of the entries, and a closed dictionary says it."""
        index = self._identity_index
        entry = self._objects.get((index, 0)) if index is not None else None
        if index is None or entry is None:
            return
        last = self._last[index]
        own = [self._objects[key] for key in sorted(self._own) if key[0] == index]
        if isinstance(entry.default, int) and entry in own and entry.default < last:
            what = f"{_called(entry)} is {entry.default}, and the identity has {last} entries"
            self._note(Code.ECS507, entry.at, what, f"write {last}")
        elif entry.default is None and own and self._protocol.dictionary.closed:
            what = f"the identity has no number of entries, {_place(index, 0)}"
            self._note(Code.ECS507, own[0].at, what, f"declare it with the value {last}")

    def _direction(self, assignment: str, first: str) -> None:
        pdos = self._pdos(first)
        outputs = assignment == "output_assignment"
        for entry in self._counted(self._key(assignment)[0]):
            pdo = entry.default
            if not isinstance(pdo, int) or not pdo:
                continue
            if pdo not in pdos:
                what = f"{_called(entry)} assigns {pdo:#06x}, which is no PDO of its direction"
                remedy = f"write one of {pdos.start:#06x} .. {pdos.stop - 1:#06x}"
                self._note(Code.ECS508, entry.at, what, remedy)
            elif pdo not in self._last:
                what = f"{_called(entry)} assigns PDO {pdo:#06x}, which is not declared"
                self._note(Code.ECS508, entry.at, what, "declare it or assign another one")
        for index in sorted(self._last):
            if index in pdos:
                for entry in self._counted(index):
                    self._mapped(entry, outputs=outputs)

    def _mapped(self, entry: ObjectEntry, *, outputs: bool) -> None:
        word = self._protocol.words.get("pdo_entry")
        if not isinstance(entry.default, int) or word is None:
            return
        index, subindex, bits = (
            _part(word, name, entry.default) for name in ("index", "subindex", "bit_length")
        )
        if not index:
            return
        target = self._objects.get((index, subindex))
        what = f"{_called(entry)} maps {_place(index, subindex)}"
        if target is None:
            remedy = "declare it, or write `maps BITS` in place of the value"
            self._note(Code.ECS509, entry.at, f"{what}, which is not declared", remedy)
            return
        width = width_of(self._protocol, target.type)
        if width is not None and width != bits:
            what = f"{what} with {bits} bits, and `{target.name}` has {width}"
            self._note(Code.ECS510, entry.at, what, "correct the last byte of the value")
        elif outputs and target.access is Access.READ:
            what = f"{what} as an output, and `{target.name}` is read only"
            self._note(Code.ECS510, entry.at, what, "map it into a PDO of inputs")
        elif not outputs and target.access is Access.WRITE:
            what = f"{what} as an input, and `{target.name}` is write only"
            self._note(Code.ECS510, entry.at, what, "map it into a PDO of outputs")
        elif not target.mappable and not self._silent():
            what = f"{what}, and `{target.name}` is not mappable"
            self._note(Code.ECS510, entry.at, what, "write `mappable` in its row")

    def _silent(self) -> bool:
        """Tell whether no mailbox is there to ask whether an object can be mapped."""
        pin = self._protocol.pins.get("mailbox_support")
        return pin is not None and pin.alternative == "absent"

    def image_bits(self, assignment: str) -> int:
        """How many bits the PDOs have that an assignment assigns by default, as far as is known."""
        word, total = self._protocol.words.get("pdo_entry"), 0
        for assigned in self._counted(self._key(assignment)[0]):
            if isinstance(assigned.default, int):
                for entry in self._counted(assigned.default):
                    if entry.maps is not None:
                        total += entry.maps
                    elif isinstance(entry.default, int) and word is not None:
                        total += _part(word, "bit_length", entry.default)
        return total

    def _counted(self, index: int) -> Iterator[ObjectEntry]:
        """Give the entries that the number at subindex 0 reaches; others have no effect."""
        head = self._objects.get((index, 0))
        if head is not None and isinstance(head.default, int):
            for subindex in range(1, min(head.default, self._last[index]) + 1):
                if (index, subindex) in self._own:
                    yield self._objects[index, subindex]

    def _pdos(self, first: str) -> range:
        start, count = self._number(first), self._number("pdos_a_direction")
        return range(0) if start is None or count is None else range(start, start + count)

    def _number(self, parameter: str) -> int | None:
        found = self._protocol.parameters.get(parameter)
        value = None if found is None else found.value[0]
        return int(value.value) if isinstance(value, Literal) else None

    def _key(self, word: str) -> _Key:
        found = self._protocol.words.get(word)
        return _NO_KEY if found is None or found.key is None else found.key


_NO_KEY: Final = (-1, 0)


def _part(word: Word, name: str, value: int) -> int:
    field = next(field for field in word.fields if field.name == name)
    return value >> field.low & (1 << field.high - field.low + 1) - 1


def _place(index: int, subindex: int) -> str:
    return f"{index:#06x}:{subindex}"


def _called(entry: ObjectEntry) -> str:
    return f"object {_place(entry.index, entry.subindex)} `{entry.name}`"
