"""Tests of shared libraries: every way in which one can be wrong, or die."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest
from c_device import TEXT, build, library, sanitizes
from processes import descriptors, gone, living_group, memory

from ecatspec.conformance.adapters import lib, open_adapter
from ecatspec.conformance.adapters.contract_test import check_adapter
from ecatspec.conformance.adapters.host import CRASHED
from ecatspec.conformance.adapters.process import ProcessAdapter
from ecatspec.conformance.adapters.shared_library import HEADERS, environment
from ecatspec.conformance.base.adapter import (
    AdapterError,
    DeviceCrash,
    DeviceFault,
    DeviceHang,
    DeviceRubbish,
)
from ecatspec.conformance.base.devices import load
from ecatspec.conformance.base.verdict import Outcome
from ecatspec.conformance.run.runner import run_device

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

# A device that is 64 KB of memory, and does at a read what the environment asks for.
HOSTILE = r"""
#define _GNU_SOURCE
#include <ecatspec_dut.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

static int is(const char *name)
{
    const char *asked = getenv("HOSTILE");
    return asked != NULL && strcmp(asked, name) == 0;
}

__attribute__((constructor)) static void loaded(void)
{
    if (is("exits at load")) { fprintf(stderr, "no licence\n"); exit(3); }
    if (is("crashes at load")) raise(SIGSEGV);
}

struct memory { uint8_t bytes[0x10000]; };

static int eat(int depth)
{
    volatile char much[4096];
    much[0] = (char)depth;
    return eat(depth + 1) + much[0];
}

static void *create(void)
{
    return is("no instance") ? NULL : calloc(1, sizeof(struct memory));
}

static void reset(void *device) { memset(device, 0, sizeof(struct memory)); }

static int read_memory(void *device, uint16_t address, uint8_t *data, size_t length)
{
    volatile int *nowhere = NULL;
    int n;
    memcpy(data, ((struct memory *)device)->bytes + address, length);
    if (address == 0x0FFF || getenv("HOSTILE") == NULL) return 1;
    if (is("exits")) exit(4);
    if (is("exits at once")) _exit(5);
    if (is("ends in abort")) abort();
    if (is("segmentation fault")) *nowhere = 1;
    if (is("stack overflow")) return eat(0);
    if (is("infinite loop")) for (;;) nowhere = NULL;
    if (is("floods for ever")) for (;;) puts("more and more");
    if (is("floods")) for (n = 0; n < 200000; n++) puts("more and more");
    if (is("half a line")) { printf("{\"ok\":tr"); fflush(stdout); }
    if (is("a byte too many")) data[length] ^= 0xFF;
    if (is("wrong counter")) return -7;
    if (is("closes descriptors")) for (n = 3; n < 64; n++) close(n);
    if (is("writes everywhere"))
        for (n = 3; n < 64; n++) if (write(n, "rubbish\n", 8) < 0) continue;
    if (is("refuses to die")) {
        signal(SIGTERM, SIG_IGN);
        if (fork() == 0) for (;;) pause();
        for (;;) pause();
    }
    return 1;
}

static int write_memory(void *device, uint16_t address, const uint8_t *data, size_t length)
{
    memcpy(((struct memory *)device)->bytes + address, data, length);
    return 1;
}

static void advance(void *device, uint64_t microseconds) { (void)device; (void)microseconds; }

const struct ecatspec_dut *ecatspec_dut(void)
{
    static const struct ecatspec_device device = {
        create, free, reset, read_memory, write_memory, advance, NULL
    };
    static const struct ecatspec_dut dut = {
        .abi = ECATSPEC_DUT_ABI, .name = "memory", .protocols = "al", .limits = "segment_data=7",
        .without = "malformed repeat", .notes = "limits: as a test\nmalformed\nrepeat",
        .open_dictionary = 1, .device = &device
    };
    return is("no table") ? NULL : &dut;
}
"""

# A stack that does nothing but what the first byte of process memory asks for.
STACK = r"""
#include <ecatspec_chip.h>
#include <stdlib.h>

