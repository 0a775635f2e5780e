"""The only place for tests of what is kept between starts."""

from __future__ import annotations

from importlib import resources
from typing import TYPE_CHECKING

import pytest

from ecatspec.spec.language import load
from ecatspec.spec.language.kept import folder, kept
from ecatspec.spec.language.parse import decode, parse_text

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "ecatspec"


class Maker:
    """Counts how often it is asked."""

    def __init__(self) -> None:
        self.asked = 0

    def __call__(self) -> str:
        self.asked += 1
        return f"made {self.asked}"


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
