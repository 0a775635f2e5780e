"""Tests of the areas of an ESC: buffers, events, FMMUs, deactivation."""

from __future__ import annotations

from typing import Final

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ecatspec.model.core.compilation import Model
from ecatspec.model.core.register_map import PROCESS_DATA, SYNC_MANAGERS, field_mask, field_of
from ecatspec.model.esc.esc import Esc
from ecatspec.model.esc.three_buffers import Channel
from ecatspec.spec.language.load import load_device

MODEL: Final = Model(load_device("reference"))
PROTOCOL: Final = MODEL.protocol
OUTPUTS, INPUTS = PROCESS_DATA
OUT: Final = Channel(0x1000, 6, main_writes=True)
IN: Final = Channel(0x1100, 5, main_writes=False)
MAIL_OUT, MAIL_IN = SYNC_MANAGERS
TO_DEVICE: Final = Channel(0x1200, 6, main_writes=True, mailbox=True)
TO_MAIN: Final = Channel(0x1210, 5, main_writes=False, mailbox=True)
ON, OFF = b"\x01", b"\x00"


def put(esc: Esc, register: str, data: bytes) -> int:
    """Write a register as the MainDevice, from its first byte on."""
    return esc.main_write(PROTOCOL.registers[register].address, data)


def status(esc: Esc, name: str, field: str) -> int:
    register = f"{name}_status"
    return field_of(PROTOCOL, register, field, esc.register(register))


def set_up(esc: Esc, name: str, channel: Channel, *, control: int | None = None) -> None:
    """Write start, length, control and activation of a SyncManager as a MainDevice does."""
    if control is None:
        control = 0x64 if channel.main_writes else 0x20
        if channel.mailbox:
            control = 0x26 if channel.main_writes else 0x22
    words = channel.start.to_bytes(2, "little") + channel.length.to_bytes(2, "little")
    assert put(esc, name, words + bytes([control, 0])) == 1
    assert put(esc, f"{name}_activation", ON) == 1


def map_bytes(esc: Esc, number: int, logical: int, channel: Channel) -> None:
    map_bits(esc, number, (logical, channel.length, 0, 7), (channel.start, 0), channel.main_writes)


def map_bits(
    esc: Esc, number: int, logical: tuple[int, int, int, int], physical: tuple[int, int], kind: int
) -> None:
    """Set an FMMU; `kind` is 0 for a read, 1 for a write, 2 for both."""
    start, length, first, last = logical
    data = start.to_bytes(4, "little") + length.to_bytes(2, "little") + bytes([first, last])
    data += physical[0].to_bytes(2, "little") + bytes([physical[1], kind + 1, 1, 0, 0, 0])
    assert put(esc, f"fmmu_{number}", data) == 1


@pytest.fixture
def esc() -> Esc:
    """A memory with outputs and inputs, the device still has to look at the settings."""
    esc = Esc(MODEL)
    set_up(esc, OUTPUTS, OUT)
    set_up(esc, INPUTS, IN)
    return esc


@pytest.fixture
def mail(esc: Esc) -> Esc:
    """The same with both mailboxes, and the device has looked at the settings."""
    set_up(esc, MAIL_OUT, TO_DEVICE)
    set_up(esc, MAIL_IN, TO_MAIN)
    esc.pdi_read(PROTOCOL.registers[MAIL_OUT].address, 8)
    return esc


def write(esc: Esc, data: bytes) -> int:
    return esc.main_write(OUT.start, data)


def read(esc: Esc) -> tuple[int, bytes]:
    return esc.main_read(IN.start, IN.length)


# --- outputs --------------------------------------------------------------------------------------


def test_nothing_is_there_before_it_is_set_up() -> None:
    esc = Esc(MODEL)
    assert [esc.process_channel(name) for name in PROCESS_DATA] == [None, None]
    assert (esc.outputs(), esc.outputs_written) == (None, False)
    esc.set_inputs(b"12345")
    assert esc.main_write(OUT.start, b"plain!") == 1
    assert esc.main_read(OUT.start, 6) == (1, b"plain!")
    assert status(esc, OUTPUTS, "last_buffer") == 3


