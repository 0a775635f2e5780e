"""Serves one Python adapter over the line protocol, in a process of its own.

    python -m ecatspec.conformance.adapters.host NAME '{"device": "akd", "options": {}}'

Descriptor 1 is the protocol's alone: whatever the device prints goes to the error stream.  An
exception of the device is not caught to go on: it is the device's crash, with the traceback on
the error stream and exit status 70.  Only `AdapterError` is answered, for it is not the device's.
"""

from __future__ import annotations

import json
import os
import select
import signal
import sys
import threading
import time
import traceback
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.adapters import factory
from ecatspec.conformance.adapters.signal_stack import tell_the_stack
from ecatspec.conformance.base.adapter import AdapterError, advance_until, raise_local

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from ecatspec.conformance.base.adapter import Adapter, Reading

CRASHED: Final = 70
USAGE: Final = 2
_CHUNK: Final = 1 << 16
_GRACE: Final = 1.0
"""Seconds after the last request that a device may take to end."""


def main(arguments: list[str] | None = None) -> int:
    """Serve the adapter named on the command line until the requests end."""
    match sys.argv[1:] if arguments is None else arguments:
        case [name]:
            text = "{}"
        case [name, text]:
            pass
        case _:
            print(
                "usage: python -m ecatspec.conformance.adapters.host NAME [JSON]", file=sys.stderr
            )
            return USAGE
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    requests, replies = _private_descriptors()
    threading.Thread(target=_end_with_the_run, args=(requests,), daemon=True).start()
    if name == "lib":
        tell_the_stack()
    try:
        serve = _server(name, text, lambda: _write(replies, b" "))
    except AdapterError as error:
        serve = _refusal(str(error))
    except Exception as error:  # noqa: BLE001  nothing of the device has run yet: set-up trouble
        serve = _refusal(f"cannot set up {name!r}: {_told(error)}")
    try:
        for line in _lines(requests):
            _write(replies, serve(json.loads(line)).encode("utf-8") + b"\n")
    except BaseException:  # noqa: BLE001  the device's exception: say it and die of it
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(CRASHED)  # a thread of the device must not keep the process alive
    sys.stderr.flush()
    os._exit(0)


def _private_descriptors() -> tuple[int, int]:
    """Keep the two pipes for the protocol; 0 becomes empty and 1 becomes the error stream."""
    requests, replies = os.dup(0), os.dup(1)
    empty = os.open(os.devnull, os.O_RDONLY)
    os.dup2(empty, 0)
    os.close(empty)
    os.dup2(2, 1)
    return requests, replies


def _end_with_the_run(requests: int) -> None:
    """End a device that does not come back from a call, once nobody is there to wait for it."""
    gone = select.poll()
    gone.register(requests, 0)
    gone.poll()
    time.sleep(_GRACE)
    os._exit(CRASHED)


def _server(name: str, text: str, mark: Callable[[], None]) -> Callable[[dict[str, object]], str]:
    arguments = json.loads(text)
    adapter = factory(name)(arguments.get("device", ""), arguments.get("options", {}))

    def serve(request: dict[str, object]) -> str:
        try:
            return _perform(adapter, request, mark)
        except AdapterError as error:
            return json.dumps({"ok": False, "error": str(error)})

    return serve


def _told(error: Exception) -> str:
    """Say what was wrong; only what is not the user's doing needs a traceback."""
    from ecatspec.conformance.base.devices import UserError

    if isinstance(error, UserError):
        return str(error)
    traceback.print_exception(error)
    return f"{type(error).__name__}: {error}"


def _refusal(reason: str) -> Callable[[dict[str, object]], str]:
    reply = json.dumps({"ok": False, "error": reason})
    return lambda _: reply


def _perform(adapter: Adapter, request: dict[str, object], mark: Callable[[], None]) -> str:
    match request:
        case {"op": "read", "address": int(address), "length": int(length)}:
            return _read(adapter.read(address, length))
        case {"op": "write", "address": int(address), "data": str(text)}:
            return f'{{"ok":true,"wkc":{adapter.write(address, bytes.fromhex(text)):d}}}'
        case {"op": "advance", "seconds": float(seconds) | int(seconds)}:
            adapter.advance(seconds)
        case {"op": "local", "event": str(event)}:
            raise_local(adapter, event)
        case {"op": "reset"}:
            adapter.reset()
        case {"op": "close"}:
            adapter.close()
        case {"op": "describe"}:
            described = {**adapter.describe().to_json(), "batch": True, "advance_until": True}
            return json.dumps({"ok": True, "description": described})
        case {"op": "batch", "calls": list(calls)}:
            results = ",".join(_perform(adapter, call, mark) for call in calls)
            return f'{{"ok":true,"results":[{results}]}}'
        case {"op": "advance_until", "steps": list(steps), "seen": list(shown)}:
            seen = {
                (each["address"], each["length"]): (each["wkc"], bytes.fromhex(each["data"]))
                for each in shown
            }
            passed, found = advance_until(adapter, steps, seen, mark)
            results = ",".join(map(_read, found))
            return f'{{"ok":true,"passed":{passed:d},"results":[{results}]}}'
        case _:
            message = f"no such request: {request!r}"
            raise AdapterError(message)
    return '{"ok":true}'


def _read(reading: Reading) -> str:
    working_counter, data = reading
    return f'{{"ok":true,"wkc":{working_counter:d},"data":"{data.hex()}"}}'


def _lines(descriptor: int) -> Iterator[bytes]:
    rest = b""
    while chunk := os.read(descriptor, _CHUNK):
        *lines, rest = (rest + chunk).split(b"\n")
        yield from lines


def _write(descriptor: int, data: bytes) -> None:
    while data:
        data = data[os.write(descriptor, data) :]


if __name__ == "__main__":
    sys.exit(main())