struct stack { const struct ecatspec_esc *esc; uint32_t time; };

static void *create(const struct ecatspec_esc *esc)
{
    struct stack *stack = calloc(1, sizeof *stack);
    stack->esc = esc;
    return stack;
}

static void init(void *stack) { ((struct stack *)stack)->time = 0; }

static void poll(void *context, uint32_t microseconds)
{
    struct stack *stack = context;
    const struct ecatspec_esc *esc = stack->esc;
    static uint8_t much[0x20000];
    volatile int *nowhere = NULL;
    uint8_t order;
    uint32_t said[2];
    esc->pdi_read(esc->context, 0x1000, &order, 1);
    stack->time += microseconds;
    said[0] = stack->time;
    said[1] = esc->al_event(esc->context);
    esc->pdi_write(esc->context, 0x1004, said, sizeof said);
    switch (order) {
    case 1: *nowhere = 1; break;
    case 2: for (;;) nowhere = NULL;
    case 3: esc->pdi_read(esc->context, 0xFFFF, much, 2); break;
    case 4: esc->pdi_write(esc->context, 0x1000, much, 0x20000); break;
    case 5: exit(5);
    case 6:    /* no bytes, for which there need not be a place */
        esc->pdi_read(esc->context, 0x1C00, NULL, 0);
        esc->pdi_write(esc->context, 0xFFFF, NULL, 0);
        break;
    }
}

static int local(void *stack, const char *event) { (void)stack; (void)event; return -1; }

