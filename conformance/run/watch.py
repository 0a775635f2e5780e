"""Waits for what a device may still do, and looks at what it shows."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.base.adapter import (
    AdapterError,
    DeviceFault,
    advance_until,
    read_all,
)
from ecatspec.conformance.base.verdict import (
    SUB_DEVICE,
)
from ecatspec.conformance.run.device_link import (
    AL,
    DATA_IN,
    MAIL,
    MAIN_IN,
    SECOND,
    DeviceLink,
    InconclusiveError,
    message_said,
)
from ecatspec.model.core.register_map import (
    field_of,
)
from ecatspec.model.oracle.explanations import Exchange
from ecatspec.model.oracle.waiting import unseen

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from ecatspec.conformance.base.adapter import Span
    from ecatspec.model.oracle.oracle import Oracle


FIRST_WAIT = 500
SLOWER = {True: 400, False: 4}
"""Each wait for the same is so much longer than the one before, in virtual and in real time: to
wait costs nothing in one, to look nothing in the other."""
_FLOOD = 64
"""More messages at once than a device can have reason for."""
LOOKS: Final = 64
"""Maximum number of looks for what is still to come of one stimulus."""
UNASKED: Final = 1024
"""Unsolicited messages that are read in a case at most."""
WATCHED = (*AL, *MAIL)
"""The registers that are read after every stimulus: what the device shows."""


@dataclass(slots=True)
class Watch(DeviceLink):
    """A device that is watched until nothing more may happen."""

    def _settle(self, *, unread: bool = False) -> None:
        if self._hurries:
            self._hurries = False
            self._look(unread=unread)
            self._keep_up()
            return
        wait = FIRST_WAIT
        # where anything may happen there is nothing to see before it has
        open_for = self.oracle.known.open_until(self.time) - self.time
        if open_for > 0:
            self._wait(open_for + 1)
        for looks_left in reversed(range(LOOKS)):
            self._look(unread=unread)
            coming = self.oracle.to_come(self.time, unread=unread)
            self._keep_up()
            if not coming:
                break
            if self._runs_ahead and not self._passed:
                waits = self._foreseen(wait, coming, unread=unread)[:looks_left]
                if waits:
                    self._run_ahead(waits)
            self._wait(min(wait, min(coming) - self.time + 1))
            wait *= SLOWER[self._virtual]
        else:
            raise InconclusiveError(f"the device does not come to rest, looked at {LOOKS} times")
        if not unread and unseen(self.model, self.oracle.expanded(self.time), self.time):
            why = "a reply is due, and whether it is there cannot be seen: working counter 0"
            raise InconclusiveError(why)

    def _foreseen(self, wait: int, coming: Collection[int], *, unread: bool) -> list[int]:
        """Give the waits, in microseconds, that follow while looks give what they gave last.

        They end with the first behind which something must have come: what is to be done then the
        oracle has to tell, and until then what it makes of a look that shows nothing new costs
        next to nothing. No wait: what a look begins with is not all that is done meanwhile.
        """
        looked = {span: self._seen.get(span) for span in self._spans(self.oracle)}
        shown = {span: reading for span, reading in looked.items() if reading is not None}
        reads_mail = self._mail_waits and not unread
        if self._outputs is not None or len(shown) < len(looked) or reads_mail:
            return []
        oracle, time = self.oracle.fork(), self.time
        waits: list[int] = []
        while coming and not oracle.lost:
            due = min(coming) - time + 1
            waits.append(min(wait, due))
            if wait >= due:
                break
            time += wait
            wait *= SLOWER[self._virtual]
            for (address, _), (counter, data) in shown.items():
                read = Exchange(
                    time, write=False, address=address, data=data, working_counter=counter
                )
                if oracle.observe(read) is not None or self._spans(oracle) != tuple(shown):
                    return waits
            coming = oracle.to_come(time, unread=unread)
        return waits

    def _run_ahead(self, waits: Sequence[int]) -> None:
        """Let the device go through these waits by one exchange, as far as looks show nothing new.

        `_wait` and `_look` take from `_passed` what came of it, step by step.
        """
        seen = {span: self._seen[span] for span in self._spans(self.oracle)}
        marks = 0

        def mark() -> None:
            nonlocal marks
            self._passed.append(seen if marks % 2 else {})
            marks += 1

        steps = [wait / SECOND for wait in waits]
        try:
            passed, found = advance_until(self.adapter, steps, seen, mark)
        except (AdapterError, DeviceFault) as error:
            self._passed.append(error)
        else:
            if marks < 2 * passed:
                self._passed.append(dict(zip(seen, found, strict=True)))

    def _look(self, *, unread: bool = False) -> None:
        if self._passed:
            self._ahead = self._next_passed().copy()
        elif self._batches:
            self._read_ahead()
        self._look_at_all(unread=unread)
        self._ahead = {}

    def _look_at_all(self, *, unread: bool) -> None:
        # the code is judged only once the state is known, so the state comes first
        self._read_registers(*AL)
        self._read_inputs()
        if unread:
            self._full()
            return
        for _ in range(_FLOOD):
            if not self._full():
                return
            start, length = self._area(MAIN_IN)
            counter, data = self.adapter.read(start, length)
            message = self.model.decode(data) if counter else None
            if message is not None:
                self._answers.append(message)
            said = data if message is None else data[: self.model.codec.length(message)]
            self._say(SUB_DEVICE, partial(message_said, self.model, "answers", message), said)
            self._observe(self._exchange(start, data, counter))
            if not counter:
                return
            self._unasked += self.oracle.known.judges_mail()
            if self._unasked > UNASKED:
                why = f"the device sends messages without end: {UNASKED} were unsolicited"
                raise InconclusiveError(why)

    def _read_ahead(self) -> None:
        """Read by one exchange with the adapter what a look begins with."""
        spans = self._spans(self.oracle)
        self._tick()
        self._ahead = dict(zip(spans, read_all(self.adapter, spans), strict=True))

    def _spans(self, oracle: Oracle) -> tuple[Span, ...]:
        """Give what a look begins with, in order, as this oracle has it."""
        inputs = oracle.known.process_area(DATA_IN)
        return (self._span(*AL), *([] if inputs is None else [inputs]), self._span(*MAIL))

    def _full(self) -> bool:
        status = self._read_registers(*MAIL)[0]
        self._mail_waits = bool(field_of(self.model.protocol, MAIL[0], "full", status))
        return self._mail_waits
