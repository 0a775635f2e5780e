"""Tests of our pages in a browser: Debian's Chromium, led by Playwright."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import pytest
from playwright.sync_api import Browser, Locator, Page, expect, sync_playwright

from ecatspec.conformance.base.verdict import Outcome, Result, SetUp, TraceLine, Verdict
from ecatspec.conformance.diff.comparison import Comparison
from ecatspec.conformance.diff.page import page as diff_page
from ecatspec.conformance.reports import REPORTS
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

CONTRAST: Final = """kinds => {
  const parts = (colour) => {
    const box = Object.assign(document.createElement("canvas"), { width: 1, height: 1 });
    const draw = box.getContext("2d", { willReadFrequently: true });
    for (const each of [getComputedStyle(page).backgroundColor, colour]) {
      draw.fillStyle = each;
      draw.fillRect(0, 0, 1, 1);
    }
    return [...draw.getImageData(0, 0, 1, 1).data].slice(0, 3);
  };
  const light = (colour) => parts(colour).map((part) => part / 255)
    .map((part) => part <= 0.03928 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4)
    .reduce((sum, part, at) => sum + part * [0.2126, 0.7152, 0.0722][at], 0);
  const page = document.body.appendChild(document.createElement("div"));
  page.style.background = "Canvas";
  return [...document.querySelectorAll(kinds)].map((each) => {
    const behind = each.closest("thead th") ?? page;
    const lights = [getComputedStyle(each).color, getComputedStyle(behind).backgroundColor];
    const [dark, bright] = lights.map(light).sort((one, other) => one - other);
    return (bright + 0.05) / (dark + 0.05);
  });
}"""
"""How much the words of elements differ from what is behind them, as WCAG 2 counts it."""

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


def finder(page: Page, what: str) -> Locator:
    """The field that searches the clauses or the findings."""
    return page.get_by_role("searchbox", name=f"Find {what}")


def counted(page: Page, what: str) -> str:
    return page.locator(f"form[data-what={what}] output").inner_text()


def findings(page: Page) -> list[str]:
    """The findings that are shown, and their lines in the list, by their numbers."""
    titles = page.locator("article:visible h3").all_inner_texts()
    lines = page.locator("ol.short > li:visible").evaluate_all("all => all.map(l => l.value)")
    numbers = [title.partition(".")[0] for title in titles]
    assert numbers == [str(line) for line in lines]
    return numbers


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
    finder(page, "clauses").fill("mbx-06")
    assert "MBX-06" in rows(page)
    assert len(rows(page)) < len(every)
    assert counted(page, "clauses") == f"{len(rows(page))} of {len(every)} clauses"
    finder(page, "clauses").fill("no clause says this")
    assert rows(page) == []


def test_what_was_shown_filters_the_clauses(opened: Opened) -> None:
    page = opened.page
    page.get_by_role("combobox", name="Show clauses").select_option("failed")
    assert rows(page) == [FINDING.broken]
    page.get_by_role("combobox", name="Show clauses").select_option("held")
    assert "AL-02" in rows(page)


@pytest.mark.parametrize(
    ("words", "shown"),
    [
        ("counter 0 TWICE", ["2"]),  # the title
        ("sdo/7", ["1"]),  # the case
        ("mbx-06 unknown", ["1"]),  # a clause, and another word
        ("index 0x1000", ["1", "2"]),  # a field
        ("no state explains it", ["1", "2"]),  # the reason
        ("waits 0.5 ms", []),  # what sequences say is alike in many findings
        ("no finding says this", []),
    ],
)
def test_words_filter_the_findings(opened: Opened, words: str, shown: list[str]) -> None:
    page = opened.page
    assert findings(page) == ["1", "2"]
    assert counted(page, "findings") == "2 of 2 findings"
    finder(page, "findings").fill(words)
    assert findings(page) == shown
    assert counted(page, "findings") == f"{len(shown)} of 2 findings"
    assert len(rows(page)) == len(DEVICE.clauses)
    finder(page, "findings").fill("")
    assert findings(page) == ["1", "2"]


def test_how_they_ended_filters_the_findings(opened: Opened) -> None:
    opened.page.get_by_role("combobox", name="Show findings").select_option("crash")
    assert findings(opened.page) == ["1"]


def test_a_link_to_a_finding_that_is_filtered_away_shows_it(opened: Opened) -> None:
    page = opened.page
    finder(page, "findings").fill("sdo/7")
    page.locator(f"#run-1-clause-{FINDING.broken}").get_by_role("link", name="2").click()
    expect(page.locator("#run-1-finding-2")).to_be_in_viewport()
    assert findings(page) == ["1", "2"]


def test_the_first_sequence_alone_is_open_and_clauses_come_behind(opened: Opened) -> None:
    sequences = opened.page.locator("article > details")
    assert sequences.evaluate_all("all => all.map(d => d.open)") == [True, False]
    order = "all => all.map(d => d.nextElementSibling.querySelector('dt').textContent)"
    assert sequences.evaluate_all(order) == ["Broken", "Broken"]


def test_the_whole_run_is_a_table_that_can_be_read_without_colours(opened: Opened) -> None:
    page = opened.page
    table = page.get_by_role("table", name="How far the run got")
    heads = table.get_by_role("columnheader").all_inner_texts()
    assert heads == [
        "machine",
        "✓ exercised",
        "✗ blamed",
        "○ not exercised",
        "\N{EN DASH} cannot fire",
        "rules",
    ]
    row = table.get_by_role("row").filter(has=page.get_by_role("rowheader", name="al", exact=True))
    exercised, blamed, *others, total = map(int, row.get_by_role("cell").all_inner_texts())
    assert (exercised, blamed) == (1, 1)
    assert exercised + blamed + sum(others) == total == len(DEVICE.machines["al"].rules)
    row.get_by_role("link").click()
    rules = page.get_by_role("region", name="Table of the rules of al")
    expect(rules).to_be_in_viewport()
    preop = rules.get_by_role("row").filter(
        has=page.get_by_role("rowheader", name="PREOP", exact=True)
    )
    assert "✓ exercised: preop_kept" in " ".join(preop.inner_text().split())


def test_print_shows_all_but_what_is_for_hands(opened: Opened) -> None:
    opened.page.emulate_media(media="print")
    assert not opened.page.locator("form").first.is_visible()
    assert opened.page.locator("table.rules span").first.is_visible()
    adjusted = "b => getComputedStyle(b).printColorAdjust"
    assert opened.page.locator(".bar").first.evaluate(adjusted) == "exact"


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_word_of_the_whole_run_has_contrast(
    browser: Browser, report: Path, scheme: str
) -> None:
    opened = Opened(browser, report, color_scheme=scheme)
    ratios = opened.page.evaluate(CONTRAST, ".whole th, .rules b, .rules span")
    assert min(ratios) >= 4.5
    opened.page.close()


def test_links_lead_from_findings_to_clauses_and_back(opened: Opened) -> None:
    page = opened.page
    page.locator("ol.short a").last.click()
    heading = page.locator("#run-1-finding-2")
    assert heading.inner_text().startswith("2. counter 0 twice")
    finder(page, "clauses").fill("no clause says this")
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
    assert page.get_by_role("img").count() == 5  # each machine with its title


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
    assert findings(opened.page) == ["1", "2"]
    assert not opened.page.locator("form:visible").count()
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
