"""Tests of generators/formats: what each form of the vectors holds."""

from __future__ import annotations

import csv
import hashlib
import io
import os
import shutil
import subprocess
from functools import cache
from typing import TYPE_CHECKING

import dpkt
import dpkt.pcapng
import msgspec
import pytest

from ecatspec.conformance.capture.files import packets
from ecatspec.conformance.vectors.export import Wanted, export
from ecatspec.generators.formats import FORMATS
from ecatspec.generators.formats.pcapng_format import STATION_ADDRESS
from ecatspec.generators.vectors.schema import (
    SCHEMA,
    SCHEMA_VERSION,
    Allowed,
    Area,
    Clause,
    Config,
    Cycle,
    Full,
    Generator,
    Guarantee,
    Head,
    Local,
    Mail,
    Note,
    Read,
    Send,
    Spec,
    Step,
    Vectors,
    Write,
)
from ecatspec.generators.vectors.schema import Test as OneTest
from ecatspec.generators.vectors.symbols import words_of
from ecatspec.model.core.compilation import Model
from ecatspec.model.esc.wire import Datagram, Wire, wire_format
from ecatspec.spec.language.ir import Level
from ecatspec.spec.language.load import load_device

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

STATUS = 0x0130
OUT, BACK, FULL = Area(0x1000, 64), Area(0x1080, 48), Area(0x080D, 1)
UPLOAD = "0a0000000013002040001020"  # zeros at the end are left out
ABORT = "0a00000000030020800010200000" + "0206"
UNTOUCHED = "ffff0000000f00f0ffffffffffffffff"
ERROR = "04000000000001000000"
INPUTS = "400000000802", "6f00ffffffff"  # might be a message in a mailbox
ERROR_MASK = "ffff0000000fffff0000"
VAGUE = "0000000000030020"
VAGUE_MASK = "00000000000f00f0"


def make_head(**changed: object) -> Head:
    fields: dict[str, object] = {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "generator": Generator("ecatspec", "1.2.3", "quick", seed=7),
        "spec": Spec("reference", "a | b", load_device("reference").digest),
        "numberOfTests": 2,
        "header": ["what is to be known"],
        "notes": {"other_ways": Note("other ways", "there is another way")},
        "guarantee": [Guarantee("al/*", "h_method", 6, 1, "solver")],
        "choices": {"repeat_service": "served"},
        "open": {"bootstrap": "unsupported"},
        "config": Config(
            mailboxOut=OUT,
            mailboxIn=BACK,
            mailboxFull=FULL,
            mailboxFullMask="08",
            mailboxHead=6,
            mailboxLength=Area(0, 2),
            mailboxCounter=Area(5, 1),
            mailboxCounterMask="70",
            requestUs=100_000,
            passOver=[
                Allowed("0a0000000003001000000000000000" + "00", "ffff0000000f00f0" + "00" * 8)
            ],
        ),
        "rules": {"al.to_init": ["AL-15", "AL-18"]},
        "clauses": {"AL-15": Clause(Level.MUST, "INIT is always reached", "facts 2.3")},
    }
    return msgspec.convert(fields | changed, Head)


