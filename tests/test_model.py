"""The only place for tests of model/: codec, values, logic, interpreter, ESC, virtual SubDevice."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from ecatspec.generators.bringup import mailbox_settings, request, row, way_to
from ecatspec.generators.case import WriteRegister, WriteRegisters
from ecatspec.generators.stimulus import register_bytes, registers_bytes
from ecatspec.model.compiled import Model
from ecatspec.model.esc import Esc, field_of
from ecatspec.model.evaluate import Environment, compile_expression
from ecatspec.model.interpreter import step
from ecatspec.model.state import Event
from ecatspec.model.subdevice import VirtualSubDevice
from ecatspec.model.values import UNKNOWN, Pattern, Value, admits
from ecatspec.spec.language.ir import Binary, Bool, Bytes, Literal, Name, SInt, Unary
from ecatspec.spec.language.load import load_device
from ecatspec.spec.language.scope import width_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ecatspec.generators.case import Stimulus
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


def drawn(field: FrameField, unused: int) -> st.SearchStrategy[Value]:
    match field.type:
        case Bytes(length=None):
            return st.binary(max_size=20)
        case Bytes():
            size = unused if field.name == "padding" else EXPEDITED - unused
            return st.binary(min_size=size, max_size=size)
        case Bool():
            return st.booleans()
    width = width_of(AKD, field.type)
    assert width is not None
    if isinstance(field.type, SInt):
        return st.integers(-(1 << (width - 1)), (1 << (width - 1)) - 1)
    return st.integers(0, (1 << width) - 1)


def filled(data: st.DataObject, frame: str) -> dict[str, Value]:
    """Values for every free field of the frame and of all around it, bodies and counts left out."""
    trail = CODEC.trail(frame)
    fixed = CODEC.fixed(frame)
    unused = data.draw(st.integers(0, 3), "unused")
    values: dict[str, Value] = {}
    for name in trail:
        for field in AKD.frames[name].fields:
            body = field.name in {"payload", "body"} and name != frame
            if body or field.name in fixed or CODEC.is_derived(frame, field.name):
                continue
            values[field.name] = data.draw(drawn(field, unused), field.name)
    if "value" in values and frame.endswith("expedited"):
        values["unused"] = unused
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
    for name, value in CODEC.fixed(frame).items():
        assert message.fields[name] == value


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


# --- values ---------------------------------------------------------------------------------------

PATTERNS = st.builds(
    Pattern,
    st.lists(
        st.tuples(st.integers(0, 12), st.integers(0, 12)).map(lambda p: (min(p), max(p))),
        min_size=1,
        max_size=3,
    ).map(tuple),
    st.none() | st.integers(0, 12),
)


@given(pattern=PATTERNS, value=st.integers(-2, 15))
def test_a_pattern_admits_its_ranges_without_the_excluded(pattern: Pattern, value: int) -> None:
    members = {n for low, high in pattern.ranges or () for n in range(low, high + 1)}
    assert pattern.admits(value) == (value in members - {pattern.excluded})
    assert admits(pattern, value) == pattern.admits(value)


@given(pattern=PATTERNS, after=st.integers(-2, 15))
def test_the_first_value_is_the_next_one_or_wraps(pattern: Pattern, after: int) -> None:
    members = sorted(n for n in range(13) if pattern.admits(n))
    if not members:
        with pytest.raises(ValueError, match="no number is acceptable"):
            pattern.first(after)
        return
    above = [n for n in members if n > after]
    assert pattern.first(after) == (above or members)[0]


def test_an_unknown_value_admits_everything_and_a_pattern_no_text() -> None:
    assert all(UNKNOWN.admits(value) for value in (0, True, b"", "stay"))
    assert not Pattern(((0, 9),)).admits(b"\0")
    assert not Pattern(((0, 9),)).admits("stay")
    assert UNKNOWN.first() == 0


# --- three-valued logic ---------------------------------------------------------------------------

TRUTHS: tuple[Value, ...] = (False, UNKNOWN, True)
ORDER = {False: 0, UNKNOWN: 1, True: 2}


def truth(expression: Binary | Unary, a: Value, b: Value = UNKNOWN) -> Value:
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


@pytest.mark.parametrize("a", TRUTHS)
def test_not_turns_the_order_round(a: Value) -> None:
    assert ORDER[truth(Unary("not", Name("a")), a)] == 2 - ORDER[a]


def test_comparisons_with_what_is_not_known() -> None:
    equal = Binary("==", Name("a"), Literal(5))
    assert truth(equal, UNKNOWN) == UNKNOWN
    assert truth(equal, Pattern(((1, 3),))) is False
    assert truth(equal, Pattern(((1, 9),))) == UNKNOWN
    assert truth(Binary("!=", Name("a"), Literal(5)), Pattern(((1, 3),))) is True
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


def test_a_reset_undoes_everything() -> None:
    device = VirtualSubDevice(AKD)
    fresh = device.read(0, 0x0A00)
    drive(device, way_to(device.model, "OP"))
    assert device.read(0, 0x0A00) != fresh
    device.reset()
    assert device.read(0, 0x0A00) == fresh


# --- ESC memory -----------------------------------------------------------------------------------


def esc_with_mailboxes() -> Esc:
    esc = Esc(MODEL)
    for stimulus in mailbox_settings(MODEL):
        assert esc.main_write(*written(stimulus)) == 1
    return esc


OUT = MODEL.parameter("mailbox_out", "start"), MODEL.parameter("mailbox_out", "length")
IN = MODEL.parameter("mailbox_in", "start"), MODEL.parameter("mailbox_in", "length")


def test_a_full_mailbox_refuses_a_write_until_the_device_reads() -> None:
    esc = esc_with_mailboxes()
    first, second = bytes([1]) * OUT[1], bytes([2]) * OUT[1]
    assert esc.main_write(OUT[0], first) == 1
    assert esc.channel("sync_manager_0") == (*OUT, True)
    assert esc.main_write(OUT[0], second) == 0
    assert esc.pdi_read(*OUT) == first
    assert esc.main_write(OUT[0], second) == 1
    assert esc.pdi_read(*OUT) == second


def test_a_write_that_does_not_reach_the_end_does_not_fill() -> None:
    esc = esc_with_mailboxes()
    assert esc.main_write(OUT[0], b"\1") == 1
    assert esc.channel("sync_manager_0") == (*OUT, False)
    assert esc.main_write(OUT[0] + OUT[1] - 1, b"\1") == 1
    assert esc.channel("sync_manager_0") == (*OUT, True)


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
    address, data = register_bytes(MODEL, request(row(MODEL, "al_state", "PREOP")))
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
        assert esc.channel(name) is None
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