def test_outputs_reach_the_device_with_an_event(esc: Esc) -> None:
    before = esc.al_event()
    assert esc.outputs() is None
    assert write(esc, b"abcdef") == 1
    assert esc.outputs_written
    assert esc.al_event() == before | 1 << 10
    assert (status(esc, OUTPUTS, "written"), status(esc, OUTPUTS, "taken")) == (True, False)
    assert esc.outputs() == b"abcdef"
    assert not esc.outputs_written
    assert (status(esc, OUTPUTS, "written"), status(esc, OUTPUTS, "taken")) == (False, True)
    assert esc.outputs() == b"abcdef"
    assert write(esc, b"ghijkl") == write(esc, b"mnopqr") == 1
    assert esc.outputs() == b"mnopqr"


def test_outputs_are_new_with_their_last_byte(esc: Esc) -> None:
    assert esc.main_write(OUT.start + 1, b"x") == 0
    assert write(esc, b"abc") == 1
    assert status(esc, OUTPUTS, "write_open")
    assert (esc.outputs(), esc.outputs_written) == (None, False)
    assert esc.main_write(OUT.start + 3, b"de") == 1
    assert esc.main_write(OUT.start + 5, b"f") == 1
    assert esc.outputs() == b"abcdef"
    assert esc.main_write(OUT.start + 3, b"def") == 0


def test_each_side_has_its_own_area(esc: Esc) -> None:
    write(esc, b"abcdef")
    esc.set_inputs(b"12345")
    assert esc.main_read(OUT.start, OUT.length) == (0, bytes(OUT.length))
    assert esc.main_write(IN.start, b"xxxxx") == 0
    assert esc.pdi_read(IN.start, IN.length) == bytes(IN.length)
    esc.pdi_write(OUT.start, b"xxxxxx")
    assert esc.outputs() == b"abcdef"
    assert read(esc) == (1, b"12345")


@pytest.mark.parametrize("area", [OUT, IN])
def test_the_hidden_buffers_belong_to_nobody(esc: Esc, area: Channel) -> None:
    for start in (area.end, area.end + area.length):
        assert esc.main_read(start, area.length) == (0, bytes(area.length))
        assert esc.main_write(start, bytes(area.length)) == 0
        esc.pdi_write(start, b"\xff")
        assert esc.pdi_read(start, 1) == b"\0"
    assert esc.main_write(area.hidden_end, b"z") == 1
    assert esc.main_read(area.hidden_end, 1) == (1, b"z")


def test_there_is_no_memory_behind_the_memory() -> None:
    model = Model(load_device("afag-se-power"))
    esc = Esc(model)
    last = esc.size - 1
    assert esc.main_write(last, b"a") == 1
    assert esc.main_write(last, b"bc") == esc.main_write(esc.size, b"d") == 0
    assert esc.main_read(last, 1) == (1, b"a")
    assert esc.main_read(last, 2) == (0, bytes(2))
    assert esc.main_read(esc.size, 1) == (0, bytes(1))


def test_an_area_that_an_access_sets_up_takes_the_rest_of_it(esc: Esc) -> None:
    """Registers and memory lie in one access; a piece of it is cut by the areas before it."""
    last = PROTOCOL.registers[f"{INPUTS}_activation"]
    put(esc, f"{INPUTS}_activation", OFF)
    rest = bytes(IN.start - last.address - 1)
    assert esc.main_write(last.address, ON + rest + b"in?") == 1
    assert esc.process_channel(INPUTS) == IN
    put(esc, f"{INPUTS}_activation", OFF)
    assert esc.main_read(IN.start, 3) == (1, bytes(3))


def test_hidden_buffers_give_way_to_areas(esc: Esc) -> None:
    put(esc, f"{INPUTS}_activation", OFF)
    set_up(esc, INPUTS, Channel(OUT.end, 5, main_writes=False))
    esc.set_inputs(b"12345")
    assert esc.main_read(OUT.end, 5) == (1, b"12345")


