"""Tests of model/: codec, values, logic, interpreter, ESC, virtual SubDevice."""

from __future__ import annotations

import itertools
from dataclasses import replace
from random import Random
from typing import TYPE_CHECKING

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from ecatspec.generators.cases.bringup import mailbox_settings, request, way_to
from ecatspec.generators.cases.case import WriteOutputs, WriteRegister, WriteRegisters
from ecatspec.generators.cases.play import play
from ecatspec.generators.cases.stimulus import frame_bytes, register_bytes, registers_bytes
from ecatspec.generators.cases.transfers import download
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.expressions import Environment, compile_expression
from ecatspec.model.core.functions import PLAIN
from ecatspec.model.core.interpreter import step
from ecatspec.model.core.process_image import OUTPUTS
from ecatspec.model.core.register_map import field_of
from ecatspec.model.core.state import Event, State
from ecatspec.model.core.values import (
    UNKNOWN,
    Numbers,
    Octets,
    Pattern,
    Unknown,
    Value,
    admits,
    concrete,
)
from ecatspec.model.core.wording import typed_words
from ecatspec.model.esc.esc import Esc
from ecatspec.model.esc.subdevice import Quirk, VirtualSubDevice
from ecatspec.model.symbolic.terms import counted
from ecatspec.spec.language.arithmetic import calculated
from ecatspec.spec.language.ir import Binary, Bool, Bytes, In, Literal, Name, Range, SInt, Unary
from ecatspec.spec.language.kinds import width_of
from ecatspec.spec.language.load import load_device

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ecatspec.generators.cases.case import Stimulus
    from ecatspec.model.core.codec import Message
    from ecatspec.model.esc.three_buffers import Buffers
    from ecatspec.spec.language.ir import FrameField

AKD = load_device("kollmorgen-akd")
STANDARD = load_device("standard")
MODEL = Model(AKD)
CODEC = MODEL.codec
PARENTS = {frame.parent for frame in AKD.frames.values()}
LEAVES = sorted(set(AKD.frames) - PARENTS)
EXPEDITED = 4
"""Bytes of the data field of an expedited transfer: the layouts say `4 - unused`."""


# --- codec ----------------------------------------------------------------------------------------


def drawn(field: FrameField) -> st.SearchStrategy[Value]:
    match field.type:
        case Bytes(length=Literal(value=size)):
            return st.binary(min_size=size, max_size=size)
        case Bytes(length=Binary()):
            return st.binary(min_size=1, max_size=EXPEDITED)
        case Bytes():
            return st.binary(max_size=20)
        case Bool():
            return st.booleans()
    width = width_of(AKD, field.type)
    assert width is not None
    if isinstance(field.type, SInt):
        return st.integers(-(1 << (width - 1)), (1 << (width - 1)) - 1)
    return st.integers(0, (1 << width) - 1)


def filled(data: st.DataObject, frame: str) -> dict[str, Value]:
    """Values for every free field of the frame and of all around it.

    Bodies, counts and what the encoder fills are left out; padding goes with the value.
    """
    trail = CODEC.trail(frame)
    fixed = CODEC.fixed(frame)
    values: dict[str, Value] = {}
    for name in trail:
        fields = AKD.frames[name].fields
        for field in fields:
            body = field is fields[-1] and name != frame
            left = body or field.filled is not None or CODEC.is_derived(frame, field.name)
            if left or field.name in fixed or field.name == "padding":
                continue
            values[field.name] = data.draw(drawn(field), field.name)
    return values


@pytest.mark.parametrize("frame", LEAVES)
@given(data=st.data())
def test_every_frame_survives_the_round_trip(frame: str, data: st.DataObject) -> None:
    values = filled(data, frame)
    root = CODEC.trail(frame)[0]
    encoded = CODEC.encode(frame, values)
    message = CODEC.decode(encoded, root)
    assert message is not None
    # `sdo_request` and `sdo_response` stand for whatever no other layout describes
    if frame in {"sdo_request", "sdo_response"}:
        assume(message.frame == frame)
    assert message.frame == frame
    assert {name: message.fields[name] for name in values} == values
    assert CODEC.encode(frame, message.fields) == encoded
    for name, value in CODEC.fixed(frame).items():
        assert message.fields[name] == value


@pytest.mark.parametrize("frame", LEAVES)
@given(data=st.data())
def test_every_field_is_at_its_place(frame: str, data: st.DataObject) -> None:
    encoded = CODEC.encode(frame, filled(data, frame))
    message = CODEC.decode(encoded, CODEC.trail(frame)[0])
    assert message is not None
    raw = int.from_bytes(encoded, "little")
    for name, (low, width) in CODEC.places(message).items():
        value, bits = message.fields[name], raw >> low & ((1 << width) - 1)
        if isinstance(value, bytes):
            assert bits.to_bytes(len(value), "little") == value
        else:
            assert isinstance(value, int)
            assert bits == value & ((1 << width) - 1)


IN_A_MAILBOX = [frame for frame in LEAVES if CODEC.trail(frame)[0] == "mailbox"]


@pytest.mark.parametrize("frame", IN_A_MAILBOX)
@given(data=st.data(), trailing=st.binary(max_size=40))
def test_bytes_after_the_counted_body_are_ignored(
    frame: str, data: st.DataObject, trailing: bytes
) -> None:
    encoded = CODEC.encode(frame, filled(data, frame))
    assert CODEC.decode(encoded, "mailbox") == CODEC.decode(encoded + trailing, "mailbox")


