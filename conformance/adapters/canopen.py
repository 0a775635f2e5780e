"""Tests the SDO server of the package canopen, as level A.

Level B: the virtual SubDevice carries the mailbox, the package answers the SDO requests.  What
is decided here, and why, so that a finding is the package's own:

- The request goes to `Network.notify`, the package's documented entry for a received frame, and
  the answers are what the package gives to `Network.send_message`, the method it documents to be
  overridden.  No method of the server is called or replaced.
- A CAN frame has eight bytes, so the package gets the first eight of a request.  What needs more
  is declared: `limits` says how a download has to be cut, `without` what does not get through.
- A node number is needed; it appears only in frame identifiers, which the mailbox does not have.
- No exception is caught: it ends the process and is a crash.  On a real bus, the package's own
  listener logs such an exception and sends nothing, so the MainDevice would see silence.
- An index that has subindex 0 alone is an ODVariable, every other an ODRecord.  Never an ODArray:
  that class answers for subindexes that nobody declared, and the texts do not say "array".
- An integer has the package's type of its width, rounded up to whole bytes as on the wire, and a
  text its type for texts, which has no fixed length.
- Every entry has a value, its declared default or zero, as the bytes that the texts say: without
  a value the package refuses the upload.
- Access goes over unchanged.  Declared limits of value (min, max) do too, although the package
  never looks at them in a download.
- The package has no word for the greatest length of a text or byte string, nor for a right that
  depends on the AL state.  It leaves both to its application, which it asks by a write callback:
  the callback here refuses with the codes of the texts.
- The heartbeat that the package starts on a write to its heartbeat object has no bus to run on:
  it does nothing.
- A reset makes a new node: the package keeps what was written in the node.
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable
from itertools import groupby
from typing import TYPE_CHECKING, Any, Final, TypeAlias, assert_never

import canopen
from canopen.objectdictionary import ObjectDictionary, ODRecord, ODVariable, datatypes
from canopen.sdo.constants import REQUEST_BLOCK_UPLOAD

from ecatspec.conformance.adapters import refuse_options
from ecatspec.conformance.adapters.model import VirtualAdapter
from ecatspec.conformance.base.adapter import AdapterError, Description
from ecatspec.conformance.base.devices import load
from ecatspec.model.core.expressions import Environment
from ecatspec.model.core.object_dictionary import encode_value, size_of, size_varies
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.spec.language.ir import (
    Access,
    Area,
    Bool,
    Bytes,
    Named,
    SInt,
    Text,
    Time,
    UInt,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ecatspec.conformance.base.adapter import Adapter
    from ecatspec.model.core.values import ObjectKey
    from ecatspec.spec.language.ir import ObjectEntry, Protocol

Refusal: TypeAlias = Callable[["ObjectKey", bytes | None], str]
"""Give the row of the abort codes with which an application refuses a value, or nothing."""

_NODE: Final = 1
_FRAME: Final = 8
_COMMAND: Final = 5
"""The number of bits of the first byte below the command specifier."""
_BLOCK: Final = f"unknown_command_{REQUEST_BLOCK_UPLOAD >> _COMMAND}"
_NOTES: Final = (
    "limits: a normal download begins with its size alone, and a segment carries seven bytes",
    "without complete_access: the package does not know the bit",
    "without data_in_initiate: the first message of a normal download has no room for data",
    "without empty_download: on CAN a download of no bytes ends with an empty segment",
    "without mailbox_restart: nobody tells the package that the mailbox ended",
    "without malformed: a request is cut at eight bytes, so what is malformed does not arrive",
    "without oversized: what a request has beyond eight bytes does not arrive",
    f"without {_BLOCK}: a block upload on CAN, which a server may answer by a normal one",
    "an exception counts as a crash; on a bus the package's listener logs it and stays silent",
    "greatest lengths and rights by AL state are refused by the adapter, in a write callback",
)
_WITHOUT: Final = (
    "complete_access",
    "data_in_initiate",
    "empty_download",
    "mailbox_restart",
    "malformed",
    "oversized",
    _BLOCK,
)


def make(device: str, options: Mapping[str, str]) -> Adapter:
    """Return the package's SDO server with the objects of the text `device`."""
    refuse_options("canopen", options, known=("mailbox",))
    protocol = load(device, options.get("mailbox", ""))
    node = _Node(protocol)
    description = Description(
        name=f"canopen {importlib.metadata.version('canopen')} SdoServer, {protocol.name}",
        protocols=frozenset({"sdo"}),
        virtual_time=True,
        closed_dictionary=True,
        notes=_NOTES,
        limits={"initiate_data": 0, "segment_data": _FRAME - 1},
        without=_WITHOUT,
    )
    return VirtualAdapter(node.device, description, node.renew)


