"""Tests of the site: it builds without a warning, and loads its own files."""

from __future__ import annotations

import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
LOADING = {
    "audio": "src",
    "embed": "src",
    "iframe": "src",
    "img": "src",
    "link": "href",
    "object": "data",
    "script": "src",
    "source": "src",
    "video": "src",
}
"""What makes a browser load something; a link that a reader may follow does not."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    for package in ("sphinx", "myst_parser", "furo"):
        pytest.importorskip(package, reason=f"no {package}: needs pip install --group docs")
    folder = tmp_path_factory.mktemp("site")
    words = ["-q", "-W", "--keep-going", "-d", str(folder / "trees"), "-c", "docs", "."]
    made = subprocess.run(
        [sys.executable, "-P", "-m", "sphinx", *words, str(folder / "html")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert made.returncode == 0, made.stderr
    return folder / "html"


class Loaded(HTMLParser):
    """All addresses that a page loads."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.addresses += [value or "" for name, value in attrs if LOADING.get(tag) == name]


def elsewhere(address: str) -> bool:
    return re.match(r"(?!data:)([a-z]+:)?//|(?!data:)[a-z]+:", address) is not None


def test_every_page_of_the_documentation_is_on_the_site(site: Path) -> None:
    pages = [*(ROOT / "docs").rglob("*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
    made = [(site / page.relative_to(ROOT)).with_suffix(".html") for page in pages]
    assert [page for page in made if not page.is_file()] == []
    assert (site / "index.html").is_file()


def test_no_page_loads_anything_from_elsewhere(site: Path) -> None:
    found = []
    for page in site.rglob("*.html"):
        loaded = Loaded()
        loaded.feed(page.read_text(encoding="utf-8"))
        found += [f"{page.name}: {each}" for each in loaded.addresses if elsewhere(each)]
    for style in site.rglob("*.css"):
        text = style.read_text(encoding="utf-8")
        named = re.findall(r"url\(\s*[\"']?([^\"')]+)", text) + re.findall(r"@import\s+(\S+)", text)
        found += [f"{style.name}: {each}" for each in named if elsewhere(each)]
    assert found == []


def test_what_is_loaded_is_there(site: Path) -> None:
    missing = []
    for page in site.rglob("*.html"):
        loaded = Loaded()
        loaded.feed(page.read_text(encoding="utf-8"))
        for address in loaded.addresses:
            name = re.split(r"[?#]", address)[0]
            if name and not name.startswith("data:") and not (page.parent / name).exists():
                missing.append(f"{page.name}: {address}")
    assert missing == []


@pytest.mark.parametrize(
    ("address", "is_elsewhere"),
    [
        ("https://example.org/a.js", True),
        ("//example.org/a.js", True),
        ("../_static/a.js?v=1", False),
        ("data:image/png;base64,AAAA", False),
    ],
)
def test_what_counts_as_elsewhere(address: str, *, is_elsewhere: bool) -> None:
    assert elsewhere(address) is is_elsewhere