@given(data=st.binary(max_size=64), root=st.sampled_from(sorted(AKD.frames)))
def test_decoding_anything_never_raises(data: bytes, root: str) -> None:
    message = CODEC.decode(data, root)
    assert message is None or message.trail[0] == root


@given(content=st.binary(max_size=32))
def test_decoding_a_message_with_any_content_never_raises(content: bytes) -> None:
    for kind in range(16):
        encoded = CODEC.encode("mailbox", {"type": kind, "payload": content})
        message = CODEC.decode(encoded, "mailbox")
        assert message is not None
        assert message.fields["payload"] == content


@given(data=st.data(), cut=st.integers(1, 30))
def test_a_message_that_is_cut_is_no_message(data: st.DataObject, cut: int) -> None:
    encoded = CODEC.encode("sdo_abort", filled(data, "sdo_abort"))
    assert CODEC.decode(encoded[: max(0, len(encoded) - cut)], "mailbox") is None


@given(kind=st.integers(0, 15), service=st.integers(0, 15), content=st.binary(max_size=30))
def test_what_was_decoded_encodes_to_the_same_bytes(
    kind: int, service: int, content: bytes
) -> None:
    """Whatever the header of a service says of unused bytes and padding."""
    in_coe = CODEC.encode("coe", {"type": kind, "service": service, "body": content})
    for encoded in (in_coe, CODEC.encode("mailbox", {"type": kind, "payload": content})):
        message = CODEC.decode(encoded, "mailbox")
        assert message is not None
        assert CODEC.encode(message.frame, message.fields) == encoded


SEGMENTS = ("sdo_download_segment", "sdo_upload_segment_response")


@pytest.mark.parametrize("frame", SEGMENTS)
@pytest.mark.parametrize("size", range(21))
def test_a_segment_is_filled_to_its_smallest_size(frame: str, size: int) -> None:
    value = bytes(range(1, size + 1))
    encoded = CODEC.encode(frame, {"value": value, "toggle": 1})
    assert len(encoded) == 6 + 2 + 1 + max(size, 7)
    message = CODEC.decode(encoded, "mailbox")
    assert message is not None
    assert message.frame == frame
    assert message.fields["value"] == value
    assert message.fields["unused"] == max(0, 7 - size)
    assert message.fields["padding"] == bytes(max(0, 7 - size))


@pytest.mark.parametrize("frame", ["sdo_download_expedited", "sdo_upload_expedited"])
@pytest.mark.parametrize("size", range(1, 5))
def test_an_expedited_message_counts_its_unused_bytes(frame: str, size: int) -> None:
    encoded = CODEC.encode(frame, {"value": bytes([7] * size)})
    assert len(encoded) == 6 + 10
    message = CODEC.decode(encoded, "mailbox")
    assert message is not None
    assert (message.fields["unused"], message.fields["size_indicated"]) == (4 - size, True)
    assert message.fields["value"] == bytes([7] * size)


def test_what_is_given_is_not_filled() -> None:
    given_value = CODEC.encode("sdo_download_normal", {"value": b"abc", "size": 9})
    message = CODEC.decode(given_value, "mailbox")
    assert message is not None
    assert message.fields["size"] == 9
    unsized = CODEC.encode("sdo_download_expedited", {"value": bytes(4), "size_indicated": 0})
    message = CODEC.decode(unsized, "mailbox")
    assert message is not None
    assert (message.fields["size_indicated"], message.fields["unused"]) == (False, 0)


# --- byte strings that are known in part ----------------------------------------------------------


def call(name: str, *arguments: Value) -> Value:
    return PLAIN[name](Environment((), {}, {}), arguments)


def known(content: bytes) -> Octets:
    return Octets((len(content), len(content)), content)


@given(
    content=st.binary(max_size=12),
    offset=st.integers(0, 14),
    least=st.integers(0, 14),
    most=st.integers(0, 14),
    seen=st.binary(max_size=14),
)
def test_a_piece_of_what_is_known_admits_exactly_its_slices(
    content: bytes, offset: int, least: int, most: int, seen: bytes
) -> None:
    piece = call("piece", content, offset, least, most)
    assert isinstance(piece, Pattern)
    top = min(most, len(content[offset:]))
    slices = {content[offset : offset + n] for n in range(min(least, top), top + 1)}
    if least > most:
        slices = set()  # more is demanded than there is room for
    assert all(piece.admits(part) for part in slices)
    assert piece.admits(seen) == (seen in slices)
    if slices:
        assert piece.taken() == content[offset : offset + top]
    assert piece == call("piece", known(content), offset, least, most)


@given(content=st.binary(min_size=1, max_size=6), data=st.data())
def test_a_mask_leaves_bytes_open(content: bytes, data: st.DataObject) -> None:
    certain = data.draw(
        st.lists(st.booleans(), min_size=len(content), max_size=len(content)), "certain"
    )
    mask = bytes(255 if sure else 0 for sure in certain)
    size = (len(content), len(content))
    pattern = Octets(size, content, mask)
    seen = data.draw(st.binary(min_size=len(content), max_size=len(content)), "seen")
    same = all(a == b for a, b, sure in zip(seen, content, certain, strict=True) if sure)
    assert pattern.admits(seen) == same
    assert pattern.admits(content)
    assert not pattern.admits(content + b"\0")
    tail = pattern.piece(1, 0, len(content))
    assert tail.admits(content[1:])
    if len(content) > 1 and certain[-1]:
        assert not tail.admits(content[1:-1] + bytes([content[-1] ^ 1]))


