"""Opens a network interface for EtherCAT frames, and words what may go wrong there."""

from __future__ import annotations

import socket
import struct
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.base.adapter import AdapterError

if TYPE_CHECKING:
    from typing import NoReturn

LARGEST_FRAME: Final = 2048
"""Room for any frame, one with a VLAN tag too."""
_SOL_PACKET: Final = 263
_ADD_MEMBERSHIP: Final = 1
_PROMISCUOUS: Final = 1
"""Numbers of Linux for which Python has no names."""
_MEMBERSHIP: Final = "iHH8s"
"""How Linux is asked for frames to any address: interface, kind, length of an address, address."""


def open_interface(name: str, ethertype: int) -> socket.socket:
    """Give a socket for frames of that type on an interface, whomever they are addressed to.

    Raises:
        AdapterError: There is no such interface, or no right to it.

    """
    if not hasattr(socket, "AF_PACKET"):
        raise AdapterError("raw frames need Linux (AF_PACKET); run it there")
    names = [known for _, known in socket.if_nameindex()]
    if name not in names:
        message = f"there is no interface {name!r}; there are {', '.join(sorted(names))}"
        raise AdapterError(message)
    try:
        opened = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ethertype))
    except PermissionError:
        message = (
            f"raw frames on {name!r} need the right CAP_NET_RAW; run it as root, or give the right "
            "to the Python that runs it (setcap cap_net_raw+ep)"
        )
        raise AdapterError(message) from None
    try:
        opened.bind((name, ethertype))
        number = socket.if_nametoindex(name)
        wanted = struct.pack(_MEMBERSHIP, number, _PROMISCUOUS, 0, b"")
        opened.setsockopt(_SOL_PACKET, _ADD_MEMBERSHIP, wanted)
    except OSError as error:
        opened.close()
        failed(name, error)
    return opened


def failed(name: str, error: OSError) -> NoReturn:
    """Say what became of an interface."""
    why = error.strerror or type(error).__name__
    message = f"the interface {name!r} does not work ({why}); set it up (ip link set {name} up)"
    raise AdapterError(message) from None
