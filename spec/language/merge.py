"""Merges texts: extend, pin, set, close, replace, remove."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, TypeAlias, TypeVar

from ecatspec.spec.language.diagnostics import Code, Diagnostic
from ecatspec.spec.language.ir import (
    NOWHERE,
    Anomaly,
    Choice,
    Clause,
    Close,
    CodeRow,
    CodeTable,
    Condition,
    Conditional,
    Confirm,
    Definition,
    Dictionary,
    EsiEntry,
    Example,
    Extend,
    Frame,
    Gap,
    Input,
    Literal,
    Machine,
    Manual,
    Name,
    Named,
    ObjectEntry,
    OneOf,
    Open,
    Parameter,
    Pin,
    Property,
    Protocol,
    Range,
    Reason,
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
    from collections.abc import Iterable, Mapping, Sequence

    from ecatspec.spec.language.ir import (
        Declaration,
        Expression,
        Fault,
        SourceText,
        Span,
        Type,
        Update,
    )

_STATEMENTS = (Pin, Open, Confirm, Close, SetParameter, Replace, Remove, ReplaceField, Dictionary)
_Named: TypeAlias = Variable | Input | Rule | Gap
_CHANGES = (Replace, Remove, Extend, ReplaceField)


def merge_standard(texts: Sequence[SourceText]) -> tuple[Protocol, list[Diagnostic]]:
    """All declarations of the standard's texts, in the order of the texts, and the findings."""
    protocol = _declared(texts)
    merge = _Merge(protocol, _declared(()))
    for text in texts:
        for extension in _of(text.declarations, Extend):
            merge.take(extension)
    return replace(protocol, machines=merge.machines), merge.findings


def _declared(texts: Sequence[SourceText]) -> Protocol:
    """What texts declare, before anything in them changes anything else."""
    declared = [declaration for text in texts for declaration in text.declarations]
    wording = texts[0].wording if len(texts) == 1 else "the standard"
    dictionaries = _of(declared, Dictionary)
    return Protocol(
        name="standard",
        wording=wording,
        manuals=_of(declared, Manual),
        clauses={clause.id: clause for clause in _of(declared, Clause)},
        tables=_named(_of(declared, CodeTable)),
        parameters=_named(_of(declared, Parameter)),
        registers=_named(_of(declared, Register)),
        words=_named(_of(declared, Word)),
        frames=_named(_of(declared, Frame)),
        machines=_named(_of(declared, Machine)),
        choices=_named(_of(declared, Choice)),
        conditions=_named(_of(declared, Condition)),
        definitions=_named(_of(declared, Definition)),
        properties=_named(_of(declared, Property)),
        reasons=_named(_of(declared, Reason)),
        pins={},
        opened={},
        closed={},
        objects=_of(declared, ObjectEntry),
        dictionary=dictionaries[-1] if dictionaries else Dictionary(closed=False, clauses=()),
        esi=_of(declared, EsiEntry),
        anomalies=_of(declared, Anomaly),
        examples=_of(declared, Example),
        replaced=(),
        digest="",
    )


def merge_device(standard: Protocol, text: SourceText) -> tuple[Protocol, list[Diagnostic]]:
    """The standard as one device keeps it, and the findings of 4xx."""
    own = _declared((text,))
    merge = _Merge(standard, own)
    for declaration in text.declarations:
        merge.take(declaration)
    for close in own_closes(text):
        merge.close(close)
    if own.manuals:
        merge.unclaimed(own.clauses.values())
        merge.unfounded(text.declarations, standard.clauses | own.clauses)
        merge.unaccounted(own.manuals, own.clauses.values())
    merge.same_objects(standard.objects, own.objects)
    merge.same_words(standard.words, own.words.values())
    changed = tuple(d for d in text.declarations if isinstance(d, _CHANGES))
    protocol = Protocol(
        name=text.name,
        wording=text.wording,
        manuals=standard.manuals + own.manuals,
        clauses=standard.clauses | own.clauses,
        tables=merge.tables,
        parameters=merge.parameters,
        registers=merge.registers,
        words=merge.words,
        frames=merge.frames,
        machines=merge.machines,
        choices=merge.choices,
        conditions=merge.conditions,
        definitions=merge.definitions,
        properties=merge.properties,
        reasons=merge.reasons | own.reasons,
        pins=merge.pins,
        opened=merge.opened,
        closed=merge.closed,
        objects=_objects(standard.objects, own.objects),
        dictionary=own.dictionary if own.dictionary.at != NOWHERE else standard.dictionary,
        esi=standard.esi + own.esi,
        anomalies=standard.anomalies + own.anomalies,
        examples=standard.examples + own.examples,
        replaced=standard.replaced + changed,
        digest="",
    )
    return protocol, merge.findings