@given(first=st.binary(max_size=6), second=st.binary(max_size=6), seen=st.binary(max_size=12))
def test_join_with_what_is_known_in_part(first: bytes, second: bytes, seen: bytes) -> None:
    assert call("join", first, second) == first + second
    joined = call("join", first, known(second))
    assert isinstance(joined, Pattern)
    assert joined.admits(seen) == (seen == first + second)
    open_end = call("join", first, Octets((0, 5)))
    assert isinstance(open_end, Pattern)
    fits = seen.startswith(first) and len(seen) <= len(first) + 5
    assert open_end.admits(seen) == fits
    assert call("join", UNKNOWN, second) == UNKNOWN
    assert call("join", first, UNKNOWN) == UNKNOWN


def test_functions_of_known_and_unknown_values() -> None:
    assert call("cut", b"abcdef", 2) == b"ab"
    assert call("cut", UNKNOWN, 2) == call("cut", b"ab", UNKNOWN) == UNKNOWN
    assert call("lesser", 3, 5) == call("lesser", 5, 3) == 3
    assert call("lesser", 3, UNKNOWN) == UNKNOWN
    assert call("zeros", 3) == bytes(3)
    assert call("zeros", -1) == b""
    assert call("zeros", UNKNOWN) == UNKNOWN
    assert call("word", 0x1234) == b"\x34\x12"
    assert call("word", UNKNOWN) == UNKNOWN
    assert call("length", b"abc") == 3
    assert call("length", UNKNOWN) == UNKNOWN
    assert call("piece", UNKNOWN, 0, 1, 5) == Octets((1, 5))
    unsure = call("piece", b"abc", UNKNOWN, 0, 2)
    assert isinstance(unsure, Pattern)
    assert unsure.admits(b"whatever it is")


OF_AN_OBJECT = (
    *("complete_size", "complete_value", "complete_in_range", "complete_readable"),
    *("complete_writable", "declared", "object_exists", "object_list", "object_code_of"),
    *("highest_subindex", "is_plain_variable", "readable", "writable", "size_of"),
)


@pytest.mark.parametrize("name", OF_AN_OBJECT)
@pytest.mark.parametrize("closed", [False, True])
def test_of_an_object_that_is_not_known_nothing_is(name: str, *, closed: bool) -> None:
    model = Model(load_device("reference"), closed=closed)
    function = model.dictionary.functions[name]
    environment = Environment(model.initial.slots, {}, {})
    assert isinstance(function(environment, (UNKNOWN, 0, b"")), Unknown)


def test_what_a_device_takes_where_it_is_free() -> None:
    assert Unknown(7).taken() == 7
    assert Unknown(7).admits(3)
    assert Octets((2, 5)).taken() == bytes(2)
    assert Octets((2, 5), b"a").taken() == b"a\0"
    assert Octets((0, 3), b"abcdef").taken() == b"abc"
    assert Octets((0, 3)).taken() == b""
    assert [concrete(v) for v in (5, b"a", Numbers(((3, 4),)), known(b"ab"))] == [5, b"a", 3, b"ab"]
    assert not Octets((0, 9)).admits(5)


# --- values ---------------------------------------------------------------------------------------

PATTERNS = st.builds(
    Numbers,
    st.lists(
        st.tuples(st.integers(0, 12), st.integers(0, 12)).map(lambda p: (min(p), max(p))),
        min_size=1,
        max_size=3,
    ).map(tuple),
    st.none() | st.integers(0, 12),
)


@given(pattern=PATTERNS, value=st.integers(-2, 15))
def test_a_pattern_admits_its_ranges_without_the_excluded(pattern: Numbers, value: int) -> None:
    members = {n for low, high in pattern.ranges for n in range(low, high + 1)}
    assert pattern.admits(value) == (value in members - {pattern.excluded})
    assert admits(pattern, value) == pattern.admits(value)


@given(pattern=PATTERNS, after=st.integers(-2, 15))
def test_the_first_value_is_the_next_one_or_wraps(pattern: Numbers, after: int) -> None:
    members = sorted(n for n in range(13) if pattern.admits(n))
    if not members:
        with pytest.raises(ValueError, match="no number is acceptable"):
            pattern.taken(after)
        return
    above = [n for n in members if n > after]
    named = pattern.ranges[0][0]
    first = named if after < 0 and named in members else (above or members)[0]
    assert pattern.taken(after) == first


def test_an_unknown_value_admits_everything_and_a_pattern_no_text() -> None:
    assert all(UNKNOWN.admits(value) for value in (0, True, b"", "stay"))
    assert not Numbers(((0, 9),)).admits(b"\0")
    assert not Numbers(((0, 9),)).admits("stay")
    assert UNKNOWN.taken() == 0


# --- complete access ------------------------------------------------------------------------------

REFERENCE = load_device("reference")


