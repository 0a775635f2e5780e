"""What a device text changes in the standard, statement by statement."""

from __future__ import annotations

import difflib
from dataclasses import replace
from typing import TYPE_CHECKING, Final, TypeAlias, TypeVar

from ecatspec.spec.language.diagnostics import Code, Diagnostic
from ecatspec.spec.language.ir import (
    Choice,
    Clause,
    Close,
    CodeRow,
    CodeTable,
    Condition,
    Confirm,
    Definition,
    Dictionary,
    Extend,
    Frame,
    Gap,
    Input,
    Literal,
    Machine,
    Manual,
    Name,
    ObjectEntry,
    Open,
    Parameter,
    Pin,
    Property,
    Protocol,
    Register,
    Remove,
    Replace,
    ReplaceField,
    Rule,
    SetParameter,
    Variable,
    Word,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from ecatspec.spec.language.ir import (
        Declaration,
        Expression,
        Span,
        Update,
    )


_Named: TypeAlias = Variable | Input | Rule | Gap


_Citing = TypeVar("_Citing", Rule, CodeRow)


_Cites = TypeVar(
    "_Cites", Register, Word, Parameter, Frame, Choice, Condition, Definition, Property
)

_MOST_NAMES: Final = 5
_STATEMENTS = (Pin, Open, Confirm, Close, SetParameter, Replace, Remove, ReplaceField, Dictionary)


class Changes:
    """The parts of the standard that a device text changes, and what was wrong with it."""

    def __init__(self, standard: Protocol, own: Protocol) -> None:
        self.findings: list[Diagnostic] = []
        self.tables = dict(standard.tables)
        for name, table in own.tables.items():
            self.tables[name] = _with_rows(self.tables.get(name), table)
        self.parameters = standard.parameters | own.parameters
        self.machines = standard.machines | own.machines
        self.choices = standard.choices | own.choices
        self.frames = standard.frames | own.frames
        self.registers = standard.registers | own.registers
        self.words = standard.words | own.words
        self.conditions = standard.conditions | own.conditions
        self.definitions = standard.definitions | own.definitions
        self.properties = standard.properties | own.properties
        self.reasons = dict(standard.reasons)
        self.pins = dict(standard.pins)
        self.opened = dict(standard.opened)
        self.closed = dict(standard.closed)

    def take(self, declaration: Declaration) -> None:
        """Do what one statement says; a Close waits until all rules are what they will be."""
        match declaration:
            case Pin():
                self._pin(declaration)
            case Open():
                self._leave_open(declaration)
            case Confirm():
                self._confirm(declaration)
            case SetParameter():
                self._set(declaration)
            case Replace():
                self._replace(declaration)
            case Remove():
                self._remove(declaration)
            case Extend():
                self._extend(declaration)
            case ReplaceField():
                self._replace_field(declaration)
            case _:
                pass

    def unclaimed(self, clauses: Iterable[Clause]) -> None:
        """A device with a manual is judged by what that says: each clause must name a claim."""
        for clause in clauses:
            if not clause.claims:
                self._find(
                    Code.ECS404,
                    clause.at,
                    f"clause {clause.id} names no claim of the manual",
                    "add `claims [...]`",
                )

    def unfounded(self, declarations: Iterable[Declaration], clauses: Mapping[str, Clause]) -> None:
        """What changes the standard must go back to a claim, by one of its clauses."""
        for statement in declarations:
            if not isinstance(statement, _STATEMENTS):
                continue
            if not any(clauses[name].claims for name in statement.clauses if name in clauses):
                self._find(
                    Code.ECS404,
                    statement.at,
                    "no clause that is cited here names a claim of the manual",
                    "cite a clause of the device text",
                )

    def unaccounted(self, manuals: Iterable[Manual], clauses: Iterable[Clause]) -> None:
        """Each claim of a manual that counts them has a clause, and there are no others."""
        carried = {claim: clause for clause in clauses for claim in clause.claims}
        stated = {claim for manual in manuals for claim in manual.claims}
        for manual in manuals:
            for claim in manual.claims:
                if claim not in carried:
                    what = f"no clause carries claim {claim} of the manual"
                    self._find(Code.ECS406, manual.at, what, "add it to the `claims` of a clause")
        for claim, clause in carried.items():
            if stated and claim not in stated:
                what = f"clause {clause.id} carries claim {claim}, which the manual does not count"
                remedy = f"write one of {min(stated)} .. {max(stated)}"
                self._find(Code.ECS406, clause.at, what, remedy)

    def same_objects(self, standard: Iterable[ObjectEntry], own: Iterable[ObjectEntry]) -> None:
        """An object of the standard is said again only where it is another one."""
        known = {replace(entry, clauses=()) for entry in standard}
        for entry in own:
            if replace(entry, clauses=()) in known:
                self._find(
                    Code.ECS402,
                    entry.at,
                    f"object {entry.index:#06x}:{entry.subindex} is the same in the standard",
                    "take the row away or write what is different",
                )

    def same_words(self, standard: Mapping[str, Word], own: Iterable[Word]) -> None:
        """A word of the standard is said again only where it is another one."""
        for word in own:
            old = standard.get(word.name)
            if old is not None and replace(word, clauses=old.clauses) == old:
                self._find(
                    Code.ECS402,
                    word.at,
                    f"word `{word.name}` is the same in the standard",
                    "take it away or write what is different",
                )

    def _find(self, code: Code, at: Span, message: str, remedy: str) -> None:
        self.findings.append(Diagnostic(code, at, message, remedy))

    def _pin(self, pin: Pin) -> None:
        choice = self.choices.get(pin.choice)
        if choice is None:
            self._find(
                Code.ECS401,
                pin.at,
                f"there is no choice `{pin.choice}`",
                f"pin one of {listed(self.choices, pin.choice)}",
            )
            return
        names = [alternative.name for alternative in choice.alternatives]
        if pin.alternative not in names:
            self._find(
                Code.ECS401,
                pin.at,
                f"choice `{pin.choice}` has no alternative `{pin.alternative}`",
                f"take one of {listed(names, pin.alternative)}",
            )
        if pin.choice in self.opened:
            self._pinned_and_open(pin.choice, pin.at)
        self.pins[pin.choice] = pin

    def _leave_open(self, left: Open) -> None:
        if left.choice not in self.choices:
            self._find(
                Code.ECS401,
                left.at,
                f"there is no choice `{left.choice}`",
                f"leave one of {listed(self.choices, left.choice)} open",
            )
        if left.choice in self.pins:
            self._pinned_and_open(left.choice, left.at)
        self.opened[left.choice] = left

    def _confirm(self, statement: Confirm) -> None:
        """The manual says the same: its clauses stand beside those of the standard."""
        for kind, path in statement.targets:
            if not self._confirmed(kind, path, statement.clauses):
                what, remedy = f"there is no {kind} `{path}`", "name what the standard has"
                self._find(Code.ECS401, statement.at, what, remedy)

    def _confirmed(self, kind: str, path: str, clauses: tuple[str, ...]) -> bool:
        owner, _, name = path.partition(".")
        if kind == "rule" and owner in self.machines:
            machine = self.machines[owner]
            rules, found = _citing(machine.rules, name, clauses)
            self.machines[owner] = replace(machine, rules=rules)
        elif kind == "row" and owner in self.tables:
            table = self.tables[owner]
            rows, found = _citing(table.rows, name, clauses)
            self.tables[owner] = replace(table, rows=rows)
        else:
            found = self._of_kind(kind, path, clauses)
        return found

    def _of_kind(self, kind: str, name: str, clauses: tuple[str, ...]) -> bool:
        match kind:
            case "register":
                found = _cite(self.registers, name, clauses)
            case "word":
                found = _cite(self.words, name, clauses)
            case "parameter":
                found = _cite(self.parameters, name, clauses)
            case "frame":
                found = _cite(self.frames, name, clauses)
            case "choice":
                found = _cite(self.choices, name, clauses)
            case "condition":
                found = _cite(self.conditions, name, clauses)
            case "define":
                found = _cite(self.definitions, name, clauses)
            case "property":
                found = _cite(self.properties, name, clauses)
            case _:
                found = False
        return found

    def _pinned_and_open(self, choice: str, at: Span) -> None:
        what = f"choice `{choice}` is pinned and left open"
        self._find(Code.ECS402, at, what, "keep one of the two lines")

    def _set(self, setting: SetParameter) -> None:
        parameter = self.parameters.get(setting.name)
        if parameter is None:
            self._find(
                Code.ECS401,
                setting.at,
                f"there is no parameter `{setting.name}`",
                f"set one of {listed(self.parameters, setting.name)}",
            )
            return
        if parameter.value == setting.value:
            self._find(
                Code.ECS402,
                setting.at,
                f"parameter `{setting.name}` has this value already",
                "take the line away or give another value",
            )
        self.parameters[setting.name] = replace(
            parameter,
            value=setting.value,
            clauses=setting.clauses + parameter.clauses,
            at=setting.at,
        )

    def _machine(self, statement: Replace | Remove | Extend) -> Machine | None:
        machine = self.machines.get(statement.machine)
        if machine is None:
            self._find(
                Code.ECS401,
                statement.at,
                f"there is no machine `{statement.machine}`",
                f"name one of {listed(self.machines, statement.machine)}",
            )
        return machine

    def _extend(self, statement: Extend) -> None:
        machine = self._machine(statement)
        if machine is not None:
            self._added(machine, statement)
            self.machines[machine.name] = replace(
                machine,
                variables=machine.variables + statement.variables,
                inputs=machine.inputs + statement.inputs,
                rules=machine.rules + statement.rules,
                gaps=machine.gaps + statement.gaps,
            )

    def _added(self, machine: Machine, statement: Extend) -> None:
        """What is added must have names of its own."""
        old: tuple[_Named, ...] = (*machine.variables, *machine.inputs)
        new: tuple[_Named, ...] = (*statement.variables, *statement.inputs)
        self._again(machine, Code.ECS102, old, new)
        old, new = (*machine.rules, *machine.gaps), (*statement.rules, *statement.gaps)
        self._again(machine, Code.ECS103, old, new)

    def _again(
        self, machine: Machine, code: Code, old: tuple[_Named, ...], new: tuple[_Named, ...]
    ) -> None:
        places = {(_sort(item), item.name): item.at for item in old}
        for item in new:
            first = places.get((_sort(item), item.name))
            if first is not None:
                what = f"{_sort(item)} `{machine.name}.{item.name}` stands already at {first}"
                self._find(code, item.at, what, "give it another name")

    def _replace_field(self, statement: ReplaceField) -> None:
        frame = self.frames.get(statement.frame)
        old = (
            None
            if frame is None
            else next((f for f in frame.fields if f.name == statement.name), None)
        )
        if frame is None or old is None:
            self._find(
                Code.ECS401,
                statement.at,
                f"there is no field `{statement.frame}.{statement.name}`",
                "name a field of a frame that `ecatspec show` lists",
            )
            return
        new = replace(old, reply=statement.reply, into=statement.into)
        if new == old:
            self._find(
                Code.ECS402,
                statement.at,
                f"field `{frame.name}.{old.name}` is this already",
                "take the statement away or write what is different",
            )
        new = replace(new, clauses=joined(statement.clauses, old.clauses))
        fields = tuple(new if field is old else field for field in frame.fields)
        clauses = joined(statement.clauses, frame.clauses)
        self.frames[frame.name] = replace(frame, fields=fields, clauses=clauses)

    def _rule(self, statement: Replace | Remove) -> tuple[Machine, Rule] | None:
        machine = self._machine(statement)
        if machine is None:
            return None
        rules = {rule.name: rule for rule in machine.rules}
        if statement.rule not in rules:
            self._find(
                Code.ECS401,
                statement.at,
                f"machine `{statement.machine}` has no rule `{statement.rule}`",
                "name a rule that `ecatspec show` lists",
            )
            return None
        return machine, rules[statement.rule]

    def _replace(self, statement: Replace) -> None:
        found = self._rule(statement)
        if found is None:
            return
        machine, old = found
        new = replace(
            old,
            guard=old.guard if statement.guard is None else statement.guard,
            target=old.target if statement.target is None else statement.target,
            updates=_updated(old.updates, statement.updates),
            sends=statement.sends or old.sends,
            gives=statement.gives or old.gives,
            laters=statement.laters or old.laters,
            within=old.within if statement.within is None else statement.within,
        )
        if new == old:
            self._find(
                Code.ECS402,
                statement.at,
                f"rule `{machine.name}.{old.name}` says exactly this already",
                "take the statement away or write what is different",
            )
        new = replace(new, clauses=joined(statement.clauses, old.clauses))
        rules = tuple(new if rule is old else rule for rule in machine.rules)
        self.machines[machine.name] = replace(machine, rules=rules)

    def _remove(self, statement: Remove) -> None:
        found = self._rule(statement)
        if found is not None:
            machine, old = found
            rules = tuple(rule for rule in machine.rules if rule is not old)
            self.machines[machine.name] = replace(machine, rules=rules)
            self.reasons = {
                name: reason
                for name, reason in self.reasons.items()
                if (reason.machine, reason.rule) != (machine.name, old.name)
            }


def _citing(
    items: tuple[_Citing, ...], name: str, clauses: tuple[str, ...]
) -> tuple[tuple[_Citing, ...], bool]:
    """The items, of which the one with this name cites more clauses; whether there is one."""
    cited = tuple(
        replace(item, clauses=joined(item.clauses, clauses)) if item.name == name else item
        for item in items
    )
    return cited, any(item.name == name for item in items)


def _cite(named: dict[str, _Cites], name: str, clauses: tuple[str, ...]) -> bool:
    """Let a declaration cite more clauses; tell whether there is one of this name."""
    if name not in named:
        return False
    named[name] = replace(named[name], clauses=joined(named[name].clauses, clauses))
    return True


def _sort(item: _Named) -> str:
    """Variables and inputs have names of their own; a rule and a gap share theirs."""
    match item:
        case Variable():
            return "variable"
        case Input():
            return "input"
        case _:
            return "rule"


def constant_in(value: Expression, names: Mapping[str, int], table: str) -> int | None:
    """The number that a literal or a row name of the table stands for."""
    match value:
        case Literal():
            return int(value.value)
        case Name():
            return names.get(value.path.removeprefix(f"{table}."))
        case _:
            return None


def _with_rows(old: CodeTable | None, new: CodeTable) -> CodeTable:
    """A table of a device text adds its rows to the standard's; same values are replaced."""
    if old is None:
        return new
    rows = {row.value: row for row in old.rows} | {row.value: row for row in new.rows}
    return replace(old, rows=tuple(rows.values()))


def _updated(old: tuple[Update, ...], new: tuple[Update, ...]) -> tuple[Update, ...]:
    updates = {update.variable: update for update in old}
    return tuple((updates | {update.variable: update for update in new}).values())


def joined(first: tuple[str, ...], second: tuple[str, ...]) -> tuple[str, ...]:
    """Give two lists of clauses as one."""
    return tuple(dict.fromkeys(first + second))


def listed(names: Iterable[str], wanted: str | None = None) -> str:
    """Give names as one text; beside a `wanted` one the nearest first, and at most five."""
    names = list(names)
    if wanted is not None and len(names) > _MOST_NAMES:
        close = difflib.get_close_matches(wanted, names, _MOST_NAMES, 0.6)
        names = [*close, *(name for name in names if name not in close)][:_MOST_NAMES]
        return ", ".join(f"`{name}`" for name in names) + ", ..."
    return ", ".join(f"`{name}`" for name in names) or "nothing"
