"""The EEPROM (SII) of a virtual SubDevice, made from its text.

The image is made for the state after power-on: identity and PDOs are those of the objects then.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ecatspec.model.core.expressions import Environment
from ecatspec.model.core.observables import control_fields, layout
from ecatspec.model.core.process_image import INPUTS, OUTPUTS
from ecatspec.model.core.register_map import AREAS, BOOTSTRAP, PROCESS_DATA, SYNC_MANAGERS
from ecatspec.model.esc.fmmu import fmmu_registers
from ecatspec.model.esc.subdevice import power_on
from ecatspec.spec.language.ir import Access, Text

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.state import State
    from ecatspec.model.core.values import ObjectKey, Value

WORD: Final = 2
"""Bytes of a word, in which the EEPROM is addressed."""
_BYTE: Final = 8
_BYTE_MASK: Final = (1 << _BYTE) - 1
_IDENTITY: Final = ("vendor", "product", "revision", "serial")
"""Fields of the identity, in the order of the subindices of its object."""
_MANAGER_USES: Final = ("mailbox_out", "mailbox_in", "outputs", "inputs")
_FMMU_USES: Final = ("outputs", "inputs", "mailbox_state")
_PDOS: Final = (("rx_pdos", OUTPUTS, PROCESS_DATA[0]), ("tx_pdos", INPUTS, PROCESS_DATA[1]))
_ENDED: Final = b"\xff"
"""What an EEPROM holds where nothing was written."""


def sii_image(model: Model) -> bytes:
    """Give the content of the EEPROM of a device with these texts, which include those of the link.

    Its size is a power of two, as EEPROMs have it.
    """
    maker = _Maker(model)
    content = maker.head(0) + maker.categories()
    size = model.parameter("smallest_eeprom")
    while size < len(content):
        size *= 2
    return (maker.head(size) + maker.categories()).ljust(size, _ENDED)


def checksum(model: Model, data: bytes) -> int:
    """Give the checksum of the configuration area."""
    polynomial, rest = (model.parameter(f"checksum_{part}") for part in ("polynomial", "start"))
    for byte in data:
        rest ^= byte
        for _ in range(_BYTE):
            rest = rest << 1 ^ (polynomial if rest >> (_BYTE - 1) else 0)
            rest &= _BYTE_MASK
    return rest


class _Maker:
    """One image while it is made."""

    def __init__(self, model: Model) -> None:
        self._model = model
        self._state: State = power_on(model)
        self._known: Mapping[ObjectKey, bytes] = self._state.objects
        index = model.parameter("device_name_object")
        texts = (e for e in model.protocol.objects if e.index == index and isinstance(e.type, Text))
        named = (self._known.get((entry.index, entry.subindex), b"") for entry in texts)
        self._strings = [*filter(None, named), model.protocol.name.encode()]
        """The name comes first, where MainDevices expect it; the name of the text is the order."""
        self._order = len(self._strings)

    def head(self, size: int) -> bytes:
        """Give the part with fixed places, of an EEPROM with a size in bytes."""
        model = self._model
        loaded = {name: self._reset(name) for name in ("pdi_control", "esc_configuration")}
        configuration = model.codec.encode("sii_configuration", loaded)
        fields: dict[str, Value] = {"checksum": checksum(model, configuration), "version": 1}
        index = model.parameter("identity_object")
        for subindex, name in enumerate(_IDENTITY, 1):
            fields[name] = int.from_bytes(self._known.get((index, subindex), b""), "little")
        fields["coe"] = coe = self._goes("mailbox_support", "present")
        boots = coe and self._goes("bootstrap", "supported")
        for areas, there in ((AREAS, coe), (BOOTSTRAP, boots)):
            for name in SYNC_MANAGERS:
                for part in ("start", "length"):
                    fields[f"{areas[name]}_{part}"] = model.parameter(areas[name], part) * there
        fields["size"] = max(0, size // model.parameter("size_unit") - 1)
        return configuration + model.codec.encode("sii_information", fields)

    def categories(self) -> bytes:
        """Give all categories, and the mark that there are no more."""
        pdos = {name: b"".join(self._pdos(*of)) for name, *of in _PDOS}
        found = {
            "strings": self._texts(),  # after the PDOs, whose entries have names
            "general": self._general(),
            "fmmus": self._fmmus(),
            "sync_managers": b"".join(map(self._manager, _MANAGER_USES, AREAS)),
            **pdos,
        }
        parts = (self._category(name, content) for name, content in found.items() if content)
        end = self._model.row("sii_category", "end").to_bytes(WORD, "little")
        return b"".join(parts) + end

    def _category(self, name: str, content: bytes) -> bytes:
        content += bytes(-len(content) % WORD)
        kind = self._model.row("sii_category", name)
        header: dict[str, Value] = {"kind": kind, "words": len(content) // WORD}
        return self._model.codec.encode("sii_category_header", header) + content

    def _texts(self) -> bytes:
        encode = self._model.codec.encode
        texts = (encode("sii_string", {"text": text[:_BYTE_MASK]}) for text in self._strings)
        return bytes([len(self._strings)]) + b"".join(texts)

    def _general(self) -> bytes:
        image, coe = self._model.image, self._goes("mailbox_support", "present")
        present = self._goes("information_support", "served")
        settings: dict[str, Value] = {
            "order": self._order,
            "name": 1,
            "coe_sdo": coe,
            "coe_information": coe and present,
            "coe_assign": coe and self._can_write(image.assignments.values()),
            "coe_configure": coe and any(map(self._can_write, image.pdos.values())),
            "coe_upload": False,
            "coe_complete": coe and self._goes("complete_access_support", "served"),
            **self._ports(),
        }
        return self._model.codec.encode("sii_general", settings)

    def _ports(self) -> dict[str, Value]:
        """Give the kind of each port, which has 4 bits here and 2 in the register."""
        tables = self._model.protocol.tables
        names = {row.value: row.name for row in tables["port_type"].rows}
        register = self._model.protocol.registers["port_descriptor"]
        ports: dict[str, Value] = {}
        for field in register.fields:
            kind = register.reset >> field.low & (1 << field.high - field.low + 1) - 1
            ports[field.name] = self._model.row("physical_port", names.get(kind, "unused"))
        return ports

    def _named(self, key: ObjectKey | None) -> int:
        """Give the number of the string with the name of an object; 0: it has none."""
        entry = None if key is None else self._model.dictionary.entries.get(key)
        if entry is None:
            return 0
        name = entry.name.encode()
        if name not in self._strings:
            if len(self._strings) == _BYTE_MASK:
                return 0
            self._strings.append(name)
        return self._strings.index(name) + 1

    def _can_write(self, indices: Iterable[int]) -> bool:
        """Tell whether one of the objects can be written at all."""
        wanted = set(indices)
        rights = {Access.WRITE, Access.BOTH}
        return any(e.index in wanted and e.access in rights for e in self._model.protocol.objects)

    def _fmmus(self) -> bytes:
        number = len(fmmu_registers(self._model.protocol))
        uses = [self._model.row("fmmu_use", use) for use in _FMMU_USES][:number]
        return bytes(uses).ljust(number, bytes([self._model.row("fmmu_use", "unused")]))

    def _manager(self, use: str, name: str) -> bytes:
        model = self._model
        length = model.parameter(AREAS[name], "length")
        if name in PROCESS_DATA:
            assigned = OUTPUTS if use == "outputs" else INPUTS
            bits = sum(part.bits for part in layout(model, self._state, assigned) or ())
            length = -(-bits // _BYTE)
        settings: dict[str, Value] = {
            "start": model.parameter(AREAS[name], "start"),
            "length": length,
            **control_fields(model, name),
            # one of process data is needed even where nothing is assigned at power-on
            "enabled": length > 0 or name in PROCESS_DATA,
            "use": model.row("sync_manager_use", use),
        }
        return model.codec.encode("sii_sync_manager", settings)

    def _pdos(self, assignment: str, manager: str) -> Iterator[bytes]:
        """Yield the PDOs of a direction, those that are assigned at power-on with their manager."""
        model, image = self._model, self._model.image
        encode, known = model.codec.encode, self._known
        chosen = set(self._numbers(image.assignments[assignment]))
        here = list(AREAS).index(manager)
        elsewhere = model.parameter("unused_sync_manager")
        declared = {entry.index for entry in model.protocol.objects}
        for index in sorted(declared & set(image.pdos[assignment])):
            entries = []
            for subindex in range(1, known.get((index, 0), b"\0")[0] + 1):
                value = int.from_bytes(known.get((index, subindex), b""), "little")
                key, bits = image.target(value)
                target, part = key or (0, 0)
                fields: dict[str, Value] = {
                    "index": target,
                    "subindex": part,
                    "name": self._named(key),
                    "data_type": self._data_type(key),
                    "bit_length": bits,
                }
                entries.append(encode("sii_pdo_entry", fields))
            header: dict[str, Value] = {
                "index": index,
                "entries": len(entries),
                "sync_manager": here if index in chosen else elsewhere,
                "fixed": not self._can_write([index]),
            }
            yield encode("sii_pdo", header) + b"".join(entries)

    def _numbers(self, index: int) -> Iterator[int]:
        for subindex in range(1, self._known.get((index, 0), b"\0")[0] + 1):
            yield int.from_bytes(self._known.get((index, subindex), b""), "little")

    def _data_type(self, key: ObjectKey | None) -> int:
        if key not in self._model.dictionary.entries:
            return 0
        ask = self._model.dictionary.functions["data_type_of"]
        number = ask(Environment(self._state.slots, self._known, {}), key)
        return number & _BYTE_MASK if isinstance(number, int) else 0

    def _goes(self, choice: str, way: str) -> bool:
        return self._state.slots[self._model.slots[f"choice {choice}"]] == way

    def _reset(self, register: str) -> int:
        return self._model.protocol.registers[register].reset