def test_an_access_across_areas_counts_where_a_piece_succeeds(esc: Esc) -> None:
    assert esc.main_write(OUT.start - 2, b"..abcdef++") == 1
    assert esc.outputs() == b"abcdef"
    assert esc.main_read(OUT.start - 2, 8) == (1, b".." + bytes(6))
    esc.set_inputs(b"12345")
    assert esc.main_read(IN.start, 8) == (1, b"12345\0\0\0")


# --- inputs ---------------------------------------------------------------------------------------


def test_inputs_must_be_written_before_they_can_be_read(esc: Esc) -> None:
    assert read(esc) == (0, bytes(5))
    esc.set_inputs(b"123")
    assert read(esc) == (1, b"123\0\0")
    assert status(esc, INPUTS, "taken")
    assert read(esc) == (1, b"123\0\0")
    esc.set_inputs(b"1234567")
    assert not status(esc, INPUTS, "taken")
    assert read(esc) == (1, b"12345")


def test_the_device_learns_that_inputs_were_read(esc: Esc) -> None:
    esc.set_inputs(b"12345")
    read(esc)
    assert esc.al_event() & 1 << 11
    esc.set_inputs(b"12345")
    assert not esc.al_event() & 1 << 11


def test_a_buffer_that_is_being_read_stays(esc: Esc) -> None:
    esc.set_inputs(b"abcde")
    assert esc.main_read(IN.start, 2) == (1, b"ab")
    assert status(esc, INPUTS, "read_open")
    for image in (b"11111", b"22222", b"33333"):
        esc.set_inputs(image)
    assert esc.main_read(IN.start + 2, 3) == (1, b"cde")
    assert esc.main_read(IN.start + 2, 3) == (0, bytes(3))
    assert read(esc) == (1, b"33333")


def test_the_device_can_use_its_hooks_instead(esc: Esc) -> None:
    esc.pdi_write(IN.start, b"abc")
    assert read(esc)[0] == 0
    esc.pdi_write(IN.start + 3, b"de")
    assert read(esc) == (1, b"abcde")
    write(esc, b"abcdef")
    assert esc.pdi_read(OUT.start, 3) == b"abc"
    assert not esc.outputs_written
    assert esc.pdi_read(OUT.start + 3, 3) == b"def"


# --- events ---------------------------------------------------------------------------------------


def seen(esc: Esc, name: str) -> str:
    """Give the bits of the status that are set, and whether there is an event for the device."""
    bits = ["written", "taken"] + ["full"] * (name in SYNC_MANAGERS)
    event = field_mask(PROTOCOL, "al_event_request", name) & esc.al_event()
    return " ".join([bit for bit in bits if status(esc, name, bit)] + ["event"] * bool(event))


def test_a_message_to_the_device_is_an_event_until_its_first_byte_is_read(mail: Esc) -> None:
    assert mail.main_write(TO_DEVICE.start, b"abc") == 1
    assert seen(mail, MAIL_OUT) == ""
    assert mail.main_write(TO_DEVICE.start + 3, b"def") == 1
    assert seen(mail, MAIL_OUT) == "written full event"
    assert mail.pdi_read(TO_DEVICE.start, 1) == b"a"
    assert seen(mail, MAIL_OUT) == "full"
    assert mail.pdi_read(TO_DEVICE.start, 5) == b"abcde"
    assert mail.pdi_read(TO_DEVICE.start + 5, 1) == b"f"
    assert seen(mail, MAIL_OUT) == "taken"
    assert mail.main_write(TO_DEVICE.start, b"g") == 1
    assert seen(mail, MAIL_OUT) == ""


def test_a_message_of_the_device_was_read_until_its_first_byte_is_written(mail: Esc) -> None:
    mail.pdi_write(TO_MAIN.start, b"abc")
    assert seen(mail, MAIL_IN) == ""
    mail.pdi_write(TO_MAIN.start + 3, b"de")
    assert seen(mail, MAIL_IN) == "written full"
    assert mail.main_read(TO_MAIN.start, 1) == (1, b"a")
    assert seen(mail, MAIL_IN) == "full"
    assert mail.main_read(TO_MAIN.start + 1, 4) == (1, b"bcde")
    assert seen(mail, MAIL_IN) == "taken event"
    # so a stack takes notice of the event, long before it has something to say
    mail.pdi_write(TO_MAIN.start, b"\0")
    assert seen(mail, MAIL_IN) == ""
    assert mail.main_read(TO_MAIN.start, 5)[0] == 0
    mail.pdi_write(TO_MAIN.start, b"fghij")
    assert mail.main_read(TO_MAIN.start, 5) == (1, b"fghij")


