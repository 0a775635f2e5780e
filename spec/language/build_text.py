"""Builds the IR of a text from the tree of its grammar: one method for each rule of the grammar."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lark import Token, v_args
from lark.exceptions import VisitError

from ecatspec.spec.language import ir
from ecatspec.spec.language.build_expressions import MICROSECONDS, TIME_DIGITS, number_of
from ecatspec.spec.language.build_machines import MachineBuilder, two_parts
from ecatspec.spec.language.diagnostics import Code
from ecatspec.spec.language.syntax_errors import refuse

if TYPE_CHECKING:
    from lark import Tree
    from lark.tree import Meta

    from ecatspec.spec.language.build_expressions import Binding
    from ecatspec.spec.language.build_machines import Clauses


def built(tree: Tree[Token], file: str, digest: str) -> ir.SourceText:
    """Give the IR of the tree of a file with this digest.

    Raises:
        SpecError: A word has a shape that the grammar cannot refuse.
        RecursionError: Expressions are nested too deeply.

    """
    try:
        return TextBuilder(file, digest).transform(tree)
    except VisitError as error:
        raise error.orig_exc from None


def _range_of_claims(first: str, last: str, at: ir.Span) -> tuple[str, ...]:
    """All ids from one to another: the same letters, then a number of the same length."""
    (start, _, low), (prefix, _, high) = first.rpartition("-"), last.rpartition("-")
    numbers = low.isdigit() and high.isdigit() and len(low) == len(high)
    if start != prefix or not numbers or int(low) > int(high):
        what = f"{first} .. {last} is no row of claims"
        refuse(Code.ECS001, at, what, "write the first and the last: AKD-001 .. AKD-469")
    return tuple(f"{start}-{number:0{len(low)}}" for number in range(int(low), int(high) + 1))


@v_args(inline=True, meta=True)
class TextBuilder(MachineBuilder):
    """The rules of the grammar for all other declarations, and for a whole text."""

    def __init__(self, file: str, digest: str) -> None:
        super().__init__(file)
        self._digest = digest

    def start(
        self, _: Meta, header: ir.SourceText, *parts: ir.Declaration | list[ir.Declaration]
    ) -> ir.SourceText:
        declarations: list[ir.Declaration] = []
        for part in parts:
            declarations += part if isinstance(part, list) else [part]
        return ir.SourceText(
            header.name,
            header.wording,
            header.extends,
            tuple(declarations),
            header.faults,
            self._digest,
            header.at,
        )

    def standard_header(self, meta: Meta, name: Token, wording: str) -> ir.SourceText:
        return ir.SourceText(str(name), wording, None, (), at=self._at(meta))

    def faults_header(self, meta: Meta, name: Token, wording: str) -> ir.SourceText:
        return ir.SourceText(str(name), wording, None, (), faults=True, at=self._at(meta))

    def device_header(self, meta: Meta, name: Token, base: Token, wording: str) -> ir.SourceText:
        return ir.SourceText(str(name), wording, str(base), (), at=self._at(meta))

    # --- facts and data ---

    def clause(
        self,
        meta: Meta,
        name: Token,
        level: Token,
        wording: str,
        source: str,
        claims: Clauses,
        because: str | None,
    ) -> ir.Clause:
        at = self._at(meta)
        return ir.Clause(str(name), ir.Level(level), wording, source, claims or (), because, at)

    def manual(
        self, meta: Meta, file: str, edition: str, first: Token | None, last: Token | None
    ) -> ir.Manual:
        at = self._at(meta)
        claims = () if first is None or last is None else _range_of_claims(first, last, at)
        return ir.Manual(file, edition, claims, at)

    def table(
        self, meta: Meta, name: Token, width: Token, openness: Token, *rows: ir.CodeRow
    ) -> ir.CodeTable:
        closed = openness == "closed"
        return ir.CodeTable(str(name), int(width[1:]), closed, rows, self._at(meta))

    def code_row(
        self, meta: Meta, value: Token, name: Token, wording: str, clauses: Clauses
    ) -> ir.CodeRow:
        return ir.CodeRow(number_of(value), str(name), wording, clauses or (), self._at(meta))

    def parameter(
        self,
        meta: Meta,
        name: Token,
        kind: ir.Type,
        value: tuple[ir.Expression, ...],
        clauses: tuple[str, ...],
    ) -> ir.Parameter:
        return ir.Parameter(str(name), kind, value, clauses, self._at(meta))

    def set_parameter(
        self, meta: Meta, name: Token, value: tuple[ir.Expression, ...], clauses: tuple[str, ...]
    ) -> ir.SetParameter:
        return ir.SetParameter(str(name), value, clauses, self._at(meta))

    def area_value(self, _: Meta, *parts: ir.Expression) -> tuple[ir.Expression, ...]:
        return parts

    def plain_value(self, _: Meta, value: ir.Expression) -> tuple[ir.Expression, ...]:
        return (value,)

    def time_value(self, meta: Meta, number: Token, unit: Token) -> tuple[ir.Expression, ...]:
        value = number_of(number) * MICROSECONDS[unit]
        return (ir.Literal(value, TIME_DIGITS, self._at(meta)),)

    def register(
        self,
        meta: Meta,
        name: Token,
        address: Token,
        size: Token,
        main: Token,
        device: Token,
        reset: Token | None,
        clauses: Clauses,
        *fields: ir.RegisterField,
    ) -> ir.Register:
        return ir.Register(
            str(name),
            number_of(address),
            number_of(size),
            ir.Access(main),
            ir.Access(device),
            0 if reset is None else number_of(reset),
            fields,
            clauses or (),
            self._at(meta),
        )

    def register_field(
        self,
        meta: Meta,
        low: Token,
        high: Token | None,
        name: Token,
        kind: ir.Type,
        shows: ir.Shows | None,
        clauses: Clauses,
    ) -> ir.RegisterField:
        first = number_of(low)
        last = first if high is None else number_of(high)
        return ir.RegisterField(str(name), first, last, kind, shows, clauses or (), self._at(meta))

    def shows(
        self,
        _: Meta,
        value: ir.Expression,
        condition: ir.Expression | None,
        advised: ir.Advised | None,
    ) -> ir.Shows:
        return ir.Shows(value, condition, advised)

    def advised(self, _: Meta, value: ir.Expression, clauses: tuple[str, ...]) -> ir.Advised:
        return ir.Advised(value, clauses)

    def word(
        self,
        meta: Meta,
        name: Token,
        index: Token | None,
        subindex: Token | None,
        size: Token,
        clauses: Clauses,
        *fields: ir.RegisterField,
    ) -> ir.Word:
        key = None
        if index is not None and subindex is not None:
            key = (number_of(index), number_of(subindex))
        return ir.Word(str(name), key, number_of(size), fields, clauses or (), self._at(meta))

    def frame(
        self,
        meta: Meta,
        name: Token,
        place: tuple[str, tuple[Binding, ...]] | None,
        clauses: Clauses,
        *fields: ir.FrameField,
    ) -> ir.Frame:
        parent, conditions = (None, ()) if place is None else place
        return ir.Frame(str(name), parent, conditions, fields, clauses or (), self._at(meta))

    def frame_place(
        self, _: Meta, parent: Token, *conditions: Binding
    ) -> tuple[str, tuple[Binding, ...]]:
        return str(parent), conditions

    def frame_field(
        self,
        meta: Meta,
        name: Token,
        kind: ir.Type,
        value: ir.Expression | None,
        filled: ir.Expression | None,
        reply: ir.Expression | None,
        into: str | None,
        clauses: Clauses,
    ) -> ir.FrameField:
        at = self._at(meta)
        return ir.FrameField(str(name), kind, value, filled, reply, into, clauses or (), at)

    def objects(self, _: Meta, *rows: ir.Declaration) -> list[ir.Declaration]:
        return list(rows)

    def object_row(
        self,
        meta: Meta,
        index: Token,
        subindex: Token,
        name: Token,
        kind: ir.Type,
        access: Token,
        marks: frozenset[str],
        states: tuple[str, ...] | None,
        readable: tuple[str, ...] | None,
        low: int | None,
        high: int | None,
        default: int | str | None,
        maps: Token | None,
        clauses: Clauses,
    ) -> ir.ObjectEntry:
        return ir.ObjectEntry(
            number_of(index),
            number_of(subindex),
            str(name),
            kind,
            ir.Access(access),
            constant="constant" in marks,
            volatile="volatile" in marks,
            mappable="mappable" in marks,
            fixed="fixed" in marks,
            varying="varying" in marks,
            stored="stored" in marks,
            guarded="guarded" in marks,
            states=states or (),
            read_states=readable or (),
            low=low,
            high=high,
            default=default,
            maps=None if maps is None else number_of(maps),
            clauses=clauses or (),
            at=self._at(meta),
        )

    def marks(self, _: Meta, *marks: str) -> frozenset[str]:
        return frozenset(marks)

    def mark(self, _: Meta, mark: Token) -> str:
        return str(mark)

    def string_default(self, _: Meta, value: str) -> str:
        return value

    def signed_number(self, _: Meta, minus: Token | None, number: Token) -> int:
        return number_of(number) if minus is None else -number_of(number)

    def dictionary(self, meta: Meta, openness: Token, clauses: tuple[str, ...]) -> ir.Dictionary:
        return ir.Dictionary(openness == "closed", clauses, self._at(meta))

    def esi(self, _: Meta, *rows: ir.Declaration) -> list[ir.Declaration]:
        return list(rows)

    def esi_row(self, meta: Meta, path: str, value: int | str, clauses: Clauses) -> ir.EsiEntry:
        return ir.EsiEntry(path, value, clauses or (), self._at(meta))

    def string_value(self, _: Meta, value: str) -> str:
        return value

    def example(
        self, meta: Meta, name: Token, clauses: tuple[str, ...], request: bytes, response: bytes
    ) -> ir.Example:
        return ir.Example(str(name), request, response, clauses, self._at(meta))

    def HEX(self, token: Token) -> bytes:  # noqa: N802 - the name of the terminal
        try:
            return bytes.fromhex(token[len('hex"') : -1])
        except ValueError:
            at = ir.Span(self._file, token.line or 0, token.column or 0)
            remedy = "write two digits for each byte"
            refuse(Code.ECS001, at, f"{token} is half a byte", remedy)

    def anomaly(
        self,
        meta: Meta,
        name: Token,
        subject: Token,
        printed: str,
        normative: str,
        treatment: str,
        clauses: tuple[str, ...],
    ) -> ir.Anomaly:
        at = self._at(meta)
        return ir.Anomaly(str(name), str(subject), printed, normative, treatment, clauses, at)

    # --- freedom ---

    def choice(
        self,
        meta: Meta,
        name: Token,
        wording: str,
        clauses: tuple[str, ...],
        *alternatives: ir.Alternative,
    ) -> ir.Choice:
        return ir.Choice(str(name), wording, alternatives, clauses, self._at(meta))

    def alternative(
        self, meta: Meta, name: Token, wording: str, risk: ir.Risk | None
    ) -> ir.Alternative:
        return ir.Alternative(str(name), wording, risk, self._at(meta))

    def risk(self, _: Meta, wording: str, clauses: tuple[str, ...]) -> ir.Risk:
        return ir.Risk(wording, clauses)

    def condition(
        self, meta: Meta, name: Token, wording: str, assumed: Token, clauses: tuple[str, ...]
    ) -> ir.Condition:
        return ir.Condition(str(name), wording, assumed == "true", clauses, self._at(meta))

    def definition(
        self, meta: Meta, name: Token, wording: str, value: ir.Expression, clauses: tuple[str, ...]
    ) -> ir.Definition:
        return ir.Definition(str(name), wording, value, clauses, self._at(meta))

    def property(
        self, meta: Meta, name: Token, wording: str, value: ir.Expression, clauses: tuple[str, ...]
    ) -> ir.Property:
        return ir.Property(str(name), wording, value, clauses, self._at(meta))

    def reason(
        self,
        meta: Meta,
        name: Token,
        owner: str,
        wording: str,
        values: tuple[ir.Expression, ...] | None,
        guard: ir.Expression,
        clauses: tuple[str, ...],
    ) -> ir.Reason:
        at = self._at(meta)
        machine, rule = two_parts(owner, at)
        return ir.Reason(str(name), machine, rule, wording, values or (), guard, clauses, at)

    def reason_values(self, _: Meta, *values: ir.Expression) -> tuple[ir.Expression, ...]:
        return values

    def pin(self, meta: Meta, name: Token, way: Token, clauses: tuple[str, ...]) -> ir.Pin:
        return ir.Pin(str(name), str(way), clauses, self._at(meta))

    def open_choice(self, meta: Meta, name: Token, clauses: tuple[str, ...]) -> ir.Open:
        return ir.Open(str(name), clauses, self._at(meta))

    def confirm(self, meta: Meta, *parts: tuple[str, ...]) -> ir.Confirm:
        *targets, clauses = parts
        return ir.Confirm(tuple((kind, name) for kind, name in targets), clauses, self._at(meta))

    def confirmed(self, _: Meta, kind: Token, name: str) -> tuple[str, ...]:
        return str(kind), name

    def close(self, meta: Meta, name: Token, *parts: ir.Expression | tuple[str, ...]) -> ir.Close:
        values = tuple(part for part in parts if not isinstance(part, tuple))
        clauses = next(part for part in parts if isinstance(part, tuple))
        return ir.Close(str(name), values, clauses, self._at(meta))
