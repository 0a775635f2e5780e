"""`ecatspec show`: a device as tables, a machine as a drawing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import click

from ecatspec.conformance.cli.console import print_json, print_text, refuse, table_text
from ecatspec.conformance.cli.exit_status import CONFORMS
from ecatspec.conformance.cli.options import example

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ecatspec.conformance.render.tables import Sheet


_CHAPTER: Final = "markdown"
_IMAGE: Final = ".bin"
_LARGEST: Final = 1 << 23
"""Bytes of an EEPROM at most: its size word counts up to 65,536 units of 128 bytes."""


@click.command(epilog=example("show"))
@click.argument("device")
@click.argument("machine", required=False)
@click.option("--json", "as_json", is_flag=True, help="Give the tables as JSON.")
@click.option(
    "--format",
    "form",
    metavar="svg|mermaid|dot|markdown",
    help="Draw the MACHINE instead of its tables, or give the chapter of DEVICE (markdown).",
)
def show(*, device: str, machine: str | None, as_json: bool, form: str | None) -> int:
    """Show DEVICE as tables, or the rules of one MACHINE.

    DEVICE is a name, or a path to a .ecs file; the content of an EEPROM (SII) is a .bin file.
    `ecatspec show DEVICE faults` lists the faults that can be planted into its virtual SubDevice.
    """
    from ecatspec.conformance.base.devices import load
    from ecatspec.conformance.describe.text_tables import fault_sheet, machine_sheets, sheets

    if device.endswith(_IMAGE):
        if form is not None or machine is not None:
            refuse(f"{device!a} is an EEPROM, shown as tables only; leave MACHINE and --format out")
        return _eeprom(device, as_json=as_json)
    if form is not None:
        return _drawn(device, machine, form, as_json=as_json)
    protocol = load(device)
    if machine == "faults":
        tables: tuple[Sheet, ...] = (fault_sheet(),)
    else:
        tables = sheets(protocol) if machine is None else machine_sheets(protocol, machine)
    if as_json:
        data: dict[str, object] = {
            "device": protocol.name,
            "wording": protocol.wording,
            "digest": protocol.digest,
            "tables": _as_data(tables),
        }
        print_json("ecatspec.show", data)
        return CONFORMS
    print_text(f"{protocol.name}: {protocol.wording}\n" + "".join(map(table_text, tables)))
    return CONFORMS


def _as_data(tables: Sequence[Sheet]) -> list[dict[str, object]]:
    return [
        {
            "name": table.name,
            "title": table.title,
            "rows": [dict(zip(table.columns, row, strict=True)) for row in table.rows],
        }
        for table in tables
    ]


def _eeprom(file: str, *, as_json: bool) -> int:
    from pathlib import Path

    from ecatspec.conformance.describe.sii_tables import sii_sheets
    from ecatspec.model.esc.sii_data import SiiError

    try:
        # a read without a limit would take whatever a device file gives
        with Path(file).open("rb") as stream:
            data = stream.read(_LARGEST + 1)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or str(error)
        refuse(f"cannot read {file!a} ({why}); give the content of an EEPROM")
    if len(data) > _LARGEST:
        refuse(f"{file!a} has more than {_LARGEST} bytes; give the content of one EEPROM")
    try:
        tables = sii_sheets(data)
    except SiiError as error:
        refuse(f"{file!a}: {error}; give the whole content of an EEPROM")
    if as_json:
        print_json("ecatspec.show_sii", {"file": file, "tables": _as_data(tables)})
    else:
        print_text(f"{file}: {len(data)} bytes\n" + "".join(map(table_text, tables)))
    return CONFORMS


def _drawn(device: str, machine: str | None, form: str, *, as_json: bool) -> int:
    from ecatspec.conformance.base.devices import load, nearest
    from ecatspec.conformance.describe.device_page import chapter
    from ecatspec.conformance.drawings import DRAWINGS

    if form not in DRAWINGS and form != _CHAPTER:
        raise nearest("format", form, (*DRAWINGS, _CHAPTER))
    if as_json:
        refuse("--format and --json exclude each other; give one of them")
    if form == _CHAPTER:
        if machine is not None:
            refuse(f"--format {_CHAPTER} is about the whole device; leave {machine!r} out")
        print_text(chapter(load(device)))
        return CONFORMS
    if machine is None or machine == "faults":
        what = "" if machine is None else ", which faults are not"
        refuse(f"--format draws a machine{what}; name one: ecatspec show DEVICE MACHINE")
    print_text(DRAWINGS[form](load(device), machine))
    return CONFORMS