def test_an_event_stays_that_came_in_the_middle_of_an_image(esc: Esc) -> None:
    write(esc, b"abcdef")
    assert esc.pdi_read(OUT.start, 3) == b"abc"
    assert seen(esc, OUTPUTS) == ""
    write(esc, b"ghijkl")
    assert esc.pdi_read(OUT.start + 3, 3) == b"def"
    assert seen(esc, OUTPUTS) == "written taken event"
    esc.set_inputs(b"12345")
    read(esc)
    assert seen(esc, INPUTS) == "taken event"
    esc.pdi_write(IN.start, b"67")
    assert seen(esc, INPUTS) == ""
    read(esc)
    esc.pdi_write(IN.start + 2, b"890")
    assert seen(esc, INPUTS) == "written taken event"


def test_an_event_goes_with_its_sync_manager(mail: Esc) -> None:
    mail.main_write(TO_DEVICE.start, b"abcdef")
    mail.deactivate(MAIL_OUT, off=True)
    mail.deactivate(MAIL_OUT, off=False)
    assert seen(mail, MAIL_OUT) == ""
    mail.main_write(TO_DEVICE.start, b"abcdef")
    put(mail, f"{MAIL_OUT}_activation", OFF)
    assert seen(mail, MAIL_OUT) == ""


# --- what is refused ------------------------------------------------------------------------------


def test_the_device_cannot_write_over_a_message_that_was_not_read(mail: Esc) -> None:
    mail.pdi_write(TO_MAIN.start, b"first")
    for offset in range(TO_MAIN.length):
        mail.pdi_write(TO_MAIN.start + offset, b"second"[: TO_MAIN.length - offset])
    assert seen(mail, MAIL_IN) == "written full"
    assert mail.main_read(TO_MAIN.start, 2) == (1, b"fi")
    mail.pdi_write(TO_MAIN.start, b"third")
    assert mail.main_read(TO_MAIN.start, 5) == (1, b"first")


def test_an_empty_mailbox_has_nothing_for_the_device(mail: Esc) -> None:
    assert mail.pdi_read(TO_DEVICE.start, 6) == bytes(6)
    mail.main_write(TO_DEVICE.start, b"abc")
    assert mail.pdi_read(TO_DEVICE.start, 6) == bytes(6)
    assert seen(mail, MAIL_OUT) == ""
    mail.main_write(TO_DEVICE.start + 3, b"def")
    assert mail.pdi_read(TO_DEVICE.start, 6) == b"abcdef"
    assert mail.pdi_read(TO_DEVICE.start, 6) == bytes(6)
    assert seen(mail, MAIL_OUT) == "taken"


def test_a_mailbox_has_one_direction(mail: Esc) -> None:
    mail.pdi_write(TO_DEVICE.start, b"sixsix")
    assert seen(mail, MAIL_OUT) == ""
    mail.main_write(TO_DEVICE.start, b"abcdef")
    mail.pdi_write(TO_DEVICE.start, b"sixsix")
    assert mail.pdi_read(TO_DEVICE.start, 6) == b"abcdef"
    mail.pdi_write(TO_MAIN.start, b"abcde")
    assert mail.pdi_read(TO_MAIN.start, 5) == bytes(5)
    assert seen(mail, MAIL_IN) == "written full"
    assert mail.main_read(TO_MAIN.start, 5) == (1, b"abcde")


def test_a_mailbox_begins_with_its_first_byte(mail: Esc) -> None:
    assert mail.main_write(TO_DEVICE.start + 1, b"bcdef") == 0
    mail.pdi_write(TO_MAIN.start + 1, b"bcde")
    assert (seen(mail, MAIL_OUT), seen(mail, MAIL_IN)) == ("", "")
    mail.main_write(TO_DEVICE.start, b"abcdef")
    mail.pdi_write(TO_MAIN.start, b"abcde")
    assert mail.pdi_read(TO_DEVICE.start + 5, 1) == b"\0"
    assert mail.main_read(TO_MAIN.start + 4, 1) == (0, b"\0")
    assert (seen(mail, MAIL_OUT), seen(mail, MAIL_IN)) == ("written full event", "written full")