const struct ecatspec_dut *ecatspec_dut(void)
{
    static const struct ecatspec_stack stack = { create, free, init, poll, local };
    static const struct ecatspec_dut dut = {
        .abi = ECATSPEC_DUT_ABI, .name = "stack", .locals = "al.sync_lost", .stack = &stack
    };
    return &dut;
}
"""

PART = """
#include <ecatspec_dut.h>
#include <stdlib.h>
{before}
const struct ecatspec_dut *ecatspec_dut(void)
{{
    static const struct ecatspec_device device = {{ 0 }};
    static const struct ecatspec_stack stack = {{ 0 }};
    static const struct ecatspec_dut dut = {{ {dut} }};
    (void)device; (void)stack;
    return &dut;
}}
"""


@pytest.fixture(scope="module")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return library(
        HOSTILE, tmp_path_factory.mktemp("hostile") / "libhostile.so", "-Wno-infinite-recursion"
    )


@pytest.fixture(scope="module", params=["C", "PYTHON"])
def stack(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("stack") / "libstack.so"
    return library(STACK, file, f"-DECATSPEC_{request.param}_CHIP")


@pytest.fixture(scope="module")
def slave(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("c_slave"), "library") / "libslave.so"


@pytest.fixture
def opened(hostile: Path) -> Iterator[ProcessAdapter]:
    """The hostile device while it is still peaceful; afterwards nothing of it is left."""
    adapter = open_adapter(f"lib:{hostile}", "standard", hang_timeout=1)
    assert isinstance(adapter, ProcessAdapter)
    pid = adapter.pid
    assert pid is not None
    yield adapter
    adapter.close()
    adapter.close()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    assert gone(pid), living_group(pid)


# --- what a good one does -------------------------------------------------------------------------


def test_the_header_and_the_adapter_speak_one_version() -> None:
    text = (HEADERS / "ecatspec_dut.h").read_text(encoding="utf-8")
    assert re.findall(r"#define ECATSPEC_DUT_ABI (\d+)", text) == [str(lib.ABI)]


def test_the_header_is_c99_and_cplusplus(tmp_path: Path) -> None:
    source = "#include <ecatspec_dut.h>\nint none;\n"
    library(source, tmp_path / "c.so", "-pedantic")
    if shutil.which("c++"):
        library(source, tmp_path / "cplusplus.so", "-pedantic", standard="c++11")


def test_the_kit_has_no_complaint(hostile: Path, slave: Path) -> None:
    for file, spans in ((hostile, [(0, 65536)]), (slave, [(0x130, 2), (0x800, 32), (0x1000, 48)])):
        complaints = check_adapter(
            lambda file=file: open_adapter(f"lib:{file}", TEXT),  # type: ignore[misc]
            spans=spans,
            write=(0x120, b"\x02\x00"),
        )
        assert complaints == []


def test_the_table_is_the_description(opened: ProcessAdapter) -> None:
    described = opened.describe()
    assert (described.name, described.protocols) == ("memory", frozenset({"al"}))
    assert (described.limits, described.without) == ({"segment_data": 7}, ("malformed", "repeat"))
    assert described.notes == ("limits: as a test", "malformed", "repeat")
    assert not described.closed_dictionary
    assert described.virtual_time


def test_without_a_list_every_layer_of_the_text_is_the_device_s_own(
    slave: Path, stack: Path
) -> None:
    whole, bare = (lib.make(TEXT, {"path": str(file)}).describe() for file in (slave, stack))
    assert whole.protocols == bare.protocols == set(load(TEXT).machines)


def test_several_instances_share_nothing(slave: Path) -> None:
    one, two = (lib.make(TEXT, {"path": str(slave)}) for _ in range(2))
    settings = bytes.fromhex("00103000260001008010300022000100")
    for adapter in (one, two):
        adapter.reset()
    one.write(0x0800, settings)
    one.write(0x0120, b"\x02\x00")
    assert one.read(0x0130, 1) == (1, b"\x02")
    assert two.read(0x0130, 1) == (1, b"\x01")
    one.close()
    two.write(0x0800, settings)
    two.write(0x0120, b"\x02\x00")
    assert two.read(0x0130, 1) == (1, b"\x02")
    two.close()


# --- what is wrong before anything runs -----------------------------------------------------------


@pytest.mark.parametrize(
    ("before", "dut", "words"),
    [
        ("", ".abi = 99", "was built with version 99 of ecatspec_dut.h, this ecatspec speaks 1"),
        ("", ".abi = 1", "has none of `device` and `stack`"),
        ("", ".abi = 1, .device = &device, .stack = &stack", "has both of `device` and `stack`"),
        ("", ".abi = 1, .device = &device", "has no `create` in its table `device`"),
        ("", ".abi = 1, .stack = &stack", "has no `create` in its table `stack`"),
    ],
)
def test_a_wrong_table_is_one_line(before: str, dut: str, words: str, tmp_path: Path) -> None:
    file = library(PART.format(before=before, dut=dut), tmp_path / "lib.so")
    with pytest.raises(AdapterError, match=re.escape(words)):
        open_adapter(f"lib:{file}", "standard")


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ("exits at load", "does not come up: the device ended: exit status 3; it said: no licence"),
        ("crashes at load", "does not come up: the device ended: killed by SIGSEGV"),
        ("no instance", "`create` of the library gives a null pointer"),
        ("no table", r"ecatspec_dut\(\) of .* gives a null pointer"),
    ],
)
def test_a_library_that_does_not_come_up_is_one_line(
    asked: str, words: str, hostile: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOSTILE", asked)
    with pytest.raises(AdapterError, match=words) as caught:
        open_adapter(f"lib:{hostile}", "standard")
    assert "\n" not in str(caught.value)


def test_a_file_that_is_no_library_is_one_line(tmp_path: Path, hostile: Path, stack: Path) -> None:
    text = tmp_path / "lib.so"
    text.write_text("text")
    empty = library("int none;", tmp_path / "empty.so")
    for dut, words in (
        ("lib:", "the path of the library is empty"),
        ("lib:./none.so", "there is no file './none.so'"),
        (f"lib:{tmp_path}", "there is no file"),
        (f"lib:{text}", "cannot load the library"),
        (f"lib:{empty}", r"does not export ecatspec_dut\(\)"),
        (f"lib:{hostile},speed=1", "has no option 'speed'; it takes poll"),
        (f"lib:{hostile},poll=1", "is not polled; leave out poll="),
        (f"lib:{stack},poll=0", "poll=0 is no time between polls"),
        (f"lib:{stack},poll=often", "poll=often is no time between polls"),
        (f"lib:{stack},poll=inf", "poll=inf is no time between polls"),
        (f"lib:{stack},poll=4295", "poll=4295 is no time between polls"),
    ):
        with pytest.raises(AdapterError, match=words) as caught:
            open_adapter(dut, "standard")
        assert "\n" not in str(caught.value)


# --- what a hostile one does ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("asked", "fault", "words"),
    [
        ("exits", DeviceCrash, "exit status 4"),
        ("exits at once", DeviceCrash, "exit status 5"),
        ("ends in abort", DeviceCrash, "killed by SIGABRT"),
        ("segmentation fault", DeviceCrash, "killed by SIGSEGV"),
        ("stack overflow", DeviceCrash, "killed by SIGSEGV"),
        ("infinite loop", DeviceHang, "no answer within 1 s"),
        ("floods for ever", DeviceHang, "no answer within 1 s"),
        ("refuses to die", DeviceHang, "no answer within 1 s"),
        ("a byte too many", DeviceCrash, "a read of 2 bytes at 0x0130 wrote more than that"),
        ("wrong counter", DeviceRubbish, "the working counter is not a count: -7"),
        ("closes descriptors", DeviceCrash, "Bad file descriptor"),
        ("writes everywhere", DeviceRubbish, "not JSON: b'rubbish'|more than one line"),
    ],
)
def test_what_a_library_does_wrong_is_a_fault_of_the_device(
    asked: str,
    fault: type[DeviceFault],
    words: str,
    hostile: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("HOSTILE", asked)
    adapter = open_adapter(f"lib:{hostile}", "standard", hang_timeout=1)
    assert isinstance(adapter, ProcessAdapter)
    pid = adapter.pid
    assert pid is not None
    assert adapter.read(0x0FFF, 1) == (1, b"\0")
    with pytest.raises(fault, match=words):
        adapter.read(0x130, 2)
    assert gone(pid), living_group(pid)
    adapter.reset()
    assert adapter.read(0x0FFF, 1) == (1, b"\0")
    adapter.close()


@pytest.mark.parametrize("asked", ["floods", "half a line"])
def test_what_a_library_prints_is_no_answer(
    asked: str, hostile: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOSTILE", asked)
    adapter = open_adapter(f"lib:{hostile}", "standard")
    adapter.reset()
    assert adapter.read(0x130, 2) == (1, b"\0\0")
    adapter.close()


@pytest.mark.parametrize(
    ("order", "fault", "words"),
    [
        (1, DeviceCrash, "killed by SIGSEGV"),
        (2, DeviceHang, "no answer within 1 s"),
        (3, DeviceCrash, "2 bytes at 0xffff are not in the memory of the ESC"),
        (4, DeviceCrash, "131072 bytes at 0x1000 are not in the memory of the ESC"),
        (5, DeviceCrash, "exit status 5"),
    ],
)
def test_what_a_stack_does_wrong_is_a_fault_of_the_device(
    order: int, fault: type[DeviceFault], words: str, stack: Path
) -> None:
    adapter = open_adapter(f"lib:{stack}", "standard", hang_timeout=1)
    with pytest.raises(fault, match=words):
        adapter.write(0x1000, bytes((order,)))
    adapter.reset()
    assert adapter.read(0x1000, 1) == (1, b"\0")
    adapter.close()


def test_a_stack_may_read_and_write_no_bytes(stack: Path) -> None:
    adapter = open_adapter(f"lib:{stack}", "standard")
    assert adapter.write(0x1000, b"\6") == 1
    assert adapter.read(0x1000, 1) == (1, b"\6")
    adapter.close()


def test_a_stack_finds_a_chip_that_is_up(stack: Path) -> None:
    """What public stacks read when they start, and what else is loaded from the EEPROM."""
    chip = lib.make("standard", {"path": str(stack)})
    assert chip.read(0x0004, 3) == (1, b"\x04\x04\x3c")  # FMMUs, SyncManagers, kilobytes
    assert chip.read(0x0110, 2) == (1, b"\x13\x56")  # PDI and its watchdog, link at port 0 only
    assert chip.read(0x0140, 2) == (1, b"\x05\x00")  # a processor at the PDI, no emulation
    assert chip.read(0x0502, 2) == (1, b"\x40\x00")  # EEPROM loaded, no error, not busy
    chip.close()


def test_what_a_text_says_of_a_register_goes_first(stack: Path) -> None:
    chip = lib.make("afag-se-power", {"path": str(stack)})
    assert chip.read(0x0000, 1) == (1, b"\x02")
    assert chip.read(0x0110, 2) == (1, b"\x13\x56")
    assert chip.read(0x1FFF, 2) == (0, bytes(2))
    chip.close()


def test_an_event_that_the_library_lists_and_does_not_know_is_one_line(stack: Path) -> None:
    adapter = open_adapter(f"lib:{stack}", "standard")
    assert adapter.describe().locals == {"al.sync_lost"}
    with pytest.raises(AdapterError, match=r"does not know the event 'al.sync_lost'"):
        adapter.local("al.sync_lost")  # type: ignore[attr-defined]
    adapter.close()


def test_a_stack_is_polled_in_steps(stack: Path) -> None:
    for option, step in (("", 1000), (",poll=0.0001", 100)):
        adapter = open_adapter(f"lib:{stack}{option}", "standard")
        adapter.reset()
        adapter.advance(0.0055)
        counter, said = adapter.read(0x1004, 4)
        assert (counter, int.from_bytes(said, "little")) == (1, 5500)
        adapter.advance(step * 2.5 / 1e6)
        said = adapter.read(0x1004, 4)[1]
        assert int.from_bytes(said, "little") == 5500 + 2.5 * step
        adapter.close()


def test_a_device_that_never_comes_up_is_a_note(stack: Path, slave: Path) -> None:
    """Instead of some hundred findings without a hint; a device that moves has no such note."""
    for dut, device, still in ((stack, "standard", True), (slave, "reference", False)):
        result = run_device(device, f"lib:{dut}", replay="al/set_up/request_PREOP")
        assert result.verdicts[0].outcome is Outcome.FAIL
        assert any("never changed" in note for note in result.notes) is still


def test_a_crash_is_a_verdict_and_the_run_goes_on(
    hostile: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOSTILE", "segmentation fault")
    result = run_device("standard", f"lib:{hostile}", replay="al/set_up/request_INIT")
    (verdict,) = result.verdicts
    assert verdict.outcome is Outcome.CRASH
    assert "killed by SIGSEGV" in verdict.observed


def test_sixty_crashes_leave_nothing_behind(hostile: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As bench/adapters.py does with hundreds."""
    monkeypatch.setenv("HOSTILE", "segmentation fault")
    adapter = open_adapter(f"lib:{hostile}", "standard")
    held = used = 0
    for number in range(60):
        adapter.reset()
        with pytest.raises(DeviceCrash):
            adapter.read(0x130, 2)
        if number == 10:
            held, used = descriptors(), memory()
    assert descriptors() == held
    assert memory() < used + (1 << 20)
    adapter.close()


