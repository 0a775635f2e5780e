"""Parses the characters of a text to its IR."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

from lark.exceptions import UnexpectedInput

from ecatspec.spec.language.build_text import built
from ecatspec.spec.language.diagnostics import Code
from ecatspec.spec.language.grammar import parser
from ecatspec.spec.language.ir import Span
from ecatspec.spec.language.syntax_errors import refuse, refuse_input

if TYPE_CHECKING:
    from ecatspec.spec.language.ir import SourceText


def parse_text(source: str, file: str) -> SourceText:
    """The text of `file` as IR, or a SpecError with what is wrong with its characters."""
    if "\0" in source:
        line = source.count("\n", 0, source.index("\0")) + 1
        column = source.index("\0") - source.rfind("\n", 0, source.index("\0"))
        refuse(Code.ECS003, Span(file, line, column), "a NUL byte", "save the file as plain UTF-8")
    source = source.replace("\r\n", "\n")
    try:
        tree = parser().parse(source)
    except UnexpectedInput as error:
        refuse_input(error, source, file)
    try:
        return built(tree, file, hashlib.sha256(source.encode()).hexdigest())
    except RecursionError:
        refuse(
            Code.ECS001, Span(file, 1, 1), "expressions are nested too deeply", "take them apart"
        )


def decode(raw: bytes, file: str) -> str:
    """The characters of a file, or a SpecError that says where they stop being UTF-8."""
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        column = error.start - raw.rfind(b"\n", 0, error.start)
        refuse(
            Code.ECS003,
            Span(file, line, column),
            f"byte 0x{raw[error.start]:02x} is not UTF-8",
            "save the file as plain UTF-8",
        )