class SdoServer:
    """The package's local node on a bus that ends here: request in, answers out."""

    def __init__(self, protocol: Protocol, refusal: Refusal = lambda _key, _data: "") -> None:
        self._protocol, self._refusal = protocol, refusal
        self._network = _Network()
        node: Any = canopen.LocalNode(_NODE, object_dictionary(protocol))
        node.associate_network(self._network)
        node.add_read_callback(self._on_read)
        node.add_write_callback(self._on_write)
        self._identifier: int = node.sdo.rx_cobid

    def __call__(self, request: bytes) -> list[bytes]:
        """Return the frames that the package sends because of `request`."""
        self._network.sent = []
        self._network.notify(self._identifier, bytearray(request[:_FRAME]), 0.0)
        return self._network.sent

    def _on_read(self, *, od: ODVariable, **_: object) -> None:
        self._refuse((od.index, od.subindex), None)

    def _on_write(self, *, od: ODVariable, data: bytes, **_: object) -> None:
        self._refuse((od.index, od.subindex), data)

    def _refuse(self, key: ObjectKey, data: bytes | None) -> None:
        name = self._refusal(key, data)
        if name:
            rows = self._protocol.tables["sdo_abort_code"].rows
            raise canopen.SdoAbortedError(next(row.value for row in rows if row.name == name))


class _Network(canopen.Network):
    def __init__(self) -> None:
        super().__init__()
        self.sent: list[bytes] = []

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:  # noqa: ARG002, FBT001, FBT002  the package's own signature
        self.sent.append(bytes(data))

    def send_periodic(self, *_: object, **__: object) -> Any:  # noqa: ANN401
        return _Heartbeat()


class _Heartbeat:
    def stop(self) -> None:
        pass

    def update(self, data: object) -> None:
        pass


class _Node:
    """The server of this moment, and its application: a reset puts a new one in its place."""

    def __init__(self, protocol: Protocol) -> None:
        self._protocol = protocol
        self._most = {
            (entry.index, entry.subindex): size_of(entry)
            for entry in protocol.objects
            if size_varies(entry)
        }
        self.device = VirtualSubDevice(protocol, self.serve)
        self.renew()

    def renew(self) -> None:
        self._server = SdoServer(self._protocol, self._refusal)

    def serve(self, request: bytes) -> list[bytes]:
        return self._server(request)

    def _refusal(self, key: ObjectKey, data: bytes | None) -> str:
        """Tell why the application refuses a write of `data`, or a read; empty: it does not."""
        right = "readable_now" if data is None else "writable_now"
        holds = self.device.model.dictionary.functions[right]
        if not holds(Environment(self.device.state.slots, {}, {}), key):
            return "present_device_state"
        too_long = data is not None and len(data) > self._most.get(key, len(data))
        return "length_too_high" if too_long else ""


def object_dictionary(protocol: Protocol) -> ObjectDictionary:
    """Return the declared objects as the package's object dictionary."""
    dictionary = ObjectDictionary()
    entries = sorted(protocol.objects, key=lambda entry: (entry.index, entry.subindex))
    for index, group in groupby(entries, key=lambda entry: entry.index):
        members = [_variable(entry) for entry in group]
        if [member.subindex for member in members] == [0]:
            dictionary.add_object(members[0])
            continue
        record = ODRecord(f"{index:#06x}", index)
        for member in members:
            record.add_member(member)
        dictionary.add_object(record)
    return dictionary


def _variable(entry: ObjectEntry) -> ODVariable:
    # The place is part of the name: the package also looks objects up by name, once per name.
    name = f"{entry.name} {entry.index:#06x}:{entry.subindex:02x}"
    variable: Any = ODVariable(name, entry.index, entry.subindex)
    variable.data_type = _type(entry)
    variable.value = encode_value(entry, 0 if entry.default is None else entry.default)
    variable.min, variable.max = entry.low, entry.high
    variable.access_type = "const" if entry.constant else _ACCESS[entry.access]
    made: ODVariable = variable
    return made


_ACCESS: Final[Mapping[Access, str]] = {
    Access.NONE: "",
    Access.READ: "ro",
    Access.WRITE: "wo",
    Access.BOTH: "rw",
}
_UNSIGNED: Final[Mapping[int, int]] = {
    ODVariable.STRUCT_TYPES[number].size: number for number in datatypes.UNSIGNED_TYPES
}
_SIGNED: Final[Mapping[int, int]] = {
    ODVariable.STRUCT_TYPES[number].size: number for number in datatypes.SIGNED_TYPES
}


def _type(entry: ObjectEntry) -> int:
    kind = entry.type
    match kind:
        case UInt(width):
            return _integer(entry, _UNSIGNED, width)
        case SInt(width):
            return _integer(entry, _SIGNED, width)
        case Bool():
            return datatypes.BOOLEAN
        case Text():
            return datatypes.VISIBLE_STRING
        case Bytes():
            return datatypes.OCTET_STRING
        case Named() | Area() | Time():
            message = f"object {entry.index:#06x}:{entry.subindex:02x} has no type of an object"
            raise AdapterError(message)
        case _:
            assert_never(kind)


def _integer(entry: ObjectEntry, types: Mapping[int, int], width: int) -> int:
    size = -(-width // 8)
    if size not in types:
        message = (
            f"object {entry.index:#06x}:{entry.subindex:02x} has {width} bits; "
            f"canopen has integers of at most {8 * max(types)}"
        )
        raise AdapterError(message)
    return types[size]
