"""Tests of our layouts of frames against a foreign decoder: Wireshark."""

from __future__ import annotations

import itertools
import os
import shutil
import subprocess
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal, TypeAlias, assert_never
from xml.etree import ElementTree as ET

import dpkt
import pytest

from ecatspec.model.core.compilation import Model
from ecatspec.model.core.expressions import Environment, Getter, compile_expression
from ecatspec.model.core.functions import PLAIN
from ecatspec.spec.language.ir import Bytes, FrameField, Name, Named
from ecatspec.spec.language.kinds import width_of
from ecatspec.spec.language.load import load_device
from ecatspec.spec.language.nodes import names_in

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from ecatspec.model.core.values import Value

pytestmark = pytest.mark.xdist_group("wireshark")
"""It decodes all samples once, in one process."""
MODEL: Final = Model(load_device("standard"))
PROTOCOL: Final = MODEL.protocol
CODEC: Final = MODEL.codec

# --- how Wireshark names our fields ---------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Number:
    """A number; spread over several fields of Wireshark, it has its lowest bit in the first.

    `only_if` names a flag of ours without which Wireshark takes the bytes for something else.
    """

    fields: tuple[str, ...]
    only_if: str | None = None


@dataclass(frozen=True, slots=True)
class Bits:
    """A number of which Wireshark shows `width` bits, its own bits from `low` on."""

    field: str
    low: int
    width: int


@dataclass(frozen=True, slots=True)
class Raw:
    """Bytes: all that Wireshark shows as these fields together, or the start or end of it."""

    fields: tuple[str, ...]
    where: Literal["all", "start", "end"] = "all"
    only_if: str | None = None


@dataclass(frozen=True, slots=True)
class Unseen:
    """Wireshark shows no such field."""

    reason: str


Row: TypeAlias = Number | Bits | Raw | Unseen

BOX: Final = "ecat_mailbox."
COE: Final = "ecat_mailbox.coe."


def number(*fields: str, only_if: str | None = None) -> Number:
    return Number(tuple(COE + field for field in fields), only_if)


def raw(
    *fields: str, where: Literal["all", "start", "end"] = "all", only_if: str | None = None
) -> Raw:
    return Raw(tuple(COE + field for field in fields), where, only_if)


RESERVED: Final = Unseen("reserved; Wireshark does not show reserved bits")
PARTS: Final = Unseen("the frames inside are compared field by field")
NO_ERRORS: Final = Unseen("Wireshark knows no mailbox errors")
NO_BEYOND: Final = Unseen("Wireshark calls it malformed, or no mailbox at all")
NO_EMERGENCIES: Final = Unseen("Wireshark takes no emergency apart")
NO_ABORTED: Final = Unseen("Wireshark shows the code of an abort and nothing else")
NO_EXCESS: Final = Unseen("superfluous bytes at the end; Wireshark does not look at them")
NO_PADDING: Final = Unseen("Wireshark shows 1, 2 or 4 bytes of data, the padding at times")

INDEX: Final = {"index": number("sdoidx"), "subindex": number("sdosub")}
INFO_INDEX: Final = number("sdoinfoindex")

ACCESS: Final[Mapping[str, Row]] = {
    name: Bits(COE + "sdoinfoobjaccess", low, width)
    for low, width, name in (
        (0, 1, "read_in_preop"),
        (1, 1, "read_in_safeop"),
        (2, 1, "read_in_op"),
        (3, 1, "write_in_preop"),
        (4, 1, "write_in_safeop"),
        (5, 1, "write_in_op"),
        (6, 1, "in_rx_pdo"),
        (7, 1, "in_tx_pdo"),
        (8, 1, "stored"),
        (9, 1, "setting"),
        (10, 6, "reserved_access"),
    )
}

# Without the size bit Wireshark reads a normal download as an expedited one.
SIZED: Final = "size_indicated"

