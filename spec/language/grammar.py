"""The parser that lark makes of the grammar."""

from __future__ import annotations

import sys
from functools import cache
from importlib import resources
from io import BytesIO

import lark
from lark import Lark

from ecatspec.spec.language.store import kept


@cache
def parser() -> Lark:
    """Give the parser; its tables are kept between starts."""
    grammar = resources.files(__package__).joinpath("grammar.lark").read_text(encoding="utf-8")

    def tables() -> bytes:
        made = Lark(grammar, parser="lalr", propagate_positions=True, maybe_placeholders=True)
        file = BytesIO()
        made.save(file)
        return file.getvalue()

    source = f"{lark.__version__} {sys.version} {grammar}".encode()
    return Lark.load(BytesIO(kept("grammar", source, tables)))
