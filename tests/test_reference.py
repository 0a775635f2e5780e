"""Tests of the pages of reference: they leave out nothing of what they show."""

from __future__ import annotations

import re
from importlib import resources

import pytest
from lark import Lark

from ecatspec.conformance.describe.reference_pages import grammar_page, standard_page
from ecatspec.spec import language
from ecatspec.spec.language.ir import (
    Clause,
    Extend,
    Frame,
    Gap,
    Machine,
    ObjectEntry,
    Rule,
    SourceText,
)
from ecatspec.spec.language.load import load_standard, standard_texts
from ecatspec.spec.language.parse import parse_text

TEXTS = {text.name: text for text in standard_texts()}


def sections(page: str) -> dict[str, str]:
    """What stands under each heading of a rule."""
    return dict(re.findall(r"^### (\S+)\n\n(.*?)(?=^#|\Z)", page, re.MULTILINE | re.DOTALL))


@pytest.mark.parametrize("text", TEXTS.values(), ids=list(TEXTS))
def test_a_page_has_every_declaration_of_its_text(text: SourceText) -> None:
    page = standard_page(text, load_standard())
    for each in text.declarations:
        if isinstance(each, Clause):
            assert f"| {each.id} | {each.level.value} | {each.wording} |" in page
        elif isinstance(each, ObjectEntry):
            assert f" {each.name} " in page
        elif named := getattr(each, "name", None):
            assert re.search(rf"\b{named}\b", page), named


@pytest.mark.parametrize("text", TEXTS.values(), ids=list(TEXTS))
def test_each_rule_stands_with_the_words_of_its_clauses(text: SourceText) -> None:
    told = sections(standard_page(text, load_standard()))
    machines = [each for each in text.declarations if isinstance(each, Machine | Extend)]
    rows: list[Rule | Gap] = [row for machine in machines for row in machine.rules]
    rows += [row for machine in machines for row in machine.gaps]
    assert set(told) == {row.name for row in rows}
    for row in rows:
        for name in row.clauses:
            clause = load_standard().clauses[name]
            assert f"- **{name}** {clause.level.value}: {clause.wording}" in told[row.name]


def test_what_is_shown_as_code_is_a_text_again() -> None:
    page = standard_page(TEXTS["mailbox"], load_standard())
    block = page.partition("\n## Layouts\n\n")[2].partition("\n## ")[0]
    code = re.sub(r"^    ", "", block, flags=re.MULTILINE)
    again = parse_text(f'standard mailbox "x"\n{code}', "x.ecs")
    frames = [each for each in TEXTS["mailbox"].declarations if isinstance(each, Frame)]
    assert list(again.declarations) == frames


def test_the_grammar_has_all_productions_and_nothing_that_only_the_parser_needs() -> None:
    grammar = resources.files(language).joinpath("grammar.lark").read_text(encoding="utf-8")
    parser = Lark(grammar, parser="lalr")
    wanted = {rule.origin.name for rule in parser.rules if not rule.origin.name.startswith("_")}
    wanted |= {
        t.name for t in parser.terminals if re.search(rf"^{t.name}\b", grammar, re.MULTILINE)
    }
    page = grammar_page(grammar)
    assert set(re.findall(r"^    (\w+): ", page, re.MULTILINE)) == wanted
    assert "->" not in page
    assert "%ignore" not in page
