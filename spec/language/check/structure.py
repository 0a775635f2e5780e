"""Checks that what a text names exists, and that its parts fit."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ecatspec.spec.language.check.findings import Findings
from ecatspec.spec.language.check.texts import LAYOUT_WORDS
from ecatspec.spec.language.diagnostics import Code
from ecatspec.spec.language.functions import CYCLIC
from ecatspec.spec.language.ir import (
    Access,
    Bytes,
    CodeTable,
    Frame,
    Gap,
    InputKind,
    Literal,
    Machine,
    Named,
    ObjectEntry,
    Reason,
    Register,
    RegisterField,
    Rule,
    SInt,
    Span,
    Text,
    Type,
    UInt,
    Word,
)
from ecatspec.spec.language.kinds import bounds_of, width_of
from ecatspec.spec.language.scope import frame_chain, frame_fields

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ecatspec.spec.language.ir import (
        Input,
    )


_BITS: Final = 8


class StructureChecker(Findings):
    """Walks over everything that is no expression."""

    def structure(self) -> None:
        """Check everything that is no expression."""
        for table in self._protocol.tables.values():
            self._table(table)
        for parameter in self._protocol.parameters.values():
            self._type(parameter.type, parameter.at)
        for register in self._protocol.registers.values():
            self._register(register)
        self._words()
        for frame in self._protocol.frames.values():
            self._frame(frame)
        for machine in self._protocol.machines.values():
            self._machine(machine)
        for reason in self._protocol.reasons.values():
            self._reason_of(reason)

    def _table(self, table: CodeTable) -> None:
        for row in table.rows:
            if row.value >> table.width:
                self._note(
                    Code.ECS201,
                    row.at,
                    f"{row.value:#x} does not fit the {table.width} bits of `{table.name}`",
                    "make the table wider or the value smaller",
                )

    def _type(self, kind: Type, at: Span) -> None:
        if isinstance(kind, Named) and kind.table not in self._protocol.tables:
            self._missing("table", kind.table, self._protocol.tables, at)
        if isinstance(kind, UInt | SInt) and not kind.width:
            self._note(Code.ECS201, at, "a number of no bits", "give it at least one bit")

    def _register(self, register: Register) -> None:
        bits = register.size * _BITS
        if register.reset >> bits:
            self._note(
                Code.ECS201,
                register.at,
                f"the reset value does not fit the {bits} bits of `{register.name}`",
                "make it smaller",
            )
        self._bits(register.name, bits, register.fields)

    def _words(self) -> None:
        objects: dict[tuple[int, int], Word] = {}
        for word in self._protocol.words.values():
            self._bits(word.name, word.size * _BITS, word.fields)
            for field in word.fields:
                if field.name == CYCLIC:
                    what = f"`{CYCLIC}` is a parameter of each input from a word"
                    self._note(Code.ECS102, field.at, what, "give the field another name")
            if word.key is None:
                continue
            index, subindex = word.key
            what = f"object {index:#06x}:{subindex}"
            if index >> 16 or subindex >> 8:
                self._note(Code.ECS201, word.at, f"there is no {what}", "make it smaller")
            if word.key in objects:
                first = objects[word.key]
                self._note(
                    Code.ECS102,
                    word.at,
                    f"{what} has the word `{first.name}` already at {first.at}",
                    "take one of them away",
                )
            objects.setdefault(word.key, word)

    def _bits(self, owner: str, bits: int, fields: Iterable[RegisterField]) -> None:
        taken: dict[int, str] = {}
        for field in fields:
            self._type(field.type, field.at)
            span = range(field.low, field.high + 1)
            if field.high >= bits or not span:
                self._note(
                    Code.ECS201,
                    field.at,
                    f"bits {field.low}..{field.high} are not in the {bits} bits of `{owner}`",
                    f"stay between 0 and {bits - 1}, low bit first",
                )
            others = sorted({taken[bit] for bit in span if bit in taken})
            if others:
                self._note(
                    Code.ECS201,
                    field.at,
                    f"`{field.name}` takes bits of `{others[0]}`",
                    "move one of them",
                )
            taken |= dict.fromkeys(span, field.name)
            width = width_of(self._protocol, field.type)
            if width is not None and span and width != len(span):
                self._note(
                    Code.ECS201,
                    field.at,
                    f"`{field.name}` has {len(span)} bits and a type of {width}",
                    "make them equal",
                )

    def _frame(self, frame: Frame) -> None:
        parent = None if frame.parent is None else self._protocol.frames.get(frame.parent)
        if frame.parent is not None and parent is None:
            self._missing("frame", frame.parent, self._protocol.frames, frame.at)
        chain = list(frame_chain(self._protocol, frame.name))
        if parent is not None and self._protocol.frames[chain[-1]].parent is not None:
            self._note(Code.ECS204, frame.at, f"`{frame.name}` lies in itself", "break the circle")
            return
        if parent is not None and not (parent.fields and isinstance(parent.fields[-1].type, Bytes)):
            self._note(
                Code.ECS204,
                frame.at,
                f"`{parent.name}` has no bytes at its end that `{frame.name}` could lie in",
                "give it a last field of type bytes",
            )
        outer = {
            field.name: name for name in chain[1:] for field in self._protocol.frames[name].fields
        }
        for field in frame.fields:
            if field.name in outer and not field.name.startswith(LAYOUT_WORDS):
                self._note(
                    Code.ECS204,
                    field.at,
                    f"`{field.name}` is a field of `{outer[field.name]}` around it already",
                    "give it another name",
                )
        self._layout(frame)
        fields = {} if parent is None else frame_fields(self._protocol, parent.name)
        for name, _ in frame.conditions:
            if parent is not None and name not in fields:
                self._missing(f"field of `{parent.name}`", name, fields, frame.at)

    def _layout(self, frame: Frame) -> None:
        bits: int | None = 0
        for position, field in enumerate(frame.fields):
            self._type(field.type, field.at)
            width = width_of(self._protocol, field.type)
            if isinstance(field.type, Bytes):
                if field.type.length is None and position + 1 < len(frame.fields):
                    self._note(
                        Code.ECS204,
                        field.at,
                        f"`{field.name}` takes all bytes, and `{frame.fields[-1].name}` follows",
                        "say how many bytes it has: bytes(n)",
                    )
                if bits is not None and bits % _BITS:
                    self._note(
                        Code.ECS204,
                        field.at,
                        f"`{field.name}` begins at bit {bits}, in the middle of a byte",
                        "add a reserved field before it",
                    )
                bits = 0
            elif width is None:
                if not isinstance(field.type, Named):
                    self._note(
                        Code.ECS204,
                        field.at,
                        f"`{field.name}` has no place in a frame with this type",
                        "take a number, bool, a table or bytes",
                    )
                bits = None
            elif bits is not None:
                bits += width
        if bits is not None and bits % _BITS:
            self._note(
                Code.ECS204,
                frame.at,
                f"the fields of `{frame.name}` end in the middle of a byte",
                "add a reserved field",
            )

    def _machine(self, machine: Machine) -> None:
        table = self._protocol.tables.get(machine.table)
        if table is None:
            self._missing("table", machine.table, self._protocol.tables, machine.at)
        else:
            rows = [row.name for row in table.rows]
            for state in machine.states:
                if state not in rows:
                    self._missing(f"row of table `{table.name}`", state, rows, machine.at)
        self._states(machine, (machine.initial,), machine.at)
        for variable in machine.variables:
            self._type(variable.type, variable.at)
        for item in machine.inputs:
            self._input(item)
        rules_and_gaps: tuple[Rule | Gap, ...] = (*machine.rules, *machine.gaps)
        for row in rules_and_gaps:
            self._states(machine, row.sources, row.at)
            if row.input not in machine.input_by_name:
                self._missing("input", row.input, machine.input_by_name, row.at)
        for rule in machine.rules:
            if rule.target is not None:
                self._states(machine, (rule.target,), rule.at)

    def _input(self, item: Input) -> None:
        what, known = "register", list(self._protocol.registers)
        if item.kind == InputKind.FRAME:
            what, known = "frame", list(self._protocol.frames)
        elif item.kind == InputKind.WORD:
            what, known = "word", list(self._protocol.words)
        for origin in item.origin:
            if origin not in known:
                self._missing(what, origin, known, item.at)
            elif item.kind == InputKind.WORD and self._protocol.words[origin].key is None:
                what = f"word `{origin}` has no object that could take a value"
                self._note(Code.ECS106, item.at, what, f"write word {origin} in INDEX : SUBINDEX")
        for _, kind in item.parameters:
            self._type(kind, item.at)

    def _reason_of(self, reason: Reason) -> None:
        machine = self._protocol.machines.get(reason.machine)
        if machine is None:
            self._missing("machine", reason.machine, self._protocol.machines, reason.at)
            return
        rules = [rule.name for rule in machine.rules]
        if reason.rule not in rules:
            self._missing(f"rule of `{machine.name}`", reason.rule, rules, reason.at)

    def _states(self, machine: Machine, states: Iterable[str], at: Span) -> None:
        for state in states:
            if state not in machine.states:
                self._missing(f"state of `{machine.name}`", state, machine.states, at)

    def objects(self) -> None:
        """The range, the default and the type of an object must agree, and its states exist."""
        al = self._protocol.tables.get("al_state")
        rows = {row.name for row in al.rows} if al is not None else set()
        for entry in self._protocol.objects:
            what = f"object {entry.index:#06x}:{entry.subindex} `{entry.name}`"
            for state in (*entry.states, *entry.read_states):
                if state not in rows:
                    self._missing("AL state", state, rows, entry.at)
            problem = self._problem(entry)
            if problem is not None:
                self._note(Code.ECS405, entry.at, f"{what}: {problem}", "correct the row")

    def _problem(self, entry: ObjectEntry) -> str | None:
        numbers = [n for n in (entry.low, entry.high, entry.default) if isinstance(n, int)]
        if isinstance(entry.type, Text | Bytes):
            most = entry.type.maximum if isinstance(entry.type, Text) else entry.type.length
            if isinstance(most, Literal):
                most = most.value
            if not isinstance(most, int) or isinstance(most, bool):
                return "the length of bytes is no number"
            if numbers:
                return "a text has no number"
            if len(str(entry.default or "").encode()) > most:
                return f"the default is longer than {most} bytes"
            return None
        bounds = bounds_of(self._protocol, entry.type)
        if isinstance(entry.default, str) or bounds is None:
            return "a number has no text"
        if any(not bounds[0] <= number <= bounds[1] for number in numbers):
            return f"a value is not in {bounds[0]}..{bounds[1]}, the numbers of its type"
        low = bounds[0] if entry.low is None else entry.low
        high = bounds[1] if entry.high is None else entry.high
        if low > high:
            return f"the range {low}..{high} is empty"
        if isinstance(entry.default, int) and not low <= entry.default <= high:
            return f"the default {entry.default} is not in the range {low}..{high}"
        if entry.index >> 16 or entry.subindex >> 8:
            return "index or subindex is too great"
        if entry.access is Access.NONE:
            return "nobody can read or write it"
        return None
