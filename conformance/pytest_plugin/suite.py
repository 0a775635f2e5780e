"""Makes tests of pytest from the suite of a device."""

from __future__ import annotations

import re
import warnings
from collections import defaultdict
from typing import TYPE_CHECKING, Final

import pytest
from _pytest._code.code import ExceptionRepr  # pytest gives it no public name

from ecatspec.conformance.base.adapter import AdapterError
from ecatspec.conformance.base.devices import UserError
from ecatspec.conformance.base.verdict import BLAMING, Outcome
from ecatspec.conformance.base.version import version
from ecatspec.conformance.pytest_plugin.bench import Bench, Wanted
from ecatspec.conformance.pytest_plugin.warned import EcatWarning
from ecatspec.spec.language.diagnostics import SpecError

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable, Iterator, Mapping
    from os import PathLike

    from _pytest._code.code import TerminalRepr, TracebackStyle

    from ecatspec.conformance.base.verdict import Verdict
    from ecatspec.conformance.pytest_plugin.bench import Part

MARKER: Final = "ecat"
"""The marker of every test of the suite."""
_WORD: Final = re.compile(r"[\w.-]+")
_UNJUDGED: Final = frozenset({Outcome.SKIPPED, Outcome.INCONCLUSIVE})


def suite_of(config: pytest.Config, device: str, given: Mapping[str, object]) -> Suite:
    """Reach the device that the options name; it is released when pytest ends, however it ends.

    Raises:
        UsageError: What is wrong with the options, in one line.

    """
    try:
        bench = Bench(Wanted(device, **given))  # type: ignore[arg-type]
    except SpecError as error:
        more = len(error.diagnostics) - 1
        also = f" (and {more} more: ecatspec check {device})" if more else ""
        raise pytest.UsageError(f"{error.diagnostics[0]}{also}") from None
    except (UserError, AdapterError) as error:
        raise pytest.UsageError(str(error)) from None
    config.add_cleanup(bench.close)
    suite = Suite(config, bench)
    if suite.distributes:
        suite.prepare()
        bench.close()
    return suite


class Suite:
    """The suite of the device that one process of pytest has open."""

    def __init__(self, config: pytest.Config, bench: Bench) -> None:
        """Register the markers of the device."""
        self._config = config
        self.bench = bench
        self.protocol = bench.model.protocol
        lines = [f"{MARKER}: every test of the suite of {self.protocol.name}"]
        lines += [f"{name}: tests of the layer {name}" for name in self.protocol.machines]
        lines += [f"{each.id}: {each.wording}" for each in self.protocol.clauses.values()]
        for line in lines:
            config.addinivalue_line("markers", " ".join(line.split()))

    @property
    def distributes(self) -> bool:
        """Whether other processes do the tests, each with a device of its own (pytest-xdist)."""
        worker = hasattr(self._config, "workerinput")
        return not worker and self._config.getoption("dist", "no") != "no"

    def prepare(self) -> None:
        """Do once what all processes would do."""
        self._clauses(self.bench.parts())

    # --- hooks ------------------------------------------------------------------------------------

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(
        self, session: pytest.Session, items: list[pytest.Item]
    ) -> None:
        """Put the suite before all other tests: -k and -m choose among them later."""
        root = Device.from_parent(session, name=self.protocol.name, nodeid=self.protocol.name)
        root.suite = self
        items[:0] = session.genitems(root)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """Let the reason of a skipped test stand alone: no line of a file has to do with it."""
        report = yield
        if isinstance(item, CaseItem) and report.skipped and isinstance(report.longrepr, tuple):
            report.longrepr = (self.protocol.name, None, report.longrepr[2])  # type: ignore[assignment]
        return report

    # --- markers ----------------------------------------------------------------------------------

    def marked(self) -> Iterator[tuple[Part, list[str]]]:
        """Yield the tests of the suite with their markers."""
        parts = list(self.bench.parts())
        clauses = self._clauses(parts)
        for part in parts:
            yield part, [MARKER, *part.layers, *clauses.get(part.name, ())]

    def _clauses(self, parts: Iterable[Part]) -> Mapping[str, list[str]]:
        """Give the clauses of each test, where the user selects by a clause.

        They are found by playing all tests on the virtual SubDevice, which takes a while, and
        kept in the cache of pytest for the next time.
        """
        words = f"{self._config.getoption('markexpr', '')} {self._config.getoption('keyword', '')}"
        chosen = sorted(self.protocol.clauses.keys() & set(_WORD.findall(words)))
        if not chosen:
            return {}
        cases = [part.case for part in parts if part.case is not None]
        cache: pytest.Cache | None = getattr(self._config, "cache", None)
        key = f"ecatspec/{self.protocol.name}"
        state = [version(), self.protocol.digest, self.bench.wanted.mailbox]
        known: dict[str, list[str]] = {}
        if cache is not None:
            kept = cache.get(key, None)
            if isinstance(kept, dict) and kept.get("state") == state:
                known = kept["clauses"]
        missing = [case for case in cases if case.name not in known]
        if missing:
            self._tell(f"looks which of {len(missing)} tests exercise {', '.join(chosen)}")
            known |= self.bench.clauses(missing)
            if cache is not None:
                cache.set(key, {"state": state, "clauses": known})
        return known

    def _tell(self, words: str) -> None:
        reporter = self._config.pluginmanager.get_plugin("terminalreporter")
        if reporter is not None:
            reporter.write_line(f"ecatspec: {words}; they are kept for the next time")