# Layouts around the mailbox.
LAYERS: Final[Mapping[str, Mapping[str, Row]]] = {
    "ethercat_header": {
        "frame_length": Number(("ecatf.length",)),
        "reserved": Number(("ecatf.reserved",)),
        "frame_type": Number(("ecatf.type",)),
    },
    "datagram_header": {
        "command": Number(("ecat.cmd",)),
        "number": Number(("ecat.idx",)),
        "position": Number(("ecat.adp",)),
        "offset": Number(("ecat.ado",)),
        "size": Number(("ecat.subframe.length",)),
        "reserved": Number(("ecat.subframe.reserved",)),
        "circulated": Number(("ecat.subframe.circulating",)),
        "more": Number(("ecat.subframe.more",)),
        "interrupt": Number(("ecat.int",)),
    },
    "datagram_trailer": {"working_counter": Number(("ecat.cnt",))},
}

# Frame -> field -> what Wireshark makes of it. A name that starts with `reserved` needs no row.
ROWS: Final[Mapping[str, Mapping[str, Row]]] = {
    "mailbox": {
        "length": Number((BOX + "length",)),
        "address": Number((BOX + "address",)),
        "channel": Bits(BOX + "priority", 0, 2),  # what Wireshark calls so has the mask of these
        "priority": Unseen("what Wireshark calls so are the two lowest bits of the channel"),
        "type": Number((BOX + "type",)),
        "counter": Number((BOX + "counter",)),
        "payload": Raw((BOX + "foe", BOX + "soe")),
    },
    "mailbox_beyond": dict.fromkeys(
        (
            "beyond_length",
            "beyond_address",
            "beyond_channel",
            "beyond_priority",
            "type",
            "counter",
            "rest_of_area",
        ),
        NO_BEYOND,
    ),
    "mailbox_error": {"command": NO_ERRORS, "detail": NO_ERRORS},
    "coe": {
        "number": number("number"),
        "service": number("type"),
        "body": Raw((BOX + "coe",), "end"),
    },
    "sdo_request": {"flags": PARTS, "command": number("sdoreq"), "rest": PARTS},
    "sdo_upload_request": {
        "size_indicated": Unseen("has no meaning in an upload request"),
        "complete_access": number("sdoccsid.complete"),
        "command": number("sdoreq"),
        **INDEX,
        "excess": NO_EXCESS,
    },
    "sdo_download_expedited": {
        "size_indicated": number("sdoccsid.sizeind"),
        "expedited": number("sdoccsid.expedited"),
        "unused": number("sdoccsid.size0", "sdoccsid.size1"),
        "complete_access": number("sdoccsid.complete"),
        "command": number("sdoreq"),
        **INDEX,
        "value": raw("sdodata", where="start"),
        "padding": NO_PADDING,
        "excess": NO_EXCESS,
    },
    "sdo_download_normal": {
        "size_indicated": number("sdoccsid.sizeind"),
        "expedited": number("sdoccsid.expedited"),
        "unused": number("sdoccsid.size0", "sdoccsid.size1"),
        "complete_access": number("sdoccsid.complete"),
        "command": number("sdoreq"),
        **INDEX,
        "size": number("sdolength", only_if=SIZED),
        "value": raw("dsoldata", only_if=SIZED),
    },
    "sdo_download_segment": {
        "last": number("sdoccsds.lastseg"),
        "unused": number("sdoccsds.size"),
        "toggle": number("sdoccsds.toggle"),
        "command": number("sdoreq"),
        "value": raw("dsoldata", where="start"),
        "padding": raw("dsoldata", where="end"),
    },
    "sdo_upload_segment": {
        "flags": RESERVED,
        "toggle": number("sdoccsus_toggle"),
        "command": number("sdoreq"),
        "excess": NO_EXCESS,
    },
    "sdo_abort": {
        "flags": RESERVED,
        "command": number("sdoreq"),
        "index": NO_ABORTED,
        "subindex": NO_ABORTED,
        "code": number("abortcode"),
    },
    "sdo_response": {"flags": PARTS, "command": number("sdores"), "rest": PARTS},
    "sdo_upload_expedited": {
        "size_indicated": number("sdoscsiu_sizeind"),
        "expedited": number("sdoscsiu_expedited"),
        "unused": number("sdoscsiu_size0", "sdoscsiu_size1"),
        "complete_access": number("sdoscsiu_complete"),
        "command": number("sdores"),
        **INDEX,
        "value": raw("sdodata", where="start"),
        "padding": NO_PADDING,
    },
    "sdo_upload_normal": {
        "size_indicated": number("sdoscsiu_sizeind"),
        "expedited": number("sdoscsiu_expedited"),
        "unused": number("sdoscsiu_size0", "sdoscsiu_size1"),
        "complete_access": number("sdoscsiu_complete"),
        "command": number("sdores"),
        **INDEX,
        "size": number("sdolength"),
        "value": raw("dsoldata"),
    },
    "sdo_download_response": {"flags": RESERVED, "command": number("sdores"), **INDEX},
    "sdo_download_segment_response": {
        "flags": RESERVED,
        "toggle": number("sdoscsds_toggle"),
        "command": number("sdores"),
    },
    "sdo_upload_segment_response": {
        "last": number("sdoscsus_lastseg"),
        "unused": number("sdoscsus_bytes"),
        "toggle": number("sdoscsus_toggle"),
        "command": number("sdores"),
        "value": raw("dsoldata", where="start"),
        "padding": raw("dsoldata", where="end"),
    },
    "emergency": {
        "error_code": NO_EMERGENCIES,
        "error_register": NO_EMERGENCIES,
        "manufacturer": NO_EMERGENCIES,
    },
    "sdo_information": {
        "opcode": Bits(COE + "sdoinfoopcode", 0, 7),
        "incomplete": Bits(COE + "sdoinfoopcode", 7, 1),
        "fragments_left": number("sdoinfofrag"),
        "information": PARTS,
    },
    "information_list_request": {"list_type": number("sdoinfolisttype"), "excess": NO_EXCESS},
    # The first fragment has the type of the list before the indexes; Wireshark takes each for it.
    "information_list": {"value": raw("sdoinfolisttype", "sdoinfolist")},
    "information_object_request": {"index": INFO_INDEX, "excess": NO_EXCESS},
    "information_object": {
        "index": INFO_INDEX,
        "data_type": number("sdoinfodatatype"),
        "maximum_subindex": number("sdoinfomaxsub"),
        "object_code": number("sdoinfoobjcode"),
        "object_name": raw("sdoinfoname"),
    },
    "information_entry_request": {
        "index": INFO_INDEX,
        "subindex": number("sdoinfosubindex"),
        "value_info": number("sdoinfovalueinfo"),
        "excess": NO_EXCESS,
    },
    "information_entry": {
        "index": INFO_INDEX,
        "subindex": number("sdoinfosubindex"),
        "value_info": number("sdoinfovalueinfo"),
        "data_type": number("sdoinfodatatype"),
        "bit_length": number("sdoinfobitlen"),
        **ACCESS,
        # What the value info says to stand before the name; Wireshark 4.0 takes it for the name.
        "entry_data": raw(
            "sdoinfounittype",
            "sdoinfodefaultvalue",
            "sdoinfominvalue",
            "sdoinfomaxvalue",
            "sdoinfoname",
        ),
    },
    "information_error": {"code": number("sdoinfoerrorcode")},
}

