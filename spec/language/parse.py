"""Parses the characters of a text to its IR."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Final, NoReturn

from lark import Token, Tree
from lark.exceptions import UnexpectedCharacters, UnexpectedInput, UnexpectedToken
from lark.lexer import PatternStr

from ecatspec.spec.language.diagnostics import Code, Diagnostic, SpecError
from ecatspec.spec.language.grammar import parser
from ecatspec.spec.language.ir import (
    Access,
    Advised,
    After,
    Alternative,
    Anomaly,
    AnyValue,
    Area,
    Binary,
    Bool,
    Bytes,
    Call,
    Choice,
    Clause,
    Close,
    CodeRow,
    CodeTable,
    Condition,
    Conditional,
    Confirm,
    Declaration,
    Definition,
    Dictionary,
    EsiEntry,
    Example,
    Expression,
    Extend,
    Fault,
    Frame,
    FrameField,
    Gap,
    Give,
    In,
    Input,
    InputKind,
    Later,
    Level,
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
    Range,
    Reason,
    Register,
    RegisterField,
    Remove,
    Replace,
    ReplaceField,
    Risk,
    Rule,
    Send,
    SetParameter,
    Shows,
    SInt,
    SourceText,
    Span,
    Store,
    Text,
    Time,
    Type,
    UInt,
    Unary,
    Update,
    Variable,
    Word,
)

if TYPE_CHECKING:
    from collections.abc import Callable

TIME_DIGITS: Final = -1
"""`Literal.digits` of a number that was written with a unit of time."""

MICROSECONDS: Final = {"us": 1, "ms": 1_000, "s": 1_000_000}

_WORDS: Final = {
    "NAME": "a name",
    "NUMBER": "a number",
    "STRING": 'a wording in "quotes"',
    "ID": "a clause id such as AL-03",
    "HEX": 'bytes such as hex"01 02"',
    "LEVEL": "must, should, may or unobservable",
    "CONFIRMED": "register, rule, row or another kind of declaration",
    "OPENNESS": "open or closed",
    "INPUT_KIND": "`frame` or `write`",
    "ACCESS": "ro, wo, rw or none",
    "BOOLEAN": "true or false",
    "TIME_UNIT": "us, ms or s",
    "UTYPE": "a type such as u16",
    "STYPE": "a type such as i16",
    "COMPARE": "a comparison",
    "ADD": "+ | &",
    "MINUS": "-",
    "MULTIPLY": "* / %",
    "$END": "the end of the text",
}
_DECLARATIONS: Final = frozenset(
    {
        "ANOMALY",
        "CHOICE",
        "CLAUSE",
        "CLOSED",
        "CONDITION",
        "CONFIRM",
        "DEFINE",
        "DICTIONARY",
        "ESI",
        "EXAMPLE",
        "EXTEND",
        "FAULT",
        "FRAME",
        "MACHINE",
        "MANUAL",
        "OBJECTS",
        "OPEN",
        "PARAMETER",
        "PIN",
        "PROPERTY",
        "REASON",
        "REGISTER",
        "REMOVE",
        "REPLACE",
        "TABLE",
        "WORD",
        "$END",
    }
)
_OPERATORS: Final = frozenset({"COMPARE", "ADD", "MINUS", "MULTIPLY", "AND", "OR", "IN"})
_FEW: Final = 8


def parse_text(source: str, file: str) -> SourceText:
    """The text of `file` as IR, or a SpecError with what is wrong with its characters."""
    if "\0" in source:
        line = source.count("\n", 0, source.index("\0")) + 1
        column = source.index("\0") - source.rfind("\n", 0, source.index("\0"))
        _refuse(Code.ECS003, Span(file, line, column), "a NUL byte", "save the file as plain UTF-8")
    source = source.replace("\r\n", "\n")
    try:
        tree = parser().parse(source)
    except UnexpectedInput as error:
        _refuse_input(error, source, file)
    try:
        return _Builder(file).text(tree, hashlib.sha256(source.encode()).hexdigest())
    except RecursionError:
        _refuse(
            Code.ECS001, Span(file, 1, 1), "expressions are nested too deeply", "take them apart"
        )


def decode(raw: bytes, file: str) -> str:
    """The characters of a file, or a SpecError that says where they stop being UTF-8."""
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        column = error.start - raw.rfind(b"\n", 0, error.start)
        _refuse(
            Code.ECS003,
            Span(file, line, column),
            f"byte 0x{raw[error.start]:02x} is not UTF-8",
            "save the file as plain UTF-8",
        )


# --- syntax errors -------------------------------------------------------------------------------


def _refuse(code: Code, at: Span, message: str, remedy: str) -> NoReturn:
    raise SpecError((Diagnostic(code, at, message, remedy),)) from None


def _refuse_input(error: UnexpectedInput, source: str, file: str) -> NoReturn:
    at = Span(file, max(error.line, 1), max(error.column, 1))
    if isinstance(error, UnexpectedToken):
        expected = _in_words(set(error.accepts or error.expected))
        found = f"`{error.token.value}`"
        ended = error.token.type == "$END"
    elif isinstance(error, UnexpectedCharacters):
        expected = _in_words(set(error.allowed or ()))
        found = f"the character {error.char!r}"
        ended = False
    else:
        expected, found, ended = "more", "the end", True
    if ended:
        lines = source.rstrip().split("\n")
        at = Span(file, len(lines), len(lines[-1]) + 1)
        bare = (line.split("#", 1)[0].strip() for line in lines)
        if not any(bare):
            _refuse(
                Code.ECS004,
                Span(file, 1, 1),
                "nothing but white space and comments",
                'begin with `standard NAME "..."` or `device NAME extends standard "..."`',
            )
        _refuse(Code.ECS002, at, "the text ends too early", f"go on with {expected}")
    _refuse(Code.ECS001, at, f"{found} is not expected here", f"write {expected}")


def _in_words(terminals: set[str]) -> str:
    if len(terminals & _OPERATORS) > 1:
        operators, terminals = ["an operator"], terminals - _OPERATORS
    else:
        operators = []
    if len(terminals & _DECLARATIONS) > 1:
        others, terminals = ["the next declaration"], terminals - _DECLARATIONS
    else:
        others = []
    words = sorted({_in_word(terminal) for terminal in terminals}) + operators + others
    if len(words) > _FEW:
        words = [*words[:_FEW], "..."]
    return ", ".join(words[:-1]) + (" or " if len(words) > 1 else "") + "".join(words[-1:])


def _in_word(terminal: str) -> str:
    if terminal in _WORDS:
        return _WORDS[terminal]
    pattern = parser().get_terminal(terminal).pattern
    return f"`{pattern.value}`" if isinstance(pattern, PatternStr) else terminal.lower()


# --- from tree to IR -----------------------------------------------------------------------------

_INPUTS: Final[dict[str, InputKind]] = {
    "word_input": InputKind.WORD,
    "outputs_input": InputKind.OUTPUTS,
    "event_input": InputKind.EVENT,
    "local_input": InputKind.LOCAL,
    "own_input": InputKind.OWN,
}
_BINARY: Final = {"or_": "or", "and_": "and"}
_TOKENS: Final = frozenset({"compare", "add", "subtract", "multiply"})


class _Children:
    """The children of one tree, taken from left to right."""

    def __init__(self, tree: Tree[Token], at: Span) -> None:
        self._rest: list[Tree[Token] | Token | None] = list(reversed(tree.children))
        self._at = at

    def word(self) -> str:
        child = self._rest.pop()
        assert isinstance(child, Token), self._at
        return str(child)

    def number(self) -> int:
        return _number(self.word())

    def string(self) -> str:
        return self.word()[1:-1]

    def tree(self) -> Tree[Token]:
        child = self._rest.pop()
        assert isinstance(child, Tree), self._at
        return child

    def optional_tree(self) -> Tree[Token] | None:
        """The child of an optional part in [brackets], whose place is always there."""
        child = self._rest.pop()
        assert child is None or isinstance(child, Tree), self._at
        return child

    def optional_word(self) -> str | None:
        if self._rest[-1] is None:
            self._rest.pop()
            return None
        return self.word()

    def optional_string(self) -> str | None:
        word = self.optional_word()
        return None if word is None else word[1:-1]

    def optional_number(self) -> int | None:
        word = self.optional_word()
        return None if word is None else _number(word)

    def words(self, kind: str) -> list[str]:
        """All tokens of one kind that come next; an empty optional part counts as none."""
        found = []
        while self._rest and isinstance(self._rest[-1], Token) and self._rest[-1].type == kind:
            found.append(self.word())
        if not found and self._rest and self._rest[-1] is None:
            self._rest.pop()
        return found

    def given(self, *kinds: str) -> Tree[Token] | None:
        """The next tree if it is of one of the kinds, for parts with a question mark."""
        if self._rest and isinstance(self._rest[-1], Tree) and self._rest[-1].data in kinds:
            return self.tree()
        return None

    def all(self, *kinds: str) -> list[Tree[Token]]:
        """All trees of these kinds that come next."""
        found = []
        while (tree := self.given(*kinds)) is not None:
            found.append(tree)
        return found

    def trees(self) -> list[Tree[Token]]:
        """All trees that are left."""
        found = [child for child in reversed(self._rest) if isinstance(child, Tree)]
        self._rest.clear()
        return found


class _Builder:
    """Builds IR; all it knows is the name of the file."""

    def __init__(self, file: str) -> None:
        self._file = file

    def _open(self, tree: Tree[Token]) -> tuple[_Children, Span]:
        at = Span(self._file, tree.meta.line, tree.meta.column)
        return _Children(tree, at), at

    def text(self, tree: Tree[Token], digest: str) -> SourceText:
        children, _ = self._open(tree)
        header = children.tree()
        head, at = self._open(header)
        name = head.word()
        extends = head.word() if header.data == "device_header" else None
        declarations: list[Declaration] = []
        for child in children.trees():
            if build := self._blocks.get(str(child.data)):
                rows, _ = self._open(child)
                declarations.extend(build(self, row) for row in rows.trees())
            else:
                declarations.append(self._declarations[str(child.data)](self, child))
        faults = header.data == "faults_header"
        return SourceText(name, head.string(), extends, tuple(declarations), faults, digest, at)

    # --- facts and data ---

    def _clause(self, tree: Tree[Token]) -> Clause:
        children, at = self._open(tree)
        name, level = children.word(), Level(children.word())
        wording, source = children.string(), children.string()
        claims = children.given("claims")
        listed = () if claims is None else self._ids(_Children(claims, at).tree())
        return Clause(name, level, wording, source, listed, children.optional_string(), at)

    def _manual(self, tree: Tree[Token]) -> Manual:
        children, at = self._open(tree)
        file, edition = children.string(), children.string()
        first, last = children.optional_word(), children.optional_word()
        claims = () if first is None or last is None else self._from_to(first, last, at)
        return Manual(file, edition, claims, at)

    def _from_to(self, first: str, last: str, at: Span) -> tuple[str, ...]:
        """All ids from one to another: the same letters, then a number of the same length."""
        (start, _, low), (prefix, _, high) = first.rpartition("-"), last.rpartition("-")
        numbers = low.isdigit() and high.isdigit() and len(low) == len(high)
        if start != prefix or not numbers or int(low) > int(high):
            what = f"{first} .. {last} is no row of claims"
            _refuse(Code.ECS001, at, what, "write the first and the last: AKD-001 .. AKD-469")
        width = len(low)
        return tuple(f"{start}-{number:0{width}}" for number in range(int(low), int(high) + 1))

    def _ids(self, tree: Tree[Token] | None) -> tuple[str, ...]:
        if tree is None:
            return ()
        children, _ = self._open(tree)
        return tuple(children.words("ID"))

    def _table(self, tree: Tree[Token]) -> CodeTable:
        children, at = self._open(tree)
        name, width = children.word(), int(children.word()[1:])
        closed = children.word() == "closed"
        rows = tuple(self._code_row(row) for row in children.trees())
        return CodeTable(name, width, closed, rows, at)

    def _code_row(self, tree: Tree[Token]) -> CodeRow:
        children, at = self._open(tree)
        value, name, wording = children.number(), children.word(), children.string()
        return CodeRow(value, name, wording, self._ids(children.given("id_list")), at)

    def _parameter(self, tree: Tree[Token]) -> Parameter:
        children, at = self._open(tree)
        name, kind = children.word(), self._type(children.tree())
        value = self._parameter_value(children.tree())
        return Parameter(name, kind, value, self._ids(children.given("id_list")), at)

    def _set_parameter(self, tree: Tree[Token]) -> SetParameter:
        children, at = self._open(tree)
        name, value = children.word(), self._parameter_value(children.tree())
        return SetParameter(name, value, self._ids(children.given("id_list")), at)

    def _parameter_value(self, tree: Tree[Token]) -> tuple[Expression, ...]:
        children, at = self._open(tree)
        if tree.data == "time_value":
            number = children.number()
            return (Literal(number * MICROSECONDS[children.word()], TIME_DIGITS, at),)
        return tuple(self._expression(child) for child in children.trees())

    def _type(self, tree: Tree[Token]) -> Type:
        children, _ = self._open_empty(tree)
        kind: Type
        match tree.data:
            case "unsigned":
                kind = UInt(int(children.word()[1:]))
            case "signed":
                kind = SInt(int(children.word()[1:]))
            case "boolean":
                kind = Bool()
            case "counted_bytes":
                kind = Bytes(self._expression(children.tree()))
            case "rest_bytes":
                kind = Bytes(None)
            case "text":
                kind = Text(children.number())
            case "area":
                kind = Area()
            case "time":
                kind = Time()
            case _:
                assert tree.data == "named", tree.data
                kind = Named(children.word())
        return kind

    def _open_empty(self, tree: Tree[Token]) -> tuple[_Children, Span]:
        at = Span(self._file, getattr(tree.meta, "line", 0), getattr(tree.meta, "column", 0))
        return _Children(tree, at), at

    def _register(self, tree: Tree[Token]) -> Register:
        children, at = self._open(tree)
        name, address, size = children.word(), children.number(), children.number()
        main, device = Access(children.word()), Access(children.word())
        reset = children.optional_word()
        clauses = self._ids(children.given("id_list"))
        fields = tuple(self._register_field(field) for field in children.trees())
        value = 0 if reset is None else _number(reset)
        return Register(name, address, size, main, device, value, fields, clauses, at)

    def _word(self, tree: Tree[Token]) -> Word:
        children, at = self._open(tree)
        name = children.word()
        index, subindex = children.optional_number(), children.optional_number()
        key = None if index is None or subindex is None else (index, subindex)
        size, clauses = children.number(), self._ids(children.given("id_list"))
        fields = tuple(self._register_field(field) for field in children.trees())
        return Word(name, key, size, fields, clauses, at)

    def _register_field(self, tree: Tree[Token]) -> RegisterField:
        children, at = self._open(tree)
        low = children.number()
        end = children.optional_word()
        name, kind = children.word(), self._type(children.tree())
        shows = children.given("shows")
        clauses = self._ids(children.given("id_list"))
        high = low if end is None else _number(end)
        shown = None if shows is None else self._shows(shows)
        return RegisterField(name, low, high, kind, shown, clauses, at)

    def _shows(self, tree: Tree[Token]) -> Shows:
        children, _ = self._open(tree)
        value = self._expression(children.tree())
        condition = self._optional_expression(children.optional_tree())
        advice = children.given("advised")
        return Shows(value, condition, None if advice is None else self._advised(advice))

    def _advised(self, tree: Tree[Token]) -> Advised:
        children, _ = self._open(tree)
        return Advised(self._expression(children.tree()), self._ids(children.given("id_list")))

    def _frame(self, tree: Tree[Token]) -> Frame:
        children, at = self._open(tree)
        name = children.word()
        place = children.given("frame_place")
        clauses = self._ids(children.given("id_list"))
        fields = tuple(self._frame_field(field) for field in children.trees())
        parent: str | None = None
        conditions: tuple[tuple[str, Expression], ...] = ()
        if place is not None:
            inner, _ = self._open(place)
            parent, conditions = inner.word(), self._bindings(inner)
        return Frame(name, parent, conditions, fields, clauses, at)

    def _frame_field(self, tree: Tree[Token]) -> FrameField:
        children, at = self._open(tree)
        name, kind = children.word(), self._type(children.tree())
        value = self._optional_expression(children.optional_tree())
        filled = self._optional_expression(children.optional_tree())
        reply = self._optional_expression(children.optional_tree())
        into = children.optional_tree()
        kept = None if into is None else _path(into)
        clauses = self._ids(children.given("id_list"))
        return FrameField(name, kind, value, filled, reply, kept, clauses, at)

    def _bindings(self, children: _Children) -> tuple[tuple[str, Expression], ...]:
        opened = [self._open(tree)[0] for tree in children.trees()]
        return tuple((binding.word(), self._expression(binding.tree())) for binding in opened)

    def _object_row(self, tree: Tree[Token]) -> ObjectEntry:
        children, at = self._open(tree)
        index, subindex, name = children.number(), children.number(), children.word()
        kind, access = self._type(children.tree()), Access(children.word())
        marks = {_Children(mark, at).word() for mark in children.all("mark")}
        states = tuple(children.words("NAME"))
        readable = children.given("readable")
        low, high = children.optional_tree(), children.optional_tree()
        default = children.optional_tree()
        maps = children.optional_word()
        preset: int | str | None = None
        if default is not None:
            string = default.data == "string_default"
            preset = _Children(default, at).string() if string else self._signed(default)
        return ObjectEntry(
            index,
            subindex,
            name,
            kind,
            access,
            constant="constant" in marks,
            volatile="volatile" in marks,
            mappable="mappable" in marks,
            fixed="fixed" in marks,
            varying="varying" in marks,
            stored="stored" in marks,
            guarded="guarded" in marks,
            states=states,
            read_states=() if readable is None else tuple(_Children(readable, at).words("NAME")),
            low=None if low is None else self._signed(low),
            high=None if high is None else self._signed(high),
            default=preset,
            maps=None if maps is None else int(maps, 0),
            clauses=self._ids(children.given("id_list")),
            at=at,
        )

    def _signed(self, tree: Tree[Token]) -> int:
        children, _ = self._open(tree)
        sign = children.optional_word()
        return children.number() if sign is None else -children.number()

    def _dictionary(self, tree: Tree[Token]) -> Dictionary:
        children, at = self._open(tree)
        return Dictionary(children.word() == "closed", self._ids(children.given("id_list")), at)

    def _esi_row(self, tree: Tree[Token]) -> EsiEntry:
        children, at = self._open(tree)
        path, value = children.string(), children.tree()
        text = value.data == "string_value"
        given = _Children(value, at).string() if text else self._signed(value)
        return EsiEntry(path, given, self._ids(children.given("id_list")), at)

    def _open_choice(self, tree: Tree[Token]) -> Open:
        children, at = self._open(tree)
        return Open(children.word(), self._ids(children.tree()), at)

    def _confirm(self, tree: Tree[Token]) -> Confirm:
        children, at = self._open(tree)
        targets = [self._open(target)[0] for target in children.all("confirmed")]
        named = tuple((target.word(), _path(target.tree())) for target in targets)
        return Confirm(named, self._ids(children.tree()), at)

    def _example(self, tree: Tree[Token]) -> Example:
        children, at = self._open(tree)
        name, clauses = children.word(), self._ids(children.tree())
        request, response = (self._hex(children.word(), at) for _ in range(2))
        return Example(name, request, response, clauses, at)

    def _hex(self, word: str, at: Span) -> bytes:
        try:
            return bytes.fromhex(word[len('hex"') : -1])
        except ValueError:
            _refuse(Code.ECS001, at, f"{word} is half a byte", "write two digits for each byte")

    def _anomaly(self, tree: Tree[Token]) -> Anomaly:
        children, at = self._open(tree)
        name, subject = children.word(), children.word()
        printed, normative, treatment = (children.string() for _ in range(3))
        clauses = self._ids(children.given("id_list"))
        return Anomaly(name, subject, printed, normative, treatment, clauses, at)

    # --- freedom ---

    def _choice(self, tree: Tree[Token]) -> Choice:
        children, at = self._open(tree)
        name, wording, clauses = children.word(), children.string(), self._ids(children.tree())
        alternatives = tuple(map(self._alternative, children.trees()))
        return Choice(name, wording, alternatives, clauses, at)

    def _alternative(self, tree: Tree[Token]) -> Alternative:
        children, at = self._open(tree)
        name, wording, risk = children.word(), children.string(), children.given("risk")
        return Alternative(name, wording, None if risk is None else self._risk(risk), at)

    def _risk(self, tree: Tree[Token]) -> Risk:
        children, _ = self._open(tree)
        return Risk(children.string(), self._ids(children.tree()))

    def _condition(self, tree: Tree[Token]) -> Condition:
        children, at = self._open(tree)
        name, wording, assumed = children.word(), children.string(), children.word() == "true"
        return Condition(name, wording, assumed, self._ids(children.given("id_list")), at)

    def _definition(self, tree: Tree[Token]) -> Definition:
        children, at = self._open(tree)
        name, wording, value = children.word(), children.string(), self._expression(children.tree())
        return Definition(name, wording, value, self._ids(children.given("id_list")), at)

    def _property(self, tree: Tree[Token]) -> Property:
        children, at = self._open(tree)
        name, wording, value = children.word(), children.string(), self._expression(children.tree())
        return Property(name, wording, value, self._ids(children.given("id_list")), at)

    def _reason(self, tree: Tree[Token]) -> Reason:
        children, at = self._open(tree)
        name = children.word()
        machine, rule = _two_parts(_path(children.tree()), at)
        wording, given = children.string(), children.given("reason_values")
        parts = [] if given is None else self._open(given)[0].trees()
        values = tuple(self._expression(part) for part in parts)
        guard, clauses = self._expression(children.tree()), self._ids(children.tree())
        return Reason(name, machine, rule, wording, values, guard, clauses, at)

    def _pin(self, tree: Tree[Token]) -> Pin:
        children, at = self._open(tree)
        name, alternative = children.word(), children.word()
        return Pin(name, alternative, self._ids(children.given("id_list")), at)

    def _close(self, tree: Tree[Token]) -> Close:
        children, at = self._open(tree)
        name, rest = children.word(), children.trees()
        clauses = self._ids(rest.pop()) if rest[-1].data == "id_list" else ()
        return Close(name, tuple(self._expression(value) for value in rest), clauses, at)

    # --- machines ---

    def _machine(self, tree: Tree[Token]) -> Machine:
        children, at = self._open(tree)
        name, wording = children.word(), children.string()
        table, *states, initial = children.words("NAME")
        return Machine(
            name, wording, table, tuple(states), initial, *self._machine_parts(children), at
        )

    def _machine_parts(
        self, children: _Children
    ) -> tuple[tuple[Variable, ...], tuple[Input, ...], tuple[Rule, ...], tuple[Gap, ...]]:
        variables = tuple(self._variable(item) for item in children.all("variable"))
        inputs = tuple(self._input(item) for item in children.all("origin_input", *_INPUTS))
        rows = children.trees()
        rules = tuple(self._rule(row) for row in rows if row.data == "rule")
        gaps = tuple(self._gap(row) for row in rows if row.data == "gap")
        return variables, inputs, rules, gaps

    def _extend(self, tree: Tree[Token]) -> Extend:
        children, at = self._open(tree)
        return Extend(children.word(), *self._machine_parts(children), at)

    def _variable(self, tree: Tree[Token]) -> Variable:
        children, at = self._open(tree)
        name, kind = children.word(), self._type(children.tree())
        return Variable(name, kind, self._expression(children.tree()), at)

    def _input(self, tree: Tree[Token]) -> Input:
        children, at = self._open(tree)
        name = children.word()
        if tree.data == "origin_input":
            return Input(name, InputKind(children.word()), tuple(children.words("NAME")), (), at)
        kind = _INPUTS[str(tree.data)]
        if tree.data in {"word_input", "outputs_input"}:
            return Input(name, kind, tuple(children.words("NAME")), (), at)
        items = [self._open(item)[0] for item in children.trees()]
        parameters = tuple((item.word(), self._type(item.tree())) for item in items)
        return Input(name, kind, (), parameters, at)

    def _from(self, tree: Tree[Token]) -> tuple[tuple[str, ...], str]:
        children, _ = self._open(tree)
        *sources, event = children.words("NAME")
        return tuple(sources), event

    def _rule(self, tree: Tree[Token]) -> Rule:
        children, at = self._open(tree)
        name, clauses = children.word(), self._ids(children.given("id_list"))
        sources, event = self._from(children.tree())
        guard, target = self._one(children, "when"), self._goto(children)
        updates = self._updates(children)
        stores = tuple(self._store(item) for item in children.all("store", "complete_store"))
        take = self._one(children, "take")
        sends = tuple(self._send(item) for item in children.all("send"))
        gives, laters = self._gives(children), self._laters(children)
        within, after = self._one(children, "within"), children.given("after")
        return Rule(
            name,
            clauses,
            sources,
            event,
            guard,
            target,
            updates,
            stores,
            sends,
            gives,
            within,
            None if after is None else self._after(after),
            take,
            laters,
            at,
        )

    def _after(self, tree: Tree[Token]) -> After:
        children, at = self._open(tree)
        return After(self._updates(children), self._gives(children), at)

    def _gives(self, children: _Children) -> tuple[Give, ...]:
        return tuple(self._give(item) for item in children.all("give", "deliver", "resend"))

    def _laters(self, children: _Children) -> tuple[Later, ...]:
        return tuple(self._later(item) for item in children.all("later"))

    def _later(self, tree: Tree[Token]) -> Later:
        children, at = self._open(tree)
        target, given = _path(children.tree()), children.given("arguments")
        arguments = () if given is None else self._bindings(self._open(given)[0])
        after = self._one(children, "not_before")
        return Later(target, arguments, after, self._expression(children.tree()), at)

    def _gap(self, tree: Tree[Token]) -> Gap:
        children, at = self._open(tree)
        name, clauses = children.word(), self._ids(children.given("id_list"))
        sources, event = self._from(children.tree())
        return Gap(name, clauses, sources, event, self._one(children, "when"), at)

    def _one(self, children: _Children, kind: str) -> Expression | None:
        tree = children.given(kind)
        return None if tree is None else self._expression(self._open(tree)[0].tree())

    def _goto(self, children: _Children) -> str | None:
        tree = children.given("goto")
        return None if tree is None else self._open(tree)[0].word()

    def _updates(self, children: _Children) -> tuple[Update, ...]:
        tree = children.given("set")
        if tree is None:
            return ()
        opened = [self._open(item) for item in self._open(tree)[0].trees()]
        return tuple(
            Update(_path(row.tree()), self._expression(row.tree()), at) for row, at in opened
        )

    def _store(self, tree: Tree[Token]) -> Store:
        children, at = self._open(tree)
        index, subindex, value = (self._expression(part) for part in children.trees())
        return Store(index, subindex, value, tree.data == "complete_store", at)

    def _send(self, tree: Tree[Token]) -> Send:
        children, at = self._open(tree)
        return Send(children.word(), self._bindings(children), at)

    def _give(self, tree: Tree[Token]) -> Give:
        children, at = self._open(tree)
        if tree.data in {"deliver", "resend"}:
            return Give(str(tree.data), (), at)
        return Give(_path(children.tree()), self._bindings(children), at)

    def _replace(self, tree: Tree[Token]) -> Replace:
        children, at = self._open(tree)
        machine, rule = _two_parts(_path(children.tree()), at)
        clauses = self._ids(children.given("id_list"))
        guard, target = self._one(children, "when"), self._goto(children)
        updates = self._updates(children)
        sends = tuple(self._send(item) for item in children.all("send"))
        gives, laters = self._gives(children), self._laters(children)
        within = self._one(children, "within")
        return Replace(
            machine, rule, clauses, guard, target, updates, sends, within, gives, laters, at
        )

    def _replace_field(self, tree: Tree[Token]) -> ReplaceField:
        children, at = self._open(tree)
        frame, field = _two_parts(_path(children.tree()), at, "frame.field")
        clauses, reply = self._ids(children.tree()), self._expression(children.tree())
        into = children.optional_tree()
        return ReplaceField(frame, field, clauses, reply, None if into is None else _path(into), at)

    def _fault(self, tree: Tree[Token]) -> Fault:
        children, at = self._open(tree)
        name, wording, clauses = children.word(), children.string(), self._ids(children.tree())
        quirk = children.given("quirk")
        named = None if quirk is None else self._open(quirk)[0].word()
        changes = tuple(self._changes[str(c.data)](self, c) for c in children.trees())
        return Fault(name, wording, clauses, named, changes, at)

    def _remove(self, tree: Tree[Token]) -> Remove:
        children, at = self._open(tree)
        machine, rule = _two_parts(_path(children.tree()), at)
        return Remove(machine, rule, self._ids(children.given("id_list")), at)

    # --- expressions ---

    def _optional_expression(self, tree: Tree[Token] | None) -> Expression | None:
        return None if tree is None else self._expression(tree)

    def _expression(self, tree: Tree[Token]) -> Expression:
        children, at = self._open(tree)
        kind = str(tree.data)
        if kind in _BINARY:
            left, right = (self._expression(operand) for operand in children.trees())
            return Binary(_BINARY[kind], left, right, at)
        if kind in _TOKENS:
            left = self._expression(children.tree())
            return Binary(children.word(), left, self._expression(children.tree()), at)
        result: Expression
        match kind:
            case "number":
                word = children.word()
                digits = len(word) - 2 if word.startswith("0x") else 0
                result = Literal(_number(word), digits, at)
            case "truth":
                result = Literal(children.word() == "true", 0, at)
            case "reference":
                result = Name(_path(children.tree()), at)
            case "not_":
                result = Unary("not", self._expression(children.tree()), at)
            case "negative":
                children.word()
                result = Unary("-", self._expression(children.tree()), at)
            case "in_":
                operand = self._expression(children.tree())
                result = In(operand, self._items(children.trees()), at)
            case "conditional":
                parts = [self._expression(part) for part in children.trees()]
                result = Conditional(parts[0], parts[1], parts[2], at)
            case "call":
                function = _path(children.tree())
                arguments = tuple(self._expression(part) for part in children.trees())
                result = Call(function, arguments, at)
            case "one_of":
                items = self._items(children.all("item"))
                excluded = self._optional_expression(children.optional_tree())
                result = OneOf(items, excluded, at)
            case _:
                assert kind == "any_value", kind
                result = AnyValue(self._optional_expression(children.optional_tree()), at)
        return result

    def _items(self, trees: list[Tree[Token]]) -> tuple[Expression | Range, ...]:
        items: list[Expression | Range] = []
        for tree in trees:
            children, at = self._open(tree)
            low = self._expression(children.tree())
            high = self._optional_expression(children.optional_tree())
            items.append(low if high is None else Range(low, high, at))
        return tuple(items)

    _changes: Final[
        dict[str, Callable[[_Builder, Tree[Token]], Replace | Remove | Extend | ReplaceField]]
    ] = {
        "extend": _extend,
        "remove": _remove,
        "replace": _replace,
        "replace_field": _replace_field,
    }
    _blocks: Final[dict[str, Callable[[_Builder, Tree[Token]], Declaration]]] = {
        "esi": _esi_row,
        "objects": _object_row,
    }
    _declarations: Final[dict[str, Callable[[_Builder, Tree[Token]], Declaration]]] = {
        "anomaly": _anomaly,
        "choice": _choice,
        "clause": _clause,
        "close": _close,
        "condition": _condition,
        "confirm": _confirm,
        "definition": _definition,
        "dictionary": _dictionary,
        "example": _example,
        "fault": _fault,
        "frame": _frame,
        "machine": _machine,
        "manual": _manual,
        "open_choice": _open_choice,
        "parameter": _parameter,
        "pin": _pin,
        "property": _property,
        "reason": _reason,
        "register": _register,
        **_changes,
        "set_parameter": _set_parameter,
        "table": _table,
        "word": _word,
    }


def _path(tree: Tree[Token]) -> str:
    return ".".join(str(token) for token in tree.children if isinstance(token, Token))


def _number(word: str) -> int:
    return int(word, 16) if word.startswith("0x") else int(word)


def _two_parts(path: str, at: Span, shape: str = "machine.rule") -> tuple[str, str]:
    owner, dot, name = path.partition(".")
    if not dot or "." in name:
        what = shape.partition(".")[2]
        _refuse(Code.ECS001, at, f"`{path}` names no {what}", f"write `{shape}`")
    return owner, name