def complete(name: str, *arguments: Value, watched: Model | None = None) -> Value:
    device = VirtualSubDevice(REFERENCE)
    model, state = device.model, device.state
    if watched is not None:
        model = watched
    slots = list(model.initial.slots)
    slots[model.slots["al.state"]] = model.row("al_state", "PREOP")
    objects = state.objects if watched is None else {}
    return model.dictionary.functions[name](Environment(tuple(slots), objects, {}), arguments)


def watcher(*, closed: bool = True) -> Model:
    model = Model(replace(REFERENCE, dictionary=replace(REFERENCE.dictionary, closed=closed)))
    assert model.dictionary.closed == closed
    return model


def test_subindex_0_takes_two_bytes_and_texts_all_of_theirs() -> None:
    entries = b"\1" + b"\2\2" + b"\3\0\0\0" + b"\4\4" + b"five\0\0\0\0"
    assert complete("complete_value", 0x2010, 1) == entries
    assert complete("complete_value", 0x2010, 0) == b"\5\0" + entries
    assert complete("complete_size", 0x2010, 1) == len(entries)
    assert complete("complete_size", 0x2010, 0) == len(entries) + 2


def test_who_watches_knows_the_layout_and_not_the_values() -> None:
    value = complete("complete_value", 0x2010, 0, watched=watcher())
    assert isinstance(value, Pattern)
    assert value.admits(b"\5\0" + bytes(range(17)))
    assert not value.admits(b"\4\0" + bytes(range(17)))  # the number of entries is constant
    assert not value.admits(b"\5\0" + bytes(range(16)))


def test_a_gap_makes_the_layout_uncertain() -> None:
    closed, opened = watcher(), watcher(closed=False)
    assert complete("complete_size", 0x2012, 0, watched=closed) == UNKNOWN
    assert complete("complete_size", 0x2010, 0, watched=opened) == UNKNOWN
    value = complete("complete_value", 0x2012, 0, watched=closed)
    assert isinstance(value, Pattern)
    assert value.admits(b"")
    assert value.admits(bytes(14))


def test_what_can_never_be_read_is_zero_and_what_cannot_be_read_now_is_masked() -> None:
    model = watcher()
    slots = model.initial.slots
    objects = {(0x2013, 0): b"\2", (0x2013, 1): b"\1\0", (0x2013, 2): b"\7\7"}
    function = model.dictionary.functions["complete_value"]
    value = function(Environment(slots, objects, {}), (0x2013, 0))
    assert isinstance(value, Pattern)
    assert value.admits(b"\2\0\1\0\0\0")
    assert not value.admits(b"\2\0\1\0\7\7")
    assert not value.admits(b"\2\0\2\0\0\0")
    later = replace(model.dictionary.entries[0x2013, 1], read_states=("OP",))
    model.dictionary.entries[0x2013, 1] = later
    value = function(Environment(slots, objects, {}), (0x2013, 0))
    assert isinstance(value, Pattern)
    assert value.admits(b"\2\0\7\7\0\0")
    assert complete("complete_readable", 0x2013, 0) is False
    assert complete("complete_value", 0x2013, 0) == b"\2\0\1\0\0\0"


def test_a_complete_download_skips_what_cannot_be_written() -> None:
    device = VirtualSubDevice(REFERENCE)
    slots = list(device.state.slots)
    slots[device.model.slots["al.state"]] = device.model.row("al_state", "PREOP")
    data = b"\7\0" + b"\x11" + b"\x22\x22" + b"\x33" * 4 + b"\x44\x44" + b"ab\0\0\0\0\0\0"
    environment = Environment(tuple(slots), {}, {})
    split = dict(device.model.dictionary.split(environment, 0x2010, 0, data))
    assert split == {
        (0x2010, 1): b"\x11",
        (0x2010, 2): b"\x22\x22",
        (0x2010, 3): b"\x33" * 4,
        (0x2010, 5): b"ab",
    }
    assert complete("complete_writable", 0x2010, 1) is False
    assert complete("complete_writable", 0x2011, 1) is True
    assert complete("complete_in_range", 0x2010, 0, data) is False
    assert complete("complete_in_range", 0x2010, 0, bytes(19)) is True


# --- states and inputs ----------------------------------------------------------------------------


def test_a_state_is_the_same_in_whatever_order_its_objects_came() -> None:
    first, second = ((0x2000, 0), b"a"), ((0x1000, 1), b"b")
    one = State((1,)).keeping(*first).keeping(*second)
    other = State((1,)).keeping(*second).keeping(*first)
    assert one == other
    assert hash(one) == hash(other)
    assert list(one.objects.items()) == list(other.objects.items()) == [second, first]
    assert one.keeping(*first) is one
    assert one.keeping((0x2000, 0), b"c").forgetting((0x2000, 0)) == State((1,)).keeping(*second)
    assert one.forgetting((0x3000, 0)) is one


def test_an_input_keeps_its_parameters_when_their_source_changes() -> None:
    parameters: dict[str, Value] = {"index": 1}
    event = Event("sdo", "upload", parameters)
    parameters["index"] = 2
    assert event.parameters == {"index": 1}
    assert event == Event("sdo", "upload", {"index": 1})
    assert hash(event) == hash(Event("sdo", "upload", {"index": 1}))
    assert event != Event("sdo", "upload", parameters)


