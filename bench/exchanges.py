"""Measures checked exchanges beside bare ones, on the virtual SubDevice.

The exchanges are those of all SDO uploads of a device. The rival gets the same calls in the same
order and nobody looks at what it answers.
"""

from __future__ import annotations

import json
import statistics
import sys
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Final, TypeAlias, cast

from measure import Effort, Found, Of, Part, Profile, Row, Table, Target, each, in_turns, profiled

from ecatspec.conformance.adapters.model import make
from ecatspec.conformance.adapters.process import ProcessAdapter
from ecatspec.conformance.run.session import Session
from ecatspec.generators.cases.case import NO_LIMITS
from ecatspec.generators.covers.sdo_cover import sdo_cover
from ecatspec.model.core.compilation import Model
from ecatspec.model.oracle.oracle import Oracle
from ecatspec.spec.language.load import load_device

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from ecatspec.conformance.base.adapter import Adapter, Description
    from ecatspec.generators.cases.case import Case
    from ecatspec.model.core.values import ObjectKey
    from ecatspec.model.oracle.explanations import Exchange, Mismatch

Call: TypeAlias = tuple[str, tuple[object, ...]]
"""A method by name, and its arguments."""
Bound: TypeAlias = "Sequence[tuple[Callable[..., object], tuple[object, ...]]]"
"""The same with the method itself."""

DEVICE: Final = "kollmorgen-akd"
HOST: Final = "ecatspec.conformance.adapters.host"
CASES: Final = "sdo/upload/"
CHOICES: Final = {"emulation": "none", "mailbox_support": "present"}


@dataclass(slots=True)
class Recorder:
    """A device that remembers what was asked of it; as an adapter, as far as a session goes."""

    device: Adapter
    calls: list[Call] = field(default_factory=list)

    def describe(self) -> Description:
        return self.device.describe()

    def reset(self) -> None:
        self.calls.append(("reset", ()))
        self.device.reset()

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        self.calls.append(("read", (address, length)))
        return self.device.read(address, length)

    def write(self, address: int, data: bytes) -> int:
        self.calls.append(("write", (address, data)))
        return self.device.write(address, data)

    def advance(self, seconds: float) -> None:
        self.calls.append(("advance", (seconds,)))
        self.device.advance(seconds)


class RecordingOracle(Oracle):
    """An oracle that remembers what a session asked of it."""

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.calls: list[Call] = []

    def power_on(
        self,
        choices: dict[str, str] | None = None,
        objects: Mapping[ObjectKey, bytes] | None = None,
        *,
        cold: bool = True,
    ) -> None:
        assert cold, "the devices of the benchmark are power cycled"
        self.calls.append(("power_on", (choices, objects)))
        super().power_on(choices, objects)

    def observe(self, exchange: Exchange) -> Mismatch | None:
        self.calls.append(("observe", (exchange,)))
        return super().observe(exchange)

    def to_come(self, time: int, *, unread: bool = False) -> tuple[int, ...]:
        assert not unread, "the cases of the benchmark read every answer"
        self.calls.append(("to_come", (time,)))
        return super().to_come(time)


def bound(target: object, calls: Sequence[Call]) -> Bound:
    """Look the methods up before the clock runs."""
    return [(getattr(target, name), arguments) for name, arguments in calls]


def perform(calls: Bound) -> None:
    for method, arguments in calls:
        method(*arguments)


def check(session: Session, cases: Sequence[Case]) -> None:
    """Drive a device through the cases as a run does; a deviation ends the measurement."""
    for case in cases:
        session.begin(CHOICES)
        for stimulus in case.stimuli:
            session.apply(stimulus)


def upload_cases(model: Model, effort: Effort) -> list[Case]:
    """Give the SDO uploads of a device."""
    cases = [case for case in sdo_cover(model, NO_LIMITS) if case.name.startswith(CASES)]
    return cases[: effort.of(len(cases), len(cases), 3)]


def measure(rows: tuple[Row, ...], effort: Effort) -> Found:
    """Compare checked with bare exchanges: in the process, then with the device in another."""
    model = Model(load_device(DEVICE), closed=True)  # as in a run over the virtual device
    cases = upload_cases(model, effort)
    recorder, recording = Recorder(make(DEVICE, {})), RecordingOracle(model)
    recorded = Session(cast("Adapter", recorder), model, recording)
    check(recorded, cases)
    count = recorded.exchanges
    rounds = effort.of(7, 3, 1)
    asked = json.dumps({"device": DEVICE, "options": {}})
    outside = ProcessAdapter((sys.executable, "-P", "-m", HOST, "model", asked))
    found, shares = [], []
    try:
        devices: tuple[Adapter, ...] = (make(DEVICE, {}), outside)
        for row, device in zip(rows, devices, strict=True):
            session = Session(device, model, Oracle(model))
            checked, bare, judged = in_turns(
                rounds,
                partial(check, session, cases),
                partial(perform, bound(device, recorder.calls)),
                partial(perform, bound(Oracle(model), recording.calls)),
            )
            note = f"{len(cases)} uploads of {DEVICE}, {count} exchanges a round"
            found.append(row.found(each(count, checked), each(count, bare), note))
            shares.append((row.what, *_shares(checked, bare, judged)))
    finally:
        outside.close()
    table = Table(
        "Where the time of a checked exchange goes",
        ("", "oracle", "device and adapter", "rest"),
        tuple(shares),
        "The oracle's share is that of the recorded calls given to an oracle alone, the device's "
        "that of the rival. The rest is left over, mostly the session; it is not measured.",
    )
    return Found(tuple(found), (table,))


def _shares(checked: list[float], bare: list[float], judged: list[float]) -> tuple[str, str, str]:
    whole = statistics.median(checked)
    oracle = statistics.median(judged) / whole
    device = statistics.median(bare) / whole
    return f"{oracle:.0%}", f"{device:.0%}", f"{1 - oracle - device:.0%}"


def profile(effort: Effort) -> Profile:
    model = Model(load_device(DEVICE), closed=True)  # as in a run over the virtual device
    cases = upload_cases(model, effort)
    session = Session(make(DEVICE, {}), model, Oracle(model))
    check(session, cases)
    return profiled(partial(check, session, cases))


PARTS: Final = (
    Part(
        (
            Row(
                "exchange-model",
                "checked exchange, virtual SubDevice in the process",
                "us",
                "the same calls on the virtual SubDevice alone",
                Target(Of.RATIO, 2.0),
                "An exchange of the rival is a rule of the texts at most; a checked one is the "
                "same rule for each state that explains the device so far, and the comparison.",
            ),
            Row(
                "exchange-process",
                "checked exchange, virtual SubDevice in a process of its own",
                "us",
                "the same calls through the adapter alone",
            ),
        ),
        measure,
        {"exchange-model": profile},
    ),
)