def test_a_device_that_loops_ends_with_a_run_that_was_killed(hostile: Path) -> None:
    asked = json.dumps({"device": "standard", "options": {"path": str(hostile)}})
    host = subprocess.Popen(
        [sys.executable, "-P", "-m", "ecatspec.conformance.adapters.host", "lib", asked],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, "HOSTILE": "infinite loop"},
    )
    assert host.stdin is not None
    assert host.stdout is not None
    with host.stdin, host.stdout:
        host.stdin.write(b'{"op":"read","address":4095,"length":1}\n')
        host.stdin.flush()
        assert host.stdout.readline() == b'{"ok":true,"wkc":1,"data":"00"}\n'
        host.stdin.write(b'{"op":"read","address":0,"length":1}\n')
        host.stdin.flush()
    try:
        assert host.wait(10) == CRASHED
    finally:
        host.kill()
        host.wait()


# --- sanitizers -----------------------------------------------------------------------------------

SLIPS = r"""
#include <ecatspec_dut.h>
#include <stdlib.h>
static void *create(void) { return malloc(16); }
static void reset(void *device) { (void)device; }
static int read_slip(void *device, uint16_t address, uint8_t *data, size_t length)
{
    uint8_t *bytes = device;
    int shift = address;
    if (address == 0x0FFF) return 1;
    if (address == 64) { data[0] = (uint8_t)(1 << shift); return 1; }
    data[0] = bytes[address];
    (void)length;
    return 1;
}
static int write_slip(void *d, uint16_t a, const uint8_t *data, size_t n)
{ (void)d; (void)a; (void)data; (void)n; return 1; }
static void advance(void *device, uint64_t microseconds) { (void)device; (void)microseconds; }
const struct ecatspec_dut *ecatspec_dut(void)
{
    static const struct ecatspec_device device = {
        create, free, reset, read_slip, write_slip, advance, NULL
    };
    static const struct ecatspec_dut dut = {
        .abi = ECATSPEC_DUT_ABI, .name = "slips", .protocols = "al", .device = &device
    };
    return &dut;
}
"""


