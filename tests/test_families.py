"""Tests of the families of a request: each fault is where its flag says."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ecatspec.generators.cases.case import SendFrame
from ecatspec.generators.cases.message_mutation import (
    NOTES,
    Family,
    Variant,
    family_of,
    request_frames,
)
from ecatspec.generators.cases.stimulus import frame_bytes
from ecatspec.model.core.compilation import Model
from ecatspec.spec.language.ir import Bool, Bytes, Frame, FrameField, Literal, Name, Named, UInt
from ecatspec.spec.language.kinds import width_of
from ecatspec.spec.language.load import load_device

if TYPE_CHECKING:
    from ecatspec.model.core.codec import Message
    from ecatspec.model.core.values import Value

ROOT = "mailbox"
MOST = 68
"""Variants of one frame: every one costs a conversation with the device."""
INDEX = 0x1018
BASES: dict[str, tuple[dict[str, Value], ...]] = {
    "sdo_upload_request": ({"index": INDEX, "subindex": 1},),
    "sdo_download_expedited": (
        {"size_indicated": True, "unused": 3, "index": INDEX, "value": b"\x11"},
        {"size_indicated": True, "index": INDEX, "value": b"\x11\x22\x33\x44"},
        {"size_indicated": False, "index": INDEX, "value": b"\x11\x22\x33\x44"},
    ),
    "sdo_download_normal": (
        {"size_indicated": True, "index": INDEX, "size": 5, "value": b"hello"},
        {"size_indicated": True, "index": INDEX, "size": 0, "value": b""},
    ),
    "sdo_download_segment": (
        {"value": bytes(range(7))},
        {"value": b"\x11", "unused": 6},
        {"value": b"", "last": True},
        {"value": bytes(range(20))},
    ),
    "sdo_upload_segment": ({"reserved_data": bytes(7)}, {}),
    "sdo_abort": ({"index": INDEX, "code": 0x08000000},),
}
"""Valid messages; the families of a frame without a row start from one of zeros."""

STANDARD = Model(load_device("standard"))
AKD = Model(load_device("kollmorgen-akd"))
MODELS = {"standard": STANDARD, "kollmorgen-akd": AKD}

each_device = pytest.mark.parametrize("device", sorted(MODELS))
each_frame = pytest.mark.parametrize("frame", request_frames(STANDARD))


def with_nested_header() -> Model:
    """The standard, with a header inside `coe` that has fields of the names of outer ones."""
    header = Frame(
        "probe_header",
        "coe",
        (("service", Name("tx_pdo_remote_request")),),
        (
            FrameField("opcode", UInt(7)),
            FrameField("incomplete", Bool()),
            FrameField("reserved", UInt(8)),
            FrameField("fragments_left", UInt(16)),
            FrameField("probe_data", Bytes(None)),
        ),
    )
    listed = Frame(
        "probe_list",
        "probe_header",
        (("opcode", Literal(1)),),
        (
            FrameField("kind", UInt(16)),
            FrameField("marker", Named("mailbox_error_detail"), value=Name("syntax")),
        ),
    )
    counted = Frame(
        "probe_counted",
        "probe_header",
        (("opcode", Literal(3)),),
        (FrameField("many", UInt(8)), FrameField("items", Bytes(Name("many")))),
    )
    frames = {frame.name: frame for frame in (header, listed, counted)}
    return Model(replace(STANDARD.protocol, frames=STANDARD.protocol.frames | frames))


NESTED = with_nested_header()
EVERYTHING = [
    (model, frame, base)
    for model in MODELS.values()
    for frame in request_frames(model)
    for base in BASES.get(frame, ({},))
] + [(NESTED, "probe_list", {"kind": 1}), (NESTED, "probe_counted", {"items": b"\x11\x22\x33"})]


@cache
def families() -> list[tuple[Model, str, dict[str, Value], list[Variant]]]:
    return [(m, frame, base, list(family_of(m, frame, base))) for m, frame, base in EVERYTHING]


def bytes_of(model: Model, variant: Variant) -> bytes:
    """What the mailbox holds once the variant has been sent."""
    return landed(model, frame_bytes(model, variant.stimulus, 0))


def landed(model: Model, data: bytes) -> bytes:
    return data[: area_of(model)].ljust(area_of(model), b"\0")


def area_of(model: Model) -> int:
    return model.parameter("mailbox_out", "length")


def decoded(model: Model, data: bytes) -> Message | None:
    """What a device sees of the bytes: those in the area."""
    return model.codec.decode(landed(model, data), ROOT)


def spots(model: Model, frame: str, data: bytes) -> dict[tuple[str, str], tuple[int, int]]:
    """Bits of every field of a message; the body of a layout reaches to the end of all."""
    message = model.codec.decode(data, ROOT)
    assert message is not None
    assert message.frame == frame
    found = {}
    start = 0
    for layout in model.codec.trail(frame):
        for field in model.protocol.frames[layout].fields:
            width = width_of(model.protocol, field.type)
            if width is None:
                content = message.fields[field.name]
                assert isinstance(content, bytes)
                width = 8 * len(content)
            found[layout, field.name] = (start, width)
            start += width
        if layout != frame:  # what lies inside begins where the body does
            start = found[layout, model.protocol.frames[layout].fields[-1].name][0]
    return found


def touched(model: Model, frame: str, before: bytes, after: bytes) -> set[tuple[str, str]]:
    """The innermost fields in which two messages of one length differ."""
    bits = int.from_bytes(before, "little") ^ int.from_bytes(after, "little")
    found = {
        key
        for key, (start, width) in spots(model, frame, before).items()
        if bits >> start & ((1 << width) - 1)
    }
    bodies = {
        (layout, model.protocol.frames[layout].fields[-1].name)
        for layout in model.codec.trail(frame)[:-1]
    }
    return found - bodies


# --- the family ----------------------------------------------------------------------------------


def test_names_are_unique_and_the_valid_message_comes_first() -> None:
    for _model, frame, base, family in families():
        assert len({variant.name for variant in family}) == len(family) <= MOST
        assert family[0] == Variant("valid", Family.VALID, "", SendFrame(frame, base))
        assert [v.name for v in family if v.family is Family.VALID] == ["valid"]


def check_twins(model: Model, family: list[Variant]) -> None:
    """No bytes come twice; a counter of 0 that the variant demands is not one that is left open."""
    seen: dict[tuple[bytes, bool], str] = {}
    for variant in family:
        key = frame_bytes(model, variant.stimulus, 0), "counter" in variant.stimulus.fields
        assert key not in seen, (seen[key], variant)
        seen[key] = variant.name


def test_no_two_variants_are_the_same_bytes() -> None:
    for model, _, _, family in families():
        check_twins(model, family)


def test_every_flag_has_a_note_and_every_note_a_variant() -> None:
    flags: dict[str, set[Family]] = {}
    for _, _, _, family in families():
        for variant in family:
            flags.setdefault(variant.flag, set()).add(variant.family)
    assert flags.pop("") == {Family.VALID}
    assert flags.keys() == NOTES.keys()
    assert all(len(found) == 1 for found in flags.values())
    assert set().union(*flags.values()) == {Family.BOUNDARY, Family.MALFORMED}


def test_every_note_tells_what_it_hunts_in_one_sentence() -> None:
    for flag, note in NOTES.items():
        assert "hunts" in note, flag
        assert note.index(".") == len(note) - 1, flag


def test_two_families_are_equal() -> None:
    for model, frame, base, family in families():
        assert list(family_of(model, frame, base)) == family


def test_valid_and_boundary_messages_are_still_this_frame() -> None:
    for model, frame, _base, family in families():
        for variant in family:
            if variant.family is not Family.MALFORMED:
                data = bytes_of(model, variant)
                message = decoded(model, data)
                assert message is not None
                assert message.frame == frame, variant
                assert len(frame_bytes(model, variant.stimulus, 0)) <= area_of(model)


# --- each fault where its flag says --------------------------------------------------------------


def check_length(model: Model, frame: str, flag: str, before: bytes, after: bytes) -> None:
    header, whole = model.codec.size(ROOT), len(before) - model.codec.size(ROOT)
    room = area_of(model) - header
    start, width = model.codec.place(ROOT, "length")
    length = int.from_bytes(after, "little") >> start & ((1 << width) - 1)
    expected = {
        "length_zero": range(1),
        "length_cut": range(1, whole),
        "length_padded": range(whole + 1, room + 1),
        "length_beyond": range(room + 1, 1 << width),
    }
    assert length in expected[flag]
    assert touched(model, frame, landed(model, before), after) == {(ROOT, "length")}


def check_field(model: Model, frame: str, flag: str, before: bytes, after: bytes) -> None:
    """Exactly one field differs, and it is one that the flag is about."""
    ((layout, name),) = touched(model, frame, landed(model, before), after)
    start, width = spots(model, frame, before)[layout, name]
    value = int.from_bytes(after, "little") >> start & ((1 << width) - 1)
    item = next(f for f in model.protocol.frames[layout].fields if f.name == name)
    constant = name in model.codec.fixed(frame)
    match flag:
        case "reserved_set":
            assert name.startswith(("reserved", "flags"))
        case "service_unknown":
            assert isinstance(item.type, Named)
            assert constant
            assert value not in {r.value for r in model.protocol.tables[item.type.table].rows}
        case "constant_changed":
            assert not isinstance(item.type, Named)
            assert constant
        case "unused_contradicts":
            assert name in {"unused", "size_indicated"}
        case "size_not_indicated":
            assert name == "size_indicated"
        case "count_too_small" | "count_too_large":
            assert name == "size" or model.codec.is_derived(frame, name)
            old = int.from_bytes(before, "little") >> start & ((1 << width) - 1)
            assert (value < old) == (flag == "count_too_small")
        case _:
            pytest.fail(f"no check for {flag}")


def test_a_malformed_message_is_broken_in_the_one_place_that_its_flag_names() -> None:
    for model, frame, base, family in families():
        before = model.codec.encode(frame, base)
        for variant in family:
            if variant.family is Family.MALFORMED:
                after = bytes_of(model, variant)
                check = check_length if variant.flag.startswith("length_") else check_field
                check(model, frame, variant.flag, before, after)


def test_a_malformed_message_is_no_other_message_of_the_texts() -> None:
    for model, frame, base, family in families():
        before = decoded(model, model.codec.encode(frame, base))
        for variant in family:
            if variant.family is not Family.MALFORMED:
                continue
            message = decoded(model, bytes_of(model, variant))
            if message is None or message.frame != frame:
                assert message is None or message.frame not in request_frames(model), variant
                continue
            shadowed = model is NESTED and variant.name.startswith("mailbox_reserved")
            assert message != before or shadowed, variant


def test_messages_with_an_inner_count_that_is_wrong_do_not_decode_to_their_frame() -> None:
    family = list(family_of(NESTED, "probe_counted", {"items": b"\x11\x22\x33"}))
    wrong = [v for v in family if v.name.startswith("many_")]
    assert {v.flag for v in wrong} == {"count_too_small", "count_too_large"}
    for variant in wrong:
        message = decoded(NESTED, bytes_of(NESTED, variant))
        assert message is not None
        assert message.frame == "probe_header"


def test_fields_of_one_name_are_broken_one_at_a_time() -> None:
    names = [v.name for v in family_of(NESTED, "probe_list", {}) if v.flag == "reserved_set"]
    assert {n for n in names if "coe" not in n} == {
        "mailbox_reserved_all_ones",
        "probe_header_reserved_all_ones",
        "probe_header_reserved_one_bit",
    }


@each_device
def test_every_value_without_a_row_is_sent(device: str) -> None:
    model = MODELS[device]
    family = {v.name for v in family_of(model, "sdo_upload_request", {"index": INDEX})}
    for field, table in {
        "type": "mailbox_type",
        "service": "coe_service",
        "command": "client_command",
    }.items():
        rows = {row.value for row in model.protocol.tables[table].rows}
        values = set(range(1 << model.protocol.tables[table].width))
        sent = {name for name in family if name.startswith(f"{field}_")}
        assert sent == {f"{field}_{value}" for value in values - rows}


def test_of_many_values_without_a_row_the_ends_are_sent() -> None:
    rows = {row.value for row in NESTED.protocol.tables["mailbox_error_detail"].rows}
    names = {v.name for v in family_of(NESTED, "probe_list", {}) if v.name.startswith("marker_")}
    assert names == {f"marker_{value}" for value in (0, max(rows) + 1, (1 << 16) - 1)}


@each_device
def test_lengths_are_tried_on_both_sides_of_what_fits(device: str) -> None:
    model = MODELS[device]
    family = {v.name: v for v in family_of(model, "sdo_upload_request", {"index": INDEX})}
    whole = len(frame_bytes(model, family["valid"].stimulus, 0)) - model.codec.size(ROOT)
    room = area_of(model) - model.codec.size(ROOT)
    lengths: dict[str, list[Value | None]] = {}
    for variant in family.values():
        lengths.setdefault(variant.flag, []).append(variant.stimulus.fields.get("length"))
    assert lengths["length_zero"] == [0]
    assert lengths["length_padded"] == [whole + 1, room]
    assert lengths["length_beyond"] == [room + 1, area_of(model), (1 << 16) - 1]


def test_a_counter_of_zero_is_demanded_and_not_left_to_the_sender() -> None:
    family = {v.name: v for v in family_of(STANDARD, "sdo_upload_request", {})}
    assert "counter" not in family["valid"].stimulus.fields
    assert family["counter_zero"].stimulus.fields["counter"] == 0


@each_device
def test_the_message_is_cut_after_every_field(device: str) -> None:
    model = MODELS[device]
    family = {v.name: v for v in family_of(model, "sdo_upload_request", {"index": INDEX})}
    before = model.codec.encode("sdo_upload_request", {})
    starts = {start for start, _ in spots(model, "sdo_upload_request", before).values()}
    ends = {start // 8 - model.codec.size(ROOT) for start in starts if start % 8 == 0}
    cuts = {
        variant.stimulus.fields["length"] for variant in family.values() if "cut" in variant.name
    }
    whole = len(before) - model.codec.size(ROOT)
    assert cuts == {end for end in ends if 0 < end < whole} | {whole - 1}


def test_what_fills_the_area_fills_it() -> None:
    filled = set()
    for model, _frame, _base, family in families():
        for variant in family:
            if variant.name.endswith(("_fills_area", "_goes_on")) and (
                variant.flag != "length_padded"
            ):
                data = frame_bytes(model, variant.stimulus, 0)
                assert len(data) == area_of(model), variant
                filled.add(variant.flag)
    assert filled == {"garbage_after", "body_edge", "segmented_start"}


# --- what it starts from -------------------------------------------------------------------------


@each_device
def test_requests_are_what_machines_take_and_not_the_catch_alls(device: str) -> None:
    frames = request_frames(MODELS[device])
    assert set(BASES) <= set(frames)
    assert not {"mailbox", "coe", "sdo_request", "sdo_response", "mailbox_error"} & set(frames)
    assert not {"mailbox_beyond", "sdo_information"} & set(frames)
    assert len(set(frames)) == len(frames)
    machines = MODELS[device].protocol.machines.values()
    sent = {send.frame for m in machines for rule in m.rules for send in rule.sends}
    assert sent & set(frames) == {"sdo_abort"}  # the only one that both sides send


@pytest.mark.parametrize(
    "frame", ["sdo_upload_request", "sdo_download_expedited", "sdo_upload_segment"]
)
def test_what_is_too_long_is_the_same_frame_with_an_excess_and_malformed(frame: str) -> None:
    base = BASES[frame][0]
    whole = len(STANDARD.codec.encode(frame, base))
    longer = [v for v in family_of(STANDARD, frame, base) if v.flag == "length_padded"]
    excesses = set()
    for variant in longer:
        assert variant.family is Family.MALFORMED
        message = decoded(STANDARD, bytes_of(STANDARD, variant))
        assert message is not None
        assert message.frame == frame
        excesses.add(message.fields["excess"])
    assert excesses == {b"\0", bytes(area_of(STANDARD) - whole)}


def test_a_segment_that_is_cut_is_malformed_although_it_decodes() -> None:
    family = list(family_of(STANDARD, "sdo_download_segment", {"value": bytes(range(7))}))
    lengths = [v.stimulus.fields["length"] for v in family if v.flag == "length_cut"]
    assert lengths == [2, 3, 9]
    for variant in family:
        message = decoded(STANDARD, bytes_of(STANDARD, variant))
        if variant.stimulus.fields.get("length") == 9:
            assert message is not None
            assert message.frame == "sdo_download_segment"
            assert variant.family is Family.MALFORMED


def test_bodies_of_a_segment_have_the_padding_that_they_need() -> None:
    family = list(family_of(STANDARD, "sdo_download_segment", {"value": bytes(range(20))}))
    found = {}
    for variant in family:
        if variant.flag == "body_edge":
            message = decoded(STANDARD, bytes_of(STANDARD, variant))
            assert message is not None
            value, padding = message.fields["value"], message.fields["padding"]
            assert isinstance(value, bytes)
            assert isinstance(padding, bytes)
            found[len(value)] = len(padding)
    room = area_of(STANDARD) - STANDARD.parameter("segment_overhead")
    assert found == {0: 7, 1: 6, room: 0}


@pytest.mark.parametrize(
    ("frame", "base"),
    [
        ("sdo_request", {"command": 2, "rest": bytes(7)}),  # an upload
        ("sdo_upload_request", {"type": 6}),
        ("sdo_upload_request", {"length": 2}),
        ("sdo_download_normal", {"size_indicated": False, "size": 2, "value": b"\1\2"}),
        ("sdo_download_normal", {"size_indicated": True, "size": 3, "value": b"\1\2"}),
        ("sdo_download_normal", {"size_indicated": True, "unused": 1}),
        ("sdo_download_expedited", {"size_indicated": False, "unused": 1}),
        ("sdo_download_segment", {"value": bytes(1000)}),
        ("sdo_download_segment", {"value": bytes(8), "unused": 1}),
        ("sdo_download_segment", {"value": b"\1", "unused": 1}),
        ("sdo_download_segment", {"value": b"\1", "unused": 0, "padding": b""}),  # too short
        ("sdo_upload_request", {"excess": b"\0"}),
        ("sdo_download_expedited", {"value": b"\1", "excess": b"\0"}),
        ("sdo_upload_segment", {"excess": b"\1"}),
        ("mailbox_beyond", {}),
        ("datagram_header", {}),
    ],
)
def test_a_base_that_is_not_valid_is_refused(frame: str, base: dict[str, Value]) -> None:
    with pytest.raises(ValueError, match=r"base|no frame with a length"):
        family_of(STANDARD, frame, base)


def room_of(model: Model, frame: str) -> int:
    return area_of(model) - sum(model.codec.size(layout) for layout in model.codec.trail(frame))


@st.composite
def bases(draw: st.DrawFn, model: Model, frame: str) -> dict[str, Value]:
    """Draw any fields, then make them say the same."""
    base: dict[str, Value] = {}
    body = b""
    for field in model.protocol.frames[frame].fields:
        width = width_of(model.protocol, field.type)
        if field.value is not None:
            continue
        if width is not None:
            counted = frame == "sdo_download_segment" and field.name == "unused"
            if not counted:
                base[field.name] = draw(st.integers(0, (1 << width) - 1))
        elif field.name in {"value", "object_name"} and frame != "sdo_download_expedited":
            body = draw(st.binary(max_size=room_of(model, frame)))
            base[field.name] = body
    for name in ("address", "channel", "priority", "counter", "number"):
        if draw(st.booleans()):
            base[name] = draw(st.integers(0, 3))
    if "size" in base:
        base |= {"size": len(body), "size_indicated": 1, "unused": 0}
    elif "size_indicated" in base and not base["size_indicated"]:
        base |= {"unused": 0} if "unused" in base else {}
    return base


@each_frame
@each_device
@settings(max_examples=40)
@given(data=st.data())
def test_any_valid_base_has_a_family_that_fits(
    device: str, frame: str, data: st.DataObject
) -> None:
    model = MODELS[device]
    base = data.draw(bases(model, frame))
    family = list(family_of(model, frame, base))
    before = landed(model, model.codec.encode(frame, base))
    assert len({variant.name for variant in family}) == len(family) <= MOST
    check_twins(model, family)
    for variant in family:
        after = bytes_of(model, variant)
        size = len(frame_bytes(model, variant.stimulus, 0))
        assert size <= area_of(model) or variant.flag == "length_beyond", variant
        assert after != before or variant.flag in {"", "counter_edge"}
        if variant.family is not Family.MALFORMED:
            message = decoded(model, after)
            assert message is not None
            assert message.frame == frame, variant
