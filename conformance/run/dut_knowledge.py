"""Keeps what was learned of the device under test so far: its ways, its refusals, its findings."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from ecatspec.conformance.base.devices import UserError, nearest
from ecatspec.conformance.base.verdict import CAUSED
from ecatspec.conformance.base.work_items import Knowledge, Learned
from ecatspec.model.core.state import RuleName

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from ecatspec.conformance.base.verdict import Verdict
    from ecatspec.conformance.base.work_items import Judged
    from ecatspec.spec.language.ir import Protocol

SHAPE = {"mailbox_support": "present", "emulation": "none"}
"""What a run takes for granted where no text pins it: a mailbox, and a controller of its own."""


@dataclass(slots=True)
class DutKnowledge:
    """What is known of a device, and what it rests on."""

    given: Mapping[str, str]
    """What is taken for granted of the device."""
    choices: dict[str, str] = field(default_factory=dict)
    believed: dict[str, str] = field(default_factory=dict)
    """The ways that a complete suite takes the device to go, where nothing told it."""
    untold: set[str] = field(default_factory=set)
    """Choices that the device met, and nothing told which way it went."""
    refusals: dict[str, str] = field(default_factory=dict)
    """Why the device refused a transition, with the first case that showed it."""
    signatures: set[str] = field(default_factory=set)
    """The causes that were found already."""
    rules: set[RuleName] = field(default_factory=set)
    """The rules that the device surely went by."""
    met: set[str] = field(default_factory=set)
    """Choices on which some explanation rested in the step that was taken last."""
    moved: bool = False
    """AL Status has changed in some step."""

    def __post_init__(self) -> None:
        """Begin with what is given."""
        self.choices = {**self.given, **self.choices}

    @property
    def learned(self) -> dict[str, str]:
        """The ways that earlier cases have shown."""
        return {name: way for name, way in self.choices.items() if name not in self.given}

    def is_new(self, verdict: Verdict) -> bool:
        """Tell whether a verdict is of a cause that was not found yet."""
        return verdict.signature not in self.signatures

    def snapshot(self) -> Knowledge:
        """Give what verdicts may rest on."""
        return Knowledge(dict(self.choices), dict(self.believed), frozenset(self.signatures))

    def restore(self, knowledge: Knowledge) -> None:
        """Go on as one who knows just this."""
        self.choices, self.believed = dict(knowledge.choices), dict(knowledge.believed)
        self.signatures = set(knowledge.signatures)
        self.untold, self.refusals, self.rules = set(), {}, set()

    def fork(self, ways: Mapping[str, str]) -> DutKnowledge:
        """Give knowledge that goes its own way, of a device of which only these ways are known."""
        return replace(
            self,
            choices={**self.given, **ways},
            believed={},
            untold=self.untold.copy(),
            refusals=self.refusals.copy(),
            rules=self.rules.copy(),
            met=self.met.copy(),
        )

    def begin_step(self) -> DutKnowledge:
        """Note what a step rests on from here; give what was known before it."""
        before = replace(
            self,
            choices=self.choices.copy(),
            untold=self.untold.copy(),
            refusals=self.refusals.copy(),
        )
        self.rules, self.met = set(), set()
        return before

    def end_step(
        self, before: DutKnowledge, verdict: Verdict, protocol: Protocol, *, moved: bool
    ) -> Learned:
        """Give what a step told beside its verdict."""
        new = {name: way for name, way in self.choices.items() if name not in before.choices}
        learned = Learned(
            new,
            tuple(sorted(self.untold - before.untold)),
            tuple(reason for reason in self.refusals if reason not in before.refusals),
            tuple(sorted({*map(str, self.rules), *verdict.rules})),
            bool(before.believed) and not self.believed,
            moved,
            protocol.risks(new),
        )
        self.rules |= before.rules
        return learned

    def learn(self, judged: Judged) -> None:
        """Take what a step told as known; that a step taken here is known already is no harm."""
        told = judged.learned
        if judged.verdict.outcome in CAUSED:
            self.signatures.add(judged.verdict.signature)
        self.choices |= told.choices
        self.untold |= set(told.untold)
        for reason in told.refusals:
            self.refusals.setdefault(reason, judged.verdict.case)
        self.rules |= set(map(_rule_of, told.rules))
        if told.disbelieved:
            self.believed = {}
        self.moved |= told.moved


def shape_of(protocol: Protocol) -> dict[str, str]:
    """Give what a run takes for granted of a device."""
    return {name: way for name, way in SHAPE.items() if name not in protocol.pins}


def ways_of(protocol: Protocol, choices: Iterable[str]) -> dict[str, str]:
    """Give the ways that a user says a device goes, each as `choice=alternative`.

    Raises:
        UserError: There is no such choice or way, or the text of the device has decided it.

    """
    found: dict[str, str] = {}
    for each in choices:
        name, _, way = each.partition("=")
        choice = protocol.choices.get(name)
        if choice is None:
            raise nearest("choice", name, tuple(protocol.choices))
        ways = tuple(alternative.name for alternative in choice.alternatives)
        if way not in ways:
            raise nearest(f"way of {name}", way, ways)
        pin = protocol.pins.get(name)
        if pin is not None and pin.alternative != way:
            said = f"{protocol.name} says that {name} is {pin.alternative}"
            raise UserError(f"{said}; leave out {each!r}, or change the text")
        found[name] = way
    return found


def _rule_of(name: str) -> RuleName:
    machine, _, rule = name.partition(".")
    return RuleName(machine, rule)
