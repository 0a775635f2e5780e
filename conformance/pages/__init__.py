"""Fills pages of HTML: one self-contained file each, in one style."""

from __future__ import annotations

from functools import cache
from importlib import resources

from jinja2 import Environment, FunctionLoader, StrictUndefined

from ecatspec.conformance.render.marks import plain


def render(template: str, **values: object) -> str:
    """Give the page of a template; whatever is put in is words, unless it is markup of ours."""
    return _environment().get_template(template).render(values)


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FunctionLoader(_source),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["plain"] = plain
    return environment


def _source(name: str) -> str:
    return resources.files(__name__).joinpath(name).read_text("utf-8")
