"""The table of adapters: the ways to reach a device, and their names.

    model                    the virtual SubDevice of the texts
    canopen                  the SDO server of the package canopen behind the virtual mailbox
    lib:PATH                 a shared library with the tables of ecatspec_dut.h
    exec:COMMAND ARGUMENTS   any program that speaks the line protocol of `lines`
    tcp:HOST:PORT            the same lines over a socket
    unix:PATH                the same lines over a Unix socket
    eth:IFACE                a SubDevice on a network interface

A Python adapter is a file here with `make(device, options) -> Adapter`, a row in FACTORIES and
a row in ADAPTERS; it runs in a process of its own, but for `model`, which is ours and cannot harm
a run.  Options follow a colon: `model:key=value`.  Other packages bring adapters by entry points.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import json
import shlex
import sys
from dataclasses import dataclass
from functools import cache, partial
from importlib.metadata import entry_points
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, cast

from ecatspec.conformance.adapters.in_process import GuardedSnapshots
from ecatspec.conformance.adapters.process import ProcessAdapter
from ecatspec.conformance.adapters.shared_library import environment, library_file
from ecatspec.conformance.adapters.sockets import at_path, at_port
from ecatspec.conformance.base.adapter import AdapterError, DeviceFault

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from importlib.metadata import EntryPoint

    from ecatspec.conformance.base.adapter import Adapter, Restorable

    Factory = Callable[[str, Mapping[str, str]], Adapter]
    Opener = Callable[[str, str, float], Adapter]


GROUP: Final = "ecatspec.adapters"
"""The entry points of packages that bring adapters: `name = "module:make"`."""
HANG_TIMEOUT: Final = 10.0
"""Seconds without an answer after which a device counts as hung."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One way to reach devices: `open` takes what follows the colon, and the device's text."""

    summary: str
    example: str
    open: Opener
    resizable: bool = False
    """The mailbox is ours and takes the length that a run asks for."""


def open_adapter(
    spec: str, device: str, *, mailbox: str = "", hang_timeout: float = HANG_TIMEOUT
) -> Adapter:
    """Open the adapter that `spec` names for the device text `device`, and hear it answer.

    An adapter over our own virtual mailbox has areas of the length `mailbox`, if that is given.
    """
    name, _, rest = spec.partition(":")
    known = adapters()
    entry = known.get(name)
    if entry is None:
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        message = f"unknown adapter {name!r}; {hint}there are {', '.join(sorted(known))}"
        raise AdapterError(message)
    if mailbox and entry.resizable:
        rest = f"mailbox={mailbox},{rest}"
    adapter = entry.open(rest, device, hang_timeout)
    try:
        adapter.describe()
    except DeviceFault as fault:
        adapter.close()
        message = f"the adapter {spec!r} does not come up: {fault.reason}"
        raise AdapterError(message) from None
    except BaseException:
        adapter.close()
        raise
    return adapter


def adapters() -> Mapping[str, Entry]:
    """Give all adapters by name: those of this package, then those that other packages bring."""
    brought = {
        name: Entry(
            summary=f"an adapter of the package {point.dist.name if point.dist else point.module}",
            example=name,
            open=partial(_open_hosted, name),
        )
        for name, point in _brought().items()
    }
    return {**ADAPTERS, **brought}


def factory(name: str) -> Factory:
    """Give what makes a hosted adapter.

    Raises:
        AdapterError: There is none of this name, or the package that brings it cannot be loaded.

    """
    if own := FACTORIES.get(name):
        return own
    point = _brought().get(name)
    if point is None:
        message = f"no hosted adapter {name!r}; there are {', '.join([*FACTORIES, *_brought()])}"
        raise AdapterError(message)
    try:
        return cast("Factory", point.load())
    except Exception as error:  # noqa: BLE001  whatever the package of others raises
        what = f"the adapter {name!r} ({point.value}) cannot be loaded"
        message = f"{what}: {type(error).__name__}: {error}; update or remove its package"
        raise AdapterError(message) from None


@cache
def _brought() -> Mapping[str, EntryPoint]:
    points = entry_points(group=GROUP)
    return {point.name: point for point in points if point.name not in ADAPTERS}


def parse_options(text: str) -> dict[str, str]:
    """Read `key=value,key=value`; empty text has no options."""
    options: dict[str, str] = {}
    for part in filter(None, text.split(",")):
        key, equals, value = part.partition("=")
        if not key or not equals or key in options:
            message = f"cannot read the option {part!r}; write key=value,key=value, each key once"
            raise AdapterError(message)
        options[key] = value
    return options


