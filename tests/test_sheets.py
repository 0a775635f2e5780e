"""Tests of tables of words."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ecatspec.conformance.render.tables import Sheet, markdown_table, text_table

words = st.text(st.sampled_from("ab "), max_size=90).map(lambda text: " ".join(text.split()))


@given(st.lists(st.tuples(words, words, st.integers(0, 10**6)), max_size=5), st.integers(40, 120))
def test_a_table_fits_and_loses_no_letter(rows: list[tuple[str, str, int]], width: int) -> None:
    sheet = Sheet("x", "Title", ("first", "second", "count"), tuple(rows))
    text = text_table(sheet, width)
    _, title, _, *lines = text.splitlines()
    assert title == "Title"
    assert all(len(line) <= width for line in lines)
    kept = sorted("".join("".join(lines[2:]).split()))
    assert kept == sorted("".join("".join(map(str, row)) for row in rows).replace(" ", ""))


def test_a_table_is_no_wider_than_it_needs() -> None:
    sheet = Sheet("x", "T", ("n", "long name"), ((1, ("a", "b")), (22, "c" * 60)))
    assert text_table(sheet, 120).splitlines()[3:] == [
        " n  long name",
        "─" * 64,
        " 1  a, b",
        "22  " + "c" * 60,
    ]


@pytest.mark.parametrize("width", [0, 40])
def test_the_widest_column_gives_way(width: int) -> None:
    sheet = Sheet("x", "T", ("a", "b"), (("key", "one two three four five six seven eight"),))
    assert text_table(sheet, width).splitlines()[5:] == [
        "key  one two three four five six seven",
        "     eight",
    ]


def test_a_bar_does_not_end_a_cell_of_markdown() -> None:
    sheet = Sheet("x", "T", ("a",), (("one|two",),))
    assert markdown_table(sheet).splitlines() == ["| a |", "| --- |", "| one\\|two |"]
