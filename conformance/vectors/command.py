"""Plays a vector file to its end and collects the verdicts."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from ecatspec.conformance.adapters import FACTORIES, HANG_TIMEOUT, open_adapter
from ecatspec.conformance.base.devices import UserError, load
from ecatspec.conformance.base.verdict import Outcome, Result, Verdict
from ecatspec.conformance.vectors.files import Reading, opened
from ecatspec.conformance.vectors.replay import Player
from ecatspec.generators.cases.message_mutation import NOTES
from ecatspec.generators.vectors.symbols import words_of
from ecatspec.spec.language.ir import Clause, Level, Pin, Protocol
from ecatspec.spec.language.load import load_standard

if TYPE_CHECKING:
    from pathlib import Path

    from ecatspec.conformance.base.adapter import Adapter
    from ecatspec.conformance.run.runner import Progress
    from ecatspec.generators.vectors.schema import Guarantee, Head, Test


@dataclass(slots=True)
class _Played:
    """What the tests of a file have shown so far."""

    verdicts: list[Verdict] = field(default_factory=list)
    rules: set[str] = field(default_factory=set)
    interrupted: bool = False

    def play(self, player: Player, reading: Reading, progress: Progress | None) -> None:
        """Play all tests; Ctrl-C ends with what was found so far."""
        try:
            for number, (_, test) in enumerate(reading.tests()):
                if progress is not None:
                    progress(number, player.head.numberOfTests, test.id)
                self._keep(test, player.judge(test))
        except KeyboardInterrupt:
            self.interrupted = True

    def _keep(self, test: Test, verdict: Verdict) -> None:
        whole = verdict.outcome is Outcome.PASS and not verdict.reason
        rules = {rule for step in test.steps for rule in step.covers} if whole else set()
        self.rules |= rules
        flag = next((flag for flag in test.flags if flag in NOTES), "")
        self.verdicts.append(replace(verdict, flag=flag, rules=tuple(sorted(rules))))

    def shows(self) -> bool:
        """Tell whether a verdict rests on more than what a device did not do."""
        return any(
            verdict.outcome is not Outcome.SKIPPED
            and not (verdict.outcome is Outcome.PASS and verdict.reason)
            for verdict in self.verdicts
        )

    def promises(self, guarantee: Guarantee) -> str:
        """Say what a complete suite is worth for the device."""
        tests = guarantee.tests.removesuffix("*")
        suite = [v for v in self.verdicts if v.case.startswith(tests)]
        bad = Counter(v.outcome for v in suite if v.outcome is not Outcome.PASS)
        worth = ", ".join(f"{count} {outcome.value}" for outcome, count in bad.items())
        if not worth and any(verdict.reason for verdict in suite):
            worth = "the device goes another way"
        elif not worth and (self.interrupted or not suite):
            worth = "not all was tried"
        return (
            f"{guarantee.tests}: {guarantee.method}, m = {guarantee.m}, k = {guarantee.k}, "
            f"{guarantee.checked}; {f'promises nothing: {worth}' if worth else 'passed'}"
        )


def replay(
    path: Path, dut: str, *, hang_timeout: float = HANG_TIMEOUT, progress: Progress | None = None
) -> tuple[Result, Protocol]:
    """Play the tests of a file on a device under test; Ctrl-C ends with what was found so far.

    The specification that comes with the result is what the file tells of it.

    Raises:
        UserError: The file cannot be read or is wrong, or the set-up is wrong.
        AdapterError: The device cannot be reached.

    """
    began = time.monotonic()
    if path.is_file():  # what is wrong at the end of a file is told before an hour of playing
        with opened(path) as stream:
            for _ in Reading(stream, str(path)).tests():
                pass
    with opened(path) as stream:
        reading = Reading(stream, str(path))
        head = reading.head
        notes = _notes(head, dut, path)
        adapter = _adapter(head, dut, hang_timeout)
        played = _Played()
        try:
            description = adapter.describe()
            player = Player(head, adapter, description, words_of(head).say)
            played.play(player, reading, progress)
        finally:
            adapter.close()
    if not played.interrupted and not played.shows():
        what = f"no test of {path} came to its end on {description.name}"
        raise UserError(f"{what}: it does not answer, or goes other ways; pin them by --choice")
    cited = {clause for rule in played.rules for clause in head.rules.get(rule, [])}
    result = Result(
        head.spec.name,
        description.name,
        tuple(played.verdicts),
        tuple(sorted(played.rules & head.rules.keys())),
        len(head.rules),
        tuple(sorted(cited)),
        len({clause for clauses in head.rules.values() for clause in clauses}),
        time.monotonic() - began,
        head.choices,
        (*description.notes, *notes),
        played.interrupted,
        tuple(map(played.promises, head.guarantee)),
    )
    return result, _specification(head)


def _notes(head: Head, dut: str, path: Path) -> tuple[str, ...]:
    """Give what is odd about the text that a device is made of, if it is made of one."""
    if dut.partition(":")[0] not in FACTORIES:
        return ()
    try:
        protocol = load(head.spec.name, head.generator.mailbox)
    except UserError as error:
        what = f"{path} is about {head.spec.name!r}, of which there is no text here ({error})"
        raise UserError(f"{what}; name the device under test with --dut") from None
    if protocol.digest == head.spec.sha256:
        return ()
    return (f"the text of {head.spec.name} is not the one that the tests were made of",)


def _adapter(head: Head, dut: str, hang_timeout: float) -> Adapter:
    mailbox = head.generator.mailbox
    return open_adapter(dut, head.spec.name, mailbox=mailbox, hang_timeout=hang_timeout)


def _specification(head: Head) -> Protocol:
    """Give what a file tells of the texts, for reports."""
    return replace(
        load_standard(),
        name=head.spec.name,
        wording=head.spec.title,
        digest=head.spec.sha256,
        clauses={
            name: Clause(name, Level(clause.level), clause.says, clause.source)
            for name, clause in head.clauses.items()
        },
        pins={name: Pin(name, way, ()) for name, way in head.choices.items()},
    )