def test_a_mailbox_that_the_device_switched_off_takes_and_gives_nothing(mail: Esc) -> None:
    mail.main_write(TO_DEVICE.start, b"abcdef")
    for name in SYNC_MANAGERS:
        mail.deactivate(name, off=True)
    assert mail.pdi_read(TO_DEVICE.start, 6) == bytes(6)
    assert mail.main_write(TO_DEVICE.start, b"abcdef") == 0
    mail.pdi_write(TO_MAIN.start, b"abcde")
    assert (seen(mail, MAIL_OUT), seen(mail, MAIL_IN)) == ("", "")


def test_a_mailbox_over_registers_guards_nothing() -> None:
    esc = Esc(MODEL)
    set_up(esc, MAIL_OUT, Channel(0x0100, 64, main_writes=True, mailbox=True))
    assert esc.mailbox(MAIL_OUT) is None
    assert put(esc, "al_control", b"\x02\x00") == 1
    assert esc.pdi_read(PROTOCOL.registers["al_control"].address, 2) == b"\x02\x00"


def test_no_bytes_have_no_effect(mail: Esc) -> None:
    put(mail, "al_control", b"\x02\x00")
    put(mail, f"{MAIL_IN}_activation", ON)
    mail.expire_watchdog()
    mail.main_write(TO_DEVICE.start, b"abcdef")
    mail.pdi_write(TO_MAIN.start, b"abcde")
    write(mail, b"abcdef")
    before = mail.al_event(), mail.registers()
    assert before[0].bit_count() == 5
    for address in range(mail.size + 1):
        assert mail.pdi_read(address, 0) == b""
        mail.pdi_write(address, b"")
    assert (mail.al_event(), mail.registers()) == before


# --- settings -------------------------------------------------------------------------------------


def test_settings_are_an_event_and_stay_while_enabled(esc: Esc) -> None:
    assert esc.settings_changed
    at = PROTOCOL.registers[f"{OUTPUTS}_activation"]
    esc.pdi_read(at.address, at.size)
    assert not esc.settings_changed
    put(esc, OUTPUTS, b"\x00\x20")
    assert esc.process_channel(OUTPUTS) == OUT
    assert not esc.settings_changed
    put(esc, f"{OUTPUTS}_activation", OFF)
    assert esc.settings_changed
    assert put(esc, OUTPUTS, b"\x00\x20") == put(esc, f"{OUTPUTS}_activation", ON) == 1
    assert esc.process_channel(OUTPUTS) == Channel(0x2000, 6, main_writes=True)


def test_a_new_start_has_empty_buffers(esc: Esc) -> None:
    write(esc, b"abcdef")
    esc.set_inputs(b"12345")
    put(esc, f"{INPUTS}_activation", ON)
    assert read(esc)[0] == 1
    for name in PROCESS_DATA:
        put(esc, f"{name}_activation", OFF)
        put(esc, f"{name}_activation", ON)
    assert (esc.outputs(), esc.outputs_written) == (None, False)
    assert read(esc) == (0, bytes(5))


def test_deactivation_by_the_device_takes_the_area_away(esc: Esc) -> None:
    write(esc, b"abcdef")
    esc.deactivate(OUTPUTS, off=True)
    assert esc.register(f"{OUTPUTS}_pdi_control") == 1
    assert esc.process_channel(OUTPUTS) is None
    assert (esc.outputs(), esc.outputs_written) == (None, False)
    assert write(esc, b"ghijkl") == 0
    esc.deactivate(OUTPUTS, off=False)
    assert (esc.outputs(), esc.process_channel(OUTPUTS)) == (None, OUT)
    assert write(esc, b"ghijkl") == 1
    esc.set_inputs(b"12345")
    control = PROTOCOL.registers[f"{INPUTS}_pdi_control"].address
    esc.pdi_write(control, b"\x01")
    esc.set_inputs(b"12345")
    assert read(esc)[0] == 0
    esc.pdi_write(control, b"\x00")
    assert read(esc)[0] == 0
    esc.set_inputs(b"12345")
    assert read(esc)[0] == 1


