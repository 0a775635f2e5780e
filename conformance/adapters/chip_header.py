"""Writes the numbers of ecatspec_chip.h from the texts: registers, bits, events, watchdog.

    python -m ecatspec.conformance.adapters.chip_header conformance/adapters/ecatspec_chip.h

writes them into the header anew. A run compares them with those of the device's text, so that no
library with the chip of other texts is judged.
"""

from __future__ import annotations

import sys
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.base.atomic_write import write_whole
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.register_map import (
    AL_EVENTS,
    PROCESS_DATA,
    SYNC_MANAGERS,
    WATCHDOG,
    field_mask,
)
from ecatspec.model.esc.data_link import linked
from ecatspec.spec.language.ir import Binary, Call, Literal, Name
from ecatspec.spec.language.load import load_device, load_link
from ecatspec.spec.language.references import RegisterFieldRef
from ecatspec.spec.language.scope import Scope, resolve

if TYPE_CHECKING:
    from ecatspec.spec.language.ir import Expression, Protocol

BEGIN: Final = "/* made from the texts: `make chip` writes from here */\n"
END: Final = "/* made from the texts: to here */\n"
_MANAGERS: Final = (*SYNC_MANAGERS, *PROCESS_DATA)
_SIGNS: Final = {"and": "&&", "or": "||"} | {
    sign: sign for sign in ("==", "!=", "<", "<=", ">", ">=", "+", "*", "/")
}
"""What a sign of the texts is in C, where no number is below zero."""
_SETTINGS: Final = ("start", "length", "mode", "direction")
_FLAGS: Final = ("written", "taken", "full", "last_buffer", "read_open", "write_open")
_BYTE: Final = 8


def numbers(model: Model) -> str:
    """Give the part of the header that is made from texts with those of the link beneath."""
    rows = "".join(f"    {_manager(model, name)},\n" for name in _MANAGERS)
    constants = {
        "AL_CONTROL_EVENT": 1 << model.parameter("al_control_event"),
        "CHANGE_EVENT": 1 << model.parameter("sync_manager_change_event"),
        "WATCHDOG_EVENT": field_mask(model.protocol, AL_EVENTS, "process_data_watchdog"),
        "WATCHDOG_RUNNING": field_mask(model.protocol, WATCHDOG, "running"),
        "MAIN_WRITES": model.row("sync_manager_direction", "main_writes"),
        "OUTPUTS": _MANAGERS.index(PROCESS_DATA[0]),
    }
    listed = ",\n".join(
        f"    ECATSPEC_CHIP_{name} = {value:#x}" for name, value in constants.items()
    )
    spans = ",\n".join(
        f"    ecatspec_chip_{name} = {_span(model, name)}"
        for name in ("al_control", AL_EVENTS, WATCHDOG)
    )
    macros = "".join(
        f"#define ECATSPEC_CHIP_{name.upper()}(chip) \\\n    "
        f"{_in_c(model.protocol, model.protocol.definitions[name].value)}\n"
        for name in ("watchdog_on", "watchdog_time")
    )
    text = (
        f"static const struct ecatspec_chip_manager ecatspec_chip_managers[] = {{\n{rows}}};\n"
        f"static const struct ecatspec_chip_span\n{spans};\n"
        f"enum {{\n{listed}\n}};\n{macros}"
    )
    return f"{text}#define ECATSPEC_CHIP_NUMBERS {zlib.crc32(text.encode()):#010x}u\n"


def header(before: str) -> str:
    """Give the header with the numbers of the standard in place of those that it has."""
    head, _, rest = before.partition(BEGIN)
    model = Model(linked(load_device("standard"), load_link()))
    return head + BEGIN + numbers(model) + END + rest.partition(END)[2]


def checksum(model: Model) -> int:
    """Give the number by which a header with other numbers is known."""
    return int(numbers(model).split()[-1].removesuffix("u"), 0)


def _manager(model: Model, name: str) -> str:
    """Give one row of the table of SyncManagers, as `struct ecatspec_chip_manager` has it."""
    status = model.protocol.registers[f"{name}_status"]
    fields = {bits.name for bits in status.fields}
    kind = "mailbox" if name in SYNC_MANAGERS else "buffered"
    spans = (name, *(f"{name}_{part}" for part in ("status", "activation", "pdi_control")))
    event = 1 << (model.parameter("first_sync_manager_event") + _MANAGERS.index(name))
    lines = (
        [_span(model, register) for register in spans],
        [_place(model.protocol, name, field) for field in _SETTINGS],
        [
            _place(model.protocol, f"{name}_activation", "enabled"),
            _place(model.protocol, f"{name}_pdi_control", "deactivated"),
        ],
        [
            str(int(name in SYNC_MANAGERS)),
            str(model.row("sync_manager_mode", kind)),
            f"{status.reset:#x}",
            *(
                f"{field_mask(model.protocol, status.name, flag) if flag in fields else 0:#x}"
                for flag in _FLAGS
            ),
            f"{event:#x}",
        ],
    )
    return "{ " + ",\n      ".join(", ".join(line) for line in lines) + " }"


def _span(model: Model, register: str) -> str:
    at = model.protocol.registers[register]
    return f"{{ {at.address:#06x}, {at.size} }}"


def _place(protocol: Protocol, register: str, field: str) -> str:
    """Give where a field lies: address, lowest bit, how many bits."""
    at = protocol.registers[register]
    bits = next(bits for bits in at.fields if bits.name == field)
    low = at.address + bits.low // _BYTE
    return f"{{ {low:#06x}, {bits.low % _BYTE}, {bits.high - bits.low + 1} }}"


def _in_c(protocol: Protocol, expression: Expression) -> str:
    """Give an expression over registers as C has it."""
    match expression:
        case Literal(value=value):
            return f"{int(value)}"
        case Binary(operator=sign, left=left, right=right) if sign in _SIGNS:
            return f"({_in_c(protocol, left)} {_SIGNS[sign]} {_in_c(protocol, right)})"
        case Call(function="microseconds", arguments=(argument,)):
            return _in_c(protocol, argument)
        case Name(path=path):
            match resolve(protocol, path, Scope()):
                case RegisterFieldRef(register=register, field=field):
                    place = _place(protocol, register, field)
                    return f"ecatspec_chip_bits(chip, {place[2:-2]})"
                case _:
                    pass
        case _:
            pass
    raise TypeError(f"{expression.at}: the chip in C has no such expression")


def main() -> None:
    """Write the header that the command line names anew."""
    file = Path(sys.argv[1])
    write_whole(file, header(file.read_text(encoding="utf-8")))


if __name__ == "__main__":
    main()
