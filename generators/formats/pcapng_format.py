"""Writes test vectors as a capture, with comments: what would be seen on the wire.

Each access is a request and its answer. Where a test allows several answers there is the first
with which it goes on; bits that may be anything are 0.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final, assert_never

import dpkt.pcapng

from ecatspec.generators.vectors.schema import Full, Local, Mail, Read, Send, Write
from ecatspec.generators.vectors.symbols import words_of
from ecatspec.model.esc.wire import COMMANDS, Datagram, Wire, wire_format

if TYPE_CHECKING:
    from collections.abc import Iterable
    from typing import IO

    from ecatspec.generators.vectors.schema import (
        Allowed,
        Effect,
        Expected,
        Head,
        Input,
        Step,
        Test,
    )
    from ecatspec.generators.vectors.symbols import Words

STATION_ADDRESS: Final = 0x1001
"""Of the SubDevice: any would do."""
_MAIN_DEVICE: Final = bytes([0x00, 0x01, 0x01, 0x01, 0x01, 0x01])
"""The Ethernet address of the MainDevice, of which a SubDevice sets a bit."""
_READS: Final = "FPRD"
_WRITES: Final = "FPWR"
_READS_ALL: Final = "BRD"
_WRITES_ALL: Final = "BWR"
_NOTHING: Final = "NOP"
"""Names of commands in the texts."""
_HOW_TO_READ: Final = (
    "Each access is a request and the answer that is expected, the first of several; bits that may "
    "be anything are 0. Process data are accessed by broadcast, so that nobody takes them for "
    "messages. Messages that are wrong on purpose are shown as malformed."
)
_PROCESS_DATA: Final = frozenset({"process_data", "inputs"})
"""Symbols of what is accessed by broadcast, there being one SubDevice: otherwise Wireshark takes
it for messages in a mailbox.
"""
_HALF: Final = 32
"""Bits of either half of a time."""
_NUMBERS: Final = 256
"""Datagrams are numbered below this."""
_LONGEST_PACKET: Final = 1 << 18


def write(head: Head, tests: Iterable[tuple[str, Test]], out: IO[bytes]) -> None:
    """Write a capture; a test is in memory at a time, and follows the one before in time."""
    tape = _Tape(head, words_of(head), out)
    tape.begin()
    for _, test in tests:
        tape.test(test)


@dataclass(frozen=True, slots=True)
class _Answer:
    """What comes back from an address, and what that is in words."""

    address: int
    data: bytes
    counter: int
    said: str = ""


@dataclass(slots=True)
class _Tape:
    """A capture while it is written."""

    head: Head
    words: Words
    out: IO[bytes]
    _time: int = 0
    _number: int = 0
    _comments: list[str] = field(default_factory=list)
    """What the next packet is to say besides."""
    _wire: Wire = field(init=False)
    _largest: int = field(init=False)
    """Maximum number of bytes in a datagram."""
    _outer: frozenset[str | None] = field(init=False)
    """Layouts with others inside."""

    def __post_init__(self) -> None:
        """Ask the texts for the numbers of the wire."""
        model = self.words.model
        self._wire = Wire(wire_format(model))
        self._outer = frozenset(frame.parent for frame in model.protocol.frames.values())
        self._largest = model.parameter("maximal_mailbox")

    def begin(self) -> None:
        """Write what stands before the packets."""
        made, spec = self.head.generator, self.head.spec
        choices = ", ".join(f"{name} = {way}" for name, way in self.head.choices.items())
        notes = (f"{name}: {note.description}" for name, note in self.head.notes.items())
        about = (
            f"Test vectors for {spec.name} ({spec.title}), texts {spec.sha256}, "
            f"depth {made.depth}, seed {made.seed}. {_HOW_TO_READ} "
            f"Choices that the tests take for granted: {choices or 'none'}."
        )
        maker = _option(dpkt.pcapng.PCAPNG_OPT_SHB_USERAPPL, f"{made.name} {made.version}")
        section = dpkt.pcapng.SectionHeaderBlockLE(opts=_options([about, *notes], maker))
        name = _option(dpkt.pcapng.PCAPNG_OPT_IF_NAME, spec.name)
        link = dpkt.pcapng.InterfaceDescriptionBlockLE(
            snaplen=_LONGEST_PACKET, opts=_options([], name)
        )
        self.out.write(bytes(section) + bytes(link))

    def test(self, test: Test) -> None:
        """Write one test."""
        said = [f"test {test.tcId} {test.id}: {test.comment}"]
        for what, names in (("flags", test.flags), ("clauses", test.clauses)):
            if names:
                said.append(f"{what}: {', '.join(names)}")
        self._comments = ["\n".join(said)]
        for number, step in enumerate(test.steps, 1):
            self._step(f"{test.id} step {number}", step)

    def _step(self, place: str, step: Step) -> None:
        if step.given is not None:
            self._do(f"{place} in", step.given)
        begun, cycle = self._time, step.cycle
        if cycle is not None and step.us:
            self._time += min(cycle.us, step.us)
            said = f"process data, every {cycle.us} us for {step.us} us"
            answer = _Answer(cycle.address, bytes.fromhex(cycle.data), 1, said)
            self._access(f"{place} cycle", _WRITES_ALL, answer)
        self._time = begun + step.us
        for expected in step.expect:
            everybody = isinstance(expected, Read) and expected.symbol in _PROCESS_DATA
            command = _READS_ALL if everybody else _READS
            self._access(f"{place} expect", command, self._answer(expected))

    def _do(self, place: str, given: Input) -> None:
        match given:
            case Write(address, digits, symbol, counter):
                data = bytes.fromhex(digits)
                said = f"writes {self.words.say(symbol, data)}"
                command = _WRITES_ALL if symbol in _PROCESS_DATA else _WRITES
                self._access(place, command, _Answer(address, data, counter, said))
            case Send(address, digits, symbol):
                data = bytes.fromhex(digits)
                whole = data.ljust(self.head.config.mailboxOut.length, b"\0")
                said = f"sends {self.words.say(symbol, data)}"
                self._access(place, _WRITES, _Answer(address, whole, 1, said))
            case Local(event):
                said = f"{place}: local event {event} in the device"
                self._packet(said, self._datagram(_NOTHING, _Answer(0, b"", 0), 0))
            case _:
                assert_never(given)

    # --- answers ----------------------------------------------------------------------------------

    def _answer(self, expected: Expected) -> _Answer:
        """Give the first answer with which the test goes on, else one with which it ends."""
        config = self.head.config
        match expected:
            case Read():
                chosen = _chosen(expected.anyOf, expected.refused)
                if chosen is None:
                    data, counter = b"", int(expected.refused is None)
                    said = "anything" if counter else f"refused{_or(len(expected.anyOf))}"
                else:
                    said, data, counter = self._said(expected, chosen), _value(chosen), 1
                whole = data.ljust(expected.length, b"\0")[: expected.length]
                return _Answer(expected.address, whole, counter, said)
            case Mail():
                every = sorted(expected.anyOf, key=self._is_vague)
                chosen = _chosen(every, expected.none or expected.otherwise)
                if chosen is None:
                    others = len(expected.anyOf)
                    return self._fullness(f"no message{_or(others)}", full=False)
                data = self.words.whole(_value(chosen), bytes.fromhex(chosen.mask))
                area = config.mailboxIn
                whole = data.ljust(area.length, b"\0")[: area.length]
                return _Answer(area.address, whole, 1, self._said(expected, chosen))
            case Full(full):
                said = "a message waits, which is not read" if full else "no message waits"
                return self._fullness(said, full=full)
            case _:
                assert_never(expected)

    def _is_vague(self, allowed: Allowed) -> bool:
        """Tell whether the bytes are but the beginning of some message, which looks malformed."""
        data = self.words.whole(_value(allowed), bytes.fromhex(allowed.mask))
        message = self.words.model.decode(data)
        return message is None or message.frame in self._outer

    def _fullness(self, said: str, *, full: bool) -> _Answer:
        area, mask = self.head.config.mailboxFull, bytes.fromhex(self.head.config.mailboxFullMask)
        data = mask if full else bytes(len(mask))
        return _Answer(area.address, data.ljust(area.length, b"\0")[: area.length], 1, said)

    def _said(self, expected: Read | Mail, chosen: Allowed) -> str:
        words = self.words.say_allowed(expected.symbol, chosen)
        return f"{words}{_or(len(expected.anyOf) - 1)}"

    # --- packets ----------------------------------------------------------------------------------

    def _access(self, place: str, command: str, whole: _Answer) -> None:
        """Write request and answer; what no datagram can hold goes in parts."""
        writes = command in {_WRITES, _WRITES_ALL}
        became = "taken" if whole.counter else "refused"
        for start in range(0, len(whole.data), self._largest):
            part = whole.data[start : start + self._largest]
            answer = replace(whole, address=whole.address + start, data=part)
            asked = replace(answer, data=part if writes else bytes(len(part)), counter=0)
            everybody = command in {_READS_ALL, _WRITES_ALL}
            position, passed = (0, 1) if everybody else (STATION_ADDRESS, STATION_ADDRESS)
            self._number = (self._number + 1) % _NUMBERS
            request = self._datagram(command, asked, position)
            self._packet(f"{place}: {whole.said}" if writes else place, request)
            returned = self._datagram(command, answer, passed)
            said = became if writes else whole.said
            self._packet(f"{place}: {said}", returned, returned=True)

    def _datagram(self, command: str, content: _Answer, position: int) -> Datagram:
        kind, data = COMMANDS[command], content.data
        return Datagram(kind, self._number, position, content.address, data, content.counter)

    def _packet(self, said: str, content: Datagram, *, returned: bool = False) -> None:
        source = self._wire.marked(_MAIN_DEVICE) if returned else _MAIN_DEVICE
        comments, self._comments = [said, *self._comments], []
        packet = dpkt.pcapng.EnhancedPacketBlockLE(
            ts_high=self._time >> _HALF,
            ts_low=self._time & (1 << _HALF) - 1,
            pkt_data=self._wire.frame(source, (content,)),
            opts=_options(comments),
        )
        self.out.write(bytes(packet))


def _chosen(every: list[Allowed], nothing: Effect | None) -> Allowed | None:
    """Give the bytes to show; None: rather that there is nothing."""
    passing = next((each for each in every if each.effect == "passes"), None)
    if passing is None and nothing != "passes" and every:
        return every[0]
    return passing


def _value(allowed: Allowed) -> bytes:
    return bytes.fromhex(allowed.value)


def _or(others: int) -> str:
    if others > 1:
        return f"; or one of {others} others"
    return "; or another" if others == 1 else ""


def _option(code: int, text: str) -> dpkt.pcapng.PcapngOptionLE:
    return dpkt.pcapng.PcapngOptionLE(code=code, data=text.encode())


def _options(
    comments: Iterable[str], *others: dpkt.pcapng.PcapngOptionLE
) -> list[dpkt.pcapng.PcapngOptionLE]:
    said = (_option(dpkt.pcapng.PCAPNG_OPT_COMMENT, each) for each in comments)
    return [*said, *others, dpkt.pcapng.PcapngOptionLE()]
