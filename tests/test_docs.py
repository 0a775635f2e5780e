"""Tests of docs/: what they say of the language is what the language is."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import pytest
from c_device import library

from ecatspec.conformance.adapters import ADAPTERS, open_adapter
from ecatspec.conformance.adapters.contract_test import check_adapter
from ecatspec.conformance.base.verdict import Outcome
from ecatspec.conformance.run.runner import run_device
from ecatspec.generators.vectors import schema
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.functions import PLAIN
from ecatspec.spec.language.functions import EDGES, FUNCTIONS
from ecatspec.spec.language.load import load_device, load_file
from ecatspec.spec.language.pretty_expressions import pretty_type

if TYPE_CHECKING:
    from collections.abc import Iterator

DOCS = Path(__file__).resolve().parent.parent / "docs"
PAGE = (DOCS / "language.md").read_text(encoding="utf-8")


VECTORS = (DOCS / "vectors.md").read_text(encoding="utf-8")


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


# --- test vectors ---------------------------------------------------------------------------------

PARTS = [
    each
    for each in vars(schema).values()
    if isinstance(each, type)
    and issubclass(each, msgspec.Struct)
    and each.__module__ == schema.__name__
    and not each.__name__.startswith("_")
    and each not in {schema.Head, schema.Area}
]


def rows_of(part: str) -> dict[str, str]:
    """The keys that the page names in a part of a file, and what it says of their absence."""
    start = "## The file" if part == "Vectors" else f"**{part}**"
    _, found, rest = VECTORS.partition(f"\n{start}")
    assert found
    table = rest[rest.index("\n|") :].strip().split("\n\n")[0]
    assert table.startswith("| key | type | absent | meaning |\n")
    return dict(re.findall(r"^\| `(\w+)` \|.*?\| ([^|]*?) ?\|[^|]*\|$", table, re.MULTILINE))


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.__name__)
def test_the_page_lists_the_keys_of_a_file_in_their_order(part: type[msgspec.Struct]) -> None:
    rows = rows_of(part.__name__)
    fields = msgspec.structs.fields(part)
    assert list(rows) == [field.encode_name for field in fields]
    for field in fields:
        assert bool(rows[field.encode_name]) != field.required, field.name


def test_the_sample_is_a_test_as_a_file_has_it() -> None:
    block = VECTORS.partition("## An example\n\n")[2].partition("\n## ")[0]
    sample = re.sub(r"^ *//.*$", "", block, flags=re.MULTILINE)
    test = msgspec.json.decode(sample, type=schema.Test)
    again = msgspec.json.decode(msgspec.json.encode(test))
    assert again == msgspec.json.decode(sample)
    assert [list(step) for step in again["steps"]] == [
        list(step) for step in msgspec.json.decode(sample)["steps"]
    ]


# --- adapters -------------------------------------------------------------------------------------

ADAPTERS_PAGE = (DOCS / "adapters.md").read_text(encoding="utf-8")


def test_the_page_of_adapters_names_each() -> None:
    assert all(f"`{name}" in ADAPTERS_PAGE for name in ADAPTERS if name != "lib")
    assert "--dut lib:" in ADAPTERS_PAGE


def test_the_sample_of_a_library_is_a_device_that_conforms(tmp_path: Path) -> None:
    block = ADAPTERS_PAGE.partition("A complete device")[2].partition("\n\n")[2]
    code = "".join(re.findall(r"^(?:    .*|)\n", block.partition("\n- All state")[0], re.MULTILINE))
    file = library(code, tmp_path / "libdut.so", "-pedantic")
    result = run_device("standard", f"lib:{file}", depth="quick")
    assert not result.findings()
    assert sum(verdict.outcome is Outcome.PASS for verdict in result.verdicts) > 100


def test_the_sample_in_javascript_is_a_device_that_conforms() -> None:
    node = shutil.which("node")
    if node is None:
        pytest.skip("no node")
    program = DOCS.parent / "examples" / "exec_slave" / "slave.mjs"
    command = shlex.join([node, str(program)])
    result = run_device("standard", f"exec:{command}", depth="quick")
    assert not result.findings()
    complaints = check_adapter(
        lambda: open_adapter(f"exec:{command}", "standard"),
        spans=[(0x0120, 32), (0x1000, 256)],
        write=(0x1000, b"\x01"),
    )
    assert complaints == []
