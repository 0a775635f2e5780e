"""The only place for tests of docs/: what they say of the language is what the language is."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from ecatspec.model.compiled import Model
from ecatspec.model.functions import PLAIN
from ecatspec.spec.language.load import load_device, load_file
from ecatspec.spec.language.pretty import pretty_type
from ecatspec.spec.language.scope import EDGES, FUNCTIONS

if TYPE_CHECKING:
    from collections.abc import Iterator

DOCS = Path(__file__).resolve().parent.parent / "docs"
PAGE = (DOCS / "language.md").read_text(encoding="utf-8")


def test_the_page_lists_exactly_the_functions_that_there_are() -> None:
    rows = re.findall(r"^\| `(\w+)\(([^)]*)\)` \| (\w+) \| (.+) \|$", PAGE, re.MULTILINE)
    wanted = [
        (n, ", ".join(map(pretty_type, f.arguments)), pretty_type(f.result), f.wording)
        for n, f in FUNCTIONS.items()
    ]
    assert rows == wanted


def test_every_function_of_the_language_means_something() -> None:
    standard = load_device("standard")
    model = Model(standard)
    own = set(model.dictionary.functions) | set(model.image.functions)
    assert set(FUNCTIONS) == set(PLAIN) | own | set(EDGES)


def samples() -> Iterator[str]:
    """The indented blocks of the page."""
    for block in re.findall(r"(?:^    .*\n|^\n(?=    ))+", PAGE, re.MULTILINE):
        yield re.sub(r"^    ", "", block, flags=re.MULTILINE)


def test_the_sample_device_is_a_text(tmp_path: Path) -> None:
    device = next(sample for sample in samples() if sample.lstrip().startswith("device "))
    path = tmp_path / "my-drive.ecs"
    path.write_text(device, encoding="utf-8")
    protocol = load_file(path)
    assert protocol.name == "my-drive"
    assert protocol.dictionary.closed
    assert (0x2002, 0) in {(entry.index, entry.subindex) for entry in protocol.objects}


@pytest.mark.parametrize("word", ["longest_transfer", "segmented_download", "information_support"])
def test_the_limits_that_the_page_names_exist(word: str) -> None:
    standard = load_device("standard")
    assert word in PAGE
    assert word in standard.parameters or word in standard.choices