def with_fault(protocol: Protocol, fault: Fault) -> tuple[Protocol, list[Diagnostic]]:
    """The protocol as a device with this mistake keeps it, and the findings of 4xx."""
    merge = _Merge(protocol, _declared(()))
    for change in fault.changes:
        merge.take(change)
    faulty = replace(protocol, machines=merge.machines, frames=merge.frames, reasons=merge.reasons)
    return faulty, merge.findings


def own_closes(text: SourceText) -> tuple[Close, ...]:
    """The tables that a device text closes."""
    return _of(text.declarations, Close)


_T = TypeVar("_T")


def _of(declared: Iterable[Declaration], kind: type[_T]) -> tuple[_T, ...]:
    return tuple(declaration for declaration in declared if isinstance(declaration, kind))


_N = TypeVar(
    "_N",
    CodeTable,
    Parameter,
    Register,
    Word,
    Frame,
    Machine,
    Choice,
    Condition,
    Definition,
    Property,
    Reason,
)


def _named(declared: Iterable[_N]) -> dict[str, _N]:
    return {declaration.name: declaration for declaration in declared}


def _objects(
    standard: tuple[ObjectEntry, ...], own: tuple[ObjectEntry, ...]
) -> tuple[ObjectEntry, ...]:
    merged = {(entry.index, entry.subindex): entry for entry in standard}
    merged |= {(entry.index, entry.subindex): entry for entry in own}
    return tuple(merged.values())


