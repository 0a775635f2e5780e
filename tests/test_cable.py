"""Tests of what a cable brings to `simulate`: VLAN tags, an end that is pulled, noise."""

from __future__ import annotations

import random
import sys
from typing import TYPE_CHECKING

import pytest
from wires import FAR, NEAR, cable

from ecatspec.generators.cases.bringup import way_to
from ecatspec.generators.cases.play import play
from ecatspec.model.esc.data_link import LinkedSubDevice, linked
from ecatspec.model.esc.wire import COMMANDS, Datagram, Wire, wire_format
from ecatspec.spec.language.load import device_names, load_device, load_link

if TYPE_CHECKING:
    from collections.abc import Iterator

    from wires import Cable

SOURCE = bytes.fromhex("001122334455")
AL_STATUS = 0x130
CLIENT = """
import socket, struct, sys
# a BRD of AL Status, with a VLAN tag if there is one, and what Linux says of the tag of the answer
tag = bytes.fromhex(sys.argv[2])
s = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(3))
s.bind((sys.argv[1], 3))
s.setsockopt(263, 8, 1)
s.settimeout(60)
datagram = bytes([7, 1]) + struct.pack("<HHHH", 0, 0x130, 2, 0) + bytes(4)
body = struct.pack("<H", len(datagram) | 0x1000) + datagram
s.send(b"\\xff" * 6 + bytes.fromhex("001122334455") + tag + b"\\x88\\xa4" + body.ljust(46, b"\\0"))
while True:
    frame, beside, _, _ = s.recvmsg(2048, 64)
    if frame[6] & 2 and frame[12:14] == b"\\x88\\xa4":
        break
status, *_, tci, kind = struct.unpack("3I4H", beside[0][2])
print(frame[16:30].hex(), status >> 4 & 1, tci if status >> 4 & 1 else 0)
"""


@pytest.fixture
def wire() -> Iterator[Cable]:
    with cable() as laid:
        yield laid


def asked(wire: Cable, tag: str = "") -> list[str]:
    """Give the answer to a BRD of AL Status, whether it has a VLAN tag, and the tag."""
    done = wire.run([sys.executable, "-c", CLIENT, NEAR, tag])
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_a_vlan_tag_comes_back(wire: Cable) -> None:
    with wire.simulated("reference"):
        plain, has_tag, _ = asked(wire)
        assert has_tag == "0"
        assert plain.endswith("01000100"), "INIT, working counter 1"
        assert asked(wire, "81006005") == [plain, "1", str(0x6005)]


def test_an_interface_that_went_down_is_waited_for(wire: Cable) -> None:
    with wire.simulated("reference") as running:
        before = asked(wire)
        for state in ("down", "up"):
            assert wire.run(["ip", "link", "set", FAR, state]).returncode == 0
        assert asked(wire) == before
        assert running.poll() is None


# --- frames that no MainDevice sends --------------------------------------------------------------


def segment_of(device: str) -> list[LinkedSubDevice]:
    """Three SubDevices, the first in PREOP: its mailbox takes what comes."""
    protocol = linked(load_device(device), load_link())
    devices = [LinkedSubDevice(protocol, follower=number < 2) for number in range(3)]
    model = devices[0].device.model
    play(model, devices[0].device, way_to(model, "PREOP"))
    return devices


def noise(draw: random.Random, wire: Wire, places: list[tuple[int, int]]) -> bytearray:
    """A frame of one to three datagrams, some damaged, cut short or with a tag."""
    datagrams = []
    for _ in range(draw.randrange(1, 4)):
        address, size = draw.choice(places)
        address = draw.choice([address, address + draw.randrange(4), draw.randrange(1 << 16)])
        length = draw.choice([size, 0, 1, draw.randrange(600), 128])
        position = draw.choice([0, 0xFFFF, 0xFFFE, draw.randrange(1 << 16)])
        command = COMMANDS[draw.choice(list(COMMANDS))]
        data = draw.randbytes(length)
        counter = draw.choice([0, 0xFFFF])
        datagrams.append(Datagram(command, 7, position, address & 0xFFFF, data, counter))
    frame = bytearray(wire.frame(SOURCE, datagrams))
    if draw.random() < 0.2:
        frame[draw.randrange(len(frame))] = draw.randrange(256)
    if draw.random() < 0.1:
        del frame[draw.randrange(len(frame)) :]
    if draw.random() < 0.1:
        frame[12:12] = bytes.fromhex("81000005")
    return frame


@pytest.mark.parametrize("device", device_names())
def test_no_frame_ends_it_or_changes_its_length(device: str) -> None:
    draw, devices = random.Random(device), segment_of(device)
    model = devices[0].device.model
    wire, now = Wire(wire_format(model)), 0
    places = [(r.address, r.size) for r in model.protocol.registers.values()]
    places += [
        (model.parameter(area, "start"), model.parameter(area, "length"))
        for area in ("mailbox_out", "mailbox_in")
    ]
    for number in range(2000):
        if number % 500 == 0:  # a MainDevice begins again, whatever came before
            devices[0].reset()
            play(model, devices[0].device, way_to(model, "PREOP"))
            assert devices[0].al_state == "PREOP"
        frame = noise(draw, wire, places)
        length, before = len(frame), bytes(frame)
        now += draw.choice([0, 1, 100, 10_000, 1_000_000])
        for each in devices:
            each.advance(now)
        wire.pass_on(frame, [each.visit for each in devices])
        assert len(frame) == length, (number, before.hex())


def test_an_access_behind_the_memory_is_not_served() -> None:
    devices = segment_of("reference")
    wire = Wire(wire_format(devices[0].device.model))
    sent = [
        Datagram(COMMANDS["BRW"], 7, 0, 0xFFFE, b"\x11" * 8, 0),
        Datagram(COMMANDS["BRD"], 7, 0, AL_STATUS, bytes(2), 0),
    ]
    frame = bytearray(wire.frame(SOURCE, sent))
    assert wire.pass_on(frame, [each.visit for each in devices])
    payload = wire.payload(bytes(frame))
    assert payload is not None
    (behind, status), good = wire.datagrams(payload)
    assert good
    assert (behind.data, behind.working_counter) == (b"\x11" * 8, 0)
    assert status.working_counter == len(devices)
