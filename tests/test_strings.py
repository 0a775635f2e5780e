"""Tests of strings whose size is fixed, varies, or is not said by the text."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from ecatspec.conformance.adapters.model import VirtualAdapter, described
from ecatspec.conformance.base.verdict import Outcome
from ecatspec.conformance.run.runner import Runner
from ecatspec.generators.cases.bringup import case_in
from ecatspec.generators.cases.transfers import download, upload
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.object_dictionary import encode_value, size_varies
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.spec.language.ir import ObjectEntry
from ecatspec.spec.language.load import load_device
from ecatspec.spec.language.parse import parse_text
from ecatspec.spec.language.pretty import pretty

if TYPE_CHECKING:
    from ecatspec.spec.language.ir import Protocol

KEY = 0x2020, 0
ROWS = """device x extends standard "x"
clause X-1 must "strings" source "x"
objects
  0x2000 : 0  said     text(8)   rw fixed = "abc"  [X-1]
  0x2001 : 0  varies   bytes(8)  rw varying        [X-1]
  0x2002 : 0  unsaid   text(8)   rw = "abc"        [X-1]
"""


def marked(mark: str) -> Protocol:
    """Give the reference with a short text whose row says this."""
    sound = load_device("reference")
    rows = tuple(
        replace(entry, fixed=mark == "fixed", varying=mark == "varying")
        if (entry.index, entry.subindex) == KEY
        else entry
        for entry in sound.objects
    )
    return replace(sound, objects=rows)


def outcome(expected: str, actual: str) -> tuple[Outcome, tuple[str, ...]]:
    """Judge a device whose text has one mark by a text with another: two bytes of four come."""
    device, model = marked(actual), Model(marked(expected))
    adapter = VirtualAdapter(VirtualSubDevice(device), described(device))
    short = download(*KEY, b"xy"), upload(*KEY)
    verdict = Runner(model, adapter, adapter.describe()).executor.judge(
        case_in(model, "sdo/own", "a short string", short)
    )
    return verdict.outcome, verdict.clauses


@pytest.mark.parametrize("actual", ["fixed", "varying"])
def test_what_no_text_says_of_a_string_is_free(actual: str) -> None:
    assert outcome("", actual)[0] is Outcome.PASS
    assert outcome(actual, actual)[0] is Outcome.PASS


def test_what_a_text_says_of_a_string_is_judged() -> None:
    blamed, clauses = outcome("fixed", "varying")
    assert blamed is Outcome.FAIL
    assert "SDO-13" in clauses
    blamed, clauses = outcome("varying", "fixed")
    assert blamed is Outcome.FAIL
    assert "SDO-12" in clauses or "SDO-22" in clauses


def test_a_row_says_whether_the_size_of_a_string_varies() -> None:
    text = parse_text(ROWS, "x")
    said, varies, unsaid = (d for d in text.declarations if isinstance(d, ObjectEntry))
    assert (said.fixed, said.varying) == (True, False)
    assert (varies.fixed, varies.varying) == (False, True)
    assert (unsaid.fixed, unsaid.varying) == (False, False)
    assert [size_varies(entry) for entry in (said, varies, unsaid)] == [False, True, True]
    assert encode_value(said, "abc") == b"abc" + bytes(5)
    assert encode_value(unsaid, "abc") == b"abc"
    assert "fixed" in pretty(text)
    assert "varying" in pretty(text)
