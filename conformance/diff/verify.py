"""Replays the witnesses of a comparison, and writes them as test vectors.

They go through adapters and a session, as the cases of a run do, and not through the machines that
they were found in: what a MainDevice reads then must be what the comparison says.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from ecatspec.conformance.adapters.in_process import Guarded
from ecatspec.conformance.adapters.model import VirtualAdapter, described
from ecatspec.conformance.base.devices import going
from ecatspec.conformance.diff.machines import SDO
from ecatspec.conformance.run.device_link import Deviation, InconclusiveError
from ecatspec.conformance.run.session import Session
from ecatspec.generators.cases.case_codec import to_data
from ecatspec.generators.covers.drive_cover import STATUS
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.observables import layout
from ecatspec.model.core.process_image import INPUTS, taken
from ecatspec.model.core.register_map import field_of
from ecatspec.model.core.values import Pattern, admits, bits_of, ranges_of
from ecatspec.model.esc.subdevice import VirtualSubDevice
from ecatspec.model.oracle.oracle import Oracle

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.conformance.base.adapter import Adapter
    from ecatspec.conformance.diff.behaviour import Behaviour
    from ecatspec.conformance.diff.comparison import Comparison
    from ecatspec.conformance.diff.machines import Part
    from ecatspec.generators.cases.case import Case
    from ecatspec.model.core.values import Value
    from ecatspec.spec.language.ir import Protocol

_STATUS_BIT = "status bit "
_ANSWER = "answer "


class Overheard(Guarded):
    """An adapter that keeps the messages that were read from the mailbox."""

    def __init__(self, adapter: Adapter, start: int) -> None:
        """Take the adapter and where its messages are read."""
        super().__init__(adapter)
        self._start = start
        self.messages: list[bytes] = []

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Read, and keep what is a message."""
        counter, data = super().read(address, length)
        if counter and address == self._start:
            self.messages.append(data)
        return counter, data


def verify(found: Comparison) -> tuple[str, ...]:
    """Replay all witnesses on both virtual SubDevices; give a line for each that fails."""
    failures = []
    for side in (0, 1):
        bench = _Bench(going(found.protocols[side], found.choices[side]))
        for behaviour in found.behaviours:
            parts = behaviour.seen[side].parts
            wrong = bench.replay(behaviour.machine, behaviour.cases[side], parts)
            failures += [f"{found.names[side]}: {behaviour.subject}: {each}" for each in wrong]
    return tuple(failures)


class _Bench:
    """A virtual SubDevice, driven by a session that its own text judges."""

    def __init__(self, protocol: Protocol) -> None:
        self.model = Model(protocol)
        start = self.model.parameter("mailbox_in", "start")
        device = VirtualSubDevice(protocol)
        known = device.state.objects.items()
        self.objects = {key: v for key, v in known if self.model.image.configures(key[0])}
        """What is assigned and mapped after power-on, which the MainDevice has read before."""
        self.adapter = Overheard(VirtualAdapter(device, described(protocol)), start)

    def replay(self, machine: str, case: Case, parts: tuple[Part, ...]) -> Iterator[str]:
        """Yield what a MainDevice sees otherwise after the last stimulus of a case."""
        session = Session(self.adapter, self.model, Oracle(self.model))
        try:
            session.begin({}, self.objects)
            for stimulus in case.stimuli:
                self.adapter.messages = []
                session.apply(stimulus)
        except Deviation as deviation:
            yield f"its own text does not allow it: {deviation.mismatch.observed}"
            return
        except InconclusiveError as unclear:
            yield str(unclear)
            return
        seen = self._answers() if machine == SDO else self._shown(session)
        for part in parts:
            if part.name in seen and not admits(part.value, seen[part.name]):
                yield f"{part.name} is {seen[part.name]!r} and not {part.words or part.value!r}"
            elif part.name not in seen and part.name.startswith(_ANSWER):
                yield f"there is no {part.name}: {part.words}"

    def _answers(self) -> dict[str, Value]:
        found: dict[str, Value] = {}
        for number, data in enumerate(self.adapter.messages):
            message = self.model.decode(data)
            if message is not None:
                name = f"{_ANSWER}{number}"
                found[name] = message.frame
                found |= {f"{name} {key}": value for key, value in message.fields.items()}
        return found or {f"{_ANSWER}0": "silence"}

    def _shown(self, session: Session) -> dict[str, Value]:
        protocol = self.model.protocol
        found: dict[str, Value] = {}
        for name in ("al_status", "al_status_code"):
            register = protocol.registers[name]
            raw = int.from_bytes(self.adapter.read(register.address, register.size)[1], "little")
            found |= {
                bits.name: field_of(protocol, name, bits.name, raw) for bits in register.fields
            }
        return found | self._status(session)

    def _status(self, session: Session) -> dict[str, Value]:
        """Give the bits of the status word, read from the process data as they are laid out."""
        word = self.model.protocol.words[STATUS]
        mapped = layout(self.model, session.oracle.known.example(), INPUTS) or ()
        part = next((part for part in mapped if part.key == word.key), None)
        size = -(-sum(each.bits for each in mapped) // 8)
        if part is None:
            return {}
        counter, data = self.adapter.read(self.model.parameter("process_data_in", "start"), size)
        raw = taken(data, part) if counter else None
        if raw is None:
            return {}
        return {
            f"{_STATUS_BIT}{view.name}": bits_of(raw, view.low, view.low + view.width - 1)
            for view in self.model.views[STATUS]
        }


# --- test vectors ---------------------------------------------------------------------------------


def vectors(found: Comparison) -> str:
    """Give the witnesses as JSON: the stimuli of each side, and what each may answer."""
    data = {
        "schema": "ecatspec.diff.vectors",
        "schema_version": 1,
        "devices": [
            {
                "name": name,
                "digest": protocol.digest,
                "choices": dict(sorted(choices.items())),
            }
            for name, protocol, choices in zip(
                found.names, found.protocols, found.choices, strict=True
            )
        ],
        "tests": [_vector(number, each) for number, each in enumerate(found.behaviours, 1)],
    }
    return json.dumps(data, indent=2, sort_keys=True) + "\n"


def _vector(number: int, behaviour: Behaviour) -> dict[str, object]:
    return {
        "number": number,
        "machine": behaviour.machine,
        "inputs": list(behaviour.inputs),
        "sides": [
            {
                "case": to_data(case),
                "expected": [
                    {"name": part.name, "any_of": _any_of(part.value)} for part in seen.parts
                ],
                "rules": list(rules),
                "clauses": list(clauses),
            }
            for case, seen, rules, clauses in zip(
                behaviour.cases, behaviour.seen, behaviour.rules, behaviour.clauses, strict=True
            )
        ],
    }


def _any_of(value: Value) -> list[object]:
    """Give the values that are allowed: single ones, and ranges as pairs."""
    if isinstance(value, Pattern):
        return [low if low == high else [low, high] for low, high in ranges_of(value) or ()]
    return [value.hex() if isinstance(value, bytes) else value]