@pytest.mark.parametrize(
    ("channel", "control"),
    [
        (Channel(0x1000, 0, main_writes=True), 0x24),
        (Channel(0x1000, 6, main_writes=True), 0x26),
        (Channel(0x0100, 64, main_writes=True), 0x24),
    ],
    ids=["no length", "mailbox mode", "over registers"],
)
def test_settings_that_give_no_buffers(channel: Channel, control: int) -> None:
    esc = Esc(MODEL)
    set_up(esc, OUTPUTS, channel, control=control)
    assert esc.process_channel(OUTPUTS) is None
    assert put(esc, "al_control", b"\x02\x00") == 1


def test_a_wrong_direction_is_no_output() -> None:
    esc = Esc(MODEL)
    set_up(esc, OUTPUTS, OUT, control=0x20)
    set_up(esc, INPUTS, IN, control=0x24)
    esc.set_inputs(b"12345")
    assert esc.main_write(IN.start, b"abcde") == 1
    assert esc.outputs() is None


# --- logical addressing ---------------------------------------------------------------------------


def test_a_logical_datagram_exchanges_process_data(esc: Esc) -> None:
    map_bytes(esc, 0, 0x10000, OUT)
    map_bytes(esc, 1, 0x10006, IN)
    assert esc.logical("LRW", 0x10000, b"abcdef.....") == (2, b"abcdef.....")
    assert esc.outputs() == b"abcdef"
    esc.set_inputs(b"12345")
    assert esc.logical("LRW", 0x10000, b"ghijkl.....") == (3, b"ghijkl12345")
    assert esc.logical("LRD", 0x10000, bytes(12)) == (1, bytes(6) + b"12345\0")
    assert esc.logical("LWR", 0x10000, b"mnopqr") == (1, b"mnopqr")
    assert esc.outputs() == b"mnopqr"
    assert esc.logical("LRW", 0x20000, b"nobody") == (0, b"nobody")


def test_inputs_may_lie_over_outputs(esc: Esc) -> None:
    map_bytes(esc, 0, 0, OUT)
    map_bytes(esc, 1, 0, IN)
    esc.set_inputs(b"12345")
    assert esc.logical("LRW", 0, b"abcdef") == (3, b"12345f")
    assert esc.outputs() == b"abcdef"


def test_a_part_of_the_logical_area_is_a_part_of_the_buffer(esc: Esc) -> None:
    map_bytes(esc, 0, 100, OUT)
    assert esc.logical("LWR", 103, b"def") == (0, b"def")
    assert esc.logical("LWR", 98, b"..abc") == (1, b"..abc")
    assert esc.logical("LWR", 103, b"def..") == (1, b"def..")
    assert esc.outputs() == b"abcdef"


def test_an_fmmu_that_is_off_maps_nothing(esc: Esc) -> None:
    map_bytes(esc, 2, 0, OUT)
    put(esc, "fmmu_2", bytes(16))
    assert esc.logical("LWR", 0, b"abcdef") == (0, b"abcdef")


def test_the_state_of_a_mailbox_is_one_bit(esc: Esc) -> None:
    name = SYNC_MANAGERS[1]
    set_up(esc, name, Channel(0x1200, 64, main_writes=False, mailbox=True))
    at = PROTOCOL.registers[f"{name}_status"].address
    map_bits(esc, 3, (0x500, 1, 2, 2), (at, 3), 0)
    assert esc.logical("LRD", 0x500, b"\xff") == (1, b"\xfb")
    esc.pdi_write(0x1200, bytes(64))
    assert esc.logical("LRD", 0x500, b"\x00") == (1, b"\x04")


# --- properties -----------------------------------------------------------------------------------