class Device(pytest.Collector):
    """The suite of one device."""

    suite: Suite

    def collect(self) -> Iterator[pytest.Collector]:
        """Yield the layers, in the order in which `ecatspec run` comes to them."""
        groups: defaultdict[str, list[tuple[Part, list[str]]]] = defaultdict(list)
        for part, markers in self.suite.marked():
            groups[part.group].append((part, markers))
        for name, parts in groups.items():
            layer = Layer.from_parent(self, name=name)
            layer.suite, layer.parts = self.suite, parts
            yield layer


class Layer(pytest.Collector):
    """The tests of one layer, or those that make their cases while they run."""

    suite: Suite
    parts: list[tuple[Part, list[str]]]

    def collect(self) -> Iterator[pytest.Item]:
        """Yield the tests in their order."""
        for part, markers in self.parts:
            item = CaseItem.from_parent(self, name=part.name)
            item.suite, item.part = self.suite, part
            for marker in markers:
                item.add_marker(marker)
            yield item


class CaseItem(pytest.Item):
    """One test of the suite. It is judged in its set-up, where trouble is no failure yet."""

    suite: Suite
    part: Part
    verdicts: tuple[Verdict, ...] = ()

    def setup(self) -> None:
        """Run the test on the device; what could not be judged does not go on."""
        bench = self.suite.bench
        self.verdicts = bench.verdicts(self.part)
        rules = {rule for verdict in self.verdicts for rule in verdict.rules}
        cited = {clause for verdict in self.verdicts for clause in verdict.clauses}
        if clauses := sorted(cited | bench.exercise.of_rules(rules)):
            self.user_properties.append(("clauses", " ".join(clauses)))
        outcomes = {verdict.outcome for verdict in self.verdicts}
        if Outcome.ERROR in outcomes and outcomes.isdisjoint(BLAMING):
            self._fail(Outcome.ERROR)
        if outcomes <= _UNJUDGED:
            reasons = "; ".join(dict.fromkeys(v.reason for v in self.verdicts))
            pytest.skip(reasons or "there is nothing to try in these layers")

    def runtest(self) -> None:
        """Say what the verdicts are."""
        for finding in self.suite.bench.findings(self.verdicts):
            if finding.verdict.outcome is Outcome.WARNING:
                words = self.suite.bench.explained(finding)
                place = str(self.reportinfo()[0])
                warnings.warn_explicit(EcatWarning(words), None, place, 1)
        if not BLAMING.isdisjoint(verdict.outcome for verdict in self.verdicts):
            self._fail(*BLAMING)
        reasons = [v.reason for v in self.verdicts if v.outcome is Outcome.KNOWN]
        if reasons:
            pytest.xfail("; ".join(dict.fromkeys(reasons)))

    def _fail(self, *outcomes: Outcome) -> None:
        bench = self.suite.bench
        found = [f for f in bench.findings(self.verdicts) if f.verdict.outcome in outcomes]
        pytest.fail("\n\n".join(map(bench.explained, found)), pytrace=False)

    def repr_failure(
        self, excinfo: pytest.ExceptionInfo[BaseException], style: TracebackStyle | None = None
    ) -> str | TerminalRepr:
        """Give the whole report; the summary at the end gets its first line alone."""
        words = super().repr_failure(excinfo, style)
        if isinstance(words, ExceptionRepr) and words.reprcrash is not None:
            words.reprcrash.message = words.reprcrash.message.partition("\n")[0]
        return words

    def reportinfo(self) -> tuple[PathLike[str] | str, int | None, str]:
        """Give the device as the place, and the name of the test."""
        return self.config.rootpath / self.suite.protocol.name, None, self.name