# --- three-valued logic ---------------------------------------------------------------------------

TRUTHS: tuple[Value, ...] = (False, UNKNOWN, True)
ORDER = {False: 0, UNKNOWN: 1, True: 2}


def truth(expression: Binary | In | Unary, a: Value, b: Value = UNKNOWN) -> Value:
    known = {"a": a, "b": b}
    getter = compile_expression(expression, lambda name: lambda _: known[name.path], {})
    return getter(Environment((), {}, {}))


@pytest.mark.parametrize(("a", "b"), list(itertools.product(TRUTHS, TRUTHS)))
def test_and_is_the_least_and_or_the_greatest(a: Value, b: Value) -> None:
    left, right = Name("a"), Name("b")
    both = truth(Binary("and", left, right), a, b)
    either = truth(Binary("or", left, right), a, b)
    assert ORDER[both] == min(ORDER[a], ORDER[b])
    assert ORDER[either] == max(ORDER[a], ORDER[b])
    neither = truth(Unary("not", Binary("or", left, right)), a, b)
    assert neither == truth(Binary("and", Unary("not", left), Unary("not", right)), a, b)


@pytest.mark.parametrize(
    ("sign", "a", "b", "wanted"),
    [("/", 7, 2, 3), ("/", -7, 2, -4), ("%", -7, 2, 1), ("/", 7, 0, UNKNOWN), ("%", 7, 0, UNKNOWN)],
)
def test_division_rounds_down_and_by_zero_nothing_is_known(
    sign: str, a: int, b: int, wanted: Value
) -> None:
    assert truth(Binary(sign, Name("a"), Name("b")), a, b) == wanted
    number = None if wanted is UNKNOWN else wanted
    assert calculated(sign, a, b) == number
    assert counted(sign, a, b) == number


def test_whether_a_number_is_in_a_range_of_which_a_bound_is_not_known() -> None:
    inside = In(Name("a"), (Range(Literal(1), Name("b")),))
    assert truth(inside, 3, 5) is True
    assert truth(inside, 7, 5) is False
    assert truth(inside, 3, UNKNOWN) is UNKNOWN
    assert truth(inside, UNKNOWN, 5) is UNKNOWN


@pytest.mark.parametrize("a", TRUTHS)
def test_not_turns_the_order_round(a: Value) -> None:
    assert ORDER[truth(Unary("not", Name("a")), a)] == 2 - ORDER[a]


def test_comparisons_with_what_is_not_known() -> None:
    equal = Binary("==", Name("a"), Literal(5))
    assert truth(equal, UNKNOWN) == UNKNOWN
    assert truth(equal, Numbers(((1, 3),))) is False
    assert truth(equal, Numbers(((1, 9),))) == UNKNOWN
    assert truth(Binary("!=", Name("a"), Literal(5)), Numbers(((1, 3),))) is True
    assert truth(Binary("<", Name("a"), Literal(5)), UNKNOWN) == UNKNOWN
    assert truth(Binary("+", Name("a"), Literal(5)), 2) == 7


# --- interpreter ----------------------------------------------------------------------------------


@pytest.mark.parametrize("protocol", [AKD, STANDARD], ids=lambda protocol: protocol.name)
def test_every_state_has_a_step_for_every_request(protocol: object) -> None:
    model = Model(AKD if protocol is AKD else STANDARD)
    control = model.protocol.registers["al_control"]
    events = [
        Event(
            "al",
            "request",
            {f.name: field_of(model.protocol, "al_control", f.name, raw) for f in control.fields},
        )
        for raw in range(1 << 6)
    ]
    events.append(Event("al", "settings", {}))
    seen = {model.initial}
    work = [model.initial]
    while work and len(seen) < 400:
        state = work.pop()
        for event in events:
            steps = step(model, state, event)
            assert steps, (state, event)
            for taken in steps:
                assert len(taken.state.slots) == len(state.slots)
                assert taken.rules or taken.unspecified
                if taken.state not in seen:
                    seen.add(taken.state)
                    work.append(taken.state)


@given(data=st.data())
def test_every_state_has_a_step_for_every_message(data: st.DataObject) -> None:
    content = data.draw(st.binary(max_size=16))
    encoded = CODEC.encode("coe", {"service": data.draw(st.integers(0, 15)), "body": content})
    message = CODEC.decode(encoded, "mailbox")
    assert message is not None
    event = Event("mailbox", "mail", message.fields, message.trail)
    for value in MODEL.state_names("al"):
        assert step(MODEL, MODEL.initial.having(MODEL.slots["al.state"], value), event)


# --- the virtual SubDevice ------------------------------------------------------------------------


def written(stimulus: Stimulus) -> tuple[int, bytes]:
    if isinstance(stimulus, WriteRegisters):
        return registers_bytes(MODEL, stimulus)
    assert isinstance(stimulus, WriteRegister)
    return register_bytes(MODEL, stimulus)


def drive(device: VirtualSubDevice, stimuli: Iterable[Stimulus]) -> None:
    for stimulus in stimuli:
        assert device.write(*written(stimulus)) == 1


