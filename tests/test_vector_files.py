"""Tests of vector files: how they are read, what is refused, what lint finds."""

from __future__ import annotations

import io
import json
import re
import subprocess
import sys
import textwrap
from copy import deepcopy
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any

import ijson
import jsonschema
import msgspec
import pytest

from ecatspec.conformance import cli
from ecatspec.conformance.base.devices import UserError
from ecatspec.conformance.vectors import files
from ecatspec.conformance.vectors.export import Wanted, export
from ecatspec.conformance.vectors.files import Reading, WrongError, opened
from ecatspec.conformance.vectors.lint import MOST_SHOWN, lint
from ecatspec.generators.formats import json_format
from ecatspec.generators.vectors.schema import Head, Vectors, json_schema

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    Data = dict[str, Any]
    Change = Callable[[Data], object]

TESTS = 3
SHARED_HEAD = ("rules", "clauses")


@cache
def small() -> bytes:
    """A file of a few tests, as `export` writes it."""
    whole = io.BytesIO()
    export(Wanted("reference", "quick", only=("coe",)), "json", whole)
    data = json.loads(whole.getvalue())
    tests = [test for group in data["testGroups"] for test in group["tests"]][:TESTS]
    rules = {rule for test in tests for step in test["steps"] for rule in step.get("covers", [])}
    clauses = {clause for rule in rules for clause in data["rules"][rule]}
    data["rules"] = {name: data["rules"][name] for name in data["rules"] if name in rules}
    data["clauses"] = {n: clause for n, clause in data["clauses"].items() if n in clauses}
    data["notes"] = {flag: data["notes"][flag] for test in tests for flag in test.get("flags", [])}
    data["numberOfTests"] = len(tests)
    data["testGroups"] = [{"type": "coe", "tests": tests}]
    return written(data)


def written(data: Data) -> bytes:
    """Give the bytes that `export` writes for good data."""
    found = msgspec.convert(data, Vectors)
    out = io.BytesIO()
    tests = ((group.type, test) for group in found.testGroups for test in group.tests)
    json_format.write(msgspec.convert(head_of(data), Head), tests, out)
    return out.getvalue()


def head_of(data: Data) -> Data:
    return {key: value for key, value in data.items() if key != "testGroups"}


def changed(change: Change) -> bytes:
    data = json.loads(small())
    change(data)
    return json.dumps(data).encode()


def ids(content: bytes) -> list[str]:
    return [test.id for _, test in Reading(io.BytesIO(content), "file").tests()]


def refusal(content: bytes) -> str:
    with pytest.raises(UserError) as refused:
        ids(content)
    said = str(refused.value)
    assert said.startswith("file: ")
    assert "; " in said
    assert "\n" not in said
    return said


def test_a_good_file_is_read_a_test_at_a_time() -> None:
    data = json.loads(small())
    reading = Reading(io.BytesIO(small()), "file")
    head = json.loads(msgspec.json.encode(reading.head))
    assert head == head_of(data)
    tests = reading.tests()
    for number, there in enumerate(data["testGroups"][0]["tests"]):
        layer, test = next(tests)
        assert layer == "coe"
        assert json.loads(msgspec.json.encode(test)) == there
        assert reading.place == f"testGroups[0].tests[{number}]"
    assert next(tests, None) is None


def test_the_keys_of_the_head_come_in_any_order() -> None:
    def turn(data: Data) -> None:
        keys = [key for key in data if key != "testGroups"]
        for key in (*reversed(keys), "testGroups"):
            data[key] = data.pop(key)

    assert ids(changed(turn)) == ids(small())


@pytest.mark.parametrize("backend", ["yajl2_c", "python"])
def test_every_parser_gives_the_same(monkeypatch: pytest.MonkeyPatch, backend: str) -> None:
    try:
        parser = ijson.get_backend(backend)
    except ImportError:
        pytest.skip(f"ijson is here without {backend}")
    expected = ids(small())
    monkeypatch.setattr(ijson, "basic_parse_coro", parser.basic_parse_coro)
    assert ids(small()) == expected
    start = small().index(b'"numberOfTests"')
    said = refusal(small()[:start] + b"!" + small()[start:])
    assert said.startswith((f"file: byte {start}: ", f"file: byte {start + 1}: "))
    assert refusal(small()[:-4]).startswith(f"file: byte {len(small()) - 4}: the file ends too")
    assert "UTF-8" in refusal(small()[:77] + b"\xff" + small()[77:])
    assert "no JSON that" in refusal(b'{"schema": 1' + b"0" * 5000 + b"}")