# Wireshark takes no mailbox for one whose type is none of the five protocols that it knows.
NO_MAILBOX: Final = frozenset({"mailbox_error"})

# What says of itself that it is longer than the mailbox.
BROKEN: Final = frozenset({"mailbox_beyond"})

# --- what is encoded ------------------------------------------------------------------------------

TO_DEVICE: Final = ("FPWR", "mailbox_out")
FROM_DEVICE: Final = ("FPRD", "mailbox_in")
FROM_DEVICE_ONLY: Final = frozenset({"sdo_response", "emergency"})  # services

# The encoder counts these bytes.
COUNTED: Final = "length"

# In place of all values: types that mean nothing to Wireshark beyond the header of the mailbox.
ONLY: Final = {("mailbox", "type"): ("foe", "soe")}

# What the mailbox holds beside its header.
ROOM: Final = MODEL.parameter("mailbox_out", "length") - CODEC.size("mailbox")
BEYOND: Final = ("mailbox_beyond", "beyond_length")

# Bytes of a body of free length. Wireshark calls SDO services of less than 8 bytes invalid.
LENGTHS: Final = (7, 8, 20)
OTHER_LENGTHS: Final = {
    "mailbox": (6, 7, 60),
    "mailbox_beyond": (ROOM,),
    "sdo_upload_request": (0, 1, 20),
    "sdo_download_expedited": (0, 1, 20),
    "sdo_upload_segment": (0, 1, 20),
    "coe": (8, 9, 20),
    "sdo_download_normal": (1, 0, 5, 20),
    "sdo_upload_normal": (1, 0, 5, 20),
    "sdo_information": (18, 40),
    "information_list": (2, 4, 20),
    "information_object": (1, 0, 20),
    "information_entry": (1, 0, 20),
}