@pytest.mark.parametrize("example", AKD.examples, ids=lambda example: example.name)
def test_the_virtual_drive_answers_as_its_manual_prints(example: object) -> None:
    (text,) = [item for item in AKD.examples if item is example]
    device = VirtualSubDevice(AKD)
    drive(device, way_to(device.model, "PREOP"))
    out, into = (MODEL.parameter(name, "start") for name in ("mailbox_out", "mailbox_in"))
    room = MODEL.parameter("mailbox_out", "length")
    # the print is the second of three writes: the number of PDOs is 0 by then
    clear = frame_bytes(MODEL, download(MODEL.image.assignments[OUTPUTS], 0, b"\0"), 1)
    assert device.write(out, clear.ljust(room, b"\0")) == 1
    device.read(into, MODEL.parameter("mailbox_in", "length"))
    assert device.write(out, text.request.ljust(room, b"\0")) == 1
    counter, reply = device.read(into, MODEL.parameter("mailbox_in", "length"))
    assert counter == 1
    # The print leaves the counter 0; a device that counts puts its own there.
    place, width = CODEC.place("mailbox", "counter")
    mask = ((1 << width) - 1) << place
    size = len(text.response)
    given_bits = int.from_bytes(reply[:size], "little")
    assert (given_bits & ~mask).to_bytes(size, "little") == text.response
    assert not any(reply[size:])


class Client:
    """A small SDO client over the two mailboxes of a virtual SubDevice."""

    def __init__(
        self, out: int = 128, into: int = 128, quirks: frozenset[Quirk] = frozenset()
    ) -> None:
        start = 0x1000
        protocol = replace(
            REFERENCE,
            parameters=REFERENCE.parameters
            | {
                name: replace(REFERENCE.parameters[name], value=(Literal(place), Literal(size)))
                for name, place, size in (
                    ("mailbox_out", start, out),
                    ("mailbox_in", start + out, into),
                )
            },
        )
        self.device = VirtualSubDevice(protocol, quirks=quirks)
        self.model = self.device.model
        self.out, self.into = (start, out), (start + out, into)
        self.counter = 0
        for stimulus in way_to(self.model, "PREOP"):
            if isinstance(stimulus, WriteRegisters):
                place, data = registers_bytes(self.model, stimulus)
            else:
                assert isinstance(stimulus, WriteRegister)
                place, data = register_bytes(self.model, stimulus)
            assert self.device.write(place, data) == 1

    def send(self, frame: str, fields: dict[str, Value], *, again: bool = False) -> int:
        self.counter = self.counter if again else self.counter % 7 + 1
        encoded = self.model.codec.encode(frame, {"counter": self.counter, **fields})
        return self.device.write(self.out[0], encoded.ljust(self.out[1], b"\0"))

    def receive(self) -> Message | None:
        counter, data = self.device.read(*self.into)
        return self.model.decode(data) if counter else None

    def ask(self, frame: str, **fields: Value) -> Message:
        assert self.send(frame, fields) == 1
        message = self.receive()
        assert message is not None
        return message

    def download(self, index: int, value: bytes) -> str:
        room = self.out[1] - 16
        answer = self.ask(
            "sdo_download_normal", index=index, subindex=0, size=len(value), value=value[:room]
        )
        place, toggle = room, 0
        while place < len(value):
            if answer.frame == "sdo_abort":
                return answer.frame
            part = value[place : place + self.out[1] - 9]
            place += len(part)
            last = place >= len(value)
            answer = self.ask("sdo_download_segment", toggle=toggle, last=last, value=part)
            assert answer.fields["toggle"] == bool(toggle)
            toggle = 1 - toggle
        return answer.frame

    def upload(self, index: int) -> bytes:
        answer = self.ask("sdo_upload_request", index=index, subindex=0)
        value = answer.fields["value"]
        assert isinstance(value, bytes)
        size = answer.fields.get("size", len(value))
        assert isinstance(size, int)
        toggle = 0
        while len(value) < size:
            answer = self.ask("sdo_upload_segment", toggle=toggle)
            part = answer.fields["value"]
            assert isinstance(part, bytes)
            assert part
            value += part
            assert answer.fields["last"] == (len(value) == size)
            toggle = 1 - toggle
        assert len(value) == size
        return value

    def repeat(self) -> None:
        """Toggle the repeat bit; the device acknowledges at once."""
        at = self.model.protocol.registers["sync_manager_1_activation"]
        before = int.from_bytes(self.device.read(at.address, at.size)[1], "little")
        assert self.device.write(at.address, bytes([before ^ 2])) == 1
        control = self.device.esc.register("sync_manager_1_pdi_control")
        asked = bool((before ^ 2) & 2)
        shown = field_of(
            self.model.protocol, "sync_manager_1_pdi_control", "repeat_acknowledge", control
        )
        assert shown == asked


@settings(max_examples=12)
@given(
    out=st.integers(34, 1486),
    into=st.integers(34, 1486),
    size=st.one_of(st.integers(0, 3000), st.sampled_from([65535, 65536])),
    seed=st.integers(0, 1000),
)
def test_what_was_written_is_read_back_over_any_mailbox(
    out: int, into: int, size: int, seed: int
) -> None:
    out = out if size <= 3000 else max(out, 600)
    into = into if size <= 3000 else max(into, 600)
    client = Client(out, into)
    value = Random(seed).randbytes(size)
    assert client.download(0x2031, value).startswith("sdo_download")
    assert client.upload(0x2031) == value


