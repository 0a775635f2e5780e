"""Measures ways to a device: the same exchanges through each, and bare.

The device is examples/c_slave. The bare call is that of ctypes with declared types, into the
library in this process, and nothing else.
"""

from __future__ import annotations

import ctypes
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, cast

import psutil
from exchanges import Recorder, bound, check, perform, upload_cases
from measure import (
    ROOT,
    Absent,
    Effort,
    Figure,
    Found,
    Of,
    Part,
    Profile,
    Row,
    Table,
    Target,
    each,
    in_turns,
    number,
    profiled,
)

from ecatspec.conformance.adapters import lib, open_adapter
from ecatspec.conformance.adapters.model import make
from ecatspec.conformance.adapters.shared_library import HEADERS
from ecatspec.conformance.base.adapter import DeviceCrash
from ecatspec.conformance.base.devices import load
from ecatspec.conformance.run.session import Session
from ecatspec.model.core.compilation import Model
from ecatspec.model.oracle.oracle import Oracle

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from exchanges import Bound, Call

    from ecatspec.conformance.base.adapter import Adapter

SOURCES: Final = ROOT / "examples" / "c_slave"
TEXT: Final = str(SOURCES / "slave.ecs")
PYTHON_CHIP: Final = "python_chip"
"""The folder of the device above the chip in Python."""
LEVEL_A: Final = "`lib`, level A"
LEVEL_B: Final = "`lib`, level B"
FALLS: Final = r"""
#include <ecatspec_dut.h>
#include <signal.h>
#include <stdlib.h>
static void *create(void) { return malloc(1); }
static void reset(void *device) { (void)device; }
static int read_memory(void *device, uint16_t address, uint8_t *data, size_t length)
{ (void)device; (void)address; (void)data; (void)length; raise(SIGSEGV); return 0; }
static int write_memory(void *device, uint16_t address, const uint8_t *data, size_t length)
{ (void)device; (void)address; (void)data; (void)length; return 1; }
static void advance(void *device, uint64_t microseconds) { (void)device; (void)microseconds; }
const struct ecatspec_dut *ecatspec_dut(void)
{
    static const struct ecatspec_device device = {
        create, free, reset, read_memory, write_memory, advance, NULL
    };
    static const struct ecatspec_dut dut = {
        .abi = ECATSPEC_DUT_ABI, .name = "falls", .protocols = "al", .device = &device
    };
    return &dut;
}
"""


class Bare:
    """The calls of an adapter as ctypes makes them, without a check and without an answer."""

    def __init__(self, path: str) -> None:
        adapter = lib.make(TEXT, {"path": path})
        assert isinstance(adapter, lib.WholeDevice)
        self._adapter = adapter
        functions = adapter._functions  # noqa: SLF001  the point is to have nothing in between
        device = adapter._device  # noqa: SLF001
        self.reset = partial(functions.reset, device)
        self._read, self._write = functions.read, functions.write
        self._advance, self._device = functions.advance, device
        self._kept = ctypes.create_string_buffer(1 << 16)
        self._buffer = ctypes.addressof(self._kept)

    def of(self, calls: Sequence[Call]) -> Bound:
        """Give the calls with their arguments as C takes them."""
        made: list[tuple[Callable[..., object], tuple[object, ...]]] = []
        for name, arguments in calls:
            match name, arguments:
                case "read", (address, length):
                    made.append((self._read, (self._device, address, self._buffer, length)))
                case "write", (address, bytes(data)):
                    made.append((self._write, (self._device, address, data, len(data))))
                case "advance", (float(seconds),):
                    made.append((self._advance, (self._device, round(seconds * 1_000_000))))
                case _:
                    made.append((self.reset, ()))
        return made


@contextmanager
def built() -> Iterator[Path]:
    """Build the device in a folder that goes away again."""
    make_program, compiler = shutil.which("make"), shutil.which("cc")
    if make_program is None or compiler is None:
        raise Absent("make and cc build the device, and one of them is missing")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command = (make_program, "-s", "-C", str(SOURCES), f"INCLUDE={HEADERS}")
        subprocess.run((*command, f"BUILD={folder}", "all", "library"), check=True)
        apart = (f"BUILD={folder / PYTHON_CHIP}", "CHIP=python")
        subprocess.run((*command, *apart, "library"), check=True)
        options = ("-shared", "-fPIC", f"-I{HEADERS}", "-x", "c", "-")
        out = ("-o", str(folder / "libfalls.so"))
        subprocess.run((compiler, *options, *out), input=FALLS, text=True, check=True)
        yield folder


@contextmanager
def served(program: Path, path: str) -> Iterator[str]:
    """Serve the program at a socket, and name it for `--dut`."""
    listener = socket.socket(socket.AF_UNIX if path else socket.AF_INET)
    listener.bind(path or ("127.0.0.1", 0))
    listener.listen()
    code = "import os, socket, sys; c, _ = socket.socket(fileno=0).accept(); f = c.fileno(); "
    code += "os.dup2(f, 1); os.dup2(f, 0); os.execv(sys.argv[1], sys.argv[1:])"
    command = [sys.executable, "-c", code, str(program)]
    with listener, subprocess.Popen(command, stdin=listener.fileno()) as process:
        yield f"unix:{path}" if path else f"tcp:127.0.0.1:{listener.getsockname()[1]}"
        process.kill()


