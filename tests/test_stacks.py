"""Tests of what is told of a crash: its kind, its place, its stack."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

import pytest
from c_device import library, sanitizes

from ecatspec.conformance.adapters import crash_stack, open_adapter
from ecatspec.conformance.adapters.crash_stack import Crash, Frame, crash, own_words
from ecatspec.conformance.base.adapter import DeviceCrash
from ecatspec.conformance.base.devices import load
from ecatspec.conformance.base.verdict import Outcome
from ecatspec.conformance.run.runner import Runner
from ecatspec.generators.cases.case import NO_LIMITS
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model

if TYPE_CHECKING:
    from pathlib import Path

# --- what reports look like -----------------------------------------------------------------------

OVERFLOW = """\
slave: 3 messages
=================================================================
==4711==ERROR: AddressSanitizer: heap-buffer-overflow on address 0x602000000014 at pc 0x7ff2a2e48061
WRITE of size 8 at 0x602000000014 thread T0
    #0 0x7ff2a2e48060 in __interceptor_memcpy ../../../../src/libsanitizer/asan/interceptors.inc:827
    #1 0x561f32203273 in write_mailbox /home/me/my slave/slave.c:212
    #2 0x561f32203445 in handle /home/me/my slave/slave.c:99:7
    #3 0x7ff2a2445249 in __libc_start_call_main ../sysdeps/nptl/libc_start_call_main.h:58
    #4 0x561f32203160 in _start (/home/me/slave+0x2160) (BuildId: 00ff)

0x602000000014 is located 0 bytes to the right of 4-byte region [0x602000000010,0x602000000014)
allocated by thread T0 here:
    #0 0x7ff2a2eb89cf in __interceptor_malloc ../../../../src/libsanitizer/asan/malloc.cpp:69
    #1 0x561f32203211 in create /home/me/slave.c:10

