"""Tests of examples/replay_js: it judges as `ecatspec replay` does."""

from __future__ import annotations

import io
import json
import random
import re
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from ecatspec.conformance.adapters.process import ProcessAdapter
from ecatspec.conformance.base.verdict import Outcome
from ecatspec.conformance.vectors.export import Wanted, export
from ecatspec.conformance.vectors.replay import Player
from ecatspec.generators.vectors.schema import Vectors
from ecatspec.model.core.compilation import Model
from ecatspec.spec.language.load import load_device

if TYPE_CHECKING:
    from collections.abc import Callable

NODE = shutil.which("node")
SCRIPT = Path(__file__).resolve().parent.parent / "examples" / "replay_js" / "replay.mjs"
WORDS = {
    Outcome.PASS: "passed",
    Outcome.SKIPPED: "skipped",
    Outcome.WARNING: "warned",
    Outcome.FAIL: "failed",
    Outcome.CRASH: "failed",
}

pytestmark = [
    pytest.mark.skipif(NODE is None, reason="node is not installed: the example needs it"),
    pytest.mark.xdist_group("replay_js"),
]


def virtual(fault: str = "") -> list[str]:
    options = {"fault": fault} if fault else {}
    arguments = json.dumps({"device": "reference", "options": options})
    return [sys.executable, "-m", "ecatspec.conformance.adapters.host", "model", arguments]


@cache
def exported() -> str:
    out = io.BytesIO()
    export(Wanted("reference", "quick", only=("al", "mailbox")), "json", out)
    return out.getvalue().decode()


def vectors(layer: str) -> dict[str, Any]:
    """The part of the file that is about one layer."""
    made: dict[str, Any] = json.loads(exported())
    made["testGroups"] = [group for group in made["testGroups"] if group["type"] == layer]
    return counted(made)


def some(number: int, layer: str = "al") -> dict[str, Any]:
    """A file of the first tests of a layer."""
    made = vectors(layer)
    tests = [test for group in made["testGroups"] for test in group["tests"]]
    made["testGroups"] = [{"type": layer, "tests": tests[:number]}]
    return counted(made)


def counted(made: dict[str, Any]) -> dict[str, Any]:
    made["numberOfTests"] = sum(len(group["tests"]) for group in made["testGroups"])
    return made


def replayed(path: Path, *command: str) -> subprocess.CompletedProcess[str]:
    assert NODE is not None
    return subprocess.run(
        [NODE, str(SCRIPT), str(path), *command],
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )


def written(tmp_path: Path, made: object) -> Path:
    path = tmp_path / "vectors.json"
    path.write_text(json.dumps(made), encoding="utf-8")
    return path


def wrongs(output: str) -> dict[str, tuple[str, str]]:
    """What became of the tests that have a line, and in which step."""
    lines = re.findall(r"^(failed|warned) (\S+): (step \d+ of \d+): ", output, re.MULTILINE)
    return {name: (outcome, step) for outcome, name, step in lines}


def ours(path: Path, command: list[str]) -> tuple[dict[str, tuple[str, str]], str]:
    """The verdicts of `ecatspec replay`: the same as `wrongs`, and the last line."""
    read = msgspec.json.decode(path.read_bytes(), type=Vectors)
    counts = dict.fromkeys(["passed", "ended early", "skipped", "warned", "failed"], 0)
    found = {}
    with ProcessAdapter(command) as adapter:
        player = Player(read, adapter, adapter.describe(), lambda _, data: data.hex())
        for test in (test for group in read.testGroups for test in group.tests):
            verdict = player.judge(test)
            word = WORDS[verdict.outcome]
            counts["ended early" if word == "passed" and verdict.reason else word] += 1
            if word in {"warned", "failed"}:
                found[test.id] = (word, verdict.reason)
    return found, ", ".join(f"{number} {word}" for word, number in counts.items())


# --- verdicts -------------------------------------------------------------------------------------


def test_the_virtual_subdevice_passes(tmp_path: Path) -> None:
    made = vectors("al")
    result = replayed(written(tmp_path, made), *virtual())
    assert result.stdout == (
        f"{made['numberOfTests']} passed, 0 ended early, 0 skipped, 0 warned, 0 failed\n"
    )
    assert (result.returncode, result.stderr) == (0, "")