NARROW: Final = 3  # fields of so many bits are tried in all combinations
MIXTURES: Final = 16  # samples in which every field has another value than in the one before


@dataclass(frozen=True, slots=True)
class Sample:
    """What was encoded: all fields by layout."""

    frame: str
    fields: Mapping[str, Mapping[str, Value]]
    mailbox: bytes
    ethernet: bytes


def own_fields(frame: str) -> tuple[FrameField, ...]:
    """The fields of the frame, and not the body of it that a frame inside takes apart."""
    return PROTOCOL.frames[frame].fields


def mailbox_frames() -> list[str]:
    return [name for name in PROTOCOL.frames if CODEC.trail(name)[0] not in LAYERS]


def pattern(size: int) -> bytes:
    return bytes((37 * at + 17) % 256 for at in range(size))


def values_of(frame: str, field: FrameField, width: int) -> list[int]:
    """All values of a narrow field and all rows of a table; else each bit, none and all."""
    rows = PROTOCOL.tables[field.type.table].rows if isinstance(field.type, Named) else ()
    if only := ONLY.get((frame, field.name)):
        return [row.value for row in rows if row.name in only]
    if (frame, field.name) == BEYOND:
        return [ROOM + 1, ROOM + 2, 1 << width - 1, (1 << width) - 1]
    if width <= NARROW + 1:
        return list(range(1 << width))
    bits = {1 << bit for bit in range(width)}
    return sorted({0, (1 << width) - 1, *bits, *(row.value for row in rows)})


def numbers_of(frame: str) -> Iterator[dict[str, int]]:
    """Combinations of the numbers that are free in a frame: own ones and those around it.

    Those around it are tried one by one in their own frame only, here in mixtures.
    """
    narrow: dict[str, list[int]] = {}
    wide: dict[str, list[int]] = {}
    outer: dict[str, list[int]] = {}
    for name in CODEC.trail(frame):
        for field in own_fields(name):
            width = width_of(PROTOCOL, field.type)
            given = field.name == COUNTED or field.name in CODEC.fixed(frame)
            if width is not None and not given:
                inner = narrow if width <= NARROW else wide
                (inner if name == frame else outer)[field.name] = values_of(name, field, width)
    every = outer | narrow | wide
    plain = {name: values[0] for name, values in every.items()}
    yield {name: values[-1] for name, values in every.items()}
    for shift in range(MIXTURES):
        yield {
            name: values[(place * 5 + shift * 3) % len(values)]  # neighbours differ
            for place, (name, values) in enumerate(every.items())
        }
    for chosen in itertools.product(*narrow.values()):
        yield plain | dict(zip(narrow, chosen, strict=True))
    for name, values in wide.items():
        yield from (plain | {name: value} for value in values)