STARTED = Read(STATUS, 6, "al_status al_status_code", [Allowed("110000001600", "3f000000ff00")])
NO_MAIL = Mail([], none="passes")
SUITE = (
    (
        "al",
        OneTest(
            tcId=1,
            id="al/one",
            comment='the "first", with a comma',
            flags=["other_ways"],
            clauses=["AL-15"],
            needs=["al.sync_lost"],
            result="acceptable",
            steps=[
                Step(expect=[STARTED, NO_MAIL]),
                Step(
                    given=Write(0x0120, "1100", "al_control", otherwise="ends"),
                    us=3_000_000,
                    early=True,
                    expect=[STARTED],
                    covers=["al.to_init"],
                ),
                Step(given=Write(0x0130, "0100", "al_status", counter=0), us=1500),
                Step(given=Local("al.sync_lost"), us=2, expect=[Full(full=True, otherwise="ends")]),
                Step(
                    us=250_000,
                    cycle=Cycle(0x1100, "0f000000", 100_000),
                    expect=[
                        Read(0x1400, 6, "inputs", [Allowed(*INPUTS)], refused="ends"),
                    ],
                ),
            ],
        ),
    ),
    (
        "sdo",
        OneTest(
            tcId=2,
            id="sdo/two",
            comment="mail",
            requires=True,
            steps=[
                Step(
                    given=Send(OUT.address, UPLOAD, "sdo_upload_request"),
                    us=10,
                    expect=[
                        Mail(
                            [
                                Allowed(VAGUE, VAGUE_MASK, atLeast=8),
                                Allowed(ABORT, UNTOUCHED),
                                Allowed(ERROR, ERROR_MASK, effect="ends"),
                            ],
                            symbol="sdo_abort",
                            none="ends",
                            counter="new",
                        ),
                        Mail([Allowed(ERROR, ERROR_MASK, effect="ends")], none="passes"),
                        Full(full=False),
                    ],
                ),
                Step(expect=[Read(0x0400, 2, "watchdog_divider", [], refused="passes")]),
            ],
        ),
    ),
)


def written(form: str, head: Head | None = None) -> bytes:
    out = io.BytesIO()
    FORMATS[form].write(head or make_head(), iter(SUITE), out)
    assert not out.closed
    return out.getvalue()


@cache
def exported(form: str) -> bytes:
    """Give a small suite of a device."""
    out = io.BytesIO()
    export(Wanted("reference", "quick", only=("coe",)), form, out)
    return out.getvalue()


# --- all formats ----------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMATS)
def test_the_same_vectors_are_the_same_bytes(form: str) -> None:
    data = written(form)
    assert written(form) == data
    if FORMATS[form].text:
        assert data.decode().isascii()


STREAMING = [form for form in FORMATS if form != "c"]  # its tables come last: equal rows are kept


@pytest.mark.parametrize("form", STREAMING)
def test_a_test_is_written_before_the_next_but_one_is_asked_for(form: str) -> None:
    out = io.BytesIO()
    sizes = []

    def tests() -> Iterator[tuple[str, OneTest]]:
        for number in range(100):
            sizes.append(out.tell())
            yield SUITE[number % 2]

    FORMATS[form].write(make_head(), tests(), out)
    assert all(second > first for first, second in zip(sizes, sizes[2:], strict=False))


@pytest.mark.parametrize("form", FORMATS)
def test_every_format_names_the_texts_that_it_comes_from(form: str) -> None:
    assert load_device("reference").digest.encode() in written(form)


# --- words ----------------------------------------------------------------------------------------


def test_words_leave_out_what_may_be_anything() -> None:
    words = words_of(make_head())
    registers = "al_status al_status_code"
    free = Allowed("010000000000", "3f0000000000")
    assert words.say_allowed(registers, free) == "al_status: state 1 INIT, error no, identified no"
    assert words.say_allowed(registers, Allowed("00" * 6, "00" * 6)) == "anything"
    part = words.say_allowed(registers, Allowed("010000000000", "010000000000"))
    assert part == "al_status: state 1 INIT in the bits 0x1"
    assert words.say_allowed("inputs", Allowed("400012", "6f00ff")) == "inputs 40/6F ?? 12"
    abort = words.say_allowed("sdo_abort", Allowed(ABORT, UNTOUCHED))
    assert abort.endswith("index 0x1000, subindex 32, code 0x06020000 object_does_not_exist")
    assert "counter" not in abort
    assert words.say_allowed("coe", Allowed(VAGUE, VAGUE_MASK, atLeast=8)) == (
        "coe: service 2 sdo_request; at least 8 bytes"
    )
    upload = "00000000000300304100100004000000", "00000000000f00f0" + "ff" * 8
    assert words.say_allowed("sdo_upload_normal", Allowed(*upload, atLeast=16)).endswith(
        "index 0x1000, subindex 0, size 0x00000004; at least 16 bytes"
    )


