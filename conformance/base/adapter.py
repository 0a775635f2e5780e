"""The adapter contract: what a device under test must offer, and how it may fail.

An adapter knows bytes and time and judges nothing.  Two families of error keep apart whose
fault it was: `AdapterError` is the user's set-up or a call outside the contract (exit status
2); a `DeviceFault` is what the device did (a verdict, and the run goes on after `reset`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, Protocol, Self, runtime_checkable

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    Span = tuple[int, int]
    """An address, and how many bytes from there."""
    Reading = tuple[int, bytes]
    """What a read gave: working counter and bytes."""

LIMITS: Final[Mapping[str, int]] = MappingProxyType({"initiate_data": 0, "segment_data": 1})
"""What a description may limit on the way to a device, and the fewest bytes that get through."""
ADDRESS_SPACE: Final = 1 << 16
"""The contract's own bound: an address is an unsigned number of sixteen bits."""


class AdapterError(Exception):
    """The set-up or the call is wrong; the message is one line and says what to do."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))


class Unheard(AdapterError):  # noqa: N818  nobody is wrong
    """An exchange got lost on the way: whether the device took part in it nobody knows."""


class DeviceFault(Exception):  # noqa: N818  a fault of the device is an observation
    """What the device did instead of answering; catch this to catch all three kinds.

    `cause` has the same words in every run; `placed`: it says where in the device the fault is.
    """

    def __init__(self, reason: str, cause: str = "", *, placed: bool = False) -> None:
        super().__init__(reason)
        self.reason: Final = reason
        self.cause: Final = cause or reason.rpartition(":")[2].strip()
        self.placed: Final = placed


class DeviceCrash(DeviceFault):
    """The device ended; `stderr_tail` is the end of what it said on its error stream."""

    def __init__(
        self, reason: str, stderr_tail: str = "", *, cause: str = "", placed: bool = False
    ) -> None:
        super().__init__(reason, cause, placed=placed)
        self.stderr_tail: Final = stderr_tail


class DeviceHang(DeviceFault):
    """The device gave no answer in time and was stopped."""


class DeviceRubbish(DeviceFault):
    """The device gave an answer that is not of the contract and was stopped."""


@dataclass(frozen=True, slots=True)
class Description:
    """What is known of a device before the first exchange."""

    name: str
    protocols: frozenset[str]
    """The layers that are the device's own; cases of other layers are skipped."""
    virtual_time: bool
    """True: `advance` costs no real time."""
    closed_dictionary: bool
    """True: exactly the declared objects exist."""
    notes: tuple[str, ...] = ()
    limits: Mapping[str, int] = field(default_factory=dict, hash=False)
    """`initiate_data`, `segment_data`: the most bytes of a download that one message carries."""
    without: tuple[str, ...] = ()
    """Features that the way to the device cannot carry: cases of them are skipped."""
    locals: frozenset[str] = frozenset()
    """Local events, `machine.input` as in the texts, that `local` can raise in the device."""
    batch: bool = False
    """True: the adapter answers `read_all` quicker than single reads."""
    advance_until: bool = False
    """True: the adapter answers `advance_until` quicker than the steps one by one."""
    power_cycles: bool = True
    """False: `reset` may leave something of what was before, so nothing is blamed for sure."""

    def to_json(self) -> dict[str, object]:
        """Return the description as data for JSON, in a fixed order."""
        return {
            "name": self.name,
            "protocols": sorted(self.protocols),
            "virtual_time": self.virtual_time,
            "closed_dictionary": self.closed_dictionary,
            "notes": list(self.notes),
            "limits": dict(self.limits),
            "without": list(self.without),
            "locals": sorted(self.locals),
            "batch": self.batch,
            "advance_until": self.advance_until,
            "power_cycles": self.power_cycles,
        }

    @classmethod
    def from_json(cls, data: Mapping[str, object]) -> Self:
        """Return the description that `to_json` wrote; ValueError names a wrong field."""
        unknown = sorted(set(data) - set(cls.__slots__))
        if unknown:
            message = f"unknown field {unknown[0]!r} in a description"
            raise ValueError(message)
        name = data.get("name")
        if not isinstance(name, str):
            message = "field 'name' of a description is not a text"
            raise ValueError(message)  # noqa: TRY004  the value is wrong, not the call
        return cls(
            name=name,
            protocols=frozenset(_texts(data, "protocols")),
            virtual_time=_truth(data, "virtual_time"),
            closed_dictionary=_truth(data, "closed_dictionary"),
            notes=_texts(data, "notes"),
            limits=_numbers(data, "limits"),
            without=_texts(data, "without"),
            locals=frozenset(_texts(data, "locals")),
            batch=_truth({"batch": False, **data}, "batch"),
            advance_until=_truth({"advance_until": False, **data}, "advance_until"),
            power_cycles=_truth({"power_cycles": True, **data}, "power_cycles"),
        )