@pytest.mark.parametrize(
    ("layer", "fault"), [("al", "safeop_skipped"), ("mailbox", "unknown_type_unanswered")]
)
def test_a_planted_fault_is_found(tmp_path: Path, layer: str, fault: str) -> None:
    path = written(tmp_path, some(200, layer))
    result = replayed(path, *virtual(fault))
    found, counts = ours(path, virtual(fault))
    assert (result.returncode, result.stderr) == (1, "")
    assert found
    assert wrongs(result.stdout) == found
    assert result.stdout.splitlines()[-1] == counts


def parts(tree: object) -> list[dict[str, Any]]:
    """All objects in a test."""
    match tree:
        case dict():
            return [tree, *(part for each in tree.values() for part in parts(each))]
        case list():
            return [part for each in tree for part in parts(each)]
    return []


def turned(digits: str, dice: random.Random) -> str:
    place = dice.randrange(max(1, len(digits)))
    return digits[:place] + dice.choice("0123456789abcdef") + digits[place + 1 :]


CHANGES: dict[str, Callable[[Any, random.Random], object]] = {
    "value": turned,
    "mask": turned,
    "data": turned,
    "effect": lambda _, dice: dice.choice(["passes", "ends"]),
    "none": lambda _, dice: dice.choice(["passes", "ends"]),
    "refused": lambda _, dice: dice.choice(["passes", "ends"]),
    "otherwise": lambda _, dice: dice.choice(["passes", "ends"]),
    "counter": lambda was, dice: 1 - was if was in {0, 1} else dice.choice(["new", "same", "any"]),
    "atLeast": lambda _, dice: dice.randrange(1, 20),
    "full": lambda was, _: not was,
    "us": lambda was, dice: dice.choice([0, was // 2, 2 * was]),
}


def changed(test: dict[str, Any], number: int, dice: random.Random) -> dict[str, Any]:
    """A test with one thing in it made wrong."""
    made: dict[str, Any] = json.loads(json.dumps(test))
    places = [(part, key) for part in parts(made["steps"]) for key in part if key in CHANGES]
    kind = dice.choice(sorted({key for _, key in places} | {"anyOf", "absent"}))
    if kind == "anyOf":
        looks = [part for part in parts(made["steps"]) if part.get("anyOf")]
        if looks:
            dice.choice(looks)["anyOf"] = []
    elif kind == "absent":
        part, key = dice.choice(places)
        if key not in {"value", "mask", "data", "full"}:
            del part[key]
    else:
        part, key = dice.choice([place for place in places if place[1] == kind])
        part[key] = CHANGES[key](part[key], dice)
    made["id"] = f"{number}/{kind}/{test['id']}"
    return made


@pytest.mark.parametrize("fault", ["", "service_erred_twice"])
def test_changed_vectors_are_judged_as_replay_judges_them(tmp_path: Path, fault: str) -> None:
    dice = random.Random(5)
    made = vectors("mailbox")
    tests = [test for group in made["testGroups"] for test in group["tests"]]
    counters = [part for part in parts(tests) if part.get("kind") == "mail" and part["anyOf"]]
    made["config"]["passOver"] = dice.choice(counters)["anyOf"][:1]
    chosen = [changed(dice.choice(tests), number, dice) for number in range(200)]
    made["testGroups"] = [{"type": "mailbox", "tests": chosen}]
    path = written(tmp_path, counted(made))
    result = replayed(path, *virtual(fault))
    found, counts = ours(path, virtual(fault))
    assert 20 < len(found) < 180
    assert wrongs(result.stdout) == found
    assert result.stdout.splitlines()[-1] == counts


def test_clauses_without_a_must_are_a_warning(tmp_path: Path) -> None:
    made = some(200)
    for clause in made["clauses"].values():
        clause["level"] = "should"
    path = written(tmp_path, made)
    result = replayed(path, *virtual("safeop_skipped"))
    found, counts = ours(path, virtual("safeop_skipped"))
    assert {word for word, _ in found.values()} == {"warned"}
    assert wrongs(result.stdout) == found
    assert result.stdout.splitlines()[-1] == counts
    assert result.returncode == 0


POST = """
import json, sys
queues = json.loads(sys.argv[1])
for line in sys.stdin:
    request, reply = json.loads(line), {"ok": True, "wkc": 1}
    match request["op"]:
        case "describe":
            reply["description"] = {
                "name": "post", "protocols": [], "virtual_time": False, "closed_dictionary": False,
                "notes": [], "limits": {}, "without": [], "locals": []}
        case "reset":
            queue, writes, time = [], 0, 0
        case "advance":
            time += request["seconds"]
        case "write":
            writes += 1
            reply["wkc"] = int(request["address"] != 4096 or time > 0.01)
            if request["address"] == 0:
                queue = list(queues[int(request["data"], 16)])
        case "read":
            seen = {2061: "08" if queue else "00", 100: f"{writes:02x}", 200: f"{time > 0.01:02x}"}
            address, digits = request["address"], 2 * request["length"]
            data = queue.pop(0) if address == 4224 else seen[address]
            reply["data"] = data.ljust(digits, "0")
    print(json.dumps(reply), flush=True)
"""


def message(counter: int, content: str) -> str:
    return f"{len(content) // 2:02x}00000000{counter}3{content}"


def mail(content: str, mask: str = "", **keys: object) -> dict[str, Any]:
    """An expectation of a message with this content, whatever its length says."""
    compared = "0000ffffff8f" + (mask or "f" * len(content))
    allowed = {"value": message(0, content), "mask": compared}
    if "atLeast" in keys:
        allowed["atLeast"] = keys.pop("atLeast")  # type: ignore[assignment]
    return {"kind": "mail", "anyOf": [allowed], **keys}


def one_byte(address: int, *ways: dict[str, str]) -> dict[str, Any]:
    return {"kind": "read", "address": address, "length": 1, "symbol": "it", "anyOf": list(ways)}


LOOK = {"value": "01", "mask": "ff"}
CYCLE = {"address": 50, "data": "00", "us": 3000}
SEND = {"do": "send", "address": 4096, "data": "00", "symbol": "it"}
POSTED: list[tuple[str, list[str], dict[str, Any]]] = [
    ("passed", [message(1, "aabb")], {"expect": [mail("aabbcc", atLeast=8)]}),
    ("failed", [message(1, "aabb")], {"expect": [mail("aabbcc", atLeast=9)]}),
    ("failed", [message(1, "aabb")], {"expect": [mail("aacc", atLeast=7)]}),
    ("failed", [message(1, "aa")], {"expect": [mail("aabb", "ff00")]}),
    ("passed", [message(1, "aabb")], {"expect": [mail("aa")]}),
    ("passed", [message(0, "aa")] * 2, {"expect": [mail("aa", counter="new")] * 2}),
    ("failed", [message(1, "aa")] * 2, {"expect": [mail("aa", counter="new")] * 2}),
    ("passed", [message(1, "aa")] * 2, {"expect": [mail("aa", counter="same")] * 2}),
    ("failed", [message(n, "aa") for n in (1, 2)], {"expect": [mail("aa", counter="same")] * 2}),
    ("passed", [message(1, "ee"), message(2, "aa")], {"expect": [mail("aa", counter="new")]}),
    ("failed", [message(1, "ee"), message(1, "aa")], {"expect": [mail("aa", counter="new")]}),
    ("failed", [message(1, "ee")], {"expect": [mail("aa")]}),
    (
        "passed",
        [message(1, "aa"), message(2, "bb")],
        {
            "expect": [
                {"kind": "mail", "anyOf": [], "none": "passes", "otherwise": "passes"},
                {"kind": "full", "full": False},
            ]
        },
    ),
    (
        "passed",
        [],
        {"us": 10_000, "cycle": CYCLE, "expect": [one_byte(100, LOOK | {"value": "05"})]},
    ),
    ("passed", [], {"in": SEND}),
    (
        "passed",
        [],
        {
            "us": 20_000,
            "early": True,
            "expect": [one_byte(200, {"value": "00", "mask": "ff", "effect": "ends"}, LOOK)],
        },
    ),
]


def test_messages_counters_and_time_are_judged_by_the_page(tmp_path: Path) -> None:
    made = some(1)
    made["config"]["passOver"] = mail("ee")["anyOf"]
    start = {"do": "write", "address": 0, "symbol": "which queue"}
    tests = [
        {
            "tcId": number + 1,
            "id": f"{number}/{outcome}",
            "comment": "",
            "steps": [{"in": start | {"data": f"{number:02x}"}}, step],
        }
        for number, (outcome, _, step) in enumerate(POSTED)
    ]
    made["testGroups"] = [{"type": "post", "tests": tests}]
    path = written(tmp_path, counted(made))
    command = [sys.executable, "-c", POST, json.dumps([queue for _, queue, _ in POSTED])]
    result = replayed(path, *command)
    found, counts = ours(path, command)
    assert set(found) == {test["id"] for test in tests if str(test["id"]).endswith("failed")}
    assert wrongs(result.stdout) == found
    assert result.stdout.splitlines()[-1] == counts
    assert "0 ended early" in counts


# --- what is not tried ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("effect", "line"),
    [
        ("passes", "3 passed, 0 ended early, 0 skipped, 0 warned, 0 failed"),
        ("ends", "1 passed, 1 ended early, 1 skipped, 0 warned, 0 failed"),
    ],
)
def test_what_rests_on_test_1_needs_all_of_it(tmp_path: Path, effect: str, line: str) -> None:
    made = some(3)
    first, second, _ = made["testGroups"][0]["tests"]
    first["steps"][0]["expect"][0]["anyOf"][0]["effect"] = effect
    second["requires"] = True
    assert replayed(written(tmp_path, made), *virtual()).stdout.splitlines() == [line]


def test_an_event_that_cannot_be_raised_skips_the_test(tmp_path: Path) -> None:
    made = some(2)
    made["testGroups"][0]["tests"][1]["needs"] = ["moon.full"]
    result = replayed(written(tmp_path, made), *virtual())
    assert result.stdout == "1 passed, 0 ended early, 1 skipped, 0 warned, 0 failed\n"
    assert result.returncode == 0


def test_where_nothing_can_be_played_nothing_is_judged(tmp_path: Path) -> None:
    made = some(1)
    made["testGroups"][0]["tests"][0]["needs"] = ["moon.full"]
    result = replayed(written(tmp_path, made), *virtual())
    assert (result.returncode, result.stderr) == (2, "no test could be played\n")


# --- devices --------------------------------------------------------------------------------------

BETWEEN = """
import json, subprocess, sys
device = subprocess.Popen(sys.argv[2:], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
for line in sys.stdin:
    with open(sys.argv[1], "a") as log:
        log.write(line)
    device.stdin.write(line)
    device.stdin.flush()
    reply = json.loads(device.stdout.readline())
    if "description" in reply:
        reply["description"]["virtual_time"] = False
    print(json.dumps(reply), flush=True)
"""


def test_real_time_is_not_waited_for_in_vain(tmp_path: Path) -> None:
    made = some(200)
    tests = made["testGroups"][0]["tests"]
    hasty = [
        test for test in tests if [each.get("early") for each in test["steps"][1:]] == [None, True]
    ]
    made["testGroups"][0]["tests"] = hasty
    log = tmp_path / "log"
    path = written(tmp_path, counted(made))
    between = [sys.executable, "-c", BETWEEN, str(log), *virtual()]
    result = replayed(path, *between)
    assert result.stdout == f"{len(hasty)} passed, 0 ended early, 0 skipped, 0 warned, 0 failed\n"
    requests = list(map(json.loads, log.read_text(encoding="utf-8").splitlines()))
    waited = [each["seconds"] for each in requests if each["op"] == "advance"]
    longest = [step["us"] for test in hasty for step in test["steps"] if step.get("early")]
    assert len(hasty) > 5
    assert sum(waited) < sum(longest) / 1e6 / 10


ANSWERS = """
import sys
for line in sys.stdin:
    if "describe" in line:
        print('{"ok": true, "description": {}}', flush=True)
    else:
        ANSWER
"""


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        ("sys.exit('no memory')", "it ended: exit status 1; it said: no memory"),
        ("print('hello', flush=True)", "it talks rubbish"),
        ("print('{}\\n{}', flush=True)", "it talks unasked"),
        ("print(2 ** 21 * 'x', flush=True)", "its line is too long"),
    ],
)
def test_a_device_that_dies_has_failed_and_lives_again(
    tmp_path: Path, answer: str, reason: str
) -> None:
    program = ANSWERS.replace("ANSWER", answer)
    result = replayed(written(tmp_path, some(2)), sys.executable, "-c", program)
    assert (result.returncode, result.stderr) == (1, "")
    assert result.stdout.count(reason) == 2
    assert result.stdout.endswith("2 failed\n")