def put(*path: str | int, value: object) -> Change:
    def change(data: Data) -> None:
        *way, last = path
        part: Any = data
        for key in way:
            part = part[key]
        part[last] = value

    return change


TEST = ("testGroups", 0, "tests", 1)
STEP = (*TEST, "steps", 6)
REPLY = (*STEP, "expect", 1)
SENT = (*TEST, "steps", 5, "in")


@pytest.mark.parametrize(
    ("change", "place", "words"),
    [
        (put("schema", value="ecatspec.report"), "no test vectors", "'ecatspec.report'"),
        (put("schema_version", value=2), "schema_version", "2 is not understood, only 1 is"),
        (put("schema_version", value=True), "schema_version", "True"),
        (put("numberOfTests", value=-1), "numberOfTests", ">= 0"),
        (put("spec", "sha256", value="x"), "spec.sha256", "regex"),
        (put("rules", "x" * 500, value=[]), "rules", "a key: "),
        (lambda data: data.pop("config"), "the head", "`config`"),
        (put("config", "mailboxOut", "length", value=1.5), "config.mailboxOut.length", "whole"),
        (put("seed", value=1), "seed", "comes after testGroups, which must be the last"),
        (lambda d: d["testGroups"][0].update(more=1), "testGroups[0].more", "no key of a group"),
        (put("testGroups", 0, "type", value=""), "testGroups[0].type", "length"),
        (put("testGroups", 0, value=1), "testGroups[0]", "no object"),
        (put("testGroups", value={}), "testGroups", "no list"),
        (put(*TEST, "more", value=1), "testGroups[0].tests[1]", "unknown field `more`"),
        (put(*TEST, "tcId", value=True), "testGroups[0].tests[1].tcId", "got `bool`"),
        (put(*TEST, "id", value="coe/unknown_service/0"), "testGroups[0].tests[1].id", "twice"),
        (put(*SENT, "do", value="sing"), "testGroups[0].tests[1].steps[5].in.do", "'sing'"),
        (put(*STEP, "us", value=1e3), "testGroups[0].tests[1].steps[6].us", "whole number"),
        (put(*STEP, "us", value=10**30), "testGroups[0].tests[1].steps[6].us", "too large"),
        (
            put(*REPLY, "anyOf", 1, "mask", value="F0"),
            "testGroups[0].tests[1].steps[6].expect[1].anyOf[1].mask",
            "regex",
        ),
        (
            put(*REPLY, "kind", value="dream"),
            "testGroups[0].tests[1].steps[6].expect[1].kind",
            "'dream'",
        ),
    ],
)
def test_what_is_wrong_is_told_with_its_place(change: Change, place: str, words: str) -> None:
    said = refusal(changed(change))
    assert re.match(rf"file: {re.escape(place)}[:,] ", said)
    assert words in said
    assert len(said) < 500


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "byte 0: the file is empty"),
        (b"\0", "byte 0: this is no JSON"),
        (b"no", "byte 1: this is no JSON"),
        ('{"schema"'.encode("utf-16"), "byte 0: the file is not UTF-8"),
        (b'{"schema": "\xe2\x82', "byte 12: the file is not UTF-8"),
        (b"[]", "no JSON object"),
        (b'"x"', "no JSON object"),
        (b"{}", "it has no testGroups"),
        (b'{"conforms": 1.5}', "it begins with 'conforms'"),
        (b'{"testGroups": []}', "testGroups: comes first"),
        (b'{"schema": "ecatspec.vectors"', "ends too early"),
        (b'{"schema": "ecatspec.vectors", "schema": 1}', "schema: is there twice"),
        (b'{"schema": 1' + b"0" * 5000 + b"}", "no JSON that can be read"),
        (b'{"schema": 1e99999999999999999999999}', "no JSON that can be read"),
        (b'{"spec": {"a": 1, "a": 1}}', "spec.a: is there twice"),
        (b'{"notes": {"a": [0, {"b": 1.5}]}}', "notes.a[1].b: is no whole number"),
    ],
)
def test_what_cannot_be_read_is_refused(content: bytes, words: str) -> None:
    assert words in refusal(content)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (b'{"tcId":2,', b'{"tcId":2,"tcId":2,', "testGroups[0].tests[1].tcId: is there twice"),
        (b' "open": ', b' "opem": ', "opem: is no key of test vectors"),
        (b'"tests": [', b'"tests": [], "type": "x", "tests": [', "testGroups[0].type: is there"),
        (b'"type": "coe", ', b"", "testGroups[0].tests: comes before the type"),
        (b'"tests": [', b'"tests": 1, "x": [', "testGroups[0].tests: is no list"),
        (b"\n  ]}\n ]\n}\n", b"\n}", "no JSON"),
        (b"\n ]\n}\n", b'\n ], "more": 1}', "more: comes after testGroups"),
        (b"\n ]\n}\n", b"\n ]\n}\n{}", "no JSON"),
    ],
)
def test_changed_texts_are_refused(old: bytes, new: bytes, words: str) -> None:
    assert small().count(old) == 1
    assert words in refusal(small().replace(old, new))


