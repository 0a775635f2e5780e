"""Tests of devices in another process: every way a device can die."""

from __future__ import annotations

import os
import signal
import sys
import textwrap
import threading
import time
from typing import TYPE_CHECKING

import pytest
from processes import descriptors, gone, living_group

from ecatspec.conformance.adapters.contract_test import check_adapter
from ecatspec.conformance.adapters.line_protocol import MAXIMUM_LINE
from ecatspec.conformance.adapters.process import STDERR_KEPT, ProcessAdapter
from ecatspec.conformance.base.adapter import (
    AdapterError,
    DeviceCrash,
    DeviceFault,
    DeviceHang,
    DeviceRubbish,
    advance_until,
    read_all,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    Make = Callable[..., ProcessAdapter]

HEAD = """
import json, os, signal, sys, time
memory = bytearray(65536)
def reply(**fields):
    sys.stdout.write(json.dumps({"ok": True, **fields}) + "\\n")
    sys.stdout.flush()
def serve(request):
    match request:
        case {"op": "read", "address": a, "length": n}:
            reply(wkc=1, data=memory[a:a + n].hex())
        case {"op": "write", "address": a, "data": d}:
            memory[a:a + len(d) // 2] = bytes.fromhex(d)
            reply(wkc=1)
        case {"op": "reset"}:
            memory[:] = bytes(65536)
            reply()
        case {"op": "describe"}:
            reply(description={"name": "echo", "protocols": ["al"], "virtual_time": True,
                               "closed_dictionary": False, "notes": [], "batch": True})
        case {"op": "batch", "calls": calls}:
            reply(results=[{"ok": True, "wkc": 1, "data": memory[c["address"]:][:c["length"]].hex()}
                           for c in calls])
        case _:
            reply()
"""
LOOP = """
for line in sys.stdin:
    serve(json.loads(line))
"""
# What the device does instead of answering a read.
ON_READ = (
    HEAD
    + """
for line in sys.stdin:
    if json.loads(line)["op"] != "read":
        serve(json.loads(line))
        continue
    {body}
"""
)


@pytest.fixture
def device(tmp_path: Path) -> Iterator[Make]:
    """Start devices from source; afterwards none of their processes is left."""
    opened: list[ProcessAdapter] = []
    pids: list[int] = []

    def make(source: str, hang_timeout: float = 10.0) -> ProcessAdapter:
        path = tmp_path / f"device{len(opened)}.py"
        path.write_text(textwrap.dedent(source))
        command = [sys.executable, "-I", "-S", str(path)]
        opened.append(ProcessAdapter(command, hang_timeout=hang_timeout))
        assert opened[-1].pid is not None
        pids.append(opened[-1].pid)
        return opened[-1]

    yield make
    for adapter in opened:
        adapter.close()
        adapter.close()
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
        assert gone(pid), living_group(pid)


def read_until_fault(adapter: ProcessAdapter) -> None:
    for _ in range(100):
        time.sleep(0.02)
        adapter.read(0, 1)


def on_read(body: str) -> str:
    return ON_READ.replace("{body}", body)


def test_a_good_device_passes_the_kit(device: Make) -> None:
    spans = [(0, 4096), (65535, 1)]
    assert check_adapter(lambda: device(HEAD + LOOP), spans=spans, write=(16, b"\x01\x02")) == []


def test_bytes_and_description_arrive(device: Make) -> None:
    adapter = device(HEAD + LOOP)
    assert adapter.write(0x120, b"\x02\x00") == 1
    assert adapter.read(0x11F, 4) == (1, b"\x00\x02\x00\x00")
    adapter.advance(0.5)
    adapter.reset()
    assert adapter.read(0x120, 2) == (1, b"\x00\x00")
    assert adapter.describe().name == "echo"
    assert adapter.describe().protocols == {"al"}


def test_a_whole_memory_goes_through_the_pipe_at_once(device: Make) -> None:
    adapter = device(HEAD + LOOP)
    data = bytes(range(256)) * 256
    assert adapter.write(0, data) == 1
    assert adapter.read(0, len(data)) == (1, data)


def test_exit_at_start_is_a_crash_with_its_status(device: Make) -> None:
    adapter = device("import sys; print('no licence', file=sys.stderr); sys.exit(3)")
    with pytest.raises(DeviceCrash, match="exit status 3; it said: no licence") as caught:
        adapter.read(0, 1)
    assert caught.value.stderr_tail == "no licence\n"


def test_a_signal_is_a_crash_with_its_name_and_reset_revives(device: Make) -> None:
    adapter = device(
        HEAD
        + """
for line in sys.stdin:
    request = json.loads(line)
    if request.get("address") == 66:
        os.kill(os.getpid(), signal.SIGSEGV)
    serve(request)
"""
    )
    assert adapter.read(0, 1) == (1, b"\x00")
    with pytest.raises(DeviceCrash, match="killed by SIGSEGV"):
        adapter.read(66, 1)
    with pytest.raises(DeviceCrash, match=r"not running .*reset starts it again"):
        adapter.read(0, 1)
    adapter.reset()
    assert adapter.read(0, 1) == (1, b"\x00")


def test_silence_is_a_hang(device: Make) -> None:
    adapter = device(on_read("time.sleep(1000)"), hang_timeout=0.3)
    with pytest.raises(DeviceHang, match=r"no answer within 0\.3 s"):
        adapter.read(0, 1)
    adapter.reset()


def test_a_device_that_does_not_listen_is_a_hang(device: Make) -> None:
    adapter = device("import time; time.sleep(1000)", hang_timeout=0.3)
    with pytest.raises(DeviceHang):
        adapter.write(0, bytes(60000))


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        ("hello", "not JSON"),
        ("[1]", "not an object"),
        ("[" * 100_000, "not JSON"),
        ("{}", "neither yes nor why not"),
        ('{"ok":1}', "neither yes nor why not"),
        ('{"ok":false}', "neither yes nor why not"),
        ('{"ok":true,"data":"00"}', "working counter"),
        ('{"ok":true,"wkc":"1","data":"0000"}', "working counter"),
        ('{"ok":true,"wkc":true,"data":"0000"}', "working counter"),
        ('{"ok":true,"wkc":-1,"data":"0000"}', "working counter"),
        ('{"ok":true,"wkc":1}', "not a text"),
        ('{"ok":true,"wkc":1,"data":[0,0]}', "not a text"),
        ('{"ok":true,"wkc":1,"data":"zz"}', "not hexadecimal"),
        ('{"ok":true,"wkc":1,"data":"00"}', "1 bytes came for a read of 2"),
        ('{"ok":true,"wkc":1,"data":"000000"}', "3 bytes came for a read of 2"),
        ('{"ok":true,"wkc":1,"data":"0000"}\\nmore', "more than one line"),
        ("\\xff\\xfe", "not JSON"),
    ],
)
def test_an_answer_out_of_the_contract_is_rubbish(device: Make, answer: str, reason: str) -> None:
    body = f"sys.stdout.buffer.write(b'{answer}' + b'\\n'); sys.stdout.buffer.flush()"
    adapter = device(on_read(body))
    with pytest.raises(DeviceRubbish, match=reason):
        adapter.read(0, 2)
    adapter.reset()