SUMMARY: AddressSanitizer: heap-buffer-overflow ../interceptors.inc:827 in __interceptor_memcpy
==4711==ABORTING
"""


def frame(rest: str) -> str:
    return f"    #0 0x7ff2a2e48060 {rest}\n"


@pytest.mark.parametrize(
    ("tail", "cause"),
    [
        (
            "==1==ERROR: AddressSanitizer: stack-buffer-overflow on address 0x7ffc:\n"
            + frame("in __asan_memcpy (/opt/my/slave+0xa0)")
            + frame("in ecatspec_chip_pdi_read /opt/adapters/ecatspec_chip.h:512")
            + frame("in esc_read /src/glue.c:16"),
            "stack-buffer-overflow in esc_read (glue.c:16)",
        ),
        (OVERFLOW, "heap-buffer-overflow in write_mailbox (slave.c:212)"),
        (
            "==1==ERROR: AddressSanitizer: attempting double-free on 0x602 in thread T0:\n"
            + frame("in free ../../../../src/libsanitizer/asan/asan_malloc_linux.cpp:52")
            + frame("in operator delete(void*) (/opt/my/slave+0xc0)")
            + frame("in Mailbox::drop(unsigned char const*, int) /src/mailbox.cpp:7:3"),
            "double-free in Mailbox::drop(unsigned char const*, int) (mailbox.cpp:7)",
        ),
        (
            "==1==ERROR: AddressSanitizer: SEGV on unknown address 0x08 (pc 0x5 bp 0x7 sp 0x7 T0)\n"
            + frame(" (<unknown module>)")
            + frame("in __asan_memcpy (/src/slave+0x1)")
            + frame("in strcpy (/src/slave+0x2)")
            + frame("in copy (/src/no such slave+0x3) (BuildId: 12ab)"),
            "SEGV in copy (no such slave)",
        ),
        (
            "==1==ERROR: AddressSanitizer: SEGV on unknown address 0x08 (pc 0x5 bp 0x7 sp 0x7 T0)\n"
            + frame("in memcpy (/lib/x86_64-linux-gnu/libc.so.6+0x1)")
            + frame("in ffi_call (/usr/lib/libffi.so.8+0x1)")
            + frame("in _PyEval_Vector (/usr/lib/libpython3.11.so.1.0+0x1)")
            + frame("in cfunction_call Objects/methodobject.c:553")
            + frame("in PyCFuncPtr_call /usr/src/python/Modules/_ctypes/_ctypes.c:4201")
            + frame("(/usr/bin/python3.11+0x1)"),
            "killed by SEGV outside of its own code",
        ),
        (
            "/src/sdo.c:12:3: runtime error: shift exponent 64 is too large\n"
            + frame("in shift /src/sdo.c:12")
            + "\nSUMMARY: UndefinedBehaviorSanitizer: invalid-shift-exponent /src/sdo.c:12 in\n",
            "invalid-shift-exponent in shift (sdo.c:12)",
        ),
        ("/src/sdo.c:12: runtime error: division by zero\n", "undefined-behavior in sdo.c:12"),
        (
            "a.c:1:1: runtime error: first of many\n"
            "==9==ERROR: LeakSanitizer: detected memory leaks\n\n"
            "Direct leak of 16 byte(s) in 1 object(s) allocated from:\n"
            + frame("in keep /src/a.c:5")
            + "SUMMARY: AddressSanitizer: 16 byte(s) leaked in 1 allocation(s).\n",
            "memory-leak in keep (a.c:5)",
        ),
        (
            "==1==ERROR: AddressSanitizer: stack-overflow on address 0x7ff (pc 0x5 bp 0x7 sp 0x7)\n"
            + frame("in leaf /src/a.c:5")
            + frame("in odd /src/a.c:7")
            + frame("in even /src/a.c:9")
            + frame("in odd /src/a.c:7")
            + frame("in even /src/a.c:9"),
            "stack-overflow in even, odd",
        ),
        ("\necatspec: C stack at SIGBUS\n", "killed by SIGBUS outside of its own code"),
    ],
)
def test_the_cause_is_the_kind_and_the_first_frame_of_the_device(tail: str, cause: str) -> None:
    found = crash(tail)
    assert found is not None
    assert found.cause == cause


def test_the_stack_has_the_frames_of_the_device_only() -> None:
    found = crash(OVERFLOW)
    assert found is not None
    assert [*map(str, found.stack)] == ["write_mailbox (slave.c:212)", "handle (slave.c:99)"]
    deep = crash("==1==ERROR: AddressSanitizer: SEGV on\n" + frame("in f /a.c:1") * 40)
    assert deep == Crash("SEGV", (Frame("f", "/a.c", "1"),) * crash_stack.SHOWN)


def test_words_that_are_no_report_are_the_device_s_own() -> None:
    assert crash("") is None
    assert crash("slave.c:12: all is well\n    #1 0x12 in handle /src/slave.c:3\n") is None
    assert own_words("slave: bad\n\necatspec: C stack at SIGABRT\n    #0 0x1\n") == "slave: bad\n"


@pytest.mark.parametrize(
    "rest",
    ["in read (/src/libslave.so+0x1)", "in poll /src/string/poll.c:3", "(/src/libcan.so+0x1)"],
)
def test_a_device_may_have_names_like_those_of_the_system(rest: str) -> None:
    found = crash("==1==ERROR: AddressSanitizer: SEGV on\n" + frame(rest))
    assert found is not None
    assert len(found.stack) == 1


# --- libraries that crash -------------------------------------------------------------------------

SOURCE = r"""
#include <ecatspec_dut.h>
#include <pthread.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
static void (*volatile nothing)(void);
static void *create(void) { return calloc(1, 16); }
static void reset(void *device) { (void)device; }
#line 1 "slips.c"
__attribute__((noinline)) static int slip(volatile int *p)
{
    *p = 1;
    return 1;
}
__attribute__((noinline)) static int eat(int depth)
{
    volatile char much[4096];
    much[0] = (char)depth;
    return eat(depth + 1) + much[0];
}
static void *thread(void *p) { slip(p); return NULL; }
__attribute__((noinline)) static int act(char *p, int what)
{
    volatile int zero = 0;
    char *volatile pieces[3];
    pthread_t id;
    int n;
    switch (what) {
    case 1: return slip((volatile int *)8) + 1;
    case 2: memcpy(p, (void *)(8 + (size_t)zero), 16 + (size_t)zero); break;
    case 3: abort();
    case 4: return 5 / zero;
    case 5: __builtin_trap();
    case 6: raise(SIGBUS); break;
    case 7: nothing(); break;
    case 8: return eat(0);
    case 9: pthread_create(&id, NULL, thread, NULL); pthread_join(id, NULL); break;
    case 10:    /* the memory allocator notices, and holds its lock */
        for (n = 0; n < 3; n++) pieces[n] = malloc(100000);
        free(pieces[1]);
        free(pieces[1]);
        break;
    case 11: close(2); return slip(NULL) + 1;
    case 12: fprintf(stderr, "out of tables"); abort();
    case 13: return p[16 + zero];
    }
    return 1;
}
static int read_slip(void *device, uint16_t address, uint8_t *data, size_t length)
{
    (void)data; (void)length;
    return act(device, address) + 1;
}
#line 100 "rest.c"
__attribute__((noinline)) static void one(void) { *(volatile int *)8 = 1; }
__attribute__((noinline)) static void two(void) { *(volatile int *)8 = 2; }
static int write_slip(void *device, uint16_t address, const uint8_t *data, size_t length)
{
    (void)device; (void)length;
    if (address == 0x0120 && (data[0] & 15) == 2) one();
    if (address == 0x0120 && (data[0] & 15) == 3) two();
    return 1;
}
static void advance(void *device, uint64_t microseconds) { (void)device; (void)microseconds; }
static int read_still(void *device, uint16_t address, uint8_t *data, size_t length)
{
    (void)device;
    memset(data, 0, length);
    if (address == 0x0130) data[0] = 1;
    return 1;
}
const struct ecatspec_dut *ecatspec_dut(void)
{
    static struct ecatspec_device device = {
        create, free, reset, read_slip, write_slip, advance, NULL
    };
    static const struct ecatspec_dut dut = {
        .abi = ECATSPEC_DUT_ABI, .name = "slips", .protocols = "al", .device = &device
    };
    if (getenv("STILL") != NULL) device.read = read_still;
    return &dut;
}
"""


def slips(file: Path, *options: str) -> Path:
    # the mistakes are on purpose
    return library(SOURCE, file, "-w", "-fno-optimize-sibling-calls", *options, standard="gnu11")


@pytest.fixture(scope="module")
def debug(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if shutil.which("addr2line") is None:
        pytest.skip("lines of sources need addr2line, of binutils")
    return slips(tmp_path_factory.mktemp("slips") / "libslips.so")


def death(file: Path, what: int) -> DeviceCrash:
    adapter = open_adapter(f"lib:{file}", "standard")
    with pytest.raises(DeviceCrash) as caught:
        adapter.read(what, 1)
    adapter.reset()
    adapter.close()
    return caught.value


WAY = "act (slips.c:{}), read_slip (slips.c:43)"


@pytest.mark.parametrize(
    ("what", "ended", "cause", "stack"),
    [
        (1, "SIGSEGV", "SIGSEGV in slip (slips.c:3)", f"slip (slips.c:3), {WAY.format(20)}"),
        (2, "SIGSEGV", "SIGSEGV in act (slips.c:21)", WAY.format(21)),
        (3, "SIGABRT", "SIGABRT in act (slips.c:22)", WAY.format(22)),
        (4, "SIGFPE", "SIGFPE in act (slips.c:23)", WAY.format(23)),
        (5, "SIGILL", "SIGILL in act (slips.c:24)", WAY.format(24)),
        (6, "SIGBUS", "SIGBUS in act (slips.c:25)", WAY.format(25)),
        (7, "SIGSEGV", "SIGSEGV in act (slips.c:26)", "act (slips.c:26)"),
        (9, "SIGSEGV", "SIGSEGV in slip (slips.c:3)", "slip (slips.c:3), thread (slips.c:12)"),
        (10, "SIGABRT", "SIGABRT in act (slips.c:32)", WAY.format(32)),
    ],
)
def test_a_signal_is_told_with_the_stack(
    what: int, ended: str, cause: str, stack: str, debug: Path
) -> None:
    found = death(debug, what)
    assert found.cause == cause
    assert found.placed
    assert f"killed by {ended} (" in found.reason
    assert found.reason.endswith(f"; stack: {stack}")


def test_what_the_device_said_itself_is_told_too(debug: Path) -> None:
    found = death(debug, 12)
    assert "it said: out of tables; stack: act (slips.c:35)" in found.reason


@pytest.mark.parametrize("what", [8, 11])
def test_a_crash_without_a_stack_is_a_crash(what: int, debug: Path) -> None:
    """Where the stack overflowed, and where nothing can be written."""
    found = death(debug, what)
    assert found.reason == "the device ended: killed by SIGSEGV (Segmentation fault)"
    assert not found.placed


def test_without_debug_information_the_function_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = slips(tmp_path / "libplain.so", "-g0")
    assert death(plain, 1).cause == "SIGSEGV in slip (libplain.so)"
    bare = slips(tmp_path / "libbare.so", "-g0", "-s")
    cause = death(bare, 1).cause
    assert cause.startswith("SIGSEGV in libbare.so+0x")
    assert death(bare, 1).cause == cause
    other = slips(tmp_path / "libother.so")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert death(other, 1).cause.startswith("SIGSEGV in libother.so+0x")


@pytest.mark.parametrize(
    ("what", "cause"),
    [
        (1, "SEGV in slip (slips.c:3)"),
        (2, "SEGV in act (slips.c:21)"),
        (3, "SIGABRT in act (slips.c:22)"),
        (8, "stack-overflow in eat"),
        (10, "double-free in act (slips.c:32)"),
        (13, "heap-buffer-overflow in act (slips.c:36)"),
    ],
)
def test_a_sanitizer_keeps_its_signals_and_tells_where(
    what: int, cause: str, sanitized: Path
) -> None:
    found = death(sanitized, what)
    assert found.cause == cause
    assert found.placed


@pytest.fixture(scope="module")
def sanitized(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sanitized")
    if not sanitizes(folder):
        pytest.skip("the compiler has no sanitizers")
    return slips(folder / "libslips.so", "-fsanitize=address")


def test_undefined_behaviour_has_a_stack_too(tmp_path: Path) -> None:
    if not sanitizes(tmp_path):
        pytest.skip("the compiler has no sanitizers")
    file = slips(tmp_path / "libslips.so", "-fsanitize=undefined")
    found = death(file, 4)
    assert found.cause == "integer-divide-by-zero in act (slips.c:23)"
    assert found.reason.endswith(f"; stack: {WAY.format(23)}")


def test_crashes_at_one_place_are_one_finding(debug: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STILL", "yes")
    model = Model(load("standard"))
    asked = ("PREOP", "BOOT")
    names = {f"al/{way}request_{state}" for way in ("", "set_up/") for state in asked}
    cases = [case for case in all_cases(model, NO_LIMITS, "quick") if case.name in names]
    adapter = open_adapter(f"lib:{debug}", "standard")
    runner = Runner(model, adapter, adapter.describe())
    runner.run(cases, None, len(cases))
    adapter.close()
    places = {"PREOP": "one (rest.c:100)", "BOOT": "two (rest.c:101)"}
    assert len(runner.verdicts) == 4
    assert len({verdict.signature for verdict in runner.verdicts}) == 2
    for verdict in runner.verdicts:
        place = places[verdict.case.rpartition("_")[2]]
        assert verdict.outcome is Outcome.CRASH
        assert verdict.title == f"SIGSEGV in {place}"
        assert verdict.signature == f"DeviceCrash {verdict.title}"
        assert f"; stack: {place}, write_slip (rest.c:10" in verdict.observed
        assert verdict.trace[-1].what == verdict.observed