@pytest.mark.parametrize(
    ("command", "line"),
    [
        ([], "usage: node replay.mjs FILE PROGRAM [ARGUMENT...]"),
        (["/nowhere/slave"], "/nowhere/slave is no device: it cannot be started: ENOENT"),
        (["false"], "false is no device: it ended: exit status 1"),
        (["cat"], 'cat is no device: it talks rubbish: "{\\"op\\":\\"describe\\"}\\n"'),
        (virtual("no_such_fault"), "no fault is called 'no_such_fault'"),
    ],
)
def test_a_program_that_is_no_device_is_one_line(
    tmp_path: Path, command: list[str], line: str
) -> None:
    result = replayed(written(tmp_path, some(1)), *command)
    assert (result.returncode, result.stdout) == (2, "")
    assert line in result.stderr
    assert result.stderr.count("\n") == 1


# --- files ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("was", "now", "reason"),
    [
        ('"schema_version": 1', '"schema_version": 2', "schema_version is not one of 1"),
        ('"numberOfTests": 1', '"numberOfTests": 2', "numberOfTests does not match: there are 1"),
        (
            '"kind": "read"',
            '"kind": "smell"',
            "testGroups[0].tests[0].steps[0].expect[0] has no kn",
        ),
        ('"length": 6', '"length": 6, "often": 2', "steps[0].expect[0].often is not known"),
        ('"length": 6, ', "", "steps[0].expect[0] lacks length"),
        ('"address": 304', '"address": 65536', "address is not a whole number from 0 to 65535"),
        ('"value": "01', '"value": "0g', "value is not bytes in hexadecimal"),
        ('"steps": [', '"steps": [7, ', "steps[0] is not an object"),
        ("]}", "]", "cannot read"),
        ("{", "[" * 10_000, "cannot read"),
        ("{", "null, {", "cannot read"),
    ],
)
def test_a_bad_file_is_one_line(tmp_path: Path, was: str, now: str, reason: str) -> None:
    path = written(tmp_path, some(1))
    text = path.read_text(encoding="utf-8")
    assert was in text
    path.write_text(text.replace(was, now, 1), encoding="utf-8")
    result = replayed(path, "false")
    assert (result.returncode, result.stdout) == (2, "")
    assert reason in result.stderr
    assert result.stderr.count("\n") == 1


