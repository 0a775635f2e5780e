"""Checks the kinds of values in expressions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, assert_never

from ecatspec.spec.language.arithmetic import DIVISIONS, constant
from ecatspec.spec.language.build_expressions import TIME_DIGITS
from ecatspec.spec.language.check.findings import Findings
from ecatspec.spec.language.diagnostics import Code, near
from ecatspec.spec.language.functions import CYCLIC, EDGES, FUNCTIONS, WITH_BEFORE
from ecatspec.spec.language.ir import (
    AnyValue,
    Area,
    Binary,
    Bool,
    Bytes,
    Call,
    CodeTable,
    Conditional,
    In,
    Literal,
    Name,
    Named,
    OneOf,
    Range,
    SInt,
    Span,
    Text,
    Time,
    UInt,
    Unary,
)
from ecatspec.spec.language.kinds import bounds_of, expectation, kind_of, kind_of_ref
from ecatspec.spec.language.logic import COMPARED
from ecatspec.spec.language.references import (
    ChoiceRef,
    ConstantRef,
    DefinitionRef,
    Kind,
    ParameterOfInput,
    UnresolvedName,
    VariableRef,
)
from ecatspec.spec.language.scope import Scope, input_of, known_names, resolve

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ecatspec.spec.language.ir import (
        Expression,
        Protocol,
    )


_NUMBER: Final = UInt(64)


class KindChecker(Findings):
    """Finds the kind of each expression, and where it is another than demanded."""

    def __init__(self, protocol: Protocol) -> None:
        super().__init__(protocol)
        self._kinds: dict[tuple[str, Scope, Kind | None], Kind | None] = {}
        """Definitions that were walked: what is wrong inside is noted once for a scope."""

    def _demand(self, value: Expression, scope: Scope, expected: Kind | None) -> None:
        """The expression must give a value of this kind, whatever the kind if None."""
        self._compatible(self._walk(value, scope, expected), expected, value.at)

    def _compatible(self, found: Kind | None, expected: Kind | None, at: Span) -> bool:
        if found is None or expected is None or _agree(found, expected):
            return True
        self._note(
            Code.ECS202,
            at,
            f"{word_of(found)} stands where {word_of(expected)} is needed",
            "compare and set values of one kind",
        )
        return False

    def _walk(self, value: Expression, scope: Scope, expected: Kind | None) -> Kind | None:
        """The kind of a value; everything inside it is checked."""
        found: Kind | None = None
        match value:
            case Literal():
                found = self._literal(value, value.value, expected)
            case Name():
                found = self._name(value, scope, expected)
            case Unary("-", Literal() as literal):
                found = self._literal(literal, -literal.value, expected)
            case Unary(operator, operand):
                found = Bool() if operator == "not" else _NUMBER
                self._demand(operand, scope, found)
            case Binary(operator, left, right) if operator in COMPARED:
                self._compare(operator, left, right, scope)
                found = Bool()
            case Binary(operator, left, right):
                found = Bool() if operator in {"and", "or"} else _NUMBER
                if operator == "+" and kind_of(self._protocol, left, scope) == Time():
                    found = Time()
                self._demand(left, scope, found)
                self._demand(right, scope, found)
                if operator in DIVISIONS and constant(self._protocol, right, scope) == 0:
                    what = "a number is divided by zero: nothing is known of the result"
                    self._note(Code.ECS207, right.at, what, "divide by another number")
            case In(operand, items):
                kind = self._walk(operand, scope, None)
                self._items(items, scope, kind)
                found = Bool()
            case Conditional(condition, then, otherwise):
                self._demand(condition, scope, Bool())
                found = self._walk(then, scope, expected)
                other = self._walk(otherwise, scope, expected)
                self._compatible(other, found, otherwise.at)
                found = found or other
            case Call():
                found = self._call(value, scope)
            case OneOf(items, excluded):
                self._items(items, scope, expected)
                if excluded is not None:
                    self._demand(excluded, scope, expected)
            case AnyValue(preferred):
                if preferred is not None:
                    self._demand(preferred, scope, expected)
            case _:
                assert_never(value)
        return found

    def _literal(self, literal: Literal, value: int, expected: Kind | None) -> Kind | None:
        if isinstance(literal.value, bool):
            return Bool()
        if literal.digits == TIME_DIGITS:
            return Time()
        self._fits(value, expected, literal.at)
        return _NUMBER

    def _fits(self, value: int, expected: Kind | None, at: Span) -> None:
        if expected is None or expected == _NUMBER or isinstance(expected, Bool):
            return
        bounds = bounds_of(self._protocol, expected)
        if bounds is not None and not bounds[0] <= value <= bounds[1]:
            self._note(
                Code.ECS201,
                at,
                f"{value} does not fit {word_of(expected)} ({bounds[0]}..{bounds[1]})",
                "take a value that fits or a wider type",
            )
        elif (
            isinstance(expected, Named)
            and (table := self._protocol.tables.get(expected.table)) is not None
            and table.closed
            and value not in {row.value for row in table.rows}
            and not self._closed_elsewhere(table, at)
        ):
            self._note(
                Code.ECS201,
                at,
                f"the closed table `{table.name}` has no value {value:#x}",
                "take one of its rows",
            )

    def _closed_elsewhere(self, table: CodeTable, at: Span) -> bool:
        """Tell whether another text closed the table: the standard may still ask for its values."""
        closing = self._protocol.closed.get(table.name)
        return closing is not None and closing.at.file != at.file

    def _name(self, name: Name, scope: Scope, expected: Kind | None) -> Kind | None:
        try:
            ref = resolve(self._protocol, name.path, scope, expected)
        except UnresolvedName as error:
            self._unresolved(name, error, scope, expected)
            return None
        if isinstance(ref, DefinitionRef):
            key = (ref.name, scope, expected)
            if key not in self._kinds:
                value = self._protocol.definitions[ref.name].value
                self._kinds[key] = self._walk(value, scope, expected)
            return self._kinds[key]
        if isinstance(ref, ConstantRef) and not isinstance(expected, Named):
            self._fits(ref.value, expected, name.at)
        return kind_of_ref(self._protocol, ref, scope)

    def _unresolved(
        self, name: Name, error: UnresolvedName, scope: Scope, expected: Kind | None
    ) -> None:
        if error.candidates:
            rows = " or ".join(f"`{candidate}`" for candidate in error.candidates)
            what = f"`{name.path}` is a row of several tables"
            self._note(Code.ECS107, name.at, what, f"write {rows}")
            return
        if isinstance(expected, Named) and expected.table not in self._protocol.tables:
            return  # that the table is missing is the finding
        known = known_names(self._protocol, scope, expected)
        where = f" in rules on `{scope.input}`" if scope.input is not None else ""
        self._note(
            Code.ECS101,
            name.at,
            f"`{name.path}` means nothing{where}",
            f"declare it{near(name.path, known, ', or write ')}",
        )

    def _compare(self, operator: str, left: Expression, right: Expression, scope: Scope) -> None:
        protocol = self._protocol
        of_left = expectation(protocol, right, scope) or kind_of(protocol, right, scope)
        of_right = expectation(protocol, left, scope) or kind_of(protocol, left, scope)
        if isinstance(right, Name) and of_left is None:
            of_left = kind_of(protocol, right, scope, of_right)
        if isinstance(left, Name) and of_right is None:
            of_right = kind_of(protocol, left, scope, of_left)
        kind = self._walk(left, scope, of_left)
        other = self._walk(right, scope, of_right)
        if self._compatible(other, kind, right.at) and operator not in {"==", "!="}:
            for side in (kind, other):
                if side is not None and not isinstance(side, UInt | SInt | Named | Time):
                    what = f"{word_of(side)} has no order"
                    self._note(Code.ECS202, left.at, what, "compare with == or !=")
                    break

    def _items(
        self, items: Iterable[Expression | Range], scope: Scope, expected: Kind | None
    ) -> None:
        for item in items:
            if not isinstance(item, Range):
                self._demand(item, scope, expected)
                continue
            self._demand(item.low, scope, expected)
            self._demand(item.high, scope, expected)
            match item:
                case Range(Literal(low), Literal(high)) if low > high:
                    what = f"there is no number from {low} to {high}"
                    self._note(Code.ECS201, item.at, what, "write the smaller one first")
                case _:
                    pass

    def _call(self, call: Call, scope: Scope) -> Kind | None:
        signature = FUNCTIONS.get(call.function)
        if signature is None:
            self._note(
                Code.ECS101,
                call.at,
                f"there is no function `{call.function}`",
                f"take one of scope.FUNCTIONS{near(call.function, FUNCTIONS)}",
            )
            return None
        wanted = ", ".join(word_of(kind) for kind in signature.arguments)
        remedy = f"write {call.function}({wanted})"
        if len(call.arguments) != len(signature.arguments):
            what = f"`{call.function}` gets {len(call.arguments)} arguments"
            self._note(Code.ECS203, call.at, what, remedy)
        fits = len(call.arguments) == len(signature.arguments)
        for argument, kind in zip(call.arguments, signature.arguments, strict=False):
            found = self._walk(argument, scope, kind)
            if found is not None and not _agree(found, kind):
                fits = False
                what = f"`{call.function}` gets {word_of(found)} for {word_of(kind)}"
                self._note(Code.ECS203, argument.at, what, remedy)
        if call.function in EDGES and fits:
            self._edge(call, scope)
        return signature.result

    def _edge(self, call: Call, scope: Scope) -> None:
        """Only what was written has a value before: a truth among the parameters of the input."""
        source = input_of(self._protocol, scope)
        remedy = f"write {call.function}(PARAMETER) with a bool of a register or word, by its name"
        if source is None or source.kind not in WITH_BEFORE:
            what = f"`{call.function}` where no register or word was written"
            self._note(Code.ECS205, call.at, what, remedy)
            return
        match call.arguments:
            case (Name(path),) if path != CYCLIC:
                try:
                    ref = resolve(self._protocol, path, scope)
                except UnresolvedName:
                    return  # that the name means nothing is the finding
                if ref == ParameterOfInput(path):
                    return
            case _:
                pass
        what = f"`{call.function}` of what is no field of `{', '.join(source.origin)}`"
        self._note(Code.ECS205, call.at, what, remedy)

    def _variable(self, path: str, scope: Scope, at: Span) -> Kind | None:
        """The kind of the variable that is to be set."""
        own = self._protocol.machines.get(scope.machine or "")
        if own is not None:
            for variable in own.variables:
                if variable.name == path:
                    return variable.type
        try:
            ref = resolve(self._protocol, path, Scope()) if "." in path else None
        except UnresolvedName:
            ref = None
        if isinstance(ref, VariableRef):
            return kind_of_ref(self._protocol, ref, Scope())
        known = [] if own is None else [variable.name for variable in own.variables]
        self._note(
            Code.ECS101,
            at,
            f"`{path}` is no variable that can be set",
            f"declare it as a variable{near(path, known, ', or write ')}",
        )
        return None


def _agree(one: Kind, other: Kind) -> bool:
    """Whether values of two kinds may meet: tables with themselves and with plain numbers."""
    match one, other:
        case (Named(), Named()) | (ChoiceRef(), ChoiceRef()):
            return one == other
        case (UInt() | SInt() | Named(), UInt() | SInt() | Named()):
            return True
        case (Bytes() | Text(), Bytes() | Text()):
            return True
        case _:
            return type(one) is type(other)


def word_of(kind: Kind) -> str:
    """Give a kind in words."""
    match kind:
        case UInt(width):
            return "a number" if kind == _NUMBER else f"u{width}"
        case SInt(width):
            return f"i{width}"
        case Bool():
            return "bool"
        case Named(table):
            return f"a value of `{table}`"
        case Bytes():
            return "bytes"
        case Text():
            return "a text"
        case Area():
            return "an area"
        case Time():
            return "a time"
        case ChoiceRef(name):
            return f"a way at `{name}`"
        case _:
            assert_never(kind)
