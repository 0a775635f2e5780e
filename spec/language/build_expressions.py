"""Builds types and expressions of a text from the trees of its grammar."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeAlias

from lark import Token, Transformer, v_args

from ecatspec.spec.language import ir

if TYPE_CHECKING:
    from lark.tree import Meta

Binding: TypeAlias = "tuple[str, ir.Expression]"

TIME_DIGITS: Final = -1
"""`Literal.digits` of a number that was written with a unit of time."""

MICROSECONDS: Final = {"us": 1, "ms": 1_000, "s": 1_000_000}


def number_of(word: str) -> int:
    """Give the number that is written, in decimal or as 0x."""
    return int(word, 16) if word.startswith("0x") else int(word)


@v_args(inline=True, meta=True)
class ExpressionBuilder(Transformer[Token, ir.SourceText]):
    """Methods have the names of the rules and take their parts; an absent [part] is None."""

    def __init__(self, file: str) -> None:
        super().__init__()
        self._file = file

    def _at(self, meta: Meta) -> ir.Span:
        return ir.Span(self._file, meta.line, meta.column)

    def STRING(self, token: Token) -> str:  # noqa: N802 - the name of the terminal
        return token[1:-1]

    def id_list(self, _: Meta, *names: Token) -> tuple[str, ...]:
        return tuple(map(str, names))

    def name(self, _: Meta, *parts: Token) -> str:
        return ".".join(parts)

    def names(self, _: Meta, *names: Token) -> tuple[str, ...]:
        return tuple(map(str, names))

    def binding(self, _: Meta, name: Token, value: ir.Expression) -> Binding:
        return str(name), value

    # --- types ---

    def unsigned(self, _: Meta, word: Token) -> ir.Type:
        return ir.UInt(int(word[1:]))

    def signed(self, _: Meta, word: Token) -> ir.Type:
        return ir.SInt(int(word[1:]))

    def boolean(self, _: Meta) -> ir.Type:
        return ir.Bool()

    def counted_bytes(self, _: Meta, length: ir.Expression) -> ir.Type:
        return ir.Bytes(length)

    def rest_bytes(self, _: Meta) -> ir.Type:
        return ir.Bytes(None)

    def text(self, _: Meta, maximum: Token) -> ir.Type:
        return ir.Text(number_of(maximum))

    def area(self, _: Meta) -> ir.Type:
        return ir.Area()

    def time(self, _: Meta) -> ir.Type:
        return ir.Time()

    def named(self, _: Meta, table: Token) -> ir.Type:
        return ir.Named(str(table))

    # --- expressions ---

    def number(self, meta: Meta, word: Token) -> ir.Expression:
        digits = len(word) - 2 if word.startswith("0x") else 0
        return ir.Literal(number_of(word), digits, self._at(meta))

    def truth(self, meta: Meta, word: Token) -> ir.Expression:
        return ir.Literal(word == "true", 0, self._at(meta))

    def reference(self, meta: Meta, path: str) -> ir.Expression:
        return ir.Name(path, self._at(meta))

    def not_(self, meta: Meta, operand: ir.Expression) -> ir.Expression:
        return ir.Unary("not", operand, self._at(meta))

    def negative(self, meta: Meta, minus: Token, operand: ir.Expression) -> ir.Expression:
        return ir.Unary(str(minus), operand, self._at(meta))

    def or_(self, meta: Meta, left: ir.Expression, right: ir.Expression) -> ir.Expression:
        return ir.Binary("or", left, right, self._at(meta))

    def and_(self, meta: Meta, left: ir.Expression, right: ir.Expression) -> ir.Expression:
        return ir.Binary("and", left, right, self._at(meta))

    def operation(
        self, meta: Meta, left: ir.Expression, operator: Token, right: ir.Expression
    ) -> ir.Expression:
        return ir.Binary(str(operator), left, right, self._at(meta))

    def in_(
        self, meta: Meta, operand: ir.Expression, *items: ir.Expression | ir.Range | None
    ) -> ir.Expression:
        given = tuple(item for item in items if item is not None)
        return ir.In(operand, given, self._at(meta))

    def item(
        self, meta: Meta, low: ir.Expression, high: ir.Expression | None
    ) -> ir.Expression | ir.Range:
        return low if high is None else ir.Range(low, high, self._at(meta))

    def conditional(
        self, meta: Meta, condition: ir.Expression, then: ir.Expression, otherwise: ir.Expression
    ) -> ir.Expression:
        return ir.Conditional(condition, then, otherwise, self._at(meta))

    def call(self, meta: Meta, function: str, *arguments: ir.Expression | None) -> ir.Expression:
        given = tuple(argument for argument in arguments if argument is not None)
        return ir.Call(function, given, self._at(meta))

    def one_of(self, meta: Meta, *parts: ir.Expression | ir.Range | None) -> ir.Expression:
        *items, excluded = parts
        given = tuple(item for item in items if item is not None)
        assert not isinstance(excluded, ir.Range), self._at(meta)
        return ir.OneOf(given, excluded, self._at(meta))

    def any_value(self, meta: Meta, preferred: ir.Expression | None) -> ir.Expression:
        return ir.AnyValue(preferred, self._at(meta))
