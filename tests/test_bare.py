"""Tests of our ESC as a foreign stack sees it."""

from __future__ import annotations

from functools import cache

import pytest

from ecatspec.model.core.compilation import Model
from ecatspec.model.core.register_map import field_mask
from ecatspec.model.esc.stack_harness import BareSubDevice
from ecatspec.spec.language.load import load_device

MAILBOXES = bytes.fromhex("00108000260001008010800022000100")
OUTPUTS = bytes.fromhex("0011040064000100")  # with the trigger of the watchdog
AT_MANAGERS, AT_OUTPUTS = 0x0800, 0x0810
WATCHDOG_TIME = 100_000


@cache
def model() -> Model:
    return Model(load_device("reference-drive"))


class Stack:
    """A stack that only remembers."""

    def __init__(self) -> None:
        self.polls: list[int] = []
        self.starts = 0

    def init(self) -> None:
        self.starts += 1

    def poll(self, microseconds: int) -> None:
        self.polls.append(microseconds)


@pytest.fixture
def stack() -> Stack:
    return Stack()


@pytest.fixture
def bare(stack: Stack) -> BareSubDevice:
    made = BareSubDevice(model().protocol, stack)
    made.reset()
    return made


def event(field: str) -> int:
    return field_mask(model().protocol, "al_event_request", field)


def test_a_reset_starts_the_stack_on_a_new_esc(bare: BareSubDevice, stack: Stack) -> None:
    before = bare.esc
    bare.write(0x1000, b"x")
    bare.reset()
    assert bare.esc is not before
    assert bare.read(0x1000, 1) == (1, b"\0")
    assert (stack.starts, stack.polls) == (2, [0, 0, 0])


def test_time_passes_in_steps(bare: BareSubDevice, stack: Stack) -> None:
    stack.polls.clear()
    bare.advance(0.0035)
    bare.advance(0.0)
    assert stack.polls == [1000, 1000, 1000, 500]


def test_a_read_without_effect_does_not_poll(bare: BareSubDevice, stack: Stack) -> None:
    stack.polls.clear()
    bare.read(0x0130, 2)
    assert stack.polls == []


def test_al_control_is_locked_until_the_stack_reads_it(bare: BareSubDevice) -> None:
    assert bare.write(0x0120, b"\x02\0") == 1
    assert bare.write(0x0120, b"\x01\0") == 0
    assert bare.esc.al_event() == event("al_control_changed")
    assert bare.esc.pdi_read(0x0120, 2) == b"\x02\0"
    assert bare.esc.al_event() == 0
    assert bare.write(0x0120, b"\x01\0") == 1


def test_the_register_of_events_is_the_hook(bare: BareSubDevice) -> None:
    bare.write(0x0120, b"\x02\0")
    assert int.from_bytes(bare.esc.pdi_read(0x0220, 4), "little") == bare.esc.al_event()
    bare.esc.pdi_read(0x0120, 2)
    assert bare.esc.pdi_read(0x0220, 4) == bytes(4)


def test_settings_are_an_event_until_the_activation_is_read(bare: BareSubDevice) -> None:
    bare.write(AT_MANAGERS, MAILBOXES)
    assert bare.esc.al_event() == event("sync_manager_changed")
    bare.esc.pdi_read(AT_MANAGERS + 6, 1)
    assert bare.esc.al_event() == 0


def test_the_events_of_a_mailbox_go_with_the_message(bare: BareSubDevice, stack: Stack) -> None:
    bare.write(AT_MANAGERS, MAILBOXES)
    bare.esc.pdi_read(AT_MANAGERS, 32)
    bare.write(0x1000, bytes(range(128)))
    assert bare.esc.al_event() == event("sync_manager_0")
    assert bare.write(0x1000, bytes(128)) == 0
    assert bare.esc.pdi_read(0x1000, 128) == bytes(range(128))
    assert bare.esc.al_event() == 0
    bare.esc.pdi_write(0x1080, bytes(128))
    assert bare.esc.al_event() == 0
    stack.polls.clear()
    assert bare.read(0x1080, 128)[0] == 1
    assert bare.esc.al_event() == event("sync_manager_1")
    assert stack.polls == [0]
    bare.esc.pdi_write(0x1080, bytes(128))
    assert bare.esc.al_event() == 0


def test_the_stack_takes_a_message_back_by_switching_off_and_on(bare: BareSubDevice) -> None:
    bare.write(AT_MANAGERS, MAILBOXES)
    bare.esc.pdi_write(0x1080, b"old".ljust(128, b"\0"))
    bare.esc.pdi_write(AT_MANAGERS + 15, b"\x01")
    assert bare.read(0x1080, 128) == (0, bytes(128))
    assert bare.read(AT_MANAGERS + 13, 1) == (1, b"\0")
    bare.esc.pdi_write(0x1080, b"lost".ljust(128, b"\0"))
    assert bare.read(0x1080, 128) == (0, bytes(128))
    bare.esc.pdi_write(AT_MANAGERS + 15, b"\0")
    assert bare.read(0x1080, 128) == (0, bytes(128))
    bare.esc.pdi_write(0x1080, b"new".ljust(128, b"\0"))
    assert bare.read(0x1080, 128) == (1, b"new".ljust(128, b"\0"))
    bare.esc.pdi_write(AT_MANAGERS + 7, b"\x01")
    assert bare.write(0x1000, bytes(128)) == 0


def test_the_watchdog_expires_in_time_and_outputs_restart_it(
    bare: BareSubDevice, stack: Stack
) -> None:
    expired = event("process_data_watchdog")
    assert bare.read(0x0440, 2)[1] == b"\x01\0"  # off
    bare.write(AT_OUTPUTS, OUTPUTS)
    assert bare.read(0x0440, 2)[1] == b"\0\0"  # on, and never fed
    bare.write(0x1100, b"out.")
    bare.advance(WATCHDOG_TIME / 1e6 - 0.0002)
    bare.write(0x1100, b"out.")
    bare.advance(WATCHDOG_TIME / 1e6 - 0.0002)
    assert bare.read(0x0440, 2)[1] == b"\x01\0"
    assert not bare.esc.al_event() & expired
    stack.polls.clear()
    bare.advance(0.001)
    assert stack.polls == [200, 800]
    assert bare.read(0x0440, 2)[1] == b"\0\0"
    assert bare.esc.al_event() & expired
    bare.esc.pdi_read(0x0440, 2)
    assert not bare.esc.al_event() & expired
    bare.advance(1.0)
    assert not bare.esc.al_event() & expired


def test_half_an_image_does_not_feed_the_watchdog(bare: BareSubDevice) -> None:
    bare.write(AT_OUTPUTS, OUTPUTS)
    bare.write(0x1100, b"ou")
    assert bare.read(0x0440, 2)[1] == b"\0\0"
    bare.write(0x1102, b"t.")
    assert bare.read(0x0440, 2)[1] == b"\x01\0"


def test_a_watchdog_of_no_time_is_off(bare: BareSubDevice) -> None:
    bare.write(AT_OUTPUTS, OUTPUTS)
    bare.write(0x1100, b"out.")
    bare.write(0x0420, b"\0\0")
    bare.advance(1.0)
    assert bare.read(0x0440, 2)[1] == b"\x01\0"
    assert not bare.esc.al_event() & event("process_data_watchdog")