def test_no_bytes_with_working_counter_zero_is_fine(device: Make) -> None:
    assert device(on_read("reply(wkc=0, data='')")).read(0, 2) == (0, b"")


def test_a_batch_is_one_line(device: Make) -> None:
    counted = HEAD + "count = 0\nfor line in sys.stdin:\n"
    counted += "    count += 1\n    memory[0] = count\n    serve(json.loads(line))\n"
    adapter = device(counted)
    adapter.write(2, b"two")
    assert read_all(adapter, [(0, 1), (2, 3), (0, 1)]) == [(1, b"\2"), (1, b"two"), (1, b"\2")]
    with pytest.raises(AdapterError, match="outside the address space"):
        adapter.reads([(0, 1), (1 << 16, 1)])


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        ('{"ok":true}', "the results of 2 calls are no list of as many"),
        ('{"ok":true,"results":{}}', "the results of 2 calls are no list of as many"),
        ('{"ok":true,"results":[{"ok":true,"wkc":1,"data":"00"}]}', "no list of as many"),
        ('{"ok":true,"results":[1,2]}', "the answer is not an object: 1"),
        ('{"ok":true,"results":[{},{}]}', "neither yes nor why not: {}"),
        ('{"ok":true,"results":[{"ok":true,"wkc":1,"data":""},0]}', "0 bytes came for a read of 1"),
    ],
)
def test_results_out_of_the_contract_are_rubbish(device: Make, answer: str, reason: str) -> None:
    body = f"sys.stdout.write('{answer}' + chr(10)); sys.stdout.flush()"
    adapter = device(on_read(body).replace('!= "read"', '!= "batch"'))
    with pytest.raises(DeviceRubbish, match=reason):
        adapter.reads([(0, 1), (1, 1)])


# A device in which time changes the first byte: with the third millisecond.
TIMED = (
    HEAD
    + """
now = 0
def until(steps, seen):
    global now
    for passed, seconds in enumerate(steps, 1):
        now += seconds
        memory[0] = now >= 0.003
        {step}
        sys.stdout.write(" ")
        sys.stdout.flush()
        found = [memory[c["address"]:][:c["length"]].hex() for c in seen]
        if found != [c["data"] for c in seen]:
            break
        {look}
        sys.stdout.write(" ")
        sys.stdout.flush()
    reply(passed=passed, results=[{"ok": True, "wkc": 1, "data": data} for data in found])
for line in sys.stdin:
    request = json.loads(line)
    if request["op"] == "advance_until":
        until(request["steps"], request["seen"])
    else:
        serve(request)
"""
)
SEEN = {(0, 1): (1, b"\0"), (4, 2): (1, b"\0\0")}


