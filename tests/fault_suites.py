"""The grounds on which faults are looked for, and devices shown to be sound."""

from __future__ import annotations

import gc
from collections import Counter
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from ecatspec.conformance.adapters.model import make
from ecatspec.conformance.base.devices import load
from ecatspec.conformance.base.verdict import Outcome
from ecatspec.conformance.run.runner import Runner
from ecatspec.generators.cases.case import NO_LIMITS, Case
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model
from ecatspec.spec.language.ir import Fault, Remove, Replace
from ecatspec.spec.language.load import device_names, load_device

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator


DEPTH = "quick"
SMALL = "40"
"""The mailbox for SDO information, so that a list takes several messages."""
SHORT = 6
"""So many stimuli show what an AL state does; longer cases of the transitions are left out."""
ALIKE = 1
"""So many cases are taken whose last two inputs are the same, where no edges count."""
LONG = 16
"""After so many stimuli a transfer is the same over and over; the sound device stops there."""


@dataclass(frozen=True, slots=True)
class Ground:
    """What the faults of a text are looked for with: a device, its mailbox, layers of cases."""

    device: str
    layers: tuple[str, ...] = ()
    mailbox: str = ""
    alike: int = 0
    """So many cases with the same end at most; 0: all of them."""


DEVICES = tuple(name for name in device_names() if load_device(name).manuals)
"""The devices that have a manual; a text of faults with the name of one is looked for there."""
REFERENCE = Ground("reference")
GROUNDS = {
    "information": Ground("reference", ("sdo_information",), SMALL),
    "al": Ground(
        "reference-drive", ("al", "process_data", "mailbox", "ds402/commands_in_SAFEOP_after_OP")
    ),
    "process_data": Ground("reference-drive", ("process_data", "al")),
    "configuration": Ground("reference-drive", ("sdo/configuration",)),
    "drive": Ground("reference-drive", ("ds402",), alike=ALIKE),
    "synchronisation": Ground("reference-drive", ("sdo/upload", "sdo/default", "sdo/takes")),
    "edges": Ground("kollmorgen-s300"),
    **{name.replace("-", "_"): Ground(name) for name in DEVICES},
}
"""By the text of the faults; all others are looked for with all cases of the reference."""

LIKELY = {
    "counted_array_downloaded": "sdo/complete_download_whole/1",
    "short_text_refused": "sdo/download/2021_",
    "short_text_refused_with_data": "sdo/single_bytes/2021_",
    "container_forgets": "sdo/download/6089_",
    "default_lost": "sdo/default/",
    "every_value_refused": "sdo/takes/",
    "container_refused": "sdo/upload/6089_",
    "initiate_keeps_transfer": "sdo/server/downloading/upload",
    "lost_clock_faults_idle_drive": "process_data/sync_lost/",
    "mailbox_unchecked": "al/sync_manager_0_",
    "old_tail_kept": "sdo/transfer/shorter_after",
    "stored_as_it_comes": "sdo/transfer/client_abort",
    "missing_outputs_by_standard_code": "al/set_up/request_PREOP/request_SAFEOP/",
    "pdo_on_mailbox_channel": "sdo/download_in_SAFEOP/1C12_",
    "position_pdo_unknown": "sdo/configuration/assign/",
    "restart_keeps_transfer": "sdo/transfer/over_init",
    "size_of_sixteen_bits": "sdo/length_65536/",
    "third_pdo_assigned": "sdo/range_above/1C12_",
    "unused_not_counted": "sdo/upload/1018_",
}
"""Faults whose rules tell little of where they show: how cases are called that are tried first."""


def ground_of(fault: Fault) -> Ground:
    return GROUNDS.get(Path(fault.at.file).stem, REFERENCE)


def apart(ground: Ground) -> pytest.MarkDecorator:
    """Keep what needs the same cases in one process: they run once with the sound device there."""
    return pytest.mark.xdist_group(f"{ground.device} {' '.join(ground.layers)}")


@dataclass(slots=True)
class Suite:
    """The cases of a ground, each with rules that a sound device goes by in it."""

    ground: Ground
    model: Model
    options: dict[str, str]
    cases: list[tuple[Case, frozenset[str]]] = field(default_factory=list)
    blamed: list[str] = field(default_factory=list)

    def runner(self, options: dict[str, str]) -> Runner:
        adapter = make(self.ground.device, self.options | options)
        return Runner(self.model, adapter, adapter.describe())

    def ordered(self, fault: Fault) -> list[Case]:
        """Likely cases first, then those that go by rare rules of the fault: short, then long."""
        layer = Path(fault.at.file).stem
        own = {f"{c.machine}.{c.rule}" for c in fault.changes if isinstance(c, Replace | Remove)}
        near = {
            f"{machine.name}.{rule.name}"
            for machine in self.model.protocol.machines.values()
            for rule in machine.rules
            if fault.clauses[0] in rule.clauses
        }
        often = Counter(rule for _, fired in self.cases for rule in fired)
        if any(often[rule] > len(self.cases) // 2 for rule in own):
            near = set()  # it shows at once

        def key(row: tuple[Case, frozenset[str]]) -> tuple[bool, float, float, bool, bool, int]:
            case, fired = row
            length = len(case.stimuli)
            return (
                fault.name not in LIKELY or not case.name.startswith(LIKELY[fault.name]),
                -sum(1 / often[rule] for rule in own & fired),
                -sum(1 / often[rule] for rule in near & fired),
                case.layer != layer,
                length > LONG,
                -length if length > LONG else length,
            )

        return [case for case, _ in sorted(self.cases, key=key)]


def wanted(ground: Ground, cases: Iterable[Case]) -> Iterator[Case]:
    """Give the cases of the layers; of long or similar ones that only tell the same again, few."""
    alike: Counter[tuple[str, ...]] = Counter()
    for case in cases:
        if ground.layers and not case.name.startswith(tuple(f"{n}/" for n in ground.layers)):
            continue
        if ground.layers and case.layer == "al" and len(case.stimuli) > SHORT:
            continue
        end = tuple(case.name.split("/")[-2:])
        alike[end] += 1
        if not ground.alike or alike[end] <= ground.alike:
            yield case


@cache
def suite(ground: Ground) -> Suite:
    """Run the sound device once: what it goes by, and what it is blamed for."""
    model = Model(load(ground.device, ground.mailbox), closed=True)
    made = Suite(ground, model, {"mailbox": ground.mailbox} if ground.mailbox else {})
    runner = made.runner({})
    for case in wanted(ground, all_cases(model, NO_LIMITS, DEPTH)):
        runner.known.rules = set()
        end = LONG if case.layer.startswith("sdo") else None
        verdict = runner.executor.judge(replace(case, stimuli=case.stimuli[:end]))
        if verdict.outcome is not Outcome.PASS:
            made.blamed.append(f"{verdict.case}: {verdict.outcome} {verdict.observed}")
        made.cases.append((case, frozenset(map(str, runner.known.rules))))
    gc.freeze()  # what stays need not be looked at by each collection
    return made