def test_a_file_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    result = replayed(tmp_path / "vectors.json", "false")
    assert (result.returncode, result.stderr.count("\n")) == (2, 1)


TALKING = """
import json, sys
back, told = int(sys.argv[1]), bytes.fromhex(sys.argv[2])
name = {"name": "talking", "protocols": ["sdo"], "virtual_time": True, "closed_dictionary": True}
for line in sys.stdin:
    call = json.loads(line)
    answer = {"ok": True}
    if call["op"] == "describe":
        answer["description"] = name
    if call["op"] == "read":
        data = told if call["address"] == back else bytes([255] * call["length"])
        answer.update(wkc=1, data=data.ljust(call["length"], b"\\0").hex())
    if call["op"] == "close":
        break
    print(json.dumps(answer), flush=True)
"""


def test_messages_without_end_end_a_test(tmp_path: Path) -> None:
    """A device that tells one emergency after the other, and never answers."""
    made = some(1, "mailbox")
    allowed = {"value": "0a00000000f3", "mask": "ff00000000ff"}
    (test,) = made["testGroups"][0]["tests"]
    test["steps"] = [{"expect": [{"kind": "mail", "symbol": "reply", "anyOf": [allowed]}]}]
    test["requires"] = False
    made["config"]["passOver"] = [{"value": "0a0000000003", "mask": "ffff0000000f"}]
    told = Model(load_device("reference")).codec.encode(
        "emergency",
        {"counter": 1, "error_code": 0x1000, "error_register": 0, "manufacturer": bytes(5)},
    )
    program = tmp_path / "talking.py"
    program.write_text(TALKING, encoding="utf-8")
    back = str(made["config"]["mailboxIn"]["address"])
    done = replayed(written(tmp_path, made), sys.executable, str(program), back, told.hex())
    assert "1 ended early" in done.stdout, done.stdout + done.stderr