class Adapter(Protocol):
    """A device under test, as a MainDevice sees it."""

    def reset(self) -> None:
        """Power cycle: all volatile state is gone; a dead device lives again."""

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Return the working counter and, when it is not zero, exactly `length` bytes."""

    def write(self, address: int, data: bytes) -> int:
        """Return the working counter of a write of `data`."""

    def advance(self, seconds: float) -> None:
        """Let the device run for that much of its own time."""

    def close(self) -> None:
        """Release everything; a second call does nothing."""

    def describe(self) -> Description:
        """Return what is known of the device; the same at every call."""


@runtime_checkable
class Restorable(Adapter, Protocol):
    """An adapter that can set its device back: cases that begin alike need not begin anew.

    Optional; for adapters in the process of the run. Nothing may remain of what was done after the
    snapshot, wherever it is kept.
    """

    def snapshot(self) -> object:
        """Return what the device is now, its time included."""

    def restore(self, snapshot: object) -> None:
        """Let the device be as it was then; a snapshot may be restored again."""


def raise_local(adapter: Adapter, event: str) -> None:
    """Raise a local event in the device, by the optional method `local(event)` of its adapter.

    Raises:
        AdapterError: The adapter does not describe this event, or has no such method.

    """
    local = getattr(adapter, "local", None)
    if local is None or event not in adapter.describe().locals:
        message = f"the adapter cannot raise {event!r}; describe it in `locals` and offer local()"
        raise AdapterError(message)
    local(event)


def read_all(adapter: Adapter, spans: Sequence[Span]) -> list[Reading]:
    """Read one span after the other; at once, where the adapter has the method `reads(spans)`."""
    reads: Callable[[Sequence[Span]], list[Reading]] | None
    reads = getattr(adapter, "reads", None)
    return [adapter.read(*span) for span in spans] if reads is None else reads(spans)


def advance_until(
    adapter: Adapter,
    steps: Sequence[float],
    seen: Mapping[Span, Reading],
    mark: Callable[[], None] = lambda: None,
) -> tuple[int, list[Reading]]:
    """Let time pass in steps, each with a look behind it, until a look gives other than `seen`.

    At once, where the adapter has the method `advance_until(steps, seen, mark)`.

    Args:
        adapter: The device.
        steps: Seconds, one step or more; the last ends it, whatever the look behind it gives.
        seen: What a look reads, in this order, and what each read gave last.
        mark: Called after each step, and after each look that gave what was `seen`, so that it is
            known where the device was when it died: at the latest with the fault that is raised.

    Returns:
        How many steps passed, and what the look behind the last of them gave.

    Raises:
        AdapterError: There is no step, or a step or a span is none.
        DeviceFault: What the device did instead.

    """
    own: Callable[..., tuple[int, list[Reading]]] | None
    own = getattr(adapter, "advance_until", None)
    if own is not None:
        passed, found = own(steps, seen, mark)
        return passed, found
    return step_until(adapter, steps, seen, mark)


def step_until(
    adapter: Adapter,
    steps: Sequence[float],
    seen: Mapping[Span, Reading],
    mark: Callable[[], None],
) -> tuple[int, list[Reading]]:
    """Do what `advance_until` says one by one: what its other ways have to be the same as."""
    check_steps(steps)
    expected = list(seen.values())
    for passed, seconds in enumerate(steps, 1):
        adapter.advance(seconds)
        mark()
        found = read_all(adapter, tuple(seen))
        if found != expected:
            return passed, found
        mark()
    return len(steps), expected


def check_steps(steps: Sequence[float]) -> None:
    """Refuse to let time pass in no step, or in one that does not pass forward."""
    if not steps:
        raise AdapterError("advance_until without a step; give one number of seconds or more")
    for seconds in steps:
        check_duration(seconds)


def check_span(address: int, length: int) -> None:
    """Refuse an access that no datagram can carry, so that no device ever sees it."""
    if address < 0 or length < 1 or address + length > ADDRESS_SPACE:
        message = (
            f"address {address} with length {length} is outside the address space; "
            f"address 0 to {ADDRESS_SPACE - 1}, length at least 1"
        )
        raise AdapterError(message)


def check_duration(seconds: float) -> None:
    """Refuse a time that does not pass forward."""
    if not 0 <= seconds < float("inf"):
        message = f"cannot advance by {seconds} s; give a number of seconds from 0"
        raise AdapterError(message)


def _texts(data: Mapping[str, object], field: str) -> tuple[str, ...]:
    value = data.get(field, [])
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        message = f"field {field!r} of a description is not a list of texts"
        raise ValueError(message)
    return tuple(value)


def _numbers(data: Mapping[str, object], field: str) -> dict[str, int]:
    value = data.get(field, {})
    numbers: dict[str, int] = {}
    for name, number in (value if isinstance(value, dict) else {field: value}).items():
        if name not in LIMITS or type(number) is not int or number < LIMITS[name]:
            may = " and ".join(f"{known} from {least}" for known, least in LIMITS.items())
            message = f"field {field!r} of a description has {name!r}: {number!r}; "
            message += f"it may have {may}, in bytes"
            raise ValueError(message)
        numbers[name] = number
    return numbers


def _truth(data: Mapping[str, object], field: str) -> bool:
    value = data.get(field)
    if not isinstance(value, bool):
        message = f"field {field!r} of a description is not true or false"
        raise ValueError(message)  # noqa: TRY004  the value is wrong, not the call
    return value
