"""The comparisons of a guard: their parts, truth and edges, and what layouts demand."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from ecatspec.model.symbolic.symbolic_state import Anything, Content
from ecatspec.model.symbolic.terms import (
    Term,
    all_of,
    any_of,
    counted,
    either,
    is_literal,
    negated,
)
from ecatspec.spec.language.ir import Binary, Conditional, In, Name, Range, Unary
from ecatspec.spec.language.kinds import name_hints
from ecatspec.spec.language.pretty_expressions import pretty_expression
from ecatspec.spec.language.references import DefinitionRef
from ecatspec.spec.language.scope import Scope, resolve

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from ecatspec.model.symbolic.smt_encoding import Meaning
    from ecatspec.model.symbolic.symbolic_state import Moment
    from ecatspec.spec.language.ir import Expression, Gap, Rule, Span


class Side(StrEnum):
    """Where the value that is compared lies."""

    BELOW = "below"
    ON = "on"
    ABOVE = "above"


OFFSETS: Final = {Side.BELOW: -1, Side.ON: 0, Side.ABOVE: 1}
AROUND: Final = (Side.BELOW, Side.ON, Side.ABOVE)
_LOWER: Final = (Side.BELOW, Side.ON)
UPPER: Final = (Side.ON, Side.ABOVE)
_SIDES: Final = {
    "==": AROUND,
    "!=": AROUND,
    "<": _LOWER,
    ">=": _LOWER,
    "<=": UPPER,
    ">": UPPER,
}
_MIRRORED: Final = {"<": ">", "<=": ">=", ">": "<", ">=": "<="}


@dataclass(frozen=True, slots=True)
class Constraint:
    """What a layout demands of one field: to be a constant, or that the mailbox holds it."""

    field: str
    edge: int
    sides: tuple[Side, ...]
    text: str
    at: Span


class Guards:
    """The guards of one specification."""

    def __init__(self, meaning: Meaning) -> None:
        """Take the meaning of the texts."""
        self._meaning = meaning
        self._protocol = meaning.protocol
        self._leaves: dict[tuple[int, int], Term] = {}
        self._kept: list[tuple[Expression, Moment]] = []
        """What the numbers in the keys of the leaves belong to."""

    def parts(self, row: Rule | Gap, machine: str) -> Iterator[Expression]:
        """Yield what a guard joins by `and`, `or`, `not` and `if`, each once."""
        scope = Scope(machine, row.input)
        seen: set[int] = set()
        work = [] if row.guard is None else [row.guard]
        while work:
            part = work.pop()
            inner = self._inside(part, scope)
            if inner:
                work += reversed(inner)
            elif id(part) not in seen:
                seen.add(id(part))
                yield part

    def _inside(self, part: Expression, scope: Scope) -> tuple[Expression, ...]:
        match part:
            case Unary(operator="not", operand=operand):
                return (operand,)
            case Binary(operator="and" | "or", left=left, right=right):
                return left, right
            case Conditional(condition=condition, then=then, otherwise=otherwise):
                return condition, then, otherwise
            case Name(path=path):
                ref = resolve(self._protocol, path, scope)
                if isinstance(ref, DefinitionRef):
                    return (self._protocol.definitions[ref.name].value,)
        return ()

    def truth(self, part: Expression, moment: Moment, chosen: Mapping[int, bool]) -> Term:
        """Give the truth of a guard in which some of its parts are chosen to hold or not."""
        inner = self._inside(part, moment.scope)
        match part:
            case _ if id(part) in chosen:
                return chosen[id(part)]
            case _ if not inner:
                return self._leaf(part, moment)
            case Binary(operator=sign):
                join = all_of if sign == "and" else any_of
                return join(self.truth(each, moment, chosen) for each in inner)
            case Conditional():
                condition, then, otherwise = (self.truth(e, moment, chosen) for e in inner)
                return either(condition, then, otherwise)
            case Unary():
                return negated(self.truth(inner[0], moment, chosen))
            case _:
                return self.truth(inner[0], moment, chosen)

    def _leaf(self, part: Expression, moment: Moment) -> Term:
        key = id(part), id(moment)
        if key not in self._leaves:
            self._kept.append((part, moment))
            self._leaves[key] = self._meaning.truth(part, moment)
        return self._leaves[key]

    def edges(
        self, leaf: Expression, moment: Moment
    ) -> Iterator[tuple[Term, Term, tuple[Side, ...]]]:
        """Yield what a comparison compares, an edge, and the sides that matter, for each edge."""
        hints = name_hints(self._protocol, leaf, moment.scope)

        def meant(part: Expression) -> Term | None:
            found = self._meaning.value(part, moment, hints.get(id(part)))
            return None if isinstance(found, Content | Anything) else counted("+", found, 0)

        match leaf:
            case Binary(operator=sign, left=left, right=right) if sign in _SIDES:
                one, other = meant(left), meant(right)
                if one is None or other is None:
                    return
                if is_literal(one):
                    one, other, sign = other, one, _MIRRORED.get(sign, sign)
                yield one, other, _SIDES[sign]
            case In(operand=operand, items=items):
                one = meant(operand)
                pairs = [
                    (meant(item.low), meant(item.high))
                    if isinstance(item, Range)
                    else (meant(item),) * 2
                    for item in items
                ]
                for low, high in _joined(pairs):
                    if one is None or low is None or high is None:
                        continue
                    if is_literal(low) and is_literal(high) and low == high:
                        yield one, low, AROUND
                    else:
                        yield one, low, _LOWER
                        yield one, high, UPPER
            case _:
                return


def compares(part: Expression) -> bool:
    """Tell whether a part of a guard is a comparison."""
    return isinstance(part, In) or (isinstance(part, Binary) and part.operator in _SIDES)


def _joined(
    pairs: list[tuple[Term | None, Term | None]],
) -> Iterator[tuple[Term | None, Term | None]]:
    """Yield ranges of which none goes on where another one ends; what is not known comes last."""
    numbers = sorted((p[0], p[1]) for p in pairs if isinstance(p[0], int) and isinstance(p[1], int))
    runs: list[tuple[int, int]] = []
    for low, high in numbers:
        if runs and low <= runs[-1][1] + 1:
            runs[-1] = (runs[-1][0], max(high, runs[-1][1]))
        else:
            runs.append((low, high))
    yield from runs
    yield from (p for p in pairs if not isinstance(p[0], int) or not isinstance(p[1], int))


def constraints(meaning: Meaning, frame: str) -> Iterator[Constraint]:
    """Yield what the layouts of a frame demand of single fields."""
    codec, frames = meaning.model.codec, meaning.protocol.frames
    for name in codec.trail(frame):
        layout, fixed = frames[name], codec.fixed(name)
        demanded = [(part, value, layout.at) for part, value in layout.conditions]
        demanded += [(i.name, i.value, i.at) for i in layout.fields if i.value is not None]
        for part, expression, at in demanded:
            value = fixed[part]
            assert isinstance(value, int)
            text = f"{part} = {pretty_expression(expression)}"
            yield Constraint(part, value, AROUND, text, at)
    outermost = frames[codec.trail(frame)[0]]
    room = meaning.model.parameter("mailbox_out", "length") - codec.size(outermost.name)
    for item in outermost.fields:
        if codec.is_derived(outermost.name, item.name):
            yield Constraint(item.name, room, UPPER, f"{item.name} <= {room}", item.at)
