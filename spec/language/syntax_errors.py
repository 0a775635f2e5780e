"""Words what the grammar does not accept as diagnostics."""

from __future__ import annotations

from typing import Final, NoReturn

from lark.exceptions import UnexpectedCharacters, UnexpectedInput, UnexpectedToken
from lark.lexer import PatternStr

from ecatspec.spec.language.diagnostics import Code, Diagnostic, SpecError
from ecatspec.spec.language.grammar import parser
from ecatspec.spec.language.ir import Span

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


def refuse(code: Code, at: Span, message: str, remedy: str) -> NoReturn:
    """Raise what is wrong at one place of a text."""
    raise SpecError((Diagnostic(code, at, message, remedy),)) from None


def refuse_input(error: UnexpectedInput, source: str, file: str) -> NoReturn:
    """Raise what lark found at a place where the grammar does not go on."""
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
            refuse(
                Code.ECS004,
                Span(file, 1, 1),
                "nothing but white space and comments",
                'begin with `standard NAME "..."` or `device NAME extends standard "..."`',
            )
        refuse(Code.ECS002, at, "the text ends too early", f"go on with {expected}")
    refuse(Code.ECS001, at, f"{found} is not expected here", f"write {expected}")


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