def refuse_options(name: str, options: Mapping[str, str], *, known: Sequence[str]) -> None:
    """Refuse options that an adapter does not have."""
    for option in options:
        if option not in known:
            message = f"the adapter {name!r} has no option {option!r}; it takes {', '.join(known)}"
            raise AdapterError(message)


def _make(module: str, device: str, options: Mapping[str, str]) -> Adapter:
    factory = cast("Factory", importlib.import_module(f"{__name__}.{module}").make)
    return factory(device, options)


def _open_hosted(
    name: str, rest: str, device: str, hang_timeout: float, *, package: str | None = None
) -> Adapter:
    options = parse_options(rest)
    if package is not None and importlib.util.find_spec(package) is None:
        message = f'the adapter {name!r} needs a package: pip install "ecatspec[{package}]"'
        raise AdapterError(message)
    return ProcessAdapter(_host(name, device, options), hang_timeout=hang_timeout)


def _host(name: str, device: str, options: Mapping[str, str]) -> list[str]:
    arguments = json.dumps({"device": device, "options": options})
    # -P: a file of the user's folder must not stand in for a module.
    return [sys.executable, "-P", "-m", "ecatspec.conformance.adapters.host", name, arguments]


def _open_library(rest: str, device: str, hang_timeout: float) -> Adapter:
    path, _, further = rest.partition(",")
    options = parse_options(further)
    refuse_options("lib", options, known=("poll",))
    file = library_file(path)
    command = _host("lib", device, {"path": str(file), **options})
    return ProcessAdapter(command, hang_timeout=hang_timeout, env=environment(file))


def _open_socket(
    open_at: Callable[..., Adapter], rest: str, _device: str, hang_timeout: float
) -> Adapter:
    return open_at(rest, hang_timeout=hang_timeout)


def _open_model(rest: str, device: str, _hang_timeout: float) -> Adapter:
    return GuardedSnapshots(cast("Restorable", _open_here("model", device, parse_options(rest))))


def _open_here(name: str, device: str, options: Mapping[str, str]) -> Adapter:
    from ecatspec.conformance.base.devices import UserError

    try:
        return _make(name, device, options)
    except UserError as error:
        raise AdapterError(f"cannot set up {name!r}: {error}") from None


def _open_command(rest: str, _device: str, hang_timeout: float) -> Adapter:
    try:
        command = shlex.split(rest)
    except ValueError as error:
        message = f"cannot read the command {rest!r}: {error}"
        raise AdapterError(message) from None
    return ProcessAdapter(command, hang_timeout=hang_timeout)


def _open_wire(rest: str, device: str, _hang_timeout: float) -> Adapter:
    interface, _, options = rest.partition(",")
    return _open_here("eth", device, {"interface": interface, **parse_options(options)})


FACTORIES: Final[Mapping[str, Factory]] = MappingProxyType(
    {name: partial(_make, name) for name in ("model", "canopen", "lib")}
)

ADAPTERS: Final[Mapping[str, Entry]] = MappingProxyType(
    {
        "model": Entry(
            summary="the virtual SubDevice of the texts",
            example="model:fault=toggle_ignored",
            open=_open_model,
            resizable=True,
        ),
        "canopen": Entry(
            summary="the SDO server of the package canopen behind the virtual mailbox",
            example="canopen",
            open=partial(_open_hosted, "canopen", package="canopen"),
            resizable=True,
        ),
        "lib": Entry(
            summary="a shared library with the tables of ecatspec_dut.h",
            example="lib:./libdut.so",
            open=_open_library,
        ),
        "exec": Entry(
            summary="a program that speaks the line protocol",
            example="exec:./my_stack --port 0",
            open=_open_command,
        ),
        "tcp": Entry(
            summary="a program that speaks the line protocol at the other end of a socket",
            example="tcp:localhost:5000",
            open=partial(_open_socket, at_port),
        ),
        "unix": Entry(
            summary="a program that speaks the line protocol at a Unix socket",
            example="unix:/tmp/slave.sock",
            open=partial(_open_socket, at_path),
        ),
        "eth": Entry(
            summary="a SubDevice on a network interface",
            example="eth:eth1,position=0",
            open=_open_wire,
        ),
    }
)
