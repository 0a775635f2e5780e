"""Tests of what is kept between starts."""

from __future__ import annotations

from importlib import resources
from typing import TYPE_CHECKING

import pytest
from lark import Lark

from ecatspec.conformance.base.disk_cache import DiskCache, digest_of, folder
from ecatspec.spec.language import load, store
from ecatspec.spec.language.diagnostics import SpecError
from ecatspec.spec.language.grammar import parser
from ecatspec.spec.language.parse import decode, parse_text
from ecatspec.spec.language.store import keep_in, kept

if TYPE_CHECKING:
    from pathlib import Path

    from ecatspec.spec.language.ir import Protocol

TEXT = """
device mine extends standard "first"

manual "a manual" "its edition" claims MINE-001 .. MINE-001

clause MINE-C1 must "a limit" source "1" claims [MINE-001]

objects
  0x2000 : 0 limit u16 rw range 10 .. 1000 = 100 [MINE-C1]
"""


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    keep_in(DiskCache())
    return tmp_path / "ecatspec"


class Maker:
    """Counts how often it is asked."""

    def __init__(self) -> None:
        self.asked = 0

    def __call__(self) -> str:
        self.asked += 1
        return f"made {self.asked}"


def test_without_a_store_everything_is_made_anew(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store, "_used", [store._Nowhere()])  # noqa: SLF001  as the core begins
    make = Maker()
    assert [kept("a", b"one", make) for _ in range(2)] == ["made 1", "made 2"]
    assert not place.exists()


def test_the_grammar_is_compiled_once(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parser.cache_clear()  # another start
    parse_text(TEXT, "text")
    assert [file.name for file in place.iterdir()] == ["grammar.pickle"]
    monkeypatch.setattr(Lark, "save", None)
    parser.cache_clear()
    parse_text(TEXT, "text")


def test_what_was_made_is_kept(place: Path) -> None:
    make = Maker()
    assert [kept("a", b"one", make) for _ in range(3)] == ["made 1"] * 3
    assert [file.name for file in place.iterdir()] == ["a.pickle"]


def test_another_source_is_made_anew_and_takes_its_place(place: Path) -> None:
    make = Maker()
    assert [kept("a", source, make) for source in (b"one", b"two", b"two", b"one")] == [
        "made 1",
        "made 2",
        "made 2",
        "made 3",
    ]
    assert len(list(place.iterdir())) == 1


def test_another_program_makes_it_anew(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = place.parent / "thinker"
    (package / "deeper").mkdir(parents=True)
    for folder_ in (package, package / "deeper"):
        (folder_ / "__init__.py").write_text("")
    monkeypatch.syspath_prepend(str(place.parent))
    make, program = Maker(), ("ecatspec.spec.language", "thinker")
    assert [kept("a", b"one", make, program) for _ in range(2)] == ["made 1"] * 2
    assert kept("a", b"one", make) == "made 2"
    (package / "deeper" / "part.py").write_text("x = 1")
    digest_of.cache_clear()
    assert [kept("a", b"one", make, program) for _ in range(2)] == ["made 3"] * 2


@pytest.mark.parametrize("rubbish", [b"", b"\x80\x05", b"cnowhere\nnothing\n.", b"\x80\x05K\x01."])
def test_rubbish_is_made_anew(place: Path, rubbish: bytes) -> None:
    make = Maker()
    kept("a", b"one", make)
    (place / "a.pickle").write_bytes(rubbish)
    assert kept("a", b"one", make) == "made 2"
    assert kept("a", b"one", make) == "made 2"


def test_nothing_is_kept_where_others_can_write(place: Path) -> None:
    make = Maker()
    kept("a", b"one", make)
    place.chmod(0o777)
    assert folder() is None
    assert kept("a", b"one", make) == "made 2"


def test_without_a_folder_nothing_is_kept(place: Path) -> None:
    place.write_text("a file")
    make = Maker()
    assert [kept("a", b"one", make) for _ in range(2)] == ["made 1", "made 2"]


def test_what_cannot_be_written_is_made_each_time(place: Path) -> None:
    (place / "a.pickle").mkdir(parents=True)
    place.chmod(0o700)
    make = Maker()
    assert [kept("a", b"one", make) for _ in range(2)] == ["made 1", "made 2"]
    assert [file.name for file in place.iterdir()] == ["a.pickle"]


@pytest.mark.parametrize("part", ["standard", "devices", "faults"])
def test_a_kept_text_is_the_text(part: str) -> None:
    for file in resources.files("ecatspec.spec").joinpath(part).iterdir():
        name = f"spec/{part}/{file.name}"
        parsed = parse_text(decode(file.read_bytes(), name), name)
        for _ in range(2):
            load._shipped.cache_clear()  # noqa: SLF001  another start
            assert load._shipped(part, file.name) == parsed  # noqa: SLF001


@pytest.fixture
def compiled(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The files that were really compiled."""
    files: list[str] = []
    compiling = load._compiled  # noqa: SLF001

    def watched(raw: bytes, file: str) -> Protocol:
        files.append(file)
        return compiling(raw, file)

    monkeypatch.setattr(load, "_compiled", watched)
    return files


def test_a_sound_text_is_checked_once(tmp_path: Path, compiled: list[str]) -> None:
    file = tmp_path / "mine.ecs"
    file.write_text(TEXT)
    first = load.load_file(file)
    assert load.load_file(file) == first
    assert compiled == [str(file)]
    file.write_text(TEXT.replace("first", "second"))
    assert load.load_file(file).wording == "second"
    assert compiled == [str(file)] * 2


def test_a_text_is_checked_again_on_another_standard(
    tmp_path: Path, compiled: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "mine.ecs"
    file.write_text(TEXT)
    load.load_file(file)
    monkeypatch.setattr(load, "_shipped_bytes", lambda: b"other texts")
    load.load_file(file)
    assert len(compiled) == 2


def test_a_copy_elsewhere_tells_its_own_places(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    for file in (tmp_path / "mine.ecs", tmp_path / "folder" / "mine.ecs"):
        file.write_text(TEXT)
        (clause,) = (c for c in load.load_file(file).clauses.values() if c.id == "MINE-C1")
        assert clause.at.file == str(file)


def test_a_wrong_text_is_wrong_each_time(tmp_path: Path, compiled: list[str]) -> None:
    file = tmp_path / "mine.ecs"
    file.write_text(TEXT.replace("MINE-C1 must", "MINE-C1 perhaps"))
    for _ in range(2):
        with pytest.raises(SpecError):
            load.load_file(file)
    assert len(compiled) == 2


def test_a_kept_device_is_the_device() -> None:
    for _ in range(2):
        load.load_device.cache_clear()  # another start
        kept_device = load.load_device("reference-drive")
    assert kept_device == load._device("reference-drive")  # noqa: SLF001
    assert kept_device.digest == load._device("reference-drive").digest  # noqa: SLF001