def test_words_of_what_is_known_say_all_of_it() -> None:
    words = words_of(make_head())
    assert words.say("sdo_upload_request", bytes.fromhex(UPLOAD)) == (
        "sdo_upload_request: counter 1, size_indicated no, complete_access no, "
        "index 0x1000, subindex 32"
    )
    assert words.say("al_control", b"\x11\0") == (
        "al_control: requested 1 INIT, acknowledge yes, identification no"
    )
    assert words.say("nothing", bytes.fromhex(ERROR)).startswith("mailbox_error: ")


def test_words_of_what_no_text_knows_are_hexadecimal() -> None:
    words = words_of(make_head())
    assert words.say("al_control", b"\x11") == "al control 11"
    assert words.say("process_data", b"\x0f\0") == "process data 0F 00"
    assert words.say("no_such_register al_status", b"\1") == "no such register al status 01"
    assert words.say("bytes", b"\1\2") == "01 02"
    assert words.say("memory", bytes(range(30))).endswith("1A 1B 1C 1D (30 bytes)")


def test_words_are_those_of_the_text_that_the_file_names() -> None:
    assert words_of(make_head()).model.protocol.name == "reference"
    other = hashlib.sha256(b"").hexdigest()
    for name in ("reference", "a-device-of-ones-own"):
        assert words_of(make_head(spec=Spec(name, "", other))).model.protocol.name == "standard"


# --- csv ------------------------------------------------------------------------------------------


def rows_of(data: bytes) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(data.decode(), newline="")))


def test_csv_has_a_row_for_each_expectation() -> None:
    data = written("csv")
    assert data.count(b"\r\n") == data.count(b"\n") == 1 + 6 + 4
    rows = rows_of(data)
    assert [(row["test"], row["step"], row["expectation"]) for row in rows] == [
        ("al/one", "1", "1"),
        ("al/one", "1", "2"),
        ("al/one", "2", "1"),
        ("al/one", "3", ""),
        ("al/one", "4", "1"),
        ("al/one", "5", "1"),
        ("sdo/two", "1", "1"),
        ("sdo/two", "1", "2"),
        ("sdo/two", "1", "3"),
        ("sdo/two", "2", "1"),
    ]
    assert rows[0]["comment"] == 'the "first", with a comma'
    assert rows[1]["comment"] == ""
    assert [row["do"] for row in rows] == (
        ["look", "", "write", "write", "local", "look", "send", "", "", "look"]
    )


def test_csv_says_all_that_a_verdict_needs() -> None:
    rows = rows_of(written("csv"))
    write, refused, local, cyclic, mail, none, full = (rows[n] for n in (2, 3, 4, 5, 6, 7, 8))
    told = ("address", "data", "counter", "otherwise", "us", "early", "clauses")
    assert [write[name] for name in told] == (
        ["0x0120", "1100", "1", "ends", "3000000", "1", "AL-15 AL-18"]
    )
    assert (refused["counter"], refused["otherwise"]) == ("0", "")
    assert (local["symbol"], local["alternatives"], local["anythingElse"]) == (
        ("al.sync_lost", "08/08/passes", "ends")
    )
    assert [cyclic[name] for name in ("cycleAddress", "cycleData", "cycleUs", "nothing")] == (
        ["0x1100", "0f000000", "100000", "ends"]
    )
    assert mail["alternatives"] == (
        f"{VAGUE}/{VAGUE_MASK}/passes/8 {ABORT}/{UNTOUCHED}/passes {ERROR}/{ERROR_MASK}/ends"
    )
    assert [mail[name] for name in ("kind", "readAddress", "readLength", "mailCounter")] == (
        ["mail", "0x1080", "48", "new"]
    )
    assert (mail["nothing"], none["nothing"], full["alternatives"]) == (
        ("ends", "passes", "00/08/passes")
    )


# --- markdown -------------------------------------------------------------------------------------


