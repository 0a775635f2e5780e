"""Tests of freedoms: a device that goes one of the free ways is not blamed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest
from fault_suites import GROUNDS, REFERENCE, Ground, apart, suite

from ecatspec.conformance.adapters.model import SnapshotAdapter, described
from ecatspec.conformance.base.devices import load
from ecatspec.conformance.base.verdict import FOUND, SUB_DEVICE
from ecatspec.conformance.run.runner import Runner
from ecatspec.generators.cases.bringup import case_in, request
from ecatspec.generators.cases.case import Case, WriteRegister
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.spec.language.ir import Fault
from ecatspec.spec.language.load import plant
from ecatspec.spec.language.parse import parse_text

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from ecatspec.generators.cases.case import Stimulus
    from ecatspec.model.core.compilation import Model

TEXTS: Final = Path(__file__).parent / "freedoms"
TERMINAL: Final = Ground("beckhoff-el6720", ("al", "process_data", "mailbox"))
COMPLETE: Final = (
    "complete_upload",
    "complete_and_single",
    *(f"complete_download_{word}" for word in ("whole", "size_only", "shorter", "longer")),
)
"""The cases of complete access; those of one object with a count are in none but a drive."""
PLACES: Final = {
    "al": GROUNDS["al"],
    "complete": Ground("reference-drive", tuple(f"sdo/{name}" for name in COMPLETE)),
    "configuration": GROUNDS["configuration"],
    "information": GROUNDS["information"],
    "terminal": TERMINAL,
}
"""By the text of the freedoms; all others are tried with all cases of the reference."""


def _asked(model: Model, wanted: str, *, acknowledge: bool = False) -> Stimulus:
    return request(model.row("al_state", wanted), acknowledge=acknowledge)


def _off(model: Model, manager: int, state: str) -> Case:
    """Refuse a request, switch a SyncManager off, and acknowledge."""
    off = WriteRegister(f"sync_manager_{manager}_activation", {"enabled": 0})
    refused, again = _asked(model, "BOOT"), _asked(model, state, acknowledge=True)
    return case_in(model, "al/own", "switched off in an error", (refused, off, again), state=state)


OWN: Final[Mapping[str, Callable[[Model], Case]]] = {
    "mailbox_noticed_at_request": lambda model: _off(model, 0, "PREOP"),
    "process_data_noticed_at_request": lambda model: _off(model, 2, "SAFEOP"),
}
"""A case in which a freedom shows that shows in none of those that are generated for its ground."""
UNSEEN: Final = {"control_bytes_compared", "mode_shown_with_status_word"}
"""What no run asks for: it writes the usual control bytes, and wants the mode from SAFEOP on."""
ENOUGH = 80
"""So many cases are tried: those first in which the sound device goes by what is changed."""
FREEDOMS: Final = {
    freedom.name: freedom
    for path in sorted(TEXTS.glob("*.ecs"))
    for freedom in parse_text(path.read_text(encoding="utf-8"), str(path)).declarations
    if isinstance(freedom, Fault)
}


def place_of(freedom: Fault) -> Ground:
    return PLACES.get(Path(freedom.at.file).stem, REFERENCE)


def free_device(ground: Ground, freedom: Fault) -> SnapshotAdapter:
    """Give the device of a ground that goes another way, as it is allowed to."""
    protocol = plant(load(ground.device, ground.mailbox), freedom)
    return SnapshotAdapter(VirtualSubDevice(protocol), described(protocol))


def shown(runner: Runner, case: Case) -> list[tuple[str, bytes]]:
    """Give what the device showed when a case was judged."""
    runner.executor.judge(case)
    return [
        (line.what, line.data) for line in runner.executor.session.trace if line.who == SUB_DEVICE
    ]


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=apart(place_of(each))) for name, each in FREEDOMS.items()],
)
def test_a_device_that_goes_a_free_way_is_not_blamed(name: str) -> None:
    freedom = FREEDOMS[name]
    made = suite(place_of(freedom))
    assert not made.blamed
    adapter = free_device(made.ground, freedom)
    sound, free = made.runner({}), Runner(made.model, adapter, adapter.describe())
    own = [OWN[name](made.model)] if name in OWN else []
    cases = [*own, *made.ordered(freedom)[:ENOUGH]]
    blamed = [v for v in map(free.executor.judge, cases) if v.outcome in FOUND]
    assert not [f"{v.case}: {v.observed}, expected {v.expected}" for v in blamed]
    seen = any(shown(sound, case) != shown(free, case) for case in cases)
    assert seen is (name not in UNSEEN), "take it from the list" if seen else "it never shows"


def test_no_two_freedoms_are_one() -> None:
    texts = [path.read_text(encoding="utf-8") for path in TEXTS.glob("*.ecs")]
    assert sum(text.count("\nfault ") for text in texts) == len(FREEDOMS)
    assert len({freedom.changes for freedom in FREEDOMS.values()}) == len(FREEDOMS)
