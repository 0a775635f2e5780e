"""Tests of what is generated under docs/."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from fault_suites import DEVICES

from ecatspec.conformance import cli
from ecatspec.conformance.describe.device_page import chapter
from ecatspec.spec.language.load import load_device

if TYPE_CHECKING:
    from types import ModuleType

DOCS = Path(__file__).resolve().parent.parent / "docs"


def generator() -> ModuleType:
    spec = importlib.util.spec_from_file_location("generate", DOCS / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_pages_are_those_of_the_texts() -> None:
    for file, text in generator().pages().items():
        assert file.read_text(encoding="utf-8") == text, f"{file}: run `make docs`"


def test_the_table_of_swaps_is_that_of_the_texts() -> None:
    page = (DOCS / "swaps.md").read_text(encoding="utf-8")
    digests = dict(re.findall(r"^- ([\w-]+) `([0-9a-f]{64})`$", page, re.MULTILINE))
    assert digests == {name: load_device(name).digest for name in DEVICES}, "run `make docs`"


def test_each_text_finds_each_other_device() -> None:
    page = (DOCS / "swaps.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([\w-]+) \| ([\d |]+) \|$", page, re.MULTILINE)
    counts = {name: [int(n) for n in cells.split(" | ")] for name, cells in rows}
    assert tuple(counts) == DEVICES
    for place, name in enumerate(DEVICES):
        assert counts[name][place] == 0
        assert all(n for at, n in enumerate(counts[name]) if at != place)


@pytest.mark.parametrize("name", DEVICES)
def test_a_chapter_tells_what_is_wrong_chosen_and_hidden(name: str) -> None:
    protocol = load_device(name)
    page = chapter(protocol)
    _, wrong, chosen, hidden = re.split(
        r"^## Where.*|^## What was.*|^## What the.*", page, flags=re.MULTILINE
    )
    assert all(anomaly.id in wrong for anomaly in protocol.anomalies)
    decided = (*protocol.pins, *protocol.opened)
    assert all(protocol.choices[choice].wording in chosen for choice in decided)
    because = [c.because for c in protocol.clauses.values() if c.level.value == "unobservable"]
    assert all(why is not None and why in hidden for why in because)


def test_the_command_prints_the_chapter(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["show", "beckhoff-el6720", "--format", "markdown"]) == 0
    assert capsys.readouterr().out == chapter(load_device("beckhoff-el6720"))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["al", "--format", "markdown"], "leave 'al' out"),
        (["--format", "markdown", "--json"], "exclude each other"),
        (["--format", "markdwn"], "did you mean 'markdown'"),
    ],
)
def test_what_makes_no_chapter(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["show", "beckhoff-el6720", *words]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert said in err
    assert err.count("\n") == 1