def test_markdown_says_what_the_tests_rest_on() -> None:
    text = written("markdown").decode()
    assert text.startswith("# Test vectors for reference\n\na \\| b\n")
    for line in (
        "- made by: ecatspec 1.2.3",
        "- depth: quick, all layers, seed 7",
        "- mailbox out: 64 bytes at 0x1000",
        "- repeat_service = served",
        "- bootstrap = unsupported",
        "| al/\\* | h_method | 6 | 1 | solver |",
        "- **other_ways**: there is another way",
        "- emergency",
        "| AL-15 | must | INIT is always reached | facts 2.3 |",
    ):
        assert line in text.splitlines(), line


def test_markdown_says_each_step_in_words() -> None:
    lines = written("markdown").decode().splitlines()
    assert "## al" in lines
    assert "### 1. al/one" in lines
    assert "- requires: test 1 must have passed" in lines
    status = (
        "**read 0x0130, 6 bytes**: al_status: state 1 INIT, error yes, identified no; "
        "al_status_code: code 0x0016 invalid_mailbox_configuration in the bits 0xFF"
    )
    control = "al_control: requested 1 INIT, acknowledge yes, identification no"
    refused = "al_status: state 1 INIT, error no, identified no; must be refused"
    cycle = "with process data 0F 00 00 00 written to 0x1100 every 100 ms"
    inputs = "**read 0x1400, 6 bytes**: inputs 40/6F ?? 00 00 08 02<br>or refused (**ends**)"
    for cells in (
        ("1", "only look", "at once", f"{status}<br>**message**: none"),
        ("2", f"write 0x0120: {control}; may be refused (**ends**)", "within 3 s", status),
        ("3", f"write 0x0130: {refused}", "after 1.5 ms", ""),
        (
            "4",
            "make al.sync_lost happen",
            "after 2 us",
            "**mailbox, not read**: full<br>or empty (**ends**)",
        ),
        ("5", "only look", f"after 250 ms, {cycle}", inputs),
        ("2", "only look", "at once", "**read 0x0400, 2 bytes**: refused"),
    ):
        assert f"| {' | '.join(cells)} |" in lines, cells


def test_markdown_names_every_alternative() -> None:
    text = written("markdown").decode()
    row = next(line for line in text.splitlines() if "| send " in line)
    looked = row.split(" | ")[3].removesuffix(" |")
    assert looked.split("<br>") == [
        "**message**: coe: service 2 sdo_request; at least 8 bytes",
        "or sdo_abort: flags 0, index 0x1000, subindex 32, code 0x06020000 object_does_not_exist",
        "or mailbox_error (**ends**)",
        "or none (**ends**)",
        "**message, any counter**: mailbox_error (**ends**)",
        "or none",
        "**mailbox, not read**: empty",
    ]


def test_a_whole_export_has_all_its_tests() -> None:
    vectors = msgspec.json.decode(exported("json"), type=Vectors)
    tests = [test for group in vectors.testGroups for test in group.tests]
    names = [test.id for test in tests]
    assert list(dict.fromkeys(row["test"] for row in rows_of(exported("csv")))) == names
    lines = exported("markdown").decode().splitlines()
    assert [line.split()[-1] for line in lines if line.startswith("### ")] == names
    steps = [line for line in lines if line.startswith("| ") and line[2].isdigit()]
    assert len(steps) == sum(len(test.steps) for test in tests)
    assert {line.count(" | ") for line in steps} == {3}


# --- pcapng ---------------------------------------------------------------------------------------


