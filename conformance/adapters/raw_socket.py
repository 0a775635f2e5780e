"""Opens a network interface for EtherCAT frames, and words what may go wrong there."""

from __future__ import annotations

import os
import socket
import struct
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.base.adapter import AdapterError

if TYPE_CHECKING:
    from typing import NoReturn

    from ecatspec.model.esc.wire import WireFormat

LARGEST_FRAME: Final = 2048
"""Room for any frame, one with a VLAN tag too."""
_SOL_PACKET: Final = 263
_ADD_MEMBERSHIP: Final = 1
_PROMISCUOUS: Final = 1
_AUXDATA: Final = 8
_IGNORE_OUTGOING: Final = 23
_EVERY_TYPE: Final = 3
_VLAN_VALID, _VLAN_TYPE_VALID = 1 << 4, 1 << 6
"""Numbers of Linux for which Python has no names."""
_MEMBERSHIP: Final = "iHH8s"
"""How Linux is asked for frames to any address: interface, kind, length of an address, address."""
_ABOUT_A_FRAME: Final = struct.Struct("3I4H")
"""What Linux says beside a frame: status, two lengths, two offsets, VLAN tag, its type."""


def open_interface(name: str, ethertype: int, *, tags: bool = False) -> socket.socket:
    """Give a socket for frames of that type on an interface, whomever they are addressed to.

    With `tags` it is one for frames of all types: Linux shows VLAN tags to no other.

    Raises:
        AdapterError: There is no such interface, or no right to it.

    """
    if not hasattr(socket, "AF_PACKET"):
        raise AdapterError("raw frames need Linux (AF_PACKET); run it there")
    names = [known for _, known in socket.if_nameindex()]
    if name not in names:
        message = f"there is no interface {name!r}; there are {', '.join(sorted(names))}"
        raise AdapterError(message)
    wanted_type = _EVERY_TYPE if tags else ethertype
    try:
        opened = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(wanted_type))
    except PermissionError:
        message = (
            f"raw frames on {name!r} need the right CAP_NET_RAW; run it as root, or give the right "
            "to the Python that runs it (setcap cap_net_raw+ep)"
        )
        raise AdapterError(message) from None
    try:
        opened.bind((name, wanted_type))
        if number := opened.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            raise OSError(number, os.strerror(number))  # noqa: TRY301 - worded below like others
        number = socket.if_nametoindex(name)
        wanted = struct.pack(_MEMBERSHIP, number, _PROMISCUOUS, 0, b"")
        opened.setsockopt(_SOL_PACKET, _ADD_MEMBERSHIP, wanted)
        if tags:
            opened.setsockopt(_SOL_PACKET, _IGNORE_OUTGOING, 1)
            opened.setsockopt(_SOL_PACKET, _AUXDATA, 1)
    except OSError as error:
        opened.close()
        failed(name, error)
    return opened


class FrameReader:
    """Takes frames from a socket of `open_interface` with `tags`, as they were on the cable.

    Linux takes a VLAN tag out of a frame and gives it beside the frame.
    """

    def __init__(self, opened: socket.socket, wire: WireFormat) -> None:
        """Take an open socket, and where a tag has its place in a frame."""
        self._socket = opened
        self._buffer = bytearray(LARGEST_FRAME)
        self._place = wire.source_mac_offset + wire.source_mac_size
        self._tag_type = wire.vlan_ethertype
        self._room = socket.CMSG_SPACE(_ABOUT_A_FRAME.size)

    def __call__(self) -> bytearray:
        """Wait for a frame.

        Raises:
            OSError: The interface gives none; ENETDOWN where it was switched off.

        """
        length, beside, _, _ = self._socket.recvmsg_into([self._buffer], self._room)
        frame = self._buffer[:length]
        for _, _, data in beside:
            status, *_, tag, kind = _ABOUT_A_FRAME.unpack(data)
            if status & _VLAN_VALID:
                named = kind if status & _VLAN_TYPE_VALID else self._tag_type
                frame[self._place : self._place] = struct.pack("!HH", named, tag)
        return frame


def failed(name: str, error: OSError) -> NoReturn:
    """Say what became of an interface."""
    why = error.strerror or type(error).__name__
    message = f"the interface {name!r} does not work ({why}); set it up (ip link set {name} up)"
    raise AdapterError(message) from None
