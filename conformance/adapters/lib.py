"""Tests a device in a shared library, through the tables of ecatspec_dut.h.

It runs in the process of the host, so that whatever the library does to it is a verdict. What it
does wrong without dying of it (a byte too many, an access beyond the memory of the ESC) ends the
process too.
"""

from __future__ import annotations

import ctypes
from ctypes import (
    CFUNCTYPE,
    POINTER,
    c_char_p,
    c_int,
    c_size_t,
    c_uint16,
    c_uint32,
    c_uint64,
    c_void_p,
)
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.base.adapter import (
    ADDRESS_SPACE,
    AdapterError,
    Description,
    check_duration,
    check_span,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from ecatspec.conformance.base.adapter import Adapter
    from ecatspec.model.esc.esc import Esc
    from ecatspec.spec.language.ir import Protocol

ABI: Final = 1
"""The version of ecatspec_dut.h that is spoken here."""
ENTRY: Final = "ecatspec_dut"
CHIP_ABI: Final = 1
"""The version of ecatspec_chip.h that is spoken here."""
CHIP_ENTRY: Final = "ecatspec_chip"
_REBUILD: Final = "build it with the header in the folder of `ecatspec adapters --include`"
_SECOND: Final = 1_000_000
_TOO_LONG: Final = 1 << 32
"""Microseconds that `poll` cannot tell."""
_GUARD: Final = b"\xa5\x5a\xc3\x3c\x96\x69\xf0\x0f"
"""What lies behind a buffer, to see whether a device writes beyond it."""

_READ = CFUNCTYPE(c_int, c_void_p, c_uint16, c_void_p, c_size_t)
_WRITE = CFUNCTYPE(c_int, c_void_p, c_uint16, c_char_p, c_size_t)
_LOCAL = CFUNCTYPE(c_int, c_void_p, c_char_p)
_CREATE = CFUNCTYPE(c_void_p)
_CALL = CFUNCTYPE(None, c_void_p)
_PDI_READ = CFUNCTYPE(None, c_void_p, c_uint16, c_void_p, c_size_t)
_AL_EVENT = CFUNCTYPE(c_uint32, c_void_p)


class _Device(ctypes.Structure):
    _fields_ = (
        ("create", _CREATE),
        ("destroy", _CALL),
        ("reset", _CALL),
        ("read", _READ),
        ("write", _WRITE),
        ("advance", CFUNCTYPE(None, c_void_p, c_uint64)),
        ("local", _LOCAL),
    )


class _Esc(ctypes.Structure):
    _fields_ = (
        ("context", c_void_p),
        ("pdi_read", _PDI_READ),
        ("pdi_write", _PDI_READ),
        ("al_event", _AL_EVENT),
    )


class _Stack(ctypes.Structure):
    _fields_ = (
        ("create", CFUNCTYPE(c_void_p, POINTER(_Esc))),
        ("destroy", _CALL),
        ("init", _CALL),
        ("poll", CFUNCTYPE(None, c_void_p, c_uint32)),
        ("local", _LOCAL),
    )


class _Span(ctypes.Structure):
    _fields_ = (("address", c_uint16), ("size", c_uint16))


class _Settings(ctypes.Structure):
    _fields_ = (
        ("memory_size", c_uint32),
        ("registers_end", c_uint32),
        ("poll", c_uint32),
        ("writable_registers", c_uint32),
        ("reset", c_char_p),
        ("writable", POINTER(_Span)),
    )


class _Chip(ctypes.Structure):
    _fields_ = (
        ("abi", c_uint32),
        ("numbers", c_uint32),
        ("create", CFUNCTYPE(c_void_p, POINTER(_Stack), POINTER(_Settings))),
        ("device", _Device),
    )


class _Dut(ctypes.Structure):
    _fields_ = (
        ("abi", c_uint32),
        ("name", c_char_p),
        ("protocols", c_char_p),
        ("locals", c_char_p),
        ("limits", c_char_p),
        ("without", c_char_p),
        ("notes", c_char_p),
        ("open_dictionary", c_int),
        ("device", POINTER(_Device)),
        ("stack", POINTER(_Stack)),
    )


def make(device: str, options: Mapping[str, str]) -> Adapter:
    """Load the library at the path of the options, with one instance of what it holds."""
    dut, chip = _load(options["path"])
    protocol: Protocol | None = None
    if dut.stack or dut.protocols is None:
        from ecatspec.conformance.base.devices import load

        protocol = load(device)
    description = _description(dut, protocol)
    if not dut.stack:
        if "poll" in options:
            raise AdapterError("the library is a whole device and is not polled; leave out poll=")
        functions = dut.device.contents
        return WholeDevice(functions, _created(functions.create()), description)
    assert protocol is not None
    from ecatspec.model.esc.data_link import linked
    from ecatspec.model.esc.stack_harness import POLL
    from ecatspec.spec.language.load import load_link

    poll = options.get("poll")
    microseconds = POLL if poll is None else _microseconds(poll)
    # a stack looks at more of the chip than a suite judges
    protocol = linked(protocol, load_link())
    if chip is None:
        return BareStack(dut.stack.contents, description, protocol, microseconds)
    created = _with_chip(chip, dut.stack, protocol, microseconds)
    return WholeDevice(chip.device, created, description)


def _load(path: str) -> tuple[_Dut, _Chip | None]:
    try:
        library = ctypes.CDLL(path)
    except OSError as error:
        raise AdapterError(f"cannot load the library: {error}") from None
    address = _table(path, library, ENTRY, ABI)
    if address is None:
        message = f"{path} does not export {ENTRY}(); see ecatspec_dut.h"
        raise AdapterError(message)
    dut = _Dut.from_address(address)
    if bool(dut.device) == bool(dut.stack):
        message = f"{path} has {'both' if dut.device else 'none'} of `device` and `stack`; fill one"
        raise AdapterError(message)
    part, table = ("device", dut.device) if dut.device else ("stack", dut.stack)
    for name, _ in table.contents._fields_:
        needed = name != "local" or dut.locals
        if needed and not getattr(table.contents, name):
            raise AdapterError(f"{path} has no `{name}` in its table `{part}`; fill it in")
    at = _table(path, library, CHIP_ENTRY, CHIP_ABI)
    return dut, None if at is None else _Chip.from_address(at)


def _table(path: str, library: ctypes.CDLL, name: str, abi: int) -> int | None:
    """Give the address of the table that a function gives; None: it is not there."""
    entry = getattr(library, name, None)
    if entry is None:
        return None
    entry.restype = c_void_p
    address: int | None = entry()
    if not address:
        raise AdapterError(f"{name}() of {path} gives a null pointer; see {name}.h")
    version = c_uint32.from_address(address).value
    if version != abi:
        message = f"{path} was built with version {version} of {name}.h, this ecatspec speaks {abi}"
        raise AdapterError(f"{message}; {_REBUILD}")
    return address


def _with_chip(chip: _Chip, stack: object, protocol: Protocol, poll: int) -> int:
    """Create the chip that the library brings, with the stack above it."""
    from ecatspec.conformance.adapters.chip_header import checksum
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.esc.esc import Esc
    from ecatspec.spec.language.ir import Access

    model = Model(protocol)
    if chip.numbers != checksum(model):
        message = f"ecatspec_chip.h in the library has other registers than {protocol.name!r}"
        raise AdapterError(f"{message}; {_REBUILD}, or without it")
    esc = Esc(model)
    reset = esc.registers()
    written = [r for r in protocol.registers.values() if r.main is Access.BOTH]
    spans = [_Span(register.address, register.size) for register in written]
    writable = (_Span * len(spans))(*spans)
    settings = _Settings(esc.size, len(reset), poll, len(spans), reset, writable)
    return _created(chip.create(stack, ctypes.byref(settings)))


def _description(dut: _Dut, protocol: Protocol | None) -> Description:
    def text(name: str) -> str:
        given: bytes | None = getattr(dut, name)
        return "" if given is None else given.decode("utf-8", errors="replace")

    protocols = set(text("protocols").split())
    if dut.protocols is None and protocol is not None:
        protocols = set(protocol.machines)
    limits: dict[str, object] = {}
    for word in text("limits").split():
        name, _, number = word.partition("=")
        limits[name] = int(number) if number.isascii() and number.isdigit() else number
    try:
        return Description.from_json(
            {
                "name": text("name") or "a device without a name",
                "protocols": sorted(protocols),
                "virtual_time": True,
                "closed_dictionary": not dut.open_dictionary,
                "notes": text("notes").splitlines(),
                "limits": limits,
                "without": text("without").split(),
                "locals": text("locals").split(),
            }
        )
    except ValueError as error:
        raise AdapterError(f"the table of the library is wrong: {error}") from None


class _Overrun(Exception):  # noqa: N818
    """The library went beyond what it was given."""


class WholeDevice:
    """The library is the SubDevice: on level A, and where it brings the chip of its stack."""

    def __init__(self, functions: _Device, created: int, description: Description) -> None:
        self._functions = functions
        self._description = description
        self._device: int | None = created
        self._buffer = ctypes.create_string_buffer(ADDRESS_SPACE + len(_GUARD))
        self._address = ctypes.addressof(self._buffer)
        self._view = memoryview(self._buffer).cast("B")
        # looked up once: these are the calls that a run is made of
        self._read, self._write = functions.read, functions.write
        functions.reset(self._device)

    def reset(self) -> None:
        """Power cycle."""
        self._functions.reset(self._device)

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Read as the MainDevice."""
        check_span(address, length)
        view, behind = self._view, length + len(_GUARD)
        view[length:behind] = _GUARD
        counter = self._read(self._device, address, self._address, length)
        if view[length:behind].tobytes() != _GUARD:
            raise _Overrun(f"a read of {length} bytes at {address:#06x} wrote more than that")
        return counter, view[:length].tobytes() if counter else bytes(length)

    def write(self, address: int, data: bytes) -> int:
        """Write as the MainDevice."""
        check_span(address, len(data))
        counter: int = self._write(self._device, address, data, len(data))
        return counter

    def advance(self, seconds: float) -> None:
        """Let time pass."""
        check_duration(seconds)
        self._functions.advance(self._device, round(seconds * _SECOND))

    def local(self, event: str) -> None:
        """Raise a local event in the device."""
        _happen(self._functions.local, self._device, event)

    def close(self) -> None:
        """Destroy the device."""
        device, self._device = self._device, None
        if device is not None:
            self._functions.destroy(device)

    def describe(self) -> Description:
        """What the table of the library says."""
        return self._description


class BareStack:
    """Level B: the library is the stack, the ESC is ours, with the texts of the link."""

    def __init__(
        self, functions: _Stack, description: Description, protocol: Protocol, poll: int
    ) -> None:
        from ecatspec.model.esc.stack_harness import BareSubDevice

        self._functions = functions
        self._description = description
        self._fault: Exception | None = None
        self._hooks = _Esc(
            None,
            _PDI_READ(self._guarded(self._pdi_read)),
            _PDI_READ(self._guarded(self._pdi_write)),
            _AL_EVENT(lambda _: self._esc.al_event()),
        )
        self._bare = BareSubDevice(protocol, self, poll)
        self._stack: int | None = _created(functions.create(ctypes.byref(self._hooks)))
        self._poll = functions.poll
        self.reset()

    @property
    def _esc(self) -> Esc:
        return self._bare.esc

    # --- what the ESC wants of the stack ----------------------------------------------------------

    def init(self) -> None:
        """Power on."""
        self._functions.init(self._stack)
        self._check()

    def poll(self, microseconds: int) -> None:
        """Go once round the main loop."""
        self._poll(self._stack, microseconds)
        self._check()

    # --- what the stack wants of the ESC ----------------------------------------------------------

    def _guarded(
        self, hook: Callable[[int, int, int], None]
    ) -> Callable[[object, int, int, int], None]:
        """Keep what goes wrong in a hook: ctypes would print it and go on."""

        def call(_context: object, address: int, data: int, length: int) -> None:
            try:
                self._within(address, length)
                hook(address, data, length)
            except Exception as error:  # noqa: BLE001  raised again behind the stack
                self._fault = self._fault or error

        return call

    def _within(self, address: int, length: int) -> None:
        if not 0 <= length <= self._esc.size - address:
            raise _Overrun(f"{length} bytes at {address:#06x} are not in the memory of the ESC")

    def _pdi_read(self, address: int, data: int, length: int) -> None:
        ctypes.memmove(data, self._esc.pdi_read(address, length), length)

    def _pdi_write(self, address: int, data: int, length: int) -> None:
        self._esc.pdi_write(address, ctypes.string_at(data, length))

    def _check(self) -> None:
        if self._fault is not None:
            raise self._fault

    # --- the adapter ------------------------------------------------------------------------------

    def reset(self) -> None:
        """Power cycle."""
        self._bare.reset()

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Read as the MainDevice."""
        check_span(address, length)
        return self._bare.read(address, length)

    def write(self, address: int, data: bytes) -> int:
        """Write as the MainDevice."""
        check_span(address, len(data))
        return self._bare.write(address, data)

    def advance(self, seconds: float) -> None:
        """Let time pass."""
        check_duration(seconds)
        self._bare.advance(seconds)

    def local(self, event: str) -> None:
        """Raise a local event in the device."""
        _happen(self._functions.local, self._stack, event)
        self.poll(0)

    def close(self) -> None:
        """Destroy the stack."""
        stack, self._stack = self._stack, None
        if stack is not None:
            self._functions.destroy(stack)

    def describe(self) -> Description:
        """What the table of the library says."""
        return self._description


def _created(instance: int | None) -> int:
    if not instance:
        raise AdapterError("`create` of the library gives a null pointer")
    return instance


def _happen(local: Callable[[int | None, bytes], int], instance: int | None, event: str) -> None:
    if local(instance, event.encode()):
        raise AdapterError(f"the library does not know the event {event!r} that it lists")


def _microseconds(text: str) -> int:
    try:
        microseconds = round(float(text) * _SECOND)
    except (ValueError, OverflowError):
        microseconds = 0
    if not 1 <= microseconds < _TOO_LONG:
        raise AdapterError(f"poll={text} is no time between polls; give seconds, e.g. poll=0.001")
    return microseconds