def decoded(data: bytes) -> list[tuple[int, bool, Datagram]]:
    """Microseconds, whether it came back, and the datagram of each packet."""
    decoder = Wire(wire_format(Model(load_device("reference"))))
    found = []
    for packet in packets(io.BytesIO(data)):
        payload = decoder.payload(packet.data)
        assert payload is not None
        datagrams, good = decoder.datagrams(payload)
        assert good
        (datagram,) = datagrams
        found.append((packet.nanoseconds // 1000, decoder.source(packet.data)[1], datagram))
    return found


def test_pcapng_has_requests_and_the_answers_expected() -> None:
    seen = [
        (time, back, d.command.name, d.ado, d.data.hex(), d.working_counter)
        for time, back, d in decoded(written("pcapng"))
    ]

    def pair(
        time: int, command: str, address: int, data: str, counter: int = 1
    ) -> list[tuple[object, ...]]:
        asked = data if command.endswith("WR") else "0" * len(data)
        return [
            (time, False, command, address, asked, 0),
            (time, True, command, address, data, counter),
        ]

    first, second = 3_000_000, 3_251_502
    assert seen == [
        *pair(0, "FPRD", STATUS, "110000001600"),
        *pair(0, "FPRD", FULL.address, "00"),
        *pair(0, "FPWR", 0x0120, "1100"),
        *pair(first, "FPRD", STATUS, "110000001600"),
        *pair(first, "FPWR", STATUS, "0100", 0),
        (first + 1500, False, "NOP", 0, "", 0),
        *pair(first + 1502, "FPRD", FULL.address, "08"),
        *pair(first + 101_502, "BWR", 0x1100, "0f000000"),
        *pair(second, "BRD", 0x1400, INPUTS[0]),
        *pair(second, "FPWR", OUT.address, UPLOAD.ljust(2 * OUT.length, "0")),
        *pair(second + 10, "FPRD", BACK.address, ABORT.ljust(2 * BACK.length, "0")),
        *pair(second + 10, "FPRD", FULL.address, "00"),
        *pair(second + 10, "FPRD", FULL.address, "00"),
        *pair(second + 10, "FPRD", 0x0400, "0000", 0),
    ]


def test_pcapng_addresses_one_device_and_numbers_its_requests() -> None:
    every = [datagram for _, _, datagram in decoded(written("pcapng"))]
    positions: dict[str, set[int]] = {}
    for each in every:
        positions.setdefault(each.command.name, set()).add(each.adp)
    station = {STATION_ADDRESS}
    assert positions == {"FPRD": station, "FPWR": station, "BRD": {0, 1}, "BWR": {0, 1}, "NOP": {0}}
    asked = [d.index for d in every if d.command.name != "NOP"]
    assert asked == [n for n in range(1, len(every) // 2 + 1) for _ in range(2)]


def test_pcapng_cuts_what_no_datagram_can_hold() -> None:
    out = io.BytesIO()
    long = Step(expect=[Read(0, 4000, "memory", [Allowed("ab" * 4000, "ff" * 4000)])])
    FORMATS["pcapng"].write(make_head(), [("al", OneTest(1, "al/long", "", [long]))], out)
    answers = [datagram for _, back, datagram in decoded(out.getvalue()) if back]
    assert [(d.ado, len(d.data)) for d in answers] == [(0, 1486), (1486, 1486), (2972, 1028)]
    assert b"".join(d.data for d in answers) == b"\xab" * 4000


def comments_of(data: bytes) -> list[list[str]]:
    """The comments of each packet, read block by block."""
    found, at = [], 0
    while at < len(data):
        kind, size = (int.from_bytes(data[at + n : at + n + 4], "little") for n in (0, 4))
        if kind == dpkt.pcapng.PCAPNG_BT_EPB:
            block = dpkt.pcapng.EnhancedPacketBlockLE(data[at : at + size])
            comment = dpkt.pcapng.PCAPNG_OPT_COMMENT
            found.append([each.text for each in block.opts if each.code == comment])
        at += size
    return found


def test_pcapng_comments_say_what_a_packet_is() -> None:
    comments = comments_of(written("pcapng"))
    assert comments[0] == [
        "al/one step 1 expect",
        'test 1 al/one: the "first", with a comma\nflags: other_ways\nclauses: AL-15',
    ]
    assert comments[1][0].startswith("al/one step 1 expect: al_status: state 1 INIT, error yes")
    assert b"Choices that the tests take for granted: repeat_service = served." in written("pcapng")
    assert [each for each in comments if len(each) > 1] == [
        comments[0],
        ["sdo/two step 1 in: sends " + words(UPLOAD), "test 2 sdo/two: mail"],
    ]
    flat = [each[0] for each in comments]
    for said in (
        "al/one step 2 in: writes al_control: requested 1 INIT, acknowledge yes, identification no",
        "al/one step 2 in: taken",
        "al/one step 3 in: refused",
        "al/one step 4 in: local event al.sync_lost in the device",
        "al/one step 4 expect: a message waits, which is not read",
        "al/one step 5 cycle: process data, every 100000 us for 250000 us",
        "sdo/two step 1 expect: no message; or another",
        "sdo/two step 2 expect: refused",
    ):
        assert said in flat, said
    assert any(said.endswith("object_does_not_exist; or one of 2 others") for said in flat)


def words(digits: str) -> str:
    return words_of(make_head()).say("sdo_upload_request", bytes.fromhex(digits))


@pytest.mark.parametrize("source", ["made by hand", "exported"])
def test_wireshark_reads_the_capture(source: str, tmp_path: Path) -> None:
    tshark = shutil.which("tshark")
    if tshark is None:
        pytest.skip("tshark is not installed; apt-get install tshark")
    data = written("pcapng") if source == "made by hand" else exported("pcapng")
    capture = tmp_path / "vectors.pcapng"
    capture.write_bytes(data)
    fields = ("frame.number", "ecat.cnt", "_ws.malformed", "frame.comment")
    command = [tshark, "-n", "-r", str(capture), "-T", "fields", "-E", "occurrence=f"]
    run = subprocess.run(
        [*command, *(part for name in fields for part in ("-e", name))],
        env={**os.environ, "WIRESHARK_CONFIG_DIR": str(tmp_path / "settings")},
        capture_output=True,
        text=True,
        check=True,
    )
    seen = [line.split("\t") for line in run.stdout.splitlines()]
    assert [int(line[0]) for line in seen] == list(range(1, len(seen) + 1))
    assert [int(line[1]) for line in seen] == [d.working_counter for _, _, d in decoded(data)]
    assert [line[3] for line in seen] == [comment[0] for comment in comments_of(data)]
    # What a test gets wrong on purpose is malformed, with the answer that echoes it.
    odd = {line[3].partition(" in: ")[0] for line in seen if line[2]}
    twice = (f"coe/unknown_service_twice/3 step {step}" for step in (6, 8))
    assert odd == (set() if source == "made by hand" else {"coe/unknown_service/3 step 6", *twice})


# --- c --------------------------------------------------------------------------------------------

MAIN = """\
#include "vectors.h"
static void reset(void *context) { (void)context; }
static int get(void *context, uint16_t address, uint8_t *data, size_t length)
{ (void)context; (void)address; (void)data; (void)length; return 0; }
static int put(void *context, uint16_t address, const uint8_t *data, size_t length)
{ (void)context; (void)address; (void)data; (void)length; return 0; }
static void advance(void *context, uint32_t microseconds) { (void)context; (void)microseconds; }
int main(void)
{
    const struct ecatspec_target target = { NULL, reset, get, put, advance, NULL };
    unsigned failed = 0;
    size_t number;
    for (number = 0; number < ECATSPEC_TESTS; number++)
        failed += ecatspec_run(&target, number).outcome == ECATSPEC_FAILED;
    return (int)failed;
}
"""


# The device of the program refuses everything, and may in the exported tests: they end early.
@pytest.mark.parametrize(("source", "failed"), [("made by hand", 1), ("exported", 0)])
def test_the_header_compiles_without_a_warning(source: str, failed: int, tmp_path: Path) -> None:
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    header = written("c") if source == "made by hand" else exported("c")
    (tmp_path / "vectors.h").write_bytes(header)
    (tmp_path / "main.c").write_text(MAIN)
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
    command = [compiler, *flags, str(tmp_path / "main.c"), "-o", str(tmp_path / "main")]
    made = subprocess.run(command, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    assert subprocess.run([str(tmp_path / "main")], check=False).returncode == failed