def timed(step: str = "pass", look: str = "pass") -> str:
    return TIMED.replace("{step}", step).replace("{look}", look)


def waited(adapter: ProcessAdapter, *steps: float) -> tuple[object, int]:
    """Let time pass; give what came of it, or the fault, and how often something was marked."""
    marks: list[None] = []
    try:
        return advance_until(adapter, steps, SEEN, lambda: marks.append(None)), len(marks)
    except DeviceFault as fault:
        return fault, len(marks)


def test_steps_end_where_something_is_new(device: Make) -> None:
    adapter = device(timed())
    unchanged = list(SEEN.values())
    assert waited(adapter, 0.001) == ((1, unchanged), 2)
    assert waited(adapter, 0.0005, 0.0005) == ((2, unchanged), 4)
    assert waited(adapter, 0.0001, 0.001, 5.0) == ((2, [(1, b"\1"), (1, b"\0\0")]), 3)
    assert adapter.read(0, 1) == (1, b"\1")


@pytest.mark.parametrize("steps", [(), (-1.0,), (0.1, float("nan"))])
def test_steps_that_are_none_reach_no_device(device: Make, steps: tuple[float, ...]) -> None:
    adapter = device(timed("sys.exit(3)"))
    with pytest.raises(AdapterError, match="seconds"):
        waited(adapter, *steps)
    assert adapter.read(0, 1) == (1, b"\0")


@pytest.mark.parametrize(
    ("step", "look", "marks"),
    [
        ("if passed == 1: sys.exit(3)", "pass", 0),
        ("pass", "if passed == 1: sys.exit(3)", 1),
        ("if passed == 2: sys.exit(3)", "pass", 2),
        ("pass", "if passed == 2: sys.exit(3)", 3),
    ],
)
def test_where_a_device_died_is_known(device: Make, step: str, look: str, marks: int) -> None:
    fault, came = waited(device(timed(step, look)), 0.0001, 0.0001)
    assert str(fault) == "the device ended: exit status 3"
    assert came == marks


def test_a_hang_has_the_time_of_the_step_in_which_it_is(device: Make) -> None:
    adapter = device(timed("if passed == 2: time.sleep(1000)"), hang_timeout=3.0)
    fault, marks = waited(adapter, 0.001, 0.125, 1000.0)
    assert isinstance(fault, DeviceHang)
    assert (str(fault), marks) == ("no answer within 3.125 s", 2)


ONE = '"results":[{"ok":true,"wkc":1,"data":"00"},{"ok":true,"wkc":1,"data":"0000"}]'


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        ("    {}", "neither yes nor why not"),
        ('    {"ok":true,"passed":2}', "the results of 2 calls are no list of as many"),
        (f'    {{"ok":true,{ONE}}}', "no number from 1 to 2: None"),
        (f'    {{"ok":true,"passed":true,{ONE}}}', "no number from 1 to 2: True"),
        (f'    {{"ok":true,"passed":0,{ONE}}}', "no number from 1 to 2: 0"),
        (f'    {{"ok":true,"passed":3,{ONE}}}', "no number from 1 to 2: 3"),
        (f'  {{"ok":true,"passed":1,{ONE}}}', "stopped after 1 of 2 steps, and nothing is new"),
        (f'{{"ok":true,"passed":2,{ONE}}}', "0 spaces came before the answer, for 4"),
        (f'   {{"ok":true,"passed":2,{ONE}}}', "3 spaces came before the answer, for 4"),
        (f'     {{"ok":true,"passed":2,{ONE}}}', "more than 4 spaces came for 2 steps"),
        (" " * 100_000, "more than 4 spaces came for 2 steps"),
        ('{"ok":true,"passed":1,"results":[1,2]}', "the answer is not an object: 1"),
    ],
)
def test_wrong_answers_to_steps_are_rubbish(device: Make, answer: str, reason: str) -> None:
    body = f"sys.stdout.write('{answer}' + chr(10)); sys.stdout.flush()"
    adapter = device(on_read(body).replace('!= "read"', '!= "advance_until"'))
    fault, _ = waited(adapter, 0.1, 0.2)
    assert isinstance(fault, DeviceRubbish)
    assert reason in str(fault)
    adapter.reset()


