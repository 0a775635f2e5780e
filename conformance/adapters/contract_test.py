"""Checks an adapter against the contract: the cases that every adapter must pass.

The kit checks the adapter, not the device: it knows no protocol, so the places to read and write
are arguments.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.base.adapter import (
    ADDRESS_SPACE,
    AdapterError,
    Description,
    DeviceFault,
    read_all,
    step_until,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from ecatspec.conformance.base.adapter import Adapter

_STEPS: Final = (0.0005, 0.0, 0.2)
"""Seconds of steps that are done at once and one by one."""


def check_adapter(
    make: Callable[[], Adapter],
    *,
    spans: Sequence[tuple[int, int]],
    write: tuple[int, bytes],
) -> list[str]:
    """Return what is wrong with the adapters that `make` opens; an empty list is a pass.

    `spans` are (address, length) of memory that two resets must leave equal, and `write` is an
    access that the device takes after a reset and that a reset undoes.
    """
    complaints: list[str] = []
    for name, check in CHECKS.items():
        adapter = make()
        try:
            adapter.reset()
            complaints += [f"{name}: {complaint}" for complaint in check(adapter, spans, write)]
        except (AdapterError, DeviceFault) as error:
            complaints.append(f"{name}: {type(error).__name__}: {error}")
        finally:
            adapter.close()
    return complaints


def _check_read(
    adapter: Adapter, spans: Sequence[tuple[int, int]], _write: tuple[int, bytes]
) -> Iterator[str]:
    for address, length in (*spans, *((address, 1) for address, _ in spans)):
        result: object = adapter.read(address, length)
        match result:
            case (int(working_counter), bytes(data)) if type(working_counter) is int:
                if working_counter < 0:
                    yield f"read {address} has a working counter of {working_counter}"
                if working_counter > 0 and len(data) != length:
                    yield f"read {address} gives {len(data)} bytes for {length}"
            case _:
                yield f"read {address} gives {result!r}, not a working counter and bytes"


def _check_write(
    adapter: Adapter, _spans: Sequence[tuple[int, int]], write: tuple[int, bytes]
) -> Iterator[str]:
    before = adapter.describe()
    result: object = adapter.write(*write)
    if type(result) is not int or result < 1:
        yield f"write {write[0]} gives {result!r}, not a working counter of 1 or more"
    if adapter.describe() != before:
        yield "the description changes with a write"


def _check_reset(
    adapter: Adapter, spans: Sequence[tuple[int, int]], write: tuple[int, bytes]
) -> Iterator[str]:
    fresh = [adapter.read(*span) for span in spans]
    adapter.write(*write)
    adapter.reset()
    for (address, _), old, new in zip(
        spans, fresh, (adapter.read(*span) for span in spans), strict=True
    ):
        if old != new:
            yield f"the memory from {address} is not the same after two resets"


def _check_advance(
    adapter: Adapter, _spans: Sequence[tuple[int, int]], _write: tuple[int, bytes]
) -> Iterator[str]:
    result: object = adapter.advance(0.0)  # type: ignore[func-returns-value]
    if result is not None:
        yield f"advance gives {result!r}"
    try:
        adapter.advance(-1.0)
    except AdapterError:
        pass
    else:
        yield "advance takes a time that runs backward"


def _check_advance_until(
    adapter: Adapter, spans: Sequence[tuple[int, int]], write: tuple[int, bytes]
) -> Iterator[str]:
    """Compare what it gives with the same steps one by one, before and after a change."""
    if not adapter.describe().advance_until:
        return
    own = getattr(adapter, "advance_until", None)
    if own is None:
        yield "the description has advance_until, and the adapter no such method"
        return
    fresh = dict(zip(spans, read_all(adapter, spans), strict=True))
    other = {span: (counter + 1, data) for span, (counter, data) in fresh.items()}
    for seen, written in ((fresh, False), (fresh, True), (other, False)):
        answers = []
        for way in (partial(step_until, adapter), own):
            adapter.reset()
            if written:
                adapter.write(*write)
            marks: list[None] = []
            passed, found = way(_STEPS, seen, partial(marks.append, None))
            answers.append(((passed, len(marks)), found))
        (stepwise, one_by_one), (at_once, all_at_once) = answers
        if stepwise != at_once:
            yield f"steps and marks are {at_once} at once and {stepwise} one by one"
        elif one_by_one != all_at_once:
            yield "the last look gives something else at once than one by one"
    try:
        own((), fresh, lambda: None)
    except AdapterError:
        return
    yield "advance_until takes no step at all"


def _check_describe(
    adapter: Adapter, _spans: Sequence[tuple[int, int]], _write: tuple[int, bytes]
) -> Iterator[str]:
    description: object = adapter.describe()
    if not isinstance(description, Description):
        yield f"describe gives {description!r}"
        return
    try:
        survives = Description.from_json(description.to_json()) == description
    except ValueError as error:
        yield str(error)
    else:
        if not survives:
            yield "the description does not survive JSON"
    bounds = ("limits",) if description.limits else ()
    for name in (*bounds, *description.without):
        if not any(name in note for note in description.notes):
            yield f"no note of the description says why there is {name!r}"


def _check_refusals(
    adapter: Adapter, spans: Sequence[tuple[int, int]], _write: tuple[int, bytes]
) -> Iterator[str]:
    outside = ((-1, 1), (ADDRESS_SPACE, 1), (ADDRESS_SPACE - 1, 2), (1 << 40, 1))
    for address, length in outside:
        for what, call in (
            ("read", lambda a=address, n=length: adapter.read(a, n)),
            ("write", lambda a=address, n=length: adapter.write(a, bytes(n))),
        ):
            try:
                call()
            except AdapterError:
                continue
            yield f"{what} of {length} at {address} is not refused"
    for span in spans:
        adapter.read(*span)  # still alive


def _check_close(
    adapter: Adapter, _spans: Sequence[tuple[int, int]], _write: tuple[int, bytes]
) -> Iterator[str]:
    adapter.close()
    adapter.close()
    yield from ()


CHECKS: Final[
    Mapping[
        str,
        Callable[[Adapter, Sequence[tuple[int, int]], tuple[int, bytes]], Iterator[str]],
    ]
] = {
    "read": _check_read,
    "write": _check_write,
    "reset": _check_reset,
    "advance": _check_advance,
    "advance_until": _check_advance_until,
    "describe": _check_describe,
    "refusals": _check_refusals,
    "close": _check_close,
}
