"""The only place for tests of test vectors: recorded from a virtual device, played on others."""

from __future__ import annotations

import io
from functools import cache
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import pytest

from ecatspec.conformance.adapters.model import VirtualAdapter, described
from ecatspec.conformance.devices import load
from ecatspec.conformance.guard import Guarded
from ecatspec.conformance.runner import Runner
from ecatspec.conformance.vectors import export as exporting
from ecatspec.conformance.vectors.export import CONFIGURATION, Wanted, export
from ecatspec.conformance.vectors.replay import Player
from ecatspec.conformance.verdict import Outcome
from ecatspec.generators.case import NO_LIMITS
from ecatspec.generators.suite import all_cases
from ecatspec.generators.vectors import Vectors
from ecatspec.model.compiled import Model
from ecatspec.model.subdevice import VirtualSubDevice
from ecatspec.spec.language.load import device_names, load_device

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.conformance.verdict import Verdict
    from ecatspec.generators.case import Case, Limits
    from ecatspec.generators.vectors import Test
    from ecatspec.spec.language.ir import Protocol

SAMPLE = 40
"""Of the cases of a quick suite every one of so many is taken."""
SLAVE = Path(__file__).resolve().parent.parent / "examples" / "c_slave"
DRIVE, PLAIN = "kollmorgen-akd", "reference"
REAL = tuple(name for name in device_names() if load_device(name).manuals)


def sampled(model: Model, limits: Limits, depth: str) -> Iterator[Case]:
    """Give some of the cases of each kind."""
    return islice(all_cases(model, limits, depth), 0, None, SAMPLE)


@cache
def vectors(device: str, only: tuple[str, ...] = (), **choices: str) -> Vectors:
    """Give the vectors of some cases of a device, as they are read from a file."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exporting, "all_cases", sampled)
        file = io.BytesIO()
        export(Wanted(device, "quick", only, choices=choices), "json", file)
    return msgspec.json.decode(file.getvalue(), type=Vectors)


def played(found: Vectors, device: VirtualSubDevice, protocol: Protocol) -> Iterator[Verdict]:
    """Play vectors on a virtual SubDevice."""
    adapter = Guarded(VirtualAdapter(device, described(protocol)))
    player = Player(found, adapter, adapter.describe(), lambda symbol, _: symbol)
    for group in found.testGroups:
        for test in group.tests:
            yield player.judge(test)


def by_name(found: Vectors) -> dict[str, Test]:
    return {test.id: test for group in found.testGroups for test in group.tests}


# --- what is recorded -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*REAL, PLAIN])
def test_the_device_of_a_text_gets_the_verdicts_of_a_run(name: str) -> None:
    found = vectors(name)
    protocol = load(name)
    verdicts = {v.case: v for v in played(found, VirtualSubDevice(protocol), protocol)}
    model = Model(protocol)
    adapter = VirtualAdapter(VirtualSubDevice(protocol), described(protocol))
    runner = Runner(model, adapter, adapter.describe())
    for case in sampled(model, NO_LIMITS, "quick"):
        verdict = verdicts.pop(case.name)
        assert (verdict.outcome, verdict.reason) == (Outcome.PASS, ""), verdict
        assert runner.judge(case).outcome is verdict.outcome
    assert all(verdict.outcome is Outcome.PASS for verdict in verdicts.values())
    assert verdicts.keys() <= {CONFIGURATION}