def measure(rows: tuple[Row, ...], effort: Effort) -> Found:
    """Send the same exchanges through each way: by the adapter alone, and checked."""
    model = Model(load(TEXT), closed=True)
    cases = upload_cases(model, effort)
    with built() as folder, ExitStack() as stack:
        program = folder / "slave"
        ways: dict[str, Adapter] = {
            "`model`": make(TEXT, {}),
            "library in this process": lib.make(TEXT, {"path": str(folder / "libslave.so")}),
        }
        duts = {
            LEVEL_A: f"lib:{folder}/libslave.so",
            LEVEL_B: f"lib:{folder}/libstack.so",
            f"{LEVEL_B}, chip in Python": f"lib:{folder / PYTHON_CHIP}/libstack.so",
            "`exec`": f"exec:{program}",
            "`unix`": stack.enter_context(served(program, str(folder / "socket"))),
            "`tcp`, same machine": stack.enter_context(served(program, "")),
        }
        for name, dut in duts.items():
            ways[name] = open_adapter(dut, TEXT)
            stack.callback(ways[name].close)
        recorder = Recorder(ways["`exec`"])
        recorded = Session(cast("Adapter", recorder), model, Oracle(model))
        check(recorded, cases)
        count = recorded.exchanges
        library = Bare(str(folder / "libslave.so"))  # it keeps the device that is called
        works = [partial(perform, library.of(recorder.calls))]
        for adapter in ways.values():
            works.append(partial(perform, bound(adapter, recorder.calls)))
            works.append(partial(check, Session(adapter, model, Oracle(model)), cases))
        bare, *others = (each(count, one) for one in in_turns(effort.of(7, 3, 1), *works))
    pairs = dict(zip(ways, zip(others[::2], others[1::2], strict=True), strict=True))
    note = f"{len(cases)} uploads of examples/c_slave, {count} exchanges a round"
    whole, stack_alone = pairs[LEVEL_A][1], pairs[LEVEL_B][1]
    found = rows[0].found(whole, bare, note), rows[1].found(stack_alone, whole, note)
    return Found(found, (_table(bare, pairs),))


def _table(bare: Figure, pairs: dict[str, tuple[Figure, Figure]]) -> Table:
    def cell(figure: Figure) -> tuple[str, str]:
        return str(figure), f"{number(figure.median / bare.median)}x"

    return Table(
        "Ways to a device, microseconds an exchange",
        ("way", "adapter alone", "of a bare call", "checked", "of a bare call"),
        (
            ("bare ctypes", *cell(bare), "", ""),
            *((name, *cell(alone), *cell(checked)) for name, (alone, checked) in pairs.items()),
        ),
        "A library in this process is there for comparison only: the judge would share its memory.",
    )


def crashes(rows: tuple[Row, ...], effort: Effort) -> Found:
    """Let a library end in segmentation faults, and look what the runner holds afterwards."""
    count = effort.of(500, 30, 3)
    me = psutil.Process()
    with built() as folder:
        adapter = open_adapter(f"lib:{folder}/libfalls.so", TEXT)
        times, before = [], (0, 0)
        for place in range(count):
            began = time.perf_counter()
            adapter.reset()
            with suppress(DeviceCrash):
                adapter.read(0, 1)
            times.append((time.perf_counter() - began) * 1000)
            if place == min(10, count - 1):
                before = me.num_fds(), me.memory_info().rss // 1000
        after = me.num_fds(), me.memory_info().rss // 1000
        adapter.close()
    note = f"descriptors and kilobytes held after the tenth: {before[0]}, {before[1]:,}; "
    note += f"after {count}: {after[0]}, {after[1]:,}"
    return Found((rows[0].found(Figure.of(times), note=note),))


def profile(effort: Effort) -> Profile:
    """Look at the judge; what the other process does is the time in `read` and `write`."""
    model = Model(load(TEXT), closed=True)
    cases = upload_cases(model, effort)
    with built() as folder:
        adapter = open_adapter(f"lib:{folder}/libslave.so", TEXT)
        try:
            session = Session(adapter, model, Oracle(model))
            check(session, cases)
            return profiled(partial(check, session, cases))
        finally:
            adapter.close()


PARTS: Final = (
    Part(
        (
            Row(
                "exchange-lib",
                "checked exchange, shared library (`lib`)",
                "us",
                "the same exchange by bare ctypes in the process, unchecked",
                Target(Of.RATIO, 3.0),
                "A bare call is less than a microsecond. Two changes of process keep the device "
                "from touching its judge, and session and oracle interpret the texts.",
            ),
            Row(
                "exchange-level-b",
                "checked exchange, stack above `ecatspec_chip.h` (`lib`, level B)",
                "us",
                "the same exchange, the same stack as a whole device (`lib`, level A)",
                Target(Of.RATIO, 1.3),
            ),
        ),
        measure,
        {"exchange-lib": profile},
    ),
    Part(
        (Row("crash-lib", "back after a library ended in a segmentation fault", "ms"),),
        crashes,
    ),
)