@pytest.mark.parametrize(
    ("sanitizer", "address", "words"),
    [
        ("address", 16, "it said: AddressSanitizer: heap-buffer-overflow .*read_slip"),
        ("undefined", 64, "it said: .*runtime error: shift exponent 64 is too large"),
        ("address,undefined", 64, "it said: .*runtime error: shift exponent 64 is too large"),
    ],
)
def test_the_report_of_a_sanitizer_is_the_reason(
    sanitizer: str, address: int, words: str, tmp_path: Path
) -> None:
    if not sanitizes(tmp_path):
        pytest.skip("the compiler has no sanitizers")
    file = library(SLIPS, tmp_path / "libslips.so", f"-fsanitize={sanitizer}")
    adapter = open_adapter(f"lib:{file}", "standard")
    assert adapter.read(0x0FFF, 1)[0] == 1
    with pytest.raises(DeviceCrash, match=words) as caught:
        adapter.read(address, 1)
    assert "runtime error" in caught.value.stderr_tail or "SUMMARY" in caught.value.stderr_tail
    adapter.reset()
    adapter.close()


def test_a_sanitizer_that_names_no_library_has_to_be_preloaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "lib.so"
    file.write_bytes(b"\x7fELF\0__asan_init\0libc.so.6\0")
    with pytest.raises(AdapterError, match="link with -shared-libasan, or set LD_PRELOAD"):
        environment(file)
    monkeypatch.setenv("LD_PRELOAD", "/opt/libclang_rt.asan.so")
    assert environment(file)["LD_PRELOAD"] == "/opt/libclang_rt.asan.so"
    monkeypatch.setenv("LD_PRELOAD", "libother.so")
    file.write_bytes(b"\x7fELF\0__asan_init\0libclang_rt.asan-x86_64.so\0libc.so.6\0")
    assert environment(file)["LD_PRELOAD"] == "libclang_rt.asan-x86_64.so libother.so"
    file.write_bytes(b"\x7fELF\0libc.so.6\0")
    assert environment(file) == {}