def test_half_a_character_is_refused() -> None:
    with pytest.raises(WrongError, match="half a character"):
        Reading(io.BytesIO(small()), "file")._value("x", 1, ("string", "\ud800"))  # noqa: SLF001


def test_a_part_that_is_too_large_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, size, words in [
        ("MOST_VALUES", 100, "100 values"),
        ("LONGEST_PART", 5000, "5000 bytes"),
        ("MOST_TESTS", 2, "more than 2 tests"),
        ("DEEPEST", 10, "more than 10 objects"),
    ]:
        with monkeypatch.context() as patch:
            patch.setattr(files, name, size)
            assert words in refusal(small())


HOSTILE = textwrap.dedent(
    """
    import resource, sys
    from ecatspec.conformance.base.devices import UserError
    from ecatspec.conformance.vectors.files import Reading

    limit = 200 << 20
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))

    class Endless:
        def __init__(self, start, repeated):
            self.start, self.repeated, self.left = start, repeated, 1 << 30
        def read(self, size):
            if self.start:
                start, self.start = self.start, b""
                return start
            self.left -= size
            return self.repeated * (size // len(self.repeated)) if self.left > 0 else b""
        def seek(self, offset):
            raise OSError

    head = sys.stdin.buffer.read()
    group = head + b'[{"type": "x", "tests": ['
    for start, repeated in [
        (b"", b"["), (b'{"a":', b"["), (b'{"schema":', b"["), (head, b"["), (group, b"["),
        (b"", b" "), (b"", b'{"schema":'), (b'{"schema": "', b"a"), (b'{"schema": 1', b"0"),
        (b'{"', b"a"), (b'{"header":["', b'a","'), (b'{"header":[0', b",[]"),
        (group + b'{"id":[0', b",0"), (group + b"{}", b",{}"), (head + b'[{"', b'"'),
    ]:
        try:
            for test in Reading(Endless(start, repeated), "file").tests():
                pass
        except UserError as error:
            print(error)
    """
)


def test_a_gigabyte_of_anything_is_refused_in_little_memory() -> None:
    head = small()[: small().index(b'"testGroups": ') + len(b'"testGroups": ')]
    done = subprocess.run(
        [sys.executable, "-P", "-c", HOSTILE], input=head, capture_output=True, check=False
    )
    assert done.stderr == b""
    lines = done.stdout.decode().splitlines()
    assert len(lines) == 15
    assert all(line.startswith("file: ") and "; " in line for line in lines)
    assert sum("lie in each other" in line for line in lines) == 3


@pytest.mark.parametrize("kind", ["missing", "folder", "zero byte"])
def test_a_path_that_is_no_file(tmp_path: Path, kind: str) -> None:
    name = {"missing": "none.json", "folder": ".", "zero byte": "a\0b"}[kind]
    with pytest.raises(UserError, match="give a file of test vectors"), opened(tmp_path / name):
        pass


def test_a_file_that_goes_bad_while_it_is_read() -> None:
    class Failing(io.BytesIO):
        def read(self, size: int | None = -1, /) -> bytes:
            if self.tell():
                raise OSError(5, "Input/output error")
            return super().read(size)

    with pytest.raises(UserError, match=r"byte 8192: cannot be read \(Input/output error\)"):
        list(Reading(Failing(small()), "file").tests())


# --- the schema -----------------------------------------------------------------------------------


def validator() -> jsonschema.Draft202012Validator:
    return jsonschema.Draft202012Validator(json_schema())


