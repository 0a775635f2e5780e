"""Tests of bench/: its arithmetic, what it writes, and that all of it works."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from typing import TYPE_CHECKING

import growth
import pytest
import run
from measure import (
    Absent,
    Curve,
    Effort,
    Figure,
    Found,
    Of,
    Part,
    Profile,
    Row,
    Share,
    Table,
    Target,
    in_turns,
    measured,
    number,
    profiled,
    ran,
)

from ecatspec.spec.language.load import load_file, load_standard

if TYPE_CHECKING:
    from pathlib import Path

ROW = Row("name", "what", "us", "the rival", Target(Of.RATIO, 3.0))
ON = {
    "date": "2026-01-01",
    "processor": "processor",
    "cores": "2",
    "system": "system",
    "python": "3",
    "load": "0",
}


def report() -> run.Report:
    """A report in which one target is reached, one missed, and one could not be measured."""
    found = run.Report("python bench/run.py", ON)
    missed = replace(ROW, name="missed", what="the missed one", why="Because.")
    absent = replace(ROW, name="absent", note="not measured: no tool")
    found.rows = [
        ROW.found(Figure.of([2.0, 4.0, 6.0]), Figure.single(2.0), "a note"),
        missed.found(Figure.single(9.0), Figure.single(2.0)),
        absent,
    ]
    found.tables = [Table("Details", ("a", "b"), (("1", "2|3"),), "A remark.")]
    found.curves = [Curve("time", "cases", ((1, 1.0), (2, 2.0), (4, 4.0)))]
    found.profiles = {"missed": Profile("cProfile", 1.0, (Share(0.5, "model/x.py:1 f", 7),))}
    return found


# --- arithmetic -----------------------------------------------------------------------------------


def test_a_figure_is_the_median_with_its_spread() -> None:
    assert Figure.of([5.0, 1.0, 2.0]) == Figure(2.0, 1.0, 5.0)
    assert str(Figure.of([5.0, 1.0, 2.0])) == "2 (1 to 5)"
    assert str(Figure.single(0.25)) == "0.25"


@pytest.mark.parametrize(
    ("value", "words"), [(12345.6, "12,346"), (12.34, "12.3"), (0.012345, "0.0123"), (3.0, "3")]
)
def test_a_number_has_three_digits_that_count(value: float, words: str) -> None:
    assert number(value) == words


@pytest.mark.parametrize(
    ("of", "least", "limit", "measures", "reached"),
    [
        (Of.FIGURE, False, 8.0, 8.0, True),
        (Of.FIGURE, True, 9.0, 8.0, False),
        (Of.RATIO, False, 3.9, 4.0, False),
        (Of.RATIO, True, 4.0, 4.0, True),
        (Of.INVERSE, True, 0.3, 0.25, False),
        (Of.ADDED, False, 6.0, 6.0, True),
    ],
)
def test_a_target_is_held_against_what_it_speaks_of(
    of: Of,
    least: bool,  # noqa: FBT001
    limit: float,
    measures: float,
    reached: bool,  # noqa: FBT001
) -> None:
    row = replace(ROW, target=Target(of, limit, least=least))
    found = row.found(Figure.single(8.0), Figure.single(2.0))
    assert (found.measured, found.reached) == (measures, reached)


def test_what_was_not_measured_is_neither_reached_nor_missed() -> None:
    assert (ROW.ratio, ROW.measured, ROW.reached) == (None, None, None)
    assert replace(ROW, target=None).found(Figure.single(1.0)).reached is None
    assert ROW.cells()[2] == "not measured"


def test_a_row_says_how_many_times_less() -> None:
    row = replace(ROW, target=Target(Of.INVERSE, 10.0, least=True))
    cells = row.found(Figure.single(10.0), Figure.single(640.0)).cells()
    assert cells[4:] == ("1/64", ">= 10x less", "yes")


def test_a_curve_tells_a_line_from_a_square() -> None:
    line = Curve("", "", tuple((1 << n, 0.5 * (1 << n)) for n in range(5)))
    square = Curve("", "", tuple((1 << n, 0.5 * (1 << 2 * n)) for n in range(5)))
    assert [line.slope, line.worst] == pytest.approx([1, 1])
    assert [square.slope, square.worst] == pytest.approx([2, 2])


def test_works_take_turns_after_a_round_that_is_not_counted() -> None:
    order: list[str] = []
    found = in_turns(2, lambda: order.append("a"), lambda: order.append("b"))
    assert order == ["a", "b"] * 3
    assert [len(times) for times in found] == [2, 2]
    order.clear()
    in_turns(1, lambda: order.append("a"), warm=False)
    assert order == ["a"]


def test_a_process_is_watched_and_stopped() -> None:
    size = 40_000_000
    code = f"import time; held = bytearray({size}); time.sleep(60)"
    found = ran((sys.executable, "-c", code), longest=0.6)
    assert found.peak > size / 1e6
    assert found.seconds < 20
    assert found.status != 0


def test_a_profile_names_the_largest_without_a_folder_of_this_machine() -> None:
    def busy() -> int:
        return sum(n * n for n in range(200_000))

    found = profiled(busy)
    assert found.shares[0].where.startswith("test_bench.py:")
    assert found.shares[0].part > 0.2
    assert not any("/" in share.where for share in found.shares)


def test_what_is_missing_or_went_wrong_is_told_by_the_row() -> None:
    def missing(_rows: tuple[Row, ...], _effort: Effort) -> Found:
        raise Absent("no tool")

    def wrong(_rows: tuple[Row, ...], _effort: Effort) -> Found:
        raise AssertionError("they do not agree")

    for measure, words in ((missing, "no tool"), (wrong, "they do not agree")):
        found = measured(Part((ROW,), measure), Effort.TINY)
        assert [row.note for row in found.rows] == [f"not measured: {words}"]
        assert found.rows[0].ecatspec is None


# --- what it writes -------------------------------------------------------------------------------


def test_the_data_has_figures_and_what_follows_from_them() -> None:
    data = json.loads(run.as_json(report()))
    rows = {row["name"]: row for row in data["rows"]}
    assert rows["name"]["ecatspec"] == {"median": 4.0, "low": 2.0, "high": 6.0}
    assert [row["reached"] for row in data["rows"]] == [True, False, None]
    assert rows["name"]["ratio"] == 2.0
    assert rows["name"]["target"]["words"] == "<= 3x"
    assert data["curves"][0]["slope"] == pytest.approx(1)
    assert data["profiles"]["missed"]["shares"][0]["where"] == "model/x.py:1 f"
    assert data["machine"] == ON


def test_the_page_has_all_and_a_reason_for_what_is_missed() -> None:
    page = run.as_page(report())
    assert "| what | the rival | 4 (2 to 6) us | 2 | 2x | <= 3x | yes |" in page
    assert "Of 3 targets: reached 1, missed 1, not measured 1." in page
    assert "**the missed one** is 4.5 where <= 3x was wanted. Because." in page
    assert "| 50.0% | 7 | `model/x.py:1 f` |" in page
    assert "| 1 | 2/3 |" in page  # a bar would end the cell
    assert "- **what**: not measured: no tool." in page


def test_the_page_is_written_between_its_markers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = tmp_path / "performance.md"
    monkeypatch.setattr(run, "PAGE", page)
    monkeypatch.setattr(run, "PLOT", tmp_path / "growth.svg")
    page.write_text(f"before\n{run.BEGIN}\nold\n{run.END}\nafter\n", "utf-8")
    run.write(report())
    once = page.read_text("utf-8")
    assert once.startswith(f"before\n{run.BEGIN}\n\nMeasured on 2026-01-01 by")
    assert once.endswith(f"{run.END}\nafter\n")
    assert "old" not in once
    run.write(report())
    assert page.read_text("utf-8") == once
    page.write_text("nothing\n", "utf-8")
    with pytest.raises(ValueError, match="lost its markers"):
        run.write(report())


def test_the_page_of_the_repository_can_be_written() -> None:
    page = run.PAGE.read_text("utf-8")
    assert page.index(run.BEGIN) < page.index(run.END)


def test_a_drawing_of_the_same_curves_is_the_same() -> None:
    curves = report().curves
    drawn = growth.drawing(curves)
    assert drawn == growth.drawing(curves)
    assert "power 1.00" in drawn
    assert "<dc:date>" not in drawn


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--only", "nothing"], "bench: there is nothing called nothing; topics: exchanges, "),
        (["--profile", "walk-tables"], "bench: there is no profile of walk-tables"),
    ],
)
def test_an_unknown_name_is_one_line(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run.main(arguments) == 2
    said = capsys.readouterr()
    assert (said.out, said.err.count("\n")) == ("", 1)
    assert said.err.startswith(words)


def test_the_page_is_not_written_from_a_part_of_the_figures() -> None:
    with pytest.raises(SystemExit) as ended:
        run.main(["--write", "--only", "walks"])
    assert ended.value.code == 2


def test_the_command_that_is_shown_has_no_file_of_this_machine(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    part = Part((ROW,), lambda rows, _: Found((rows[0].found(Figure.single(1.0)),)))
    monkeypatch.setattr(run, "TOPICS", {"topic": (part,)})
    path = tmp_path / "figures.json"
    assert run.main(["--quick", "--only", "topic", "--json", str(path)]) == 0
    data = json.loads(path.read_text("utf-8"))
    assert data["command"] == "python bench/run.py --quick --only topic"
    assert "ecatspec beside its rivals" in capsys.readouterr().out


# --- all of it ------------------------------------------------------------------------------------

PARTS = [part for parts in run.TOPICS.values() for part in parts]


def test_every_row_has_its_own_name_and_every_profile_a_row() -> None:
    names = [row.name for part in PARTS for row in part.rows]
    assert len(names) == len(set(names))
    assert all(part.profiles.keys() <= {row.name for row in part.rows} for part in PARTS)


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.rows[0].name)
def test_every_measurement_works(part: Part) -> None:
    try:
        found = part.measure(part.rows, Effort.TINY)
    except Absent as absent:
        pytest.skip(str(absent))
    assert [row.name for row in found.rows] == [row.name for row in part.rows]
    for row in found.rows:
        if row.ecatspec is None:
            assert row.note.startswith("not measured: "), row.name
        else:
            assert row.ecatspec.low <= row.ecatspec.median <= row.ecatspec.high
            assert row.rival is None or row.rival.median > 0
            assert row.target is None or row.measured is not None, row.name
    for curve in found.curves:
        assert len(curve.points) > 1


@pytest.mark.parametrize("name", ["exchange-model", "transfer-upload", "start-help"])
def test_a_profile_can_be_taken(name: str) -> None:
    taken = next(part.profiles[name] for part in PARTS if name in part.profiles)
    found = taken(Effort.TINY)
    assert found.seconds > 0
    assert len(found.shares) > 5
    assert 0 < found.shares[-1].part <= found.shares[0].part < 1


@pytest.mark.parametrize("count", [0, 5, 20])
def test_texts_that_grow_are_sound(count: int, tmp_path: Path) -> None:
    path = tmp_path / "grown.ecs"
    path.write_text(growth.text_of_objects(count), "utf-8")
    added = {o.name for o in load_file(path).objects} - {o.name for o in load_standard().objects}
    assert added == {f"entry_{n}" for n in range(count)}
    path.write_text(growth.text_of_rules(count), "utf-8")
    assert len(load_file(path).machines["grown"].rules) == count
