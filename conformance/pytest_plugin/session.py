"""The session to which users give stimuli in tests of their own."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from ecatspec.conformance.base.adapter import AdapterError, DeviceFault
from ecatspec.conformance.base.verdict import Finding, Outcome
from ecatspec.conformance.pytest_plugin.warned import EcatWarning
from ecatspec.conformance.run.case_executor import limits_of
from ecatspec.conformance.run.device_link import Deviation, InconclusiveError
from ecatspec.generators.cases.bringup import way_to
from ecatspec.generators.cases.case import Case, SendSegments, Stimulus
from ecatspec.generators.cases.case_codec import token_of
from ecatspec.generators.cases.transfers import upload

if TYPE_CHECKING:
    from ecatspec.conformance.base.verdict import Verdict
    from ecatspec.conformance.pytest_plugin.bench import Bench
    from ecatspec.generators.cases.case import Limits
    from ecatspec.model.core.compilation import Model


class EcatSession:
    """A device after a power cycle: what it does after each stimulus is judged by its text."""

    def __init__(self, bench: Bench, name: str) -> None:
        """Power cycle the device."""
        self._bench = bench
        self._executor = bench.runner.executor
        self._given: list[Stimulus] = []
        self._name = name
        self._executor.session.begin(self._executor.known.choices, self._executor.configuration())

    @property
    def model(self) -> Model:
        """The compiled text, for those who make stimuli of it."""
        return self._bench.model

    @property
    def limits(self) -> Limits:
        """What the way to the device cannot carry, for those who make cases."""
        return limits_of(self._bench.description)

    @property
    def state(self) -> str:
        """The AL state that the device is in, by its name in the text."""
        return " or ".join(sorted(self._executor.session.oracle.known.al_states()))

    def go_to(self, state: str) -> None:
        """Bring the device from INIT to an AL state, with the settings that this needs."""
        self.apply(*way_to(self.model, state))

    def read(self, index: int, subindex: int) -> None:
        """Read an entry by SDO."""
        self.apply(upload(index, subindex), SendSegments())

    def apply(self, *stimuli: Stimulus) -> None:
        """Give stimuli; the test fails where the device deviates from a `must`.

        After a deviation from a `should` the texts no longer know where the device is: the test
        is skipped from there, with a warning.
        """
        for stimulus in stimuli:
            self._given.append(stimulus)
            try:
                self._executor.session.apply(stimulus)
            except (Deviation, InconclusiveError, DeviceFault, AdapterError) as error:
                self._tell(error)

    def judge(self, case: Case) -> Verdict:
        """Run a case from a power cycle of its own, as the suite does, and give its verdict."""
        return self._executor.judge(case)

    def end(self) -> None:
        """Say where an accident of the device takes the worth from what was seen."""
        if surprises := self._executor.session.oracle.known.surprises():
            told = f"{' or '.join(surprises)} happened in the device while it was tested"
            warnings.warn(EcatWarning(f"inconclusive: {told}"), stacklevel=2)

    def _tell(self, error: Deviation | InconclusiveError | DeviceFault | AdapterError) -> None:
        layer = min(self._bench.description.protocols)
        case = Case(self._name, "a test of your own", layer, tuple(self._given))
        verdict = self._executor.explained(case, error)
        if verdict.outcome is Outcome.ERROR:
            raise error
        if verdict.outcome is Outcome.INCONCLUSIVE:
            pytest.skip(verdict.reason)
        finding = Finding(replace(verdict, replay=token_of(case)))
        words = self._bench.explained(finding)
        if verdict.outcome is Outcome.WARNING:
            warnings.warn(EcatWarning(words), stacklevel=3)
            pytest.skip("the device breaks a should: what follows cannot be judged")
        pytest.fail(words, pytrace=False)
