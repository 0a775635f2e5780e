"""Writes the C stack of a shared library's host when a signal ends it.

The handler is a Python function. That is sound here, though not in general: a library is called
without the lock of the interpreter, so the handler can take it. Whatever goes wrong in it, the
process ends all the same, and by the signal that came: the handler is removed as soon as it is
called, so a second error ends the process; a timer bounds it; and it sends the signal again last.
It has no stack of its own, since Python checks where its stack is: where the stack overflowed, the
process ends at once, without a word.
"""

from __future__ import annotations

import ctypes
import os
import platform
import signal
import sys
from typing import Final, NamedTuple

from ecatspec.conformance.adapters.crash_stack import HEAD

SIGNALS: Final = (
    signal.SIGSEGV,
    signal.SIGBUS,
    signal.SIGFPE,
    signal.SIGILL,
    signal.SIGABRT,
)


class _Registers(NamedTuple):
    """Where the C library of Linux keeps registers in the context that a handler gets."""

    program_counter: int
    caller: int
    """The place to return to, or the stack pointer: then it is on top of the stack."""
    on_stack: bool


_REGISTERS: Final = {
    "x86_64": _Registers(168, 160, on_stack=True),
    "aarch64": _Registers(440, 424, on_stack=False),
}
_SA_SIGINFO: Final = 4
_SA_NODEFER: Final = 1 << 30
_SA_RESETHAND: Final = 1 << 31
_DEPTH: Final = 128
"""Frames at most; the way into the handler takes some twenty."""
_LIMIT: Final = 2
"""Seconds for the whole of it."""

_kept: Final[list[object]] = []
"""The handler, which has to live as long as the process."""

_Handler = ctypes.CFUNCTYPE(None, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)


class _Action(ctypes.Structure):
    """The structure `sigaction` of <signal.h>, as on the machines of `_REGISTERS`."""

    _fields_ = (
        ("handler", _Handler),
        ("mask", ctypes.c_uint64 * 16),
        ("flags", ctypes.c_uint32),
        ("restorer", ctypes.c_void_p),
    )


class _Place(ctypes.Structure):
    """The structure `Dl_info` of <dlfcn.h>."""

    _fields_ = (
        ("file", ctypes.c_char_p),
        ("base", ctypes.c_void_p),
        ("symbol", ctypes.c_char_p),
        ("symbol_address", ctypes.c_void_p),
    )


def tell_the_stack() -> None:
    """Write the C stack to the error stream at a signal that ends the process, where that works.

    A signal that has a handler already, of a sanitizer, keeps it.
    """
    registers = _REGISTERS.get(platform.machine())
    c = ctypes.CDLL(None)
    if sys.platform != "linux" or registers is None or not hasattr(c, "backtrace"):
        return
    frames = (ctypes.c_size_t * _DEPTH)()
    place = _Place()
    names = {number: f"\n{HEAD}{number.name}\n".encode() for number in SIGNALS}
    c.dladdr.argtypes = (ctypes.c_void_p, ctypes.POINTER(_Place))

    def tell(number: int, _info: int, context: int) -> None:
        try:
            signal.alarm(_LIMIT)
            os.write(2, names[signal.Signals(number)])
            last = _word(context + registers.program_counter)
            found = frames[: c.backtrace(frames, _DEPTH)]
            if last in found:
                found = found[found.index(last) :]
            else:  # a call to where there is no code, such as a null pointer
                caller = _word(context + registers.caller)
                found = [last, _word(caller) if registers.on_stack else caller]
            for depth, address in enumerate(found):
                # but for the first these are places to return to, one behind the call
                called = address - (depth > 0)
                if c.dladdr(called, place) and place.file:
                    symbol = b"in %s " % place.symbol if place.symbol else b""
                    at = (depth, called, symbol, place.file, called - place.base)
                    os.write(2, b"    #%d 0x%x %s(%s+0x%x)\n" % at)
        finally:
            signal.raise_signal(number)

    c.backtrace(frames, _DEPTH)  # the first call loads the unwinder, which needs memory
    handler = _Handler(tell)
    _kept.append(handler)
    action = _Action(handler, flags=_SA_SIGINFO | _SA_NODEFER | _SA_RESETHAND)
    for number in SIGNALS:
        if signal.getsignal(number) is signal.SIG_DFL:
            c.sigaction(int(number), ctypes.byref(action), None)


def _word(address: int) -> int:
    return ctypes.c_size_t.from_address(address).value