def test_a_refusal_of_steps_is_told(device: Make) -> None:
    body = """sys.stdout.write('  {"ok":false,"error":"no time"}' + chr(10)); sys.stdout.flush()"""
    adapter = device(on_read(body).replace('!= "read"', '!= "advance_until"'))
    with pytest.raises(AdapterError, match="no time"):
        waited(adapter, 0.1, 0.2)


def test_a_refusal_is_the_callers_fault(device: Make) -> None:
    adapter = device(on_read("""print('{"ok":false,"error":"no such place"}', flush=True)"""))
    with pytest.raises(AdapterError, match="no such place"):
        adapter.read(0, 1)
    assert adapter.write(0, b"\x00") == 1


def test_output_without_a_request_is_rubbish(device: Make) -> None:
    adapter = device(on_read("reply(wkc=1, data='00'); time.sleep(0.05); print(1, flush=True)"))
    adapter.read(0, 1)
    time.sleep(0.3)
    with pytest.raises(DeviceRubbish, match="output without a request"):
        adapter.write(0, b"\x00")


def test_half_a_line_is_a_crash(device: Make) -> None:
    adapter = device(on_read("sys.stdout.write('{\"ok\":tr'); sys.stdout.flush(); sys.exit(0)"))
    with pytest.raises(DeviceCrash, match="exit status 0, 8 bytes into an answer"):
        adapter.read(0, 1)


def test_a_closed_output_is_a_crash(device: Make) -> None:
    adapter = device(on_read("os.close(1); time.sleep(1000)"))
    with pytest.raises(DeviceCrash, match="closed its output and stayed"):
        adapter.read(0, 1)


def test_a_flood_of_stderr_blocks_nothing_and_is_bounded(device: Make) -> None:
    adapter = device(
        on_read("sys.stderr.write('x' * 10_000_000 + '\\nlast\\n'); reply(wkc=1, data='00')")
        .replace("reply(wkc=1", "sys.stderr.flush(); reply(wkc=1")
        .replace("data='00')", "data='00'); os._exit(9)")
    )
    assert adapter.read(0, 1) == (1, b"\x00")
    with pytest.raises(DeviceCrash, match="exit status 9; it said: last") as caught:
        read_until_fault(adapter)
    assert len(caught.value.stderr_tail) == STDERR_KEPT


def test_a_flood_of_stdout_is_rubbish(device: Make) -> None:
    adapter = device(on_read("while True: os.write(1, b'x' * 65536)"))
    with pytest.raises(DeviceRubbish, match=f"more than {MAXIMUM_LINE} bytes"):
        adapter.read(0, 1)


def test_close_ends_a_device_that_ignores_everything(device: Make) -> None:
    adapter = device(
        HEAD
        + """
signal.signal(signal.SIGTERM, signal.SIG_IGN)
if not os.fork():
    time.sleep(1000)
serve(json.loads(sys.stdin.readline()))
time.sleep(1000)
"""
    )
    adapter.read(0, 1)
    started = time.monotonic()
    adapter.close()
    assert time.monotonic() - started < 3


def test_a_stray_grandchild_that_keeps_the_pipes_does_not_stop_close(device: Make) -> None:
    adapter = device(
        HEAD
        + """
if not os.fork():
    os.setsid()
    time.sleep(4)
    os._exit(0)
"""
        + LOOP
    )
    adapter.read(0, 1)
    started = time.monotonic()
    adapter.close()
    assert time.monotonic() - started < 3


def test_the_terminals_interrupt_does_not_reach_the_device(device: Make) -> None:
    adapter = device(HEAD + LOOP)
    assert adapter.pid is not None
    assert os.getsid(adapter.pid) == adapter.pid != os.getsid(0)


def test_an_interrupt_of_the_run_leaves_no_process(device: Make, tmp_path: Path) -> None:
    asked = tmp_path / "asked"
    adapter = device(on_read(f"open({str(asked)!r}, 'w').close(); time.sleep(1000)"), 1000)
    main = threading.get_ident()

    def interrupt() -> None:
        while not asked.exists():
            time.sleep(0.01)
        signal.pthread_kill(main, signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        adapter.read(0, 1)
    thread.join()
    assert adapter.pid is None


def test_two_hundred_crashes_leave_no_descriptor_behind(device: Make) -> None:
    adapter = device(on_read("os._exit(1)"))
    before = -1
    for number in range(200):
        adapter.reset()
        with pytest.raises(DeviceFault):
            adapter.read(0, 1)
        if number == 0:
            before = descriptors()
    assert descriptors() == before
    assert threading.active_count() < 10


def test_a_command_that_does_not_exist_is_a_matter_of_set_up() -> None:
    with pytest.raises(AdapterError, match="cannot start 'no-such-program-here'"):
        ProcessAdapter(["no-such-program-here"])
    with pytest.raises(AdapterError, match="empty"):
        ProcessAdapter([])
