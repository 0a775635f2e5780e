"""Writes test vectors as a table, with a row for each expectation."""

from __future__ import annotations

import csv
import io
from typing import TYPE_CHECKING, Final, assert_never

from ecatspec.generators.vectors.schema import Full, Local, Mail, Read, Send, Write

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from typing import IO

    from ecatspec.generators.vectors.schema import Allowed, Expected, Head, Input, Step, Test

    Row = Mapping[str, str | int]

COLUMNS: Final = (
    "test",
    "tcId",
    "group",
    "comment",
    "flags",
    "needs",
    "requires",
    "texts",
    "step",
    "do",
    "address",
    "data",
    "symbol",
    "counter",
    "otherwise",
    "us",
    "early",
    "cycleAddress",
    "cycleData",
    "cycleUs",
    "expectation",
    "kind",
    "readAddress",
    "readLength",
    "readSymbol",
    "alternatives",
    "nothing",
    "anythingElse",
    "mailCounter",
    "clauses",
)
"""Those of a test are filled in its first row, those of a step in the first row of the step."""


def write(head: Head, tests: Iterable[tuple[str, Test]], out: IO[bytes]) -> None:
    """Write a table with one row of names, as RFC 4180 says; a test is in memory at a time."""
    text = io.TextIOWrapper(out, encoding="utf-8", newline="", write_through=True)
    try:
        rows = csv.DictWriter(text, COLUMNS, restval="")
        rows.writeheader()
        for group, test in tests:
            rows.writerows(_rows(head, group, test))
    finally:
        text.detach()  # the file is the caller's to close


def _rows(head: Head, group: str, test: Test) -> Iterator[Row]:
    named: Row = {"test": test.id, "tcId": test.tcId}
    first: Row = {
        "group": group,
        "comment": test.comment,
        "flags": " ".join(test.flags),
        "needs": " ".join(test.needs),
        "requires": int(test.requires),
        "texts": head.spec.sha256,
    }
    for place, step in enumerate(test.steps, 1):
        row: Row = {**named, **first, "step": place, **_step(head, step)}
        first = {}
        for number, expected in enumerate(step.expect, 1):
            yield {**row, "expectation": number, **_expected(head, expected)}
            row = {**named, "step": place}
        if not step.expect:
            yield row


def _step(head: Head, step: Step) -> Row:
    clauses = sorted({clause for rule in step.covers for clause in head.rules.get(rule, [])})
    row: dict[str, str | int] = {
        **_input(step.given),
        "us": step.us,
        "early": int(step.early),
        "clauses": " ".join(clauses),
    }
    if step.cycle is not None:
        row |= {
            "cycleAddress": _address(step.cycle.address),
            "cycleData": step.cycle.data,
            "cycleUs": step.cycle.us,
        }
    return row


def _input(given: Input | None) -> Row:
    match given:
        case Write(address, data, symbol, counter, otherwise):
            return {
                "do": "write",
                "address": _address(address),
                "data": data,
                "symbol": symbol,
                "counter": counter,
                "otherwise": otherwise or "",
            }
        case Send(address, data, symbol):
            return {"do": "send", "address": _address(address), "data": data, "symbol": symbol}
        case Local(event):
            return {"do": "local", "symbol": event}
        case None:
            return {"do": "look"}
        case _:
            assert_never(given)


def _expected(head: Head, expected: Expected) -> Row:
    match expected:
        case Read():
            return {
                "kind": "read",
                "readAddress": _address(expected.address),
                "readLength": expected.length,
                "readSymbol": expected.symbol,
                "alternatives": _alternatives(expected.anyOf),
                "nothing": expected.refused or "",
                "anythingElse": expected.otherwise or "",
            }
        case Mail():
            area = head.config.mailboxIn
            return {
                "kind": "mail",
                "readAddress": _address(area.address),
                "readLength": area.length,
                "readSymbol": expected.symbol,
                "alternatives": _alternatives(expected.anyOf),
                "nothing": expected.none or "",
                "anythingElse": expected.otherwise or "",
                "mailCounter": expected.counter,
            }
        case Full(full, otherwise):
            area, mask = head.config.mailboxFull, head.config.mailboxFullMask
            value = mask if full else "0" * len(mask)
            return {
                "kind": "full",
                "readAddress": _address(area.address),
                "readLength": area.length,
                "alternatives": f"{value}/{mask}/passes",
                "anythingElse": otherwise or "",
            }
        case _:
            assert_never(expected)


def _alternatives(every: Iterable[Allowed]) -> str:
    """Say value, mask and effect of each, and how short it may be if it may."""
    return " ".join(
        f"{each.value}/{each.mask}/{each.effect}" + (f"/{each.atLeast}" if each.atLeast else "")
        for each in every
    )


def _address(address: int) -> str:
    return f"0x{address:04X}"