@pytest.mark.parametrize("size", [65537, 70000])
def test_more_than_an_object_holds_is_refused(size: int) -> None:
    client = Client(1486, 1486)
    assert client.download(0x2031, bytes([5]) * size) == "sdo_abort"
    assert client.upload(0x2031) == b""


def test_a_message_is_repeated_before_what_is_unread() -> None:
    client = Client()
    client.repeat()
    assert client.receive() is None  # nothing was read yet
    first = client.ask("sdo_upload_request", index=0x2000, subindex=0)
    client.repeat()
    assert client.receive() == first  # with its own counter
    client.repeat()
    assert client.receive() == first
    assert client.receive() is None
    assert client.send("sdo_upload_request", {"index": 0x2001, "subindex": 0}) == 1
    client.repeat()
    again, second = client.receive(), client.receive()
    assert again == first
    assert second is not None
    assert second.fields["index"] == 0x2001
    assert client.receive() is None


def test_a_faulty_device_puts_a_reply_in_the_place_of_an_unread_one() -> None:
    client = Client(quirks=frozenset({Quirk.OVERWRITES}))
    for index in (0x2000, 0x2001):
        assert client.send("sdo_upload_request", {"index": index, "subindex": 0}) == 1
    reply = client.receive()
    assert reply is not None
    assert reply.fields["index"] == 0x2001
    assert client.receive() is None


def test_an_emergency_waits_behind_a_reply_and_takes_the_next_counter() -> None:
    client = Client()
    assert client.send("sdo_upload_request", {"index": 0x2000, "subindex": 0}) == 1
    fields: dict[str, Value] = {"error_code": 0x1000, "error_register": 1}
    client.device.happen("emergency", "arises", fields | {"manufacturer": b"abcde"})
    reply, emergency = client.receive(), client.receive()
    assert reply is not None
    assert emergency is not None
    assert (reply.frame, emergency.frame) == ("sdo_upload_expedited", "emergency")
    assert emergency.fields["manufacturer"] == b"abcde"
    assert emergency.fields["counter"] != reply.fields["counter"]
    assert client.receive() is None


def test_a_request_waits_while_a_reply_is_unread() -> None:
    client = Client()
    assert client.send("sdo_upload_request", {"index": 0x2000, "subindex": 0}) == 1
    assert client.send("sdo_upload_request", {"index": 0x2001, "subindex": 0}) == 1
    assert client.send("sdo_upload_request", {"index": 0x2002, "subindex": 0}) == 0
    replies = [client.receive(), client.receive(), client.receive()]
    assert [r and r.fields["index"] for r in replies] == [0x2000, 0x2001, None]


def test_a_duplicate_is_dropped() -> None:
    client = Client()
    first = client.ask("sdo_upload_request", index=0x2000, subindex=0)
    assert client.send("sdo_upload_request", {"index": 0x2001, "subindex": 0}, again=True) == 1
    assert client.receive() is None
    assert client.ask("sdo_upload_request", index=0x2001, subindex=0) != first


def test_a_new_initiate_request_ends_a_transfer() -> None:
    client = Client()
    begun: dict[str, Value] = {"index": 0x2031, "subindex": 0, "size": 500, "value": bytes(112)}
    assert client.ask("sdo_download_normal", **begun).frame == "sdo_download_response"
    assert client.ask("sdo_upload_request", index=0x2000, subindex=0).fields["value"] == b"\x11"
    stray = client.ask("sdo_download_segment", toggle=0, last=1, value=bytes(7))
    assert stray.frame == "sdo_abort"
    assert client.upload(0x2031) == b""


def test_a_reset_undoes_everything() -> None:
    device = VirtualSubDevice(AKD)
    fresh = device.read(0, 0x0A00)
    play(device.model, device, way_to(device.model, "OP"))
    assert device.read(0, 0x0A00) != fresh
    device.reset()
    assert device.read(0, 0x0A00) == fresh


# --- ESC memory -----------------------------------------------------------------------------------


def esc_with_mailboxes() -> Esc:
    esc = Esc(MODEL)
    for stimulus in mailbox_settings(MODEL):
        assert esc.main_write(*written(stimulus)) == 1
    return esc


def mailbox(esc: Esc, name: str) -> Buffers:
    found = esc.mailbox(name)
    assert found is not None
    return found


OUT = MODEL.parameter("mailbox_out", "start"), MODEL.parameter("mailbox_out", "length")
IN = MODEL.parameter("mailbox_in", "start"), MODEL.parameter("mailbox_in", "length")


def test_a_full_mailbox_refuses_a_write_until_the_device_reads() -> None:
    esc = esc_with_mailboxes()
    first, second = bytes([1]) * OUT[1], bytes([2]) * OUT[1]
    assert esc.main_write(OUT[0], first) == 1
    assert mailbox(esc, "sync_manager_0").full
    assert esc.main_write(OUT[0], second) == 0
    assert esc.pdi_read(*OUT) == first
    assert esc.main_write(OUT[0], second) == 1
    assert esc.pdi_read(*OUT) == second


def test_a_write_that_does_not_reach_the_end_does_not_fill() -> None:
    esc = esc_with_mailboxes()
    assert esc.main_write(OUT[0], b"\1") == 1
    assert not mailbox(esc, "sync_manager_0").full
    assert esc.main_write(OUT[0] + OUT[1] - 1, b"\1") == 1
    assert mailbox(esc, "sync_manager_0").full