def bytes_of(frame: str, numbers: Mapping[str, Value], free: int) -> dict[str, bytes]:
    """Bodies: as long as the text says, and `free` bytes or what is left of them for the last.

    Texts may speak of the length of the whole message, which `free` bytes at its end settle.
    """
    fixed = sum(CODEC.size(name) for name in CODEC.trail(frame)[1:])
    known = {**numbers, COUNTED: fixed + free}

    def lookup(name: Name) -> Getter:
        return lambda environment: environment.parameters[name.path]

    found: dict[str, bytes] = {}
    for field in own_fields(frame):
        size: Value = free
        if isinstance(field.type, Bytes):
            length = field.type.length
            if length is not None and not (isinstance(length, Name) and length.path == COUNTED):
                size = compile_expression(length, lookup, PLAIN)(Environment((), {}, known))
            assert isinstance(size, int)
            found[field.name] = pattern(size)
            if length is not None and COUNTED in names_in(length):
                free -= size  # for what comes behind
    return found


def contents_of(frame: str) -> Iterator[dict[str, Value]]:
    first, *others = OTHER_LENGTHS.get(frame, LENGTHS)
    for place, numbers in enumerate(numbers_of(frame)):
        known = {**CODEC.fixed(frame), **numbers}
        yield known | bytes_of(frame, known, first)
        if place <= MIXTURES:
            yield from (known | bytes_of(frame, known, length) for length in others)


def ways_of(frame: str) -> tuple[tuple[str, str], ...]:
    """Where a frame occurs: in requests, replies, or both."""
    fixed = CODEC.fixed(frame)
    services = {row.value: row.name for row in PROTOCOL.tables["coe_service"].rows}
    service = fixed.get("service")
    if frame in NO_MAILBOX or (isinstance(service, int) and services[service] in FROM_DEVICE_ONLY):
        return (FROM_DEVICE,)
    return (TO_DEVICE, FROM_DEVICE)


def sample(frame: str, content: Mapping[str, Value], way: tuple[str, str], place: int) -> Sample:
    command, area = way
    commands = {row.name: row.value for row in PROTOCOL.tables["datagram_command"].rows}
    mailbox = CODEC.encode(frame, content)
    size = MODEL.parameter(area, "length")
    assert len(mailbox) <= size
    header: dict[str, Value] = {
        "command": commands[command],
        "number": place % 256,
        "position": 1 << (place % 16),
        "offset": MODEL.parameter(area),
        "size": size,
        "interrupt": 1 << (place % 13),
    }
    trailer: dict[str, Value] = {"working_counter": MODEL.parameter("counter_of_a_read")}
    body = (
        CODEC.encode("datagram_header", header)
        + mailbox.ljust(size, b"\0")
        + CODEC.encode("datagram_trailer", trailer)
    )
    frame_type = MODEL.parameter("datagram_frame_type")
    outer: dict[str, Value] = {"frame_length": len(body), "frame_type": frame_type}
    layers: dict[str, Mapping[str, Value]] = {
        "ethercat_header": outer,
        "datagram_header": header,
        "datagram_trailer": trailer,
    }
    inner = {**content, COUNTED: len(mailbox) - CODEC.size("mailbox")}
    source = bytes([MODEL.parameter("returned_source_bit") * (way == FROM_DEVICE), *[1] * 5])
    ethernet = bytes([255] * 6) + source + MODEL.parameter("ether_type").to_bytes(2, "big")
    return Sample(
        frame=frame,
        fields=layers | dict.fromkeys(CODEC.trail(frame), inner),
        mailbox=mailbox,
        ethernet=ethernet + CODEC.encode("ethercat_header", outer) + body,
    )


