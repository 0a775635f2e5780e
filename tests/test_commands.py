"""Runs the commands of the documentation: each one is run, or excused in words.

They run in this process, one after the other, in a folder that has what the pages speak of: a
device in C, its text, a capture. Runs and exports are cut to a few cases; that all cases work is
the matter of other tests.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
from functools import cache
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import click
import pytest
from c_device import build

from ecatspec.conformance import cli
from ecatspec.conformance.base import devices
from ecatspec.conformance.cli import exit_status
from ecatspec.conformance.cli.options import EXAMPLES
from ecatspec.conformance.diff import comparison
from ecatspec.conformance.diff.machines import MACHINES
from ecatspec.conformance.run import runner
from ecatspec.conformance.traceability import trace
from ecatspec.conformance.vectors import export
from ecatspec.generators import suite
from ecatspec.spec.language.load import load_file

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.generators.cases.case import Case, Limits
    from ecatspec.model.core.compilation import Model
    from ecatspec.spec.language.ir import Protocol

pytestmark = pytest.mark.xdist_group("commands")

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted(
    page.relative_to(ROOT).as_posix()
    for folder in ("docs", "examples")
    for page in ((ROOT / folder).rglob("*.md"))
)
PAGES = ["README.md", "CONTRIBUTING.md", *PAGES]
CASES = 3
"""Cases of a suite that run here."""

EXCUSED = {
    r" simulate ": "answers on a network interface until it is stopped: tests/test_eth.py",
    r"--dut eth:": "needs a network interface: tests/test_eth.py",
    r"--dut (tcp|unix):": "needs a device that listens: tests/test_sockets.py",
    r"--cluster ": "needs a cluster: tests/test_campaign.py",
    r"--workers ": "starts processes, each with the whole suite: tests/test_campaign.py",
    r" mutate ": "takes minutes: tests/test_mutants.py",
    r" trace .*--measure": "takes minutes: tests/test_evidence.py",
    r" prove ": "takes long: tests/test_prove.py",
    r" diff .*(--verify|--dut)": "plays whole suites: tests/test_diff.py",
    r" run reference .*--replay ": "stands in the tutorial: a test of its own, below",
}
"""What is parsed only: which commands, and why they are not run here."""

INSTEAD = {r"\bDEVICE\b": "reference"}
"""Words that stand for something, and what they stand for here."""


def code(page: str) -> Iterator[str]:
    """The lines of code blocks: indented ones, and those between fences."""
    fenced = False
    for line in (ROOT / page).read_text(encoding="utf-8").splitlines():
        if line.lstrip().startswith("```"):
            fenced = not fenced
        elif fenced or line.startswith("    "):
            yield line


def simple(line: str) -> Iterator[list[str]]:
    """The simple commands of a line of a shell, without comments and redirections."""
    words = shlex.shlex(line, posix=True, punctuation_chars=True)
    words.whitespace_split = True
    command: list[str] = []
    skip = False
    for word in words:
        if set(word) <= set("();<>|&"):
            skip = ">" in word or "<" in word
            if not skip:
                yield command
                command = []
        elif skip:
            skip = False
        else:
            command.append(word)
    yield command


def commands(page: str) -> Iterator[tuple[str, ...]]:
    """All commands of a page that call ecatspec."""
    for line in code(page):
        inner = re.findall(r"\$\((ecatspec [^)]*)\)", line)
        bare = re.sub(r"^\s*- (run: )?", "", line).strip()
        outer = [bare] if re.match(r"ecatspec |.*&& ecatspec ", bare) else []
        for part in (*inner, *outer):
            for words in simple(part):
                if words[:1] == ["ecatspec"]:
                    yield tuple(words)


SHOWN = {page: list(commands(page)) for page in PAGES}


def reason(words: tuple[str, ...]) -> str | None:
    line = " ".join(words) + " "
    return next((why for what, why in EXCUSED.items() if re.search(what, line)), None)


def parsed(words: tuple[str, ...]) -> None:
    """Check that the command and its options exist."""
    command: click.Command = cli.cli
    rest = list(words[1:])
    while isinstance(command, click.Group):
        found = command.get_command(click.Context(command), rest.pop(0))
        assert found is not None, words
        command = found
    command.make_context(command.name, rest)


def few(model: Model, limits: Limits, depth: str = "default") -> Iterator[Case]:
    del depth
    cases = suite.all_cases(model, limits, "quick")
    return islice((case for case in cases if case.layer == "al"), CASES)


once = cache(load_file)


def compiled(path: str) -> Protocol:
    """A text is the same text in every page."""
    return once(Path(path).resolve())


def shorten(patch: pytest.MonkeyPatch) -> None:
    for module in (runner, export, trace):
        patch.setattr(module, "all_cases", few)
    for module in (runner, export):
        patch.setattr(module, "complete_suites", lambda *_: iter(()))
    for depth in runner.WALKS:
        patch.setitem(runner.WALKS, depth, 0)
        patch.setitem(runner.EXAMPLES, depth, 1)
    patch.setattr(comparison, "MACHINES", MACHINES[:1])
    patch.setattr(devices, "load_file", compiled)


def repository(folder: Path) -> None:
    """A text under version control, with a tag."""
    git = shutil.which("git")
    if git is None:
        pytest.skip("no git")
    who = ["-c", "user.name=x", "-c", "user.email=x@example.org"]
    add = [["init", "-q"], ["add", "my-drive.ecs"], [*who, "commit", "-q", "-m", "x"]]
    for words in (*add, ["tag", "v1.2"]):
        subprocess.run([git, *words], cwd=folder, check=True, capture_output=True)


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all that the pages take for granted."""
    folder = tmp_path_factory.mktemp("desk")
    (folder / "spec").symlink_to(ROOT / "spec")
    shutil.copytree(ROOT / "examples", folder / "examples", ignore=shutil.ignore_patterns("build"))
    drive, level_b = (folder / "examples" / name for name in ("c_slave", "c_level_b"))
    build(drive / "build", sources=drive)
    build(drive / "build", "library", sources=drive)
    build(level_b / "build", sources=level_b)
    shutil.copy(drive / "build" / "slave", folder / "my_slave")
    shutil.copy(drive / "build" / "libslave.so", folder / "libdut.so")
    for name in ("my-drive.ecs", "my-device.ecs", "my_device.ecs"):
        shutil.copy(drive / "slave.ecs", folder / name)
    repository(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("XDG_STATE_HOME", str(folder / "two_runs"))
        capture = ["--format", "pcapng", "-o", "capture.pcapng"]
        cli.main(["export", "reference", "--depth", "quick", "--only", "coe", *capture])
        shorten(patch)
        cli.main(["run", "reference"])
        cli.main(["run", "reference"])
        cli.main(["run", "reference", "--results", "monday.sqlite"])
    for name in ("tuesday", "good", "new"):
        shutil.copy(folder / "monday.sqlite", folder / f"{name}.sqlite")
    return folder


DONE: set[tuple[str, ...]] = set()
"""A command that stands in several pages is run once."""


def started(words: tuple[str, ...], desk: Path, patch: pytest.MonkeyPatch) -> int:
    if "--replay" not in words:
        shorten(patch)
    patch.setenv("XDG_STATE_HOME", str(desk / ("two_runs" if words[1] == "compare" else "runs")))
    line = shlex.join(words[1:])
    for what, instead in INSTEAD.items():
        line = re.sub(what, instead, line)
    return cli.main(shlex.split(line))


@pytest.mark.parametrize("page", [page for page in PAGES if SHOWN[page]])
def test_each_command_of_a_page_runs(
    page: str, desk: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    home = desk / Path(page).parent if page.startswith("examples/c_") else desk
    for words in SHOWN[page]:
        if reason(words) is not None:
            parsed(words)
            continue
        if (key := (str(home), *words)) in DONE:
            continue
        DONE.add(key)
        with monkeypatch.context() as patch:
            patch.chdir(home)
            status = started(words, desk, patch)
        said = capsys.readouterr()
        assert status in {exit_status.CONFORMS, exit_status.DOES_NOT_CONFORM}, (
            f"{words}: {said.err}"
        )


def test_every_excuse_is_needed() -> None:
    every = [" ".join(words) + " " for shown in SHOWN.values() for words in shown]
    for what in (*EXCUSED, *INSTEAD):
        assert any(re.search(what, line) for line in every), what


def test_every_command_of_the_program_is_shown() -> None:
    shown = {words[1] for each in SHOWN.values() for words in each}
    assert set(EXAMPLES) <= shown


def test_commands_are_found_wherever_a_shell_finds_them() -> None:
    found = [
        simple_
        for line in (
            "ecatspec run a --dut 'exec:./b c' > x.json  # say",
            "ecatspec compare a b && cp b a",
            "ecatspec simulate a --iface b &",
        )
        for simple_ in simple(line)
        if simple_
    ]
    assert found == [
        ["ecatspec", "run", "a", "--dut", "exec:./b c"],
        ["ecatspec", "compare", "a", "b"],
        ["cp", "b", "a"],
        ["ecatspec", "simulate", "a", "--iface", "b"],
    ]


# --- the tutorial ---------------------------------------------------------------------------------

TUTORIAL = "docs/tutorial.md"
RENEW = bool(os.environ.get("ECATSPEC_RENEW"))


LAST = 4
"""The messages of the trace that the page shows."""


def shortened(report: str) -> list[str]:
    """Give the finding of a report without what is involved and without the way up."""
    lines = report[report.index("1. FAIL") :].splitlines()
    begins = [number for number, line in enumerate(lines) if line[:3] == "  " + line.strip()[:1]]
    involved = next(number for number in begins if lines[number].startswith("  involved"))
    after = next(number for number in begins if number > involved)
    trace = next(number for number in begins if lines[number].startswith("  trace"))
    said = [number for number in range(trace + 1, len(lines)) if " ms  |" in lines[number]]
    kept = [*lines[:involved], "  ...", *lines[after : trace + 1], "    ...", *lines[said[-LAST] :]]
    return [f"    {line}".rstrip() for line in kept]


def test_the_finding_of_the_tutorial_is_what_the_command_says(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong, right = (w for w in SHOWN[TUTORIAL] if "--replay" in w)
    monkeypatch.setitem(os.environ, "COLUMNS", "80")
    assert cli.main(wrong[1:]) == exit_status.DOES_NOT_CONFORM
    block = "\n".join(shortened(capsys.readouterr().out))
    page = (ROOT / TUTORIAL).read_text(encoding="utf-8")
    before, _, rest = page.partition("Shortened at the dots:\n\n")
    _, _, after = rest.partition("\n\n- **The title**")
    made = f"{before}Shortened at the dots:\n\n{block}\n\n- **The title**{after}"
    if RENEW:
        (ROOT / TUTORIAL).write_text(made, encoding="utf-8")
    assert page == made, "renew it: ECATSPEC_RENEW=1 pytest tests/test_commands.py"
    assert cli.main(right[1:]) == exit_status.CONFORMS