class _Merge:
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
                f"pin one of {_list(self.choices)}",
            )
            return
        names = [alternative.name for alternative in choice.alternatives]
        if pin.alternative not in names:
            self._find(
                Code.ECS401,
                pin.at,
                f"choice `{pin.choice}` has no alternative `{pin.alternative}`",
                f"take one of {_list(names)}",
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
                f"leave one of {_list(self.choices)} open",
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
                f"set one of {_list(self.parameters)}",
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
            parameter, value=setting.value, clauses=setting.clauses + parameter.clauses
        )

    def _machine(self, statement: Replace | Remove | Extend) -> Machine | None:
        machine = self.machines.get(statement.machine)
        if machine is None:
            self._find(
                Code.ECS401,
                statement.at,
                f"there is no machine `{statement.machine}`",
                f"name one of {_list(self.machines)}",
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
        new = replace(new, clauses=_joined(statement.clauses, old.clauses))
        fields = tuple(new if field is old else field for field in frame.fields)
        clauses = _joined(statement.clauses, frame.clauses)
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
        new = replace(new, clauses=_joined(statement.clauses, old.clauses))
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

    # --- closed tables ---

    def close(self, close: Close) -> None:
        """Close a table: other values vanish from the table and from what rules may set or send."""
        table = self.tables.get(close.table)
        if table is None:
            self._find(
                Code.ECS401,
                close.at,
                f"there is no table `{close.table}`",
                f"close one of {_list(self.tables)}",
            )
            return
        names = {row.name: row.value for row in table.rows}
        kept: dict[int, None] = {}
        for item in close.values:
            value = _constant(item, names, table.name)
            if value is None or value not in names.values():
                self._find(
                    Code.ECS401,
                    item.at,
                    f"table `{table.name}` has no row for this value",
                    f"add a row in a `table {table.name}` of the device text",
                )
            else:
                kept[value] = None
        rows = tuple(row for row in table.rows if row.value in kept)
        if table.closed and len(rows) == len(table.rows):
            self._find(
                Code.ECS402,
                close.at,
                f"table `{table.name}` is closed with these values already",
                "take the line away",
            )
        self.closed[close.table] = close
        self.tables[close.table] = replace(table, closed=True, rows=rows)
        narrow = _Narrow(table, tuple(kept))
        for machine in self.machines.values():
            rules = tuple(self._narrowed(machine, rule, narrow, close) for rule in machine.rules)
            self.machines[machine.name] = replace(machine, rules=rules)

    def _narrowed(self, machine: Machine, rule: Rule, narrow: _Narrow, close: Close) -> Rule:
        variables: dict[str, Type] = {
            f"{other.name}.{variable.name}": variable.type
            for other in self.machines.values()
            for variable in other.variables
        }
        variables |= {variable.name: variable.type for variable in machine.variables}
        narrow.lost.clear()
        updates = tuple(
            replace(update, value=narrow.value(variables.get(update.variable), update.value))
            for update in rule.updates
        )
        sends = tuple(
            replace(send, fields=narrow.fields(self._field_types(send.frame), send.fields))
            for send in rule.sends
        )
        gives = tuple(
            replace(give, arguments=narrow.fields(self._event_types(give.target), give.arguments))
            for give in rule.gives
        )
        laters = tuple(
            replace(
                later, arguments=narrow.fields(self._event_types(later.target), later.arguments)
            )
            for later in rule.laters
        )
        for value in narrow.lost:
            self._find(
                Code.ECS403,
                close.at,
                f"rule `{machine.name}.{rule.name}` ({rule.at}) is left without a code of"
                f" `{close.table}`: it has {narrow.wording(value)}",
                "replace or remove the rule, or keep its code",
            )
        new = replace(rule, updates=updates, sends=sends, gives=gives, laters=laters)
        if new == rule:
            return rule
        return replace(new, clauses=_joined(rule.clauses, close.clauses))

    def _field_types(self, name: str) -> dict[str, Type]:
        types: dict[str, Type] = {}
        place: str | None = name
        seen: set[str] = set()
        while place is not None and place in self.frames and place not in seen:
            seen.add(place)
            frame = self.frames[place]
            types = {field.name: field.type for field in frame.fields} | types
            place = frame.parent
        return types

    def _event_types(self, target: str) -> dict[str, Type]:
        name, _, event = target.partition(".")
        machine = self.machines.get(name)
        inputs = () if machine is None else machine.inputs
        return {p: t for i in inputs if i.name == event for p, t in i.parameters}


class _Narrow:
    """Takes values that a closed table no longer has out of expressions."""

    def __init__(self, table: CodeTable, kept: tuple[int, ...]) -> None:
        self._table = table
        self._names = {row.name: row.value for row in table.rows}
        self._kept = kept
        self.lost: list[Expression] = []

    def fields(
        self, types: Mapping[str, Type], given: tuple[tuple[str, Expression], ...]
    ) -> tuple[tuple[str, Expression], ...]:
        return tuple((name, self.value(types.get(name), value)) for name, value in given)

    def value(self, kind: Type | None, value: Expression) -> Expression:
        """The value with what is left of it; what has nothing left is noted in `lost`."""
        if kind != Named(self._table.name):
            return value
        match value:
            case Conditional():
                return replace(
                    value,
                    then=self.value(kind, value.then),
                    otherwise=self.value(kind, value.otherwise),
                )
            case OneOf():
                items = tuple(item for old in value.items for item in self._item(old))
                barred = None if value.excluded is None else self._constant(value.excluded)
                left = {self._constant(item) for item in items} - {None, barred}
                if not left and not any(self._constant(item) is None for item in items):
                    self.lost.append(value)
                    return value
                vanished = barred is not None and barred not in self._kept
                return replace(value, items=items, excluded=None if vanished else value.excluded)
            case Literal() | Name():
                number = self._constant(value)
                if number is not None and number not in self._kept:
                    self.lost.append(value)
                return value
            case _:
                return value

    def wording(self, value: Expression) -> str:
        """The codes that a rule had, for the finding."""
        items = value.items if isinstance(value, OneOf) else (value,)
        words = [
            f"{i.low.value:#06x}..{i.high.value:#06x}"
            if isinstance(i, Range) and isinstance(i.low, Literal) and isinstance(i.high, Literal)
            else f"`{i.path}`"
            if isinstance(i, Name)
            else f"{i.value:#06x}"
            if isinstance(i, Literal)
            else "..."
            for i in items
        ]
        return ", ".join(words)

    def _constant(self, value: Expression | Range) -> int | None:
        return None if isinstance(value, Range) else _constant(value, self._names, self._table.name)

    def _item(self, item: Expression | Range) -> tuple[Expression | Range, ...]:
        if isinstance(item, Range):
            low, high = self._constant(item.low), self._constant(item.high)
            if low is None or high is None:
                return (item,)
            digits = (self._table.width + 3) // 4
            inside = (value for value in self._kept if low <= value <= high)
            return tuple(Literal(value, digits, item.at) for value in inside)
        number = self._constant(item)
        return () if number is not None and number not in self._kept else (item,)


_Citing = TypeVar("_Citing", Rule, CodeRow)
_Cites = TypeVar(
    "_Cites", Register, Word, Parameter, Frame, Choice, Condition, Definition, Property
)


def _citing(
    items: tuple[_Citing, ...], name: str, clauses: tuple[str, ...]
) -> tuple[tuple[_Citing, ...], bool]:
    """The items, of which the one with this name cites more clauses; whether there is one."""
    cited = tuple(
        replace(item, clauses=_joined(item.clauses, clauses)) if item.name == name else item
        for item in items
    )
    return cited, any(item.name == name for item in items)


def _cite(named: dict[str, _Cites], name: str, clauses: tuple[str, ...]) -> bool:
    """Let a declaration cite more clauses; tell whether there is one of this name."""
    if name not in named:
        return False
    named[name] = replace(named[name], clauses=_joined(named[name].clauses, clauses))
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


def _constant(value: Expression, names: Mapping[str, int], table: str) -> int | None:
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


def _joined(first: tuple[str, ...], second: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(first + second))


def _list(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for name in names) or "nothing"
