"""The work items of a run: what is judged one after the other, and what each yields."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol, TypeAlias

from ecatspec.conformance.base.verdict import CAUSED, Verdict

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from ecatspec.conformance.base.adapter import Adapter, Description
    from ecatspec.generators.cases.case import Case


@dataclass(frozen=True, slots=True)
class Trial:
    """One case. Of `long` ones each new cause is made as short as it goes."""

    case: Case
    long: bool = False

    @property
    def name(self) -> str:
        """What the step is called in progress and in results files."""
        return self.case.name


@dataclass(frozen=True, slots=True)
class Search:
    """Random requests, until one shows a cause that is not known yet."""

    seed: int
    examples: int

    @property
    def name(self) -> str:
        """What the step is called in progress and in results files."""
        return "random requests"


Step: TypeAlias = Trial | Search


@dataclass(frozen=True, slots=True)
class Knowledge:
    """What was known of the device before a step, as far as a verdict may rest on it."""

    choices: Mapping[str, str]
    believed: Mapping[str, str]
    signatures: frozenset[str]
    """The causes that were found already."""

    def after(self, judged: Judged) -> Knowledge:
        """Give what is known after one more step."""
        told = judged.learned
        found = {judged.verdict.signature} if judged.verdict.outcome in CAUSED else frozenset()
        return Knowledge(
            {**self.choices, **told.choices},
            {} if told.disbelieved else self.believed,
            self.signatures | found,
        )


@dataclass(frozen=True, slots=True)
class Learned:
    """What a step told beside its verdict."""

    choices: dict[str, str] = field(default_factory=dict)
    """Ways of the device that were not known before."""
    untold: tuple[str, ...] = ()
    """Choices that the device met, and nothing told which way it went."""
    refusals: tuple[str, ...] = ()
    """Why the device refused a transition."""
    rules: tuple[str, ...] = ()
    """The rules that the device surely went by in anything that was tried."""
    disbelieved: bool = False
    """What a complete suite believed of the device ended here."""
    moved: bool = False
    """AL Status has changed at some time until then."""
    risks: dict[str, str] = field(default_factory=dict)
    """Why ways in `choices` are risky, by choice."""


@dataclass(frozen=True, slots=True)
class Judged:
    """A step with its verdict and what it told."""

    name: str
    verdict: Verdict
    learned: Learned
    met: frozenset[str] = frozenset()
    """Choices on which some explanation rested."""


class Crew(Protocol):
    """Who judges the steps of a run in place of the process that asks."""

    def adapter(self) -> Adapter:
        """Give what stands for the devices: it describes them, and that is all."""

    def judge(
        self, steps: Iterable[Step], known: Callable[[], Knowledge], description: Description
    ) -> Iterator[Judged]:
        """Yield the judged steps in their order; `known` is what those before have told."""
