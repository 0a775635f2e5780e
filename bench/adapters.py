"""The only place that measures ways to a device: the same exchanges through each, and bare.

    python bench/adapters.py [--json] [--crashes 1000]

The device is examples/c_slave, so `make` and `cc` are needed. The bare call is that of ctypes with
declared types, into the library in this process, and nothing else. All ways take turns, round by
round. With `--crashes` a library ends in so many segmentation faults, one after the other, and what
the runner holds before and after is told.
"""

from __future__ import annotations

import argparse
import ctypes
import json
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

from rich.console import Console
from rich.table import Table
from run import CHOICES, ROOT, ROUNDS, Call, Figure, Recorder, bound, in_turns, perform

from ecatspec.conformance.adapter import DeviceCrash
from ecatspec.conformance.adapters import lib, open_adapter
from ecatspec.conformance.adapters.model import make
from ecatspec.conformance.devices import load
from ecatspec.conformance.libraries import HEADERS
from ecatspec.conformance.session import Session
from ecatspec.generators.case import NO_LIMITS
from ecatspec.generators.sdo_cover import sdo_cover
from ecatspec.model.compiled import Model
from ecatspec.model.oracle import Oracle

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from ecatspec.conformance.adapter import Adapter
    from ecatspec.generators.case import Case

SOURCES: Final = ROOT / "examples" / "c_slave"
TEXT: Final = str(SOURCES / "slave.ecs")
CASES: Final = "sdo/upload/"
TARGET: Final = 3.0
"""A checked exchange through a library, in bare calls."""
WIDTH: Final = 120
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

    def of(self, calls: Sequence[Call]) -> list[tuple[object, tuple[object, ...]]]:
        """Give the calls with their arguments as C takes them."""
        made: list[tuple[object, tuple[object, ...]]] = []
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


def built(folder: Path) -> Path:
    make_program, compiler = shutil.which("make"), shutil.which("cc")
    if make_program is None or compiler is None:
        sys.exit("bench/adapters.py needs make and cc")
    command = (make_program, "-s", "-C", str(SOURCES), f"BUILD={folder}", f"INCLUDE={HEADERS}")
    subprocess.run((*command, "all", "library"), check=True)
    options = ("-shared", "-fPIC", f"-I{HEADERS}", "-x", "c", "-")
    subprocess.run(
        (compiler, *options, "-o", str(folder / "libfalls.so")), input=FALLS, text=True, check=True
    )
    return folder


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


def check(session: Session, cases: Sequence[Case]) -> None:
    for case in cases:
        session.begin(CHOICES)
        for stimulus in case.stimuli:
            session.apply(stimulus)


def measured(folder: Path) -> list[dict[str, object]]:
    """Give each way with microseconds an exchange, of the adapter alone and checked."""
    protocol = load(TEXT)
    model = Model(protocol)
    model.dictionary.close()
    cases = [case for case in sdo_cover(model, NO_LIMITS) if case.name.startswith(CASES)]
    with ExitStack() as stack:
        program = folder / "slave"
        ways: dict[str, Adapter] = {
            "model": make(TEXT, {}),
            "lib, in this process": lib.make(TEXT, {"path": str(folder / "libslave.so")}),
        }
        duts = {
            "lib": f"lib:{folder}/libslave.so",
            "lib, level B": f"lib:{folder}/libstack.so",
            "exec": f"exec:{program}",
            "unix": stack.enter_context(served(program, str(folder / "socket"))),
            "tcp": stack.enter_context(served(program, "")),
        }
        for name, dut in duts.items():
            ways[name] = open_adapter(dut, TEXT)
            stack.callback(ways[name].close)
        recorder = Recorder(ways["exec"])
        recorded = Session(cast("Adapter", recorder), model, Oracle(model))
        check(recorded, cases)
        count = recorded.exchanges
        bare = Bare(str(folder / "libslave.so"))
        works = [
            partial(
                perform,
                cast(
                    "list[tuple[Callable[..., object], tuple[object, ...]]]",
                    bare.of(recorder.calls),
                ),
            )
        ]
        for adapter in ways.values():
            works.append(partial(perform, bound(adapter, recorder.calls)))
            works.append(partial(check, Session(adapter, model, Oracle(model)), cases))
        times = in_turns(ROUNDS, *works)
    figures = [Figure.of([each / count * 1e6 for each in column]) for column in times]
    one = figures[0].median
    rows: list[dict[str, object]] = [
        {"way": "bare ctypes", "alone": one, "alone_ratio": 1.0, "exchanges": count}
    ]
    for place, name in enumerate(ways):
        alone, checked = figures[2 * place + 1], figures[2 * place + 2]
        rows.append(
            {
                "way": name,
                "alone": alone.median,
                "alone_ratio": alone.median / one,
                "checked": checked.median,
                "checked_ratio": checked.median / one,
                "judging": checked.median - alone.median,
            }
        )
    return rows


def held() -> dict[str, int]:
    """Give what this process holds: descriptors, and bytes in memory."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    memory = next(line for line in status.splitlines() if line.startswith("VmRSS:"))
    return {
        "descriptors": len(list(Path("/proc/self/fd").iterdir())),
        "kilobytes": int(memory.split()[1]),
    }


def fallen(folder: Path, crashes: int) -> dict[str, object]:
    """Let a library crash so often; give what is held after the tenth and after the last."""
    adapter = open_adapter(f"lib:{folder}/libfalls.so", TEXT)
    before: dict[str, int] = {}
    began = time.perf_counter()
    for number in range(crashes):
        adapter.reset()
        with suppress(DeviceCrash):
            adapter.read(0, 1)
        if number == min(10, crashes - 1):
            before = held()
    seconds = time.perf_counter() - began
    adapter.close()
    return {"crashes": crashes, "seconds": seconds, "before": before, "after": held()}


def show(rows: Sequence[dict[str, object]]) -> None:
    table = Table(
        title=f"microseconds an exchange, median of {ROUNDS} rounds; ratio to a bare call"
    )
    for column in ("way", "adapter alone", "ratio", "checked", "ratio", "of that judging"):
        table.add_column(column, justify="left" if column == "way" else "right")
    for row in rows:
        cells = [
            row.get(key) for key in ("alone", "alone_ratio", "checked", "checked_ratio", "judging")
        ]
        table.add_row(str(row["way"]), *("" if cell is None else f"{cell:,.1f}" for cell in cells))
    console = Console()
    if not console.is_terminal:
        console.width = WIDTH
    console.print(table)
    console.print(f"aimed at: lib at most {TARGET:g} bare calls")


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure the ways to a device.")
    parser.add_argument("--json", action="store_true", help="give the figures as JSON")
    parser.add_argument("--crashes", type=int, default=0, help="count crashes instead")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = built(Path(name))
        if asked.crashes:
            print(json.dumps(fallen(folder, asked.crashes), indent=2))
            return
        rows = measured(folder)
    if asked.json:
        print(json.dumps(rows, indent=2))
    else:
        show(rows)


if __name__ == "__main__":
    main()