def samples() -> list[Sample]:
    return [
        sample(frame, content, way, place)
        for frame in mailbox_frames()
        for place, (content, way) in enumerate(
            zip(contents_of(frame), itertools.cycle(ways_of(frame)), strict=False)
        )
    ]


# --- what Wireshark says --------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Shown:
    """A field as Wireshark shows it, and where its bytes are in the packet."""

    text: str
    start: int
    size: int

    def number(self) -> int:
        """Give the number; flags are words in newer releases."""
        words = {"True": 1, "False": 0}
        return words[self.text] if self.text in words else int(self.text, 0)


Packet: TypeAlias = "dict[str, list[Shown]]"


def packet_of(element: ET.Element) -> Packet:
    packet: Packet = {}
    for item in element.iter():
        shown = Shown(item.get("show", ""), int(item.get("pos", 0)), int(item.get("size", 0)))
        packet.setdefault(item.get("name", ""), []).append(shown)
    return packet


@pytest.fixture(scope="module")
def decoded(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Sample, Packet]]:
    """Every sample, with what Wireshark makes of it."""
    tshark = shutil.which("tshark")
    if tshark is None:
        pytest.skip("tshark is not installed; apt-get install tshark")
    folder: Path = tmp_path_factory.mktemp("wireshark")
    sent = samples()
    capture = folder / "samples.pcap"
    with capture.open("wb") as file:
        writer = dpkt.pcap.Writer(file)
        for place, each in enumerate(sent):
            writer.writepkt(each.ethernet, place / 1000)
    # PDML keeps fields of the same name apart and says where the bytes of each are. An empty
    # folder of settings: what the user has set in Wireshark shall not count.
    run = subprocess.run(
        [tshark, "-n", "-r", str(capture), "-T", "pdml"],
        env={**os.environ, "WIRESHARK_CONFIG_DIR": str(folder / "settings")},
        capture_output=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr.decode()
    packets = [packet_of(element) for element in ET.fromstring(run.stdout)]
    return list(zip(sent, packets, strict=True))


# --- the comparison -------------------------------------------------------------------------------

MOST: Final = 20  # lines of one failure: a wrong layout fails in hundreds of packets


def shown_bytes(each: Sample, packet: Packet, fields: tuple[str, ...]) -> bytes:
    found = [shown for field in fields for shown in packet.get(field, ())]
    return b"".join(each.ethernet[shown.start : shown.start + shown.size] for shown in found)


def shown_numbers(packet: Packet, fields: tuple[str, ...]) -> list[int] | None:
    """What is shown, None unless each field is there once."""
    found = [shown for field in fields for shown in packet.get(field, ())]
    return [shown.number() for shown in found] if len(found) == len(fields) else None


def as_shown(row: Row, value: Value, each: Sample, packet: Packet) -> tuple[object, object]:
    """What Wireshark should show, and what it shows."""
    match row:
        case Number(fields=(field,)):
            assert isinstance(value, int)
            return [int(value)], shown_numbers(packet, (field,))
        case Number(fields=fields):
            assert isinstance(value, int)
            return [value >> bit & 1 for bit in range(len(fields))], shown_numbers(packet, fields)
        case Bits(field=field, low=low, width=width):
            assert isinstance(value, int)
            mask = (1 << width) - 1
            shown = shown_numbers(packet, (field,))
            return value & mask, None if shown is None else shown[0] >> low & mask
        case Raw(fields=fields, where=where):
            assert isinstance(value, bytes)
            data = shown_bytes(each, packet, fields)
            whole = {
                "all": data,
                "start": data[: len(value)],
                "end": data[max(len(data) - len(value), 0) :],
            }
            return value.hex(), whole[where].hex()
        case Unseen():
            return None, None
        case _:
            assert_never(row)


def rows_of(each: Sample) -> Iterator[tuple[str, str, Row]]:
    """All rows that speak of a sample: layout, field, row."""
    trail = () if each.frame in NO_MAILBOX | BROKEN else CODEC.trail(each.frame)
    for frame, rows in (*LAYERS.items(), *((name, ROWS.get(name, {})) for name in trail)):
        own = PROTOCOL.frames[frame].fields
        for field in own[:-1] if frame in trail and frame != each.frame else own:
            row = rows.get(field.name, RESERVED)
            only_if = row.only_if if isinstance(row, Number | Raw) else None
            if only_if is None or each.fields[frame].get(only_if):
                yield frame, field.name, row


def test_every_layout_has_a_row_for_every_field() -> None:
    known = {**LAYERS, **ROWS}
    missing = [
        f"{frame}.{field.name}"
        for frame in (*LAYERS, *mailbox_frames())
        for field in own_fields(frame)
        if field.name not in known.get(frame, {})
        and not (frame in ROWS and field.name.startswith("reserved"))
    ]
    assert not missing, "say in ROWS how Wireshark shows these, or why it does not"


def test_wireshark_reads_what_we_encoded(decoded: list[tuple[Sample, Packet]]) -> None:
    wrong = []
    for place, (each, packet) in enumerate(decoded, 1):
        for frame, field, row in rows_of(each):
            expected, shown = as_shown(row, each.fields[frame].get(field, 0), each, packet)
            if expected != shown:
                wrong.append(
                    f"packet {place}, {each.frame}: {frame}.{field} is {expected}, "
                    f"Wireshark shows {shown} as {row}"
                )
    assert not wrong, "\n".join(wrong[:MOST])


def test_no_row_is_idle(decoded: list[tuple[Sample, Packet]]) -> None:
    seen: dict[tuple[str, str], set[Value]] = {}
    for each, _ in decoded:
        for layout, name, _ in rows_of(each):
            seen.setdefault((layout, name), set()).add(each.fields[layout].get(name, 0))
    idle = []
    for frame in (name for name in mailbox_frames() if name not in NO_MAILBOX | BROKEN):
        for field in own_fields(frame):
            key = frame, field.name
            values = seen.get(key, set())
            numbers = [value for value in values if isinstance(value, int)]
            width = width_of(PROTOCOL, field.type) or 0
            fixed = field.value is not None or field.name == COUNTED or key in ONLY
            both = all({number >> bit & 1 for number in numbers} == {0, 1} for bit in range(width))
            if not values or not (fixed or (both if numbers else any(values))):
                idle.append(f"{frame}.{field.name}")
    assert not idle, "some bit of these was never 0, or never 1"


def test_what_wireshark_takes_for_no_mailbox_is_one(decoded: list[tuple[Sample, Packet]]) -> None:
    for each, packet in decoded:
        if each.frame in NO_MAILBOX:
            assert shown_bytes(each, packet, ("ecat.data",)).startswith(each.mailbox)
            assert BOX + "length" not in packet, "Wireshark has learned it: compare it in ROWS"


def test_wireshark_refuses_what_is_longer_than_the_mailbox(
    decoded: list[tuple[Sample, Packet]],
) -> None:
    broken = [packet for each, packet in decoded if each.frame in BROKEN]
    assert len(broken) > MIXTURES
    for packet in broken:
        assert "_ws.malformed" in packet or "ecat.data" in packet


def test_wireshark_has_nothing_to_complain_of(decoded: list[tuple[Sample, Packet]]) -> None:
    complaints = [
        f"packet {place}, {each.frame}: {name}"
        for place, (each, packet) in enumerate(decoded, 1)
        if each.frame not in BROKEN
        for name in packet
        if name.startswith(("_ws.malformed", "_ws.expert", "_ws.short")) or "invalid" in name
    ]
    assert not complaints, "\n".join(complaints[:MOST])
