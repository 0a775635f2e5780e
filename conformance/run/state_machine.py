"""A Hypothesis state machine of a device, for the tests of its users.

TestMySlave = state_machine("kollmorgen-akd", "exec:./my_slave").TestCase
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, TypeAlias

from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule

from ecatspec.conformance.adapters import open_adapter
from ecatspec.conformance.base.adapter import DeviceFault
from ecatspec.conformance.base.devices import load
from ecatspec.conformance.run.case_executor import CaseExecutor, limits_of
from ecatspec.conformance.run.device_link import Deviation, InconclusiveError
from ecatspec.conformance.run.shrink import shortest
from ecatspec.generators.cases.assignment import first_assigned
from ecatspec.generators.cases.bringup import (
    WAY_UP,
    has_process_data,
    mailbox_settings,
    request,
    way_to,
)
from ecatspec.generators.cases.case import (
    Case,
    Happen,
    SendSegments,
    SetUpProcessData,
    Stimulus,
    StopOutputs,
    Wait,
    WriteOutputs,
    WriteRegister,
)
from ecatspec.generators.cases.case_codec import token_of
from ecatspec.generators.cases.client import Ask, Begin, Client, Move, Segment
from ecatspec.generators.cases.transfers import upload
from ecatspec.generators.cases.transfers import write as written
from ecatspec.generators.covers.drive_cover import CONTROL, commands
from ecatspec.generators.covers.process_cover import wrong_process_data
from ecatspec.generators.covers.transition_cover import wrong_settings
from ecatspec.generators.random import strategies
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.register_map import PROCESS_DATA, SYNC_MANAGERS
from ecatspec.spec.language.ir import Level

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from ecatspec.conformance.base.adapter import Adapter
    from ecatspec.spec.language.ir import ObjectEntry

    Dut: TypeAlias = str | Callable[[], Adapter]

TRIES: Final = 300
"""Replays at most to make a run that fails short."""
_LONGEST: Final = 60
"""Bytes of a segment at most."""
_PIECES: Final = 4
_WAITS: Final = (500, 50_000, 600_000, 3_000_000)
"""Microseconds: within an answer, between cycles, around and beyond a watchdog."""
_GOALS: Final = (*WAY_UP, WAY_UP[-1], WAY_UP[-1])
"""States to go to: most of what a device does shows in the highest."""
_SEARCH: Final = settings(
    deadline=None,
    stateful_step_count=20,
    print_blob=False,
    phases=(Phase.explicit, Phase.reuse, Phase.generate),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
"""A run that fails is made short by replaying it, which is quicker than what Hypothesis does."""


def state_machine(device: str, dut: Dut = "model") -> type[RuleBasedStateMachine]:
    """Give a state machine whose rules do what a MainDevice can do, judged by the texts.

    `.TestCase` of it is a test for pytest and unittest; its `settings` may be replaced. The device
    is opened at once, gets a power cycle before each run, and is closed with the process. A run
    that breaks a clause that says must raises an AssertionError: expected, observed, clauses, the
    shortest trace found, and a token that replays it. One that breaks only a should goes on
    unjudged, as the texts no longer know where the device is.

    Args:
        device: the name of a text, or the path of a file, as for `ecatspec run`.
        dut: how to reach the device, as for `ecatspec run --dut`, or what makes an adapter.

    Raises:
        AdapterError: The device cannot be reached.
        SpecError: The text is wrong.

    """
    adapter = open_adapter(dut, device) if isinstance(dut, str) else dut()
    model = Model(load(device), closed=adapter.describe().closed_dictionary)
    made = _machine(_Bench(model, adapter))
    weakref.finalize(made, adapter.close)
    made.__name__ = made.__qualname__ = f"{device.replace('-', '_')}_machine"
    made.TestCase.settings = _SEARCH
    return made


@dataclass(frozen=True, slots=True)
class _Failure:
    """What a run showed: `blames` where a clause that says must is broken."""

    signature: str
    blames: bool
    words: str


@dataclass(slots=True)
class _Bench:
    """A device and the texts that judge it."""

    model: Model
    adapter: Adapter
    executor: CaseExecutor = field(init=False)
    told: dict[str, str] = field(default_factory=dict)
    """What was said of each kind of failure."""

    def __post_init__(self) -> None:
        self.executor = CaseExecutor(self.model, self.adapter, self.adapter.describe())

    def begin(self) -> None:
        """Power cycle the device."""
        self.executor.configured = None
        objects = self.executor.configuration()
        self.executor.session.begin(self.executor.known.choices, objects)

    def apply(self, stimulus: Stimulus) -> _Failure | None:
        """Give one stimulus; give what is wrong then."""
        try:
            self.executor.session.apply(stimulus)
        except Deviation as deviation:
            found = deviation.mismatch
            clauses = [self.model.protocol.clauses[name] for name in found.clauses]
            words = [f"expected: {' or '.join(found.expected)}", f"observed: {found.observed}"]
            words += [f"clause {c.id} {c.level}: {c.wording} ({c.source})" for c in clauses]
            words += [f"reason: {reason}" for reason in found.reasons]
            blames = any(clause.level is Level.MUST for clause in clauses)
            return _Failure(found.signature, blames, self._with_trace(words))
        except InconclusiveError as unclear:
            return _Failure("inconclusive", blames=False, words=str(unclear))
        except DeviceFault as death:
            words = ["expected: an answer, and a device that lives", f"observed: {death}"]
            return _Failure(type(death).__name__, blames=True, words=self._with_trace(words))
        return None

    def run(self, stimuli: Sequence[Stimulus]) -> _Failure | None:
        """Give stimuli from power-on; give the first thing that is wrong."""
        self.begin()
        return next((f for f in map(self.apply, stimuli) if f is not None), None)

    def explained(self, failure: _Failure, stimuli: Sequence[Stimulus]) -> str:
        """Give what to say of a run that fails: the shortest that fails so, and its token."""
        if failure.signature not in self.told:
            whole = Case("stateful", "a run of the state machine", "al", tuple(stimuli))
            self.told[failure.signature] = self._shortened(failure, whole)
        return self.told[failure.signature]

    def _shortened(self, failure: _Failure, whole: Case) -> str:
        found = failure

        def fails(case: Case) -> bool:
            nonlocal found
            seen = self.run(case.stimuli)
            same = seen is not None and seen.signature == failure.signature
            if seen is not None and same:
                found = seen
            return same

        try:
            short = shortest(whole, fails, TRIES)
        except ValueError:
            return f"{failure.words}\nonce only: a replay passed\ntoken: {token_of(whole)}"
        return f"{found.words}\ntoken: {token_of(short)}"

    def _with_trace(self, words: Sequence[str]) -> str:
        trace = self.executor.session.trace
        lines = [f"  {line.time / 1000:.3f} ms {line.who} {line.what}" for line in trace]
        return "\n".join(("", *words, "trace:", *lines))


def _off(managers: Iterable[str]) -> Iterator[Stimulus]:
    """Switch SyncManagers off, which can be set only then."""
    for name in managers:
        yield WriteRegister(f"{name}_activation", {"enabled": 0})


def _machine(bench: _Bench) -> type[RuleBasedStateMachine]:
    """Give the rules; those that the device or the way to it has no use for are left out."""
    model, description = bench.model, bench.executor.description
    limits = limits_of(description)
    protocol = model.protocol
    states = [r.value for r in protocol.tables["al_state"].rows]
    entries = strategies.objects(model)
    declared = st.sampled_from(protocol.objects).map(lambda entry: (entry.index, entry.subindex))
    truths = st.booleans()
    mostly = st.sampled_from([True, True, True, False])
    pieces = st.builds(Segment, st.integers(1, _LONGEST), mostly, mostly)
    events = sorted(description.locals)
    drives = any(word.name == CONTROL for word in model.words.values())
    wrong_mailboxes = [stimuli for _, stimuli in wrong_settings(model)]
    wrong_data = [*wrong_process_data(model).values()] if has_process_data(model) else []

    class Machine(RuleBasedStateMachine):
        """What a MainDevice does with the device, one rule at a time."""

        @initialize(state=st.sampled_from(_GOALS))
        def power_on(self, state: str) -> None:
            self._client = Client(model, limits)
            self._made: list[Stimulus] = []
            self._over = False
            bench.begin()
            self._do(*(way_to(model, state) if state != WAY_UP[0] else ()))

        def _do(self, *moves: Move) -> None:
            """Make moves; raise an AssertionError when the device deviates."""
            for move in moves:
                if self._over:
                    return
                stimulus = self._client.give(move)
                self._made.append(stimulus)
                failure = bench.apply(stimulus)
                if failure is not None:
                    self._over = True
                    if failure.blames:
                        raise AssertionError(bench.explained(failure, self._made))

        # --- the AL states ------------------------------------------------------------------------

        @rule(state=st.sampled_from(_GOALS[1:]))
        def go_to(self, state: str) -> None:
            self._do(request(model.row("al_state", WAY_UP[0]), acknowledge=True))
            self._do(*way_to(model, state))

        @rule(state=st.sampled_from(states), acknowledge=truths)
        def request_state(self, state: int, acknowledge: bool) -> None:  # noqa: FBT001
            self._do(request(state, acknowledge=acknowledge))

        @rule()
        def set_up(self) -> None:
            self._do(*mailbox_settings(model), SetUpProcessData())

        @rule(settings=st.sampled_from(wrong_mailboxes), state=st.sampled_from(states))
        def misset_mailbox(self, settings: tuple[Stimulus, ...], state: int) -> None:
            """Set the mailboxes wrongly in INIT, and ask for a state."""
            init = request(model.row("al_state", WAY_UP[0]), acknowledge=True)
            self._do(init, *_off(SYNC_MANAGERS), *settings, request(state))

        if wrong_data:

            @rule(settings=st.sampled_from(wrong_data))
            def misset_process_data(self, settings: SetUpProcessData) -> None:
                """Set the process data wrongly in PREOP, and ask for SAFEOP."""
                init = request(model.row("al_state", WAY_UP[0]), acknowledge=True)
                up = (*way_to(model, "PREOP"), *first_assigned(model), *_off(PROCESS_DATA))
                self._do(init, *up, settings, request(model.row("al_state", "SAFEOP")))

        @rule(microseconds=st.sampled_from(_WAITS))
        def wait(self, microseconds: int) -> None:
            self._do(Wait(microseconds))

        # --- SDO ----------------------------------------------------------------------------------

        @rule(key=declared)
        def read(self, key: tuple[int, int]) -> None:
            self._do(upload(*key), SendSegments())

        @rule(key=declared, rights=st.lists(mostly, max_size=_PIECES))
        def read_in_pieces(self, key: tuple[int, int], rights: list[bool]) -> None:
            self._do(upload(*key), *(Ask(right) for right in rights))

        @rule(drawn=entries)
        def write(self, drawn: tuple[ObjectEntry, bytes]) -> None:
            entry, value = drawn
            self._do(*written(model, entry, value, limits))
            self._do(upload(entry.index, entry.subindex), SendSegments())

        @rule(
            drawn=entries,
            first=st.integers(0, _PIECES),
            segments=st.lists(pieces, max_size=_PIECES),
        )
        def write_in_pieces(
            self, drawn: tuple[ObjectEntry, bytes], first: int, segments: list[Segment]
        ) -> None:
            entry, value = drawn
            key = (entry.index, entry.subindex)
            self._do(Begin(key, value or b"\1", first), *segments, upload(*key))

        @rule(stimulus=strategies.stimuli(model, limits, events))
        def do_anything(self, stimulus: Stimulus) -> None:
            self._do(stimulus)

        # --- process data, local events -----------------------------------------------------------

        @rule(microseconds=st.sampled_from(_WAITS[-2:]))
        def feed_and_starve(self, microseconds: int) -> None:
            self._do(WriteOutputs(), StopOutputs(), Wait(microseconds))

        if drives:

            @rule(words=st.lists(st.sampled_from([*commands(model).values()]), max_size=_PIECES))
            def command(self, words: list[int]) -> None:
                self._do(*(WriteOutputs({CONTROL: word}) for word in words))

        if events:

            @rule(event=st.sampled_from(events))
            def raise_local(self, event: str) -> None:
                self._do(Happen(event))

    return Machine