def test_the_schema_is_shipped() -> None:
    shipped = resources.files("ecatspec.generators").joinpath("vectors.schema.json")
    assert json.loads(shipped.read_text("utf-8")) == json_schema(), (
        "make it again: ecatspec schema vectors > generators/vectors.schema.json"
    )
    jsonschema.Draft202012Validator.check_schema(json_schema())


def places(
    data: Data | list[Any], path: tuple[str | int, ...] = ()
) -> Iterator[tuple[str | int, ...]]:
    """Give the way to every part."""
    for key, part in data.items() if isinstance(data, dict) else enumerate(data):
        yield (*path, key)
        if isinstance(part, dict | list):
            yield from places(part, (*path, key))


def test_schema_and_reader_agree() -> None:
    data = json.loads(small())
    data["testGroups"][0]["tests"] = data["testGroups"][0]["tests"][:1]
    for name in ("open", *SHARED_HEAD):
        data[name] = dict(list(data[name].items())[:1])
    judge = validator()
    assert judge.is_valid(data)
    values: tuple[object, ...] = (None, True, 1.5, -1, 1 << 40, "x", "", [], {}, ["x"], {"x": "x"})
    outcomes = {True: 0, False: 0}
    for number, path in enumerate(places(data)):
        for value in (values[number % len(values)], values[(number + 4) % len(values)], "away"):
            other = deepcopy(data)
            *way, last = path
            part: Any = other
            for key in way:
                part = part[key]
            if value == "away":
                del part[last]
            elif isinstance(part[last], dict) and number % 2:
                part[last]["more"] = value
            else:
                part[last] = value
            try:
                ids(json.dumps(other).encode())
                read = True
            except UserError:
                read = False
            assert read == judge.is_valid(other), (path, value)
            outcomes[read] += 1
    assert min(outcomes.values()) > 50


# --- lint -----------------------------------------------------------------------------------------


def found(tmp_path: Path, content: bytes) -> list[str]:
    file = tmp_path / "file.json"
    file.write_bytes(content)
    findings = lint(file)
    assert findings.count == len(findings.lines)
    assert all(line.startswith(f"{file}: ") for line in findings.lines)
    return [line.removeprefix(f"{file}: ") for line in findings.lines]


def test_lint_finds_nothing_in_what_export_writes(tmp_path: Path) -> None:
    assert found(tmp_path, small()) == []


def extend(*path: str | int, value: object) -> Change:
    def change(data: Data) -> None:
        part: Any = data
        for key in path[:-1]:
            part = part[key]
        part.setdefault(path[-1], []).append(value)

    return change


ANSWER = (*REPLY, "anyOf", 0)
LOOK = (*STEP, "expect", 0)