def test_a_read_empties_the_mailbox_and_an_empty_one_has_nothing() -> None:
    esc = esc_with_mailboxes()
    assert esc.main_read(*IN) == (0, bytes(IN[1]))
    esc.pdi_write(IN[0], bytes([7]) * IN[1])
    assert field_of(AKD, "sync_manager_1_status", "full", esc.register("sync_manager_1_status"))
    assert esc.main_read(*IN) == (1, bytes([7]) * IN[1])
    assert not field_of(AKD, "sync_manager_1_status", "full", esc.register("sync_manager_1_status"))
    assert esc.main_read(*IN)[0] == 0


def test_each_side_has_its_own_mailbox() -> None:
    esc = esc_with_mailboxes()
    assert esc.main_read(*OUT)[0] == 0
    assert esc.main_write(IN[0], bytes(IN[1])) == 0


def test_al_control_is_locked_until_the_device_reads_it() -> None:
    esc = Esc(MODEL)
    address, data = register_bytes(MODEL, request(MODEL.row("al_state", "PREOP")))
    assert esc.main_write(address, data) == 1
    assert esc.al_control_changed
    assert esc.main_write(address, b"\1\0") == 0
    assert esc.pdi_read(address, len(data)) == data
    assert not esc.al_control_changed
    assert esc.main_write(address, b"\1\0") == 1


def test_a_disabled_sync_manager_leaves_plain_memory() -> None:
    esc = esc_with_mailboxes()
    esc.pdi_write(IN[0], bytes(IN[1]))
    for name in ("sync_manager_0", "sync_manager_1"):
        off = WriteRegister(f"{name}_activation", {"enabled": 0})
        assert esc.main_write(*register_bytes(MODEL, off)) == 1
        assert esc.mailbox(name) is None
    assert esc.settings_changed
    assert esc.register("sync_manager_1_status") == 0
    for _ in range(2):
        assert esc.main_write(OUT[0], bytes(OUT[1])) == 1
    assert esc.main_read(*OUT)[0] == 1


def test_an_enabled_sync_manager_keeps_its_settings() -> None:
    esc = esc_with_mailboxes()
    before = esc.register("sync_manager_0")
    esc.main_write(*register_bytes(MODEL, WriteRegister("sync_manager_0", {"start": 1})))
    assert esc.register("sync_manager_0") == before


def test_a_register_of_the_device_takes_no_write() -> None:
    esc = Esc(MODEL)
    status = AKD.registers["al_status"]
    before = esc.register("al_status")
    assert esc.main_write(status.address, bytes([8, 0])) == 0
    assert esc.register("al_status") == before


@pytest.mark.parametrize(
    ("expected", "words"),
    [
        (UNKNOWN, "any"),
        (Octets((2, 2)), "any 2 bytes"),
        (Octets((1, 4)), "any 1 to 4 bytes"),
        (Octets((2, 2), b"\x40\x02"), "40 02"),
        (Octets((2, 2), b"\x40\x02", b"\x6f\x00"), "40/6F ??"),
        (Octets((2, 2), b"\x40\x02", b"\xff"), "40 ??"),
        (Octets((1, 2), b"\x40\x02\x05"), "40 02 of 1 to 2 bytes"),
    ],
)
def test_what_is_known_of_bytes_is_said(expected: Unknown | Octets, words: str) -> None:
    assert typed_words(MODEL, Bytes(None), expected) == words


def test_devices_of_one_protocol_share_what_is_compiled_and_nothing_else() -> None:
    protocol = load_device("reference")
    first, second = VirtualSubDevice(protocol), VirtualSubDevice(protocol)
    assert first.model is second.model
    assert VirtualSubDevice(replace(protocol)).model is not first.model
    before = second.state
    first.write(first.model.protocol.registers["al_control"].address, b"\x11\x00")
    assert first.state != before
    assert second.state is before


def test_what_was_to_come_is_to_come_again_once_a_device_is_restored() -> None:
    model = Model(load_device("reference-drive"))
    device = VirtualSubDevice(model.protocol)
    play(model, device, (*way_to(model, "OP"), WriteOutputs({"control_word": 0})))
    watchdog = ("process_data", "expired")
    before = device.read(0x120, 0x20), device.state
    snapshot = device.snapshot()
    for _ in range(2):
        device.advance(10)
        assert not device.awaits(*watchdog)
        assert device.state != before[1]
        device.restore(snapshot)
        assert device.awaits(*watchdog)
        assert (device.read(0x120, 0x20), device.state) == before


def test_an_observer_is_told_of_each_step_and_of_the_state_before_it() -> None:
    device = VirtualSubDevice(load_device("reference"))
    seen: list[tuple[State, str, State]] = []
    device.observer = lambda state, event, taken: seen.append((state, event.input, taken.state))
    state = device.model.slots["al.state"]
    error = device.model.slots["al.error"]
    device.write(device.model.protocol.registers["al_control"].address, b"\x02\x00")
    before, given, after = seen[0]
    assert given == "request"
    assert (before.slots[state], before.slots[error]) == (after.slots[state], False)
    assert after.slots[error] is True  # without mailboxes there is no way up
