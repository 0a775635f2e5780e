"""The only place for the tests of our pages in a browser: Debian's Chromium, led by Playwright."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import pytest
from playwright.sync_api import Browser, Page, expect, sync_playwright

from ecatspec.conformance.diff.comparison import Comparison
from ecatspec.conformance.diff.page import page as diff_page
from ecatspec.conformance.reports import REPORTS
from ecatspec.conformance.verdict import Outcome, Result, SetUp, TraceLine, Verdict
from ecatspec.spec.language.load import load_device

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

CHROMIUM: Final = shutil.which("chromium")
DEVICE: Final = load_device("reference-drive")
ANSWER: Final = bytes.fromhex("0a000000000300304300100000000000")
FINDING: Final = Verdict(
    "mailbox/counter_zero",
    Outcome.FAIL,
    "counter 0 twice",
    "no state explains it",
    ("sdo_upload_expedited: counter 1..7 but not 0, index 0x1000",),
    "sdo_upload_expedited: counter 0, index 0x1000",
    ("MBX-06", "SDO-22"),
    trace=(
        TraceLine(0, "MainDevice", "sends sdo_upload_request: index 0x1000"),
        TraceLine(500, "MainDevice", "waits 0.5 ms"),
        TraceLine(500, "SubDevice", "answers sdo_upload_expedited: counter 0", ANSWER),
    ),
    differing=("counter",),
    blamed=("al.init_to_preop",),
)
CRASH: Final = replace(FINDING, case="sdo/7", outcome=Outcome.CRASH, title="unknown command")
RESULT: Final = Result(
    DEVICE.name,
    "a device",
    (FINDING, CRASH, Verdict("al/1", Outcome.PASS, "t", rules=("al.preop_kept",))),
    ("al.preop_kept",),
    200,
    ("AL-02",),
    100,
    1.5,
    {"mailbox_support": "present"},
    ("a note",),
    set_up=SetUp(DEVICE.name, "exec:./slave", "quick", 0, "", "2026-01-02T03:04:05+00:00"),
)

pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium: apt-get install chromium"),
    pytest.mark.xdist_group("browser"),
]


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    # a browser of root has no sandbox to put pages into
    arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)
        yield opened
        opened.close()


class Opened:
    """A page of a file, and what it complained of or asked of others."""

    def __init__(self, browser: Browser, file: Path, **options: object) -> None:
        self.complaints: list[str] = []
        self.asked: list[str] = []
        self.page: Page = browser.new_page(**options)  # type: ignore[arg-type]
        self.page.on("console", lambda message: self.complaints.append(message.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(file.as_uri())
        own = {file.as_uri(), "data:,"}
        assert {url for url in self.asked if url.partition("#")[0] not in own} == set()


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("page") / "report.html"
    file.write_text(REPORTS["html"]((RESULT,), DEVICE), encoding="utf-8")
    return file


@pytest.fixture
def opened(browser: Browser, report: Path) -> Iterator[Opened]:
    found = Opened(browser, report)
    yield found
    found.page.close()
    assert not found.complaints


def rows(page: Page) -> list[str]:
    """The clauses that are shown."""
    return page.locator("table.clauses tbody tr:visible th").all_inner_texts()


def test_the_page_opens_with_its_verdict(opened: Opened) -> None:
    page = opened.page
    assert page.title() == "Conformance of reference-drive"
    assert "Does not conform" in page.locator("header").inner_text()
    assert page.locator("article").count() == 2
    assert page.locator("article").first.locator("h3").inner_text().startswith("1. unknown command")


def test_words_filter_the_clauses(opened: Opened) -> None:
    page = opened.page
    every = rows(page)
    assert every == list(DEVICE.clauses)
    page.get_by_role("searchbox").fill("mbx-06")
    assert "MBX-06" in rows(page)
    assert len(rows(page)) < len(every)
    assert page.locator("output").inner_text() == f"{len(rows(page))} of {len(every)} clauses"
    page.get_by_role("searchbox").fill("no clause says this")
    assert rows(page) == []


def test_what_was_shown_filters_the_clauses(opened: Opened) -> None:
    page = opened.page
    page.get_by_role("combobox").select_option("failed")
    assert rows(page) == [FINDING.broken]
    page.get_by_role("combobox").select_option("held")
    assert "AL-02" in rows(page)


def test_links_lead_from_findings_to_clauses_and_back(opened: Opened) -> None:
    page = opened.page
    page.locator("ol.short a").last.click()
    heading = page.locator("#run-1-finding-2")
    assert heading.inner_text().startswith("2. counter 0 twice")
    page.get_by_role("searchbox").fill("no clause says this")
    page.locator("article").last.get_by_role("link", name="MBX-06").click()
    row = page.locator("#run-1-clause-MBX-06")
    expect(row).to_be_in_viewport()  # a row that was filtered away is shown again
    row.get_by_role("link", name="2").click()
    assert page.url.endswith("#run-1-finding-2")


def test_every_link_leads_somewhere(opened: Opened) -> None:
    assert (
        opened.page.evaluate(
            "[...document.querySelectorAll('a')].filter(a => !document.getElementById("
            "decodeURIComponent(a.hash.slice(1)))).map(a => a.hash)"
        )
        == []
    )


def test_a_message_is_shown_byte_by_byte(opened: Opened) -> None:
    article = opened.page.locator("article").last
    table = article.get_by_role("table", name="sdo_upload_expedited, byte by byte")
    assert not table.is_visible()
    article.get_by_text("Sequence of finding").click()  # of the first alone it is open
    article.locator(".bytes summary").click()
    assert table.is_visible()
    assert table.locator(".differs").inner_text().split() == [
        "5,",
        "bits",
        "4",
        "to",
        "6",
        "03",
        "counter",
        "0",
    ]


def test_the_keyboard_reaches_content_first_and_shows_where_it_is(opened: Opened) -> None:
    page = opened.page
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.textContent") == "To the content"
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") != "none"
    page.keyboard.press("Enter")
    assert page.url.endswith("#content")


def test_readers_find_landmarks_headings_and_captions(opened: Opened) -> None:
    page = opened.page
    for role in ("banner", "navigation", "main", "contentinfo"):
        assert page.get_by_role(role).count() == 1, role
    levels = page.locator("h1,h2,h3,h4").evaluate_all("all => all.map(h => +h.tagName[1])")
    assert levels[0] == 1
    assert all(after - before <= 1 for before, after in pairwise(levels))
    assert page.evaluate("[...document.querySelectorAll('table')].every(t => t.caption)")
    assert page.evaluate(
        "[...document.querySelectorAll('input,select')].every(i => i.labels.length === 1)"
    )
    assert page.get_by_role("img").count() == 2  # the two machines, each with its title


@pytest.mark.parametrize("width", [320, 390, 1280])
def test_the_page_fits_a_phone(browser: Browser, report: Path, width: int) -> None:
    opened = Opened(browser, report, viewport={"width": width, "height": 800})
    assert opened.page.evaluate("document.documentElement.scrollWidth") <= width
    opened.page.close()


@pytest.mark.parametrize(
    ("scheme", "paper"), [("light", "rgb(255, 255, 255)"), ("dark", "rgb(13, 17, 23)")]
)
def test_the_page_is_light_or_dark(browser: Browser, report: Path, scheme: str, paper: str) -> None:
    opened = Opened(browser, report, color_scheme=scheme)
    shot = "getComputedStyle(document.documentElement).colorScheme"
    assert opened.page.evaluate(shot) == "light dark"
    painted = opened.page.evaluate("getComputedStyle(document.querySelector('.ecs-paper')).fill")
    assert painted == paper
    opened.page.close()


def test_the_page_says_all_without_scripts(browser: Browser, report: Path) -> None:
    opened = Opened(browser, report, java_script_enabled=False)
    assert len(rows(opened.page)) == len(DEVICE.clauses)
    assert not opened.page.locator("form").is_visible()
    assert not opened.complaints
    opened.page.close()


def test_the_page_of_a_comparison_opens_too(browser: Browser, tmp_path: Path) -> None:
    other = load_device("reference")
    nothing: tuple[dict[str, str], dict[str, str]] = ({}, {})
    same = Comparison(("a", "b"), (DEVICE, other), (), (), (), (), nothing, (), ())
    file = tmp_path / "diff.html"
    file.write_text(diff_page(same), encoding="utf-8")
    opened = Opened(browser, file)
    assert opened.page.locator("h1").inner_text() == "a against b"
    assert opened.page.get_by_role("img").count() == 4
    assert not opened.complaints
    opened.page.close()