@pytest.mark.parametrize(
    ("change", "place", "words"),
    [
        (put("numberOfTests", value=9), "numberOfTests", "9 are stated, 3 there"),
        (put(*TEST, "tcId", value=7), "testGroups[0].tests[1].tcId", "7 is not the place 2"),
        (extend(*TEST, "flags", value="odd"), ".flags[1]", "no note 'odd'"),
        (put("notes", "a", value={"bugType": "", "description": ""}), "notes.a", "no test has"),
        (extend(*TEST, "clauses", value="ZZ-01"), "clauses[", "no clause 'ZZ-01'"),
        (extend("rules", "al.init_to_preop", value="ZZ-01"), "rules.al.init_to", "'ZZ-01'"),
        (extend(*STEP, "covers", value="al.zz"), ".steps[6].covers[2]", "no rule 'al.zz'"),
        (put(*TEST, "requires", value=True), ".requires", "not `configuration`"),
        (put(*TEST, "needs", value=["ds402.fault"]), ".needs", "raise nothing"),
        (put(*TEST, "result", value="valid"), ".result", "a step can end"),
        (put(*ANSWER, "mask", value="ff"), ".anyOf[0].mask", "1 bytes, and the value has 10"),
        (put(*ANSWER, "mask", value="00" * 10), ".anyOf[0].value", "that the mask leaves open"),
        (put(*ANSWER, "atLeast", value=11), ".anyOf[0].atLeast", "11 bytes at least"),
        (put(*ANSWER, "value", value="0400" + "00" * 300), ".value", "do not fit"),
        (put(*REPLY, "symbol", value="emergency"), "expect[1].symbol", "bytes are mailbox_error"),
        (put(*LOOK, "address", value=65535), ".expect[0]", "6 bytes at 65535 go beyond 65536"),
        (put(*LOOK, "length", value=5), ".anyOf[0].value", "6 bytes, and 5 are read"),
        (put(*SENT, "symbol", value="emergency"), "steps[5].in.symbol", "emergency, and the"),
        (put(*SENT, "address", value=5), "steps[5].in.address", "5 is not that of the mailbox"),
        (put(*SENT, "data", value="00" * 200), ".in.data", "200 bytes do not fit"),
        (put(*TEST, "steps", 1, "in", "data", value=""), ".steps[1].in", "there are no bytes"),
        (put(*TEST, "steps", 1, "in", "address", value=65535), ".steps[1].in", "go beyond"),
        (
            put(*STEP, "cycle", value={"address": 65535, "data": "0000", "us": 1}),
            "steps[6].cycle",
            "2 bytes at 65535",
        ),
        (
            put(*TEST, "steps", 1, "cycle", value={"address": 1, "data": "00", "us": 1}),
            "steps[1].cycle",
            "while no time passes",
        ),
        (put(*TEST, "steps", 1, "early", value=True), "steps[1].early", "nothing is waited for"),
        (put("config", "mailboxIn", "length", value=65000), "config.mailboxIn", "go beyond"),
        (put("config", "mailboxLength", "address", value=5), "config.mailboxLength", "beyond 6"),
        (put("config", "mailboxFullMask", value="00"), "config.mailboxFullMask", "no mask of 1"),
        (put("config", "passOver", value=[{"value": "01", "mask": "00"}]), "passOver[0]", "open"),
    ],
)
def test_lint_finds(tmp_path: Path, change: Change, place: str, words: str) -> None:
    data = json.loads(small())
    change(data)
    lines = found(tmp_path, written(data))
    assert any(place in line.partition(": ")[0] and words in line for line in lines), lines
    assert all("; " in line for line in lines)
    assert len(lines) <= 3


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        (b' "spec"', b'  "spec"', 5, '\' "spec"'),
        (b'"schema_version": 1,', b'"schema_version" : 1,', 3, "' : 1"),
        (b'{"tcId":2,', b'{"tcId": 2,', None, "' 2,"),
        (b'"counter":"new"', b'"otherwise":null,"counter":"new"', None, "otherwise"),
        (b"\n ]\n}\n", b"\n ]\n}\n\n", None, "'\\n'"),
        (b"\n ]\n}\n", b"\n ]\n}", None, "''"),
        (b"\n", b"\r\n", 1, "'\\r\\n"),
    ],
)
def test_lint_names_the_first_line_that_export_would_write_otherwise(
    tmp_path: Path, old: bytes, new: bytes, line: int | None, words: str
) -> None:
    place = small().rindex(old) if line is None else small().index(old)
    content = small()[:place] + new + small()[place + len(old) :]
    line = line or small().count(b"\n", 0, place + len(old) - (old[-1:] == b"\n")) + 1
    (said,) = found(tmp_path, content)
    assert re.match(r"line \d+: ", said)
    assert abs(int(said[5:].partition(":")[0]) - line) <= 1
    assert words in said


def test_lint_goes_on_after_a_test_that_is_wrong(tmp_path: Path) -> None:
    def change(data: Data) -> None:
        tests = data["testGroups"][0]["tests"]
        tests[0]["comment"] = 1
        tests[1]["steps"][0]["us"] = 1.5
        tests[2]["tcId"] = 7

    first, second, third = sorted(found(tmp_path, changed(change)))[-3:]
    assert first.startswith("testGroups[0].tests[0].comment: Expected `str`")
    assert second.startswith("testGroups[0].tests[1].steps[0].us: is no whole number")
    assert third.startswith("testGroups[0].tests[2].tcId: 7 is not the place 3")


def test_lint_shows_so_many_and_counts_the_rest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "file.json"
    data = json.loads(small())
    data["testGroups"][0]["tests"][0]["clauses"] = ["ZZ-01"] * (MOST_SHOWN + 20)
    file.write_bytes(written(data))
    assert cli.main(["vectors", "lint", str(file)]) == 1
    *lines, last = capsys.readouterr().out.splitlines()
    assert len(lines) == MOST_SHOWN
    assert last == f"{file}: 20 more"