ACTS: Final = st.one_of(
    st.tuples(st.just("write"), st.integers(0, 255), st.integers(0, OUT.length)),
    st.tuples(st.just("outputs"), st.just(0), st.just(0)),
    st.tuples(st.just("inputs"), st.integers(0, 255), st.integers(0, IN.length)),
    st.tuples(st.just("read"), st.just(0), st.integers(0, IN.length)),
)


@settings(max_examples=200)
@given(st.lists(ACTS, max_size=40))
def test_what_is_read_is_the_newest_complete_image(acts: list[tuple[str, int, int]]) -> None:
    """Each image is one byte repeated; it is written or read in two pieces, or left unfinished."""
    esc = Esc(MODEL)
    set_up(esc, OUTPUTS, OUT)
    set_up(esc, INPUTS, IN)
    out: bytes | None = None
    inputs: bytes | None = None
    for kind, value, cut in acts:
        match kind:
            case "write":
                image = bytes([value]) * OUT.length
                assert write(esc, image[: cut or OUT.length]) == 1
                if 0 < cut < OUT.length and value % 2:
                    assert esc.main_write(OUT.start + cut, image[cut:]) == 1
                if cut in {0, OUT.length} or value % 2:
                    out = image
            case "outputs":
                assert esc.outputs() == out
            case "inputs":
                image = bytes([value]) * IN.length
                esc.pdi_write(IN.start, image[: cut or IN.length])
                if 0 < cut < IN.length and value % 2:
                    esc.pdi_write(IN.start + cut, image[cut:])
                if cut in {0, IN.length} or value % 2:
                    inputs = image
            case _:
                first = esc.main_read(IN.start, cut or IN.length)
                if inputs is None:
                    assert first == (0, bytes(cut or IN.length))
                    continue
                assert first == (1, inputs[: cut or IN.length])
                if 0 < cut < IN.length:
                    esc.set_inputs(b"other")
                    rest = esc.main_read(IN.start + cut, IN.length - cut)
                    assert rest == (1, inputs[cut:])
                    inputs = b"other"


MEMORY: Final = 0x3000
SIZE: Final = 24
MAPPINGS: Final = st.tuples(
    st.integers(0, 6),  # logical byte
    st.integers(0, 5),  # length
    st.integers(0, 7),  # first bit
    st.integers(0, 7),  # last bit
    st.integers(0, 8),  # physical byte
    st.integers(0, 7),  # physical bit
)


def bit_of(data: bytes, number: int) -> int:
    return data[number // 8] >> number % 8 & 1


def with_bit(data: bytearray, number: int, bit: int) -> None:
    data[number // 8] = data[number // 8] & ~(1 << number % 8) | bit << number % 8


@settings(max_examples=300)
@given(
    mapping=MAPPINGS,
    command=st.sampled_from(["LRD", "LWR", "LRW"]),
    kind=st.integers(0, 2),
    address=st.integers(0, 8),
    data=st.binary(min_size=1, max_size=12),
    memory=st.binary(min_size=SIZE, max_size=SIZE),
)
def test_bits_are_mapped_one_by_one(
    mapping: tuple[int, int, int, int, int, int],
    command: str,
    kind: int,
    address: int,
    data: bytes,
    memory: bytes,
) -> None:
    logical, length, first, last, physical, bit = mapping
    esc = Esc(MODEL)
    esc.main_write(MEMORY, memory)
    map_bits(esc, 0, (logical, length, first, last), (MEMORY + physical, bit), kind)
    result, after = bytearray(data), bytearray(memory)
    reads, writes = command != "LWR" and kind != 1, command != "LRD" and kind != 0
    mapped = 0
    end = (logical + length - 1) * 8 + last + 1 if length else 0
    for count, place in enumerate(range(logical * 8 + first, end)):
        at, target = place - address * 8, physical * 8 + bit + count
        if 0 <= at < len(data) * 8:
            mapped = 1
            if reads:
                with_bit(result, at, bit_of(memory, target))
            if writes:
                with_bit(after, target, bit_of(data, at))
    weight = 2 if command == "LRW" else 1
    assert esc.logical(command, address, data) == (
        mapped * (reads + writes * weight),
        bytes(result),
    )
    assert esc.main_read(MEMORY, SIZE) == (1, bytes(after))
