"""Makes cases of complete suites of finite machines, with what they promise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from ecatspec.generators.cases.case import Case
from ecatspec.generators.complete.certificate import certify
from ecatspec.generators.complete.chain import chain_suite
from ecatspec.generators.complete.machines import (
    al_drive_machine,
    al_machine,
    drive_machine,
    sdo_machine,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping

    from ecatspec.generators.cases.case import Limits
    from ecatspec.generators.complete.machines import Abstraction
    from ecatspec.generators.complete.suites import Suite
    from ecatspec.model.core.compilation import Model


@dataclass(frozen=True, slots=True)
class _Kind:
    """A finite machine of a device: the layer that it exercises, and where it begins."""

    layer: str
    needs: str | None
    make: Callable[[Model, Mapping[str, str], Collection[str]], Abstraction | None]


_AL: Final = _Kind("al", None, lambda model, choices, _: al_machine(model, choices))
_AL_SHORT: Final = _Kind("al", None, lambda model, choices, _: al_machine(model, choices, few=True))
_DRIVE: Final = _Kind(
    "ds402", "OP", lambda model, choices, events: drive_machine(model, choices, events=events)
)
_BOTH: Final = _Kind(
    "ds402", "OP", lambda model, choices, events: al_drive_machine(model, choices, events=events)
)
_SDO: Final = _Kind("sdo", "PREOP", lambda model, choices, _: sdo_machine(model, choices))
_PLANS: Final[Mapping[str, tuple[tuple[_Kind, int], ...]]] = {
    "quick": (),
    "default": ((_AL_SHORT, 0), (_DRIVE, 0)),
    "exhaustive": ((_DRIVE, 1), (_BOTH, 1), (_SDO, 1), (_AL, 1)),
}
"""By depth: the machines, and how many states more than these a device may have."""
_RAW: Final = "malformed"
"""What a way to the device has to carry for the machine of the SDO server."""


@dataclass(frozen=True, slots=True)
class Complete:
    """A complete suite of a finite machine of a device, as cases from power-on."""

    kind: _Kind
    found: Abstraction
    suite: Suite
    assumed: Mapping[str, str]
    """The way that a device goes at each choice, as far as the suite promises anything."""

    @property
    def layer(self) -> str:
        """The machine of the texts that the suite exercises."""
        return self.kind.layer

    def cases(self) -> Iterator[Case]:
        """Yield the tests one after the other."""
        name = f"{self.layer}/complete/{self.found.name.replace(' ', '_')}_k{self.suite.k}"
        for number, word in enumerate(self.suite.words(), 1):
            title = f"{self.found.name}, test {number} of {self.suite.tests}"
            stimuli = self.found.stimuli_of(word)
            prelude = len(self.found.prelude)
            yield Case(f"{name}/{number}", title, self.layer, stimuli, self.kind.needs, prelude)

    def guarantee(self) -> str:
        """Say in one line what the suite is worth for a device that passes."""
        machine = self.found.machine
        size = f"{len(machine.states)} states, {len(machine.inputs)} inputs"
        return f"{self.found.name}, {size}: {self.suite.guarantee()}"


def complete_suites(
    model: Model,
    limits: Limits,
    events: Collection[str],
    choices: Mapping[str, str],
    depth: str,
) -> Iterator[Complete]:
    """Yield the complete suites of a device that goes `choices` its own way.

    `events` are the local events that can be raised in it. Wherever the texts leave more open
    the suites are those of a device that goes as the virtual SubDevice goes.
    """
    first = {name: each.alternatives[0].name for name, each in model.protocol.choices.items()}
    for kind, extra in _PLANS[depth]:
        if kind is _SDO and _RAW in limits.without:
            continue
        found = kind.make(model, choices, events)
        if found is not None:
            suite = chain_suite(found.machine, k=extra)
            checked = certify(found.machine, suite).checked
            yield Complete(kind, found, suite.having(checked), first | dict(choices))
