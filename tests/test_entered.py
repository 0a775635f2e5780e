"""Tests of what holds in a state since a rule led there."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import pytest

from ecatspec.model.analysis.as_built import as_built
from ecatspec.model.analysis.entry_facts import with_guesses
from ecatspec.model.symbolic.proofs import Prover
from ecatspec.model.symbolic.smt_encoding import Meaning
from ecatspec.spec.language.load import load_device
from ecatspec.spec.language.pretty_expressions import pretty_expression

if TYPE_CHECKING:
    from ecatspec.spec.language.ir import Property

pytest.importorskip("z3")


@cache
def guessed() -> tuple[dict[str, Property], Prover]:
    built = as_built(load_device("reference-drive"))
    protocol = with_guesses(built)
    guesses = {n: p for n, p in protocol.properties.items() if n not in built.properties}
    meaning = Meaning(built, abstract=False)
    return guesses, Prover(protocol, meaning=meaning)


HELD = {
    "sdo.size == complete_size(sdo.index, sdo.subindex)",
    "declared(sdo.index, sdo.subindex)",
    "not is_plain_variable(sdo.index)",
}


def test_what_a_rule_asked_is_said_in_words_of_what_it_kept() -> None:
    guesses, _ = guessed()
    said = {pretty_expression(guess.value) for guess in guesses.values()}
    for state, complete, what in (
        ("DOWNLOADING", "true", "sdo.size == complete_size(sdo.index, sdo.subindex)"),
        ("DOWNLOADING", "false", "declared(sdo.index, sdo.subindex)"),
        ("UPLOADING", "true", "not is_plain_variable(sdo.index)"),
        ("UPLOADING", "false", "not expedited_upload"),
    ):
        begin = f"not (sdo.state == {state} and sdo.complete == {complete}) or "
        assert (begin + what in said) is (what in HELD), what


def test_a_guess_that_fails_is_taken_out() -> None:
    """More data come, and an AL state may be left; the entry that was asked for stays."""
    guesses, prover = guessed()
    kept = set(guesses) - prover.unproved()
    words = {pretty_expression(guesses[name].value).partition(" or ")[2] for name in kept}
    assert words > {"declared(sdo.index, sdo.subindex)"}
    every = {pretty_expression(guess.value).partition(" or ")[2] for guess in guesses.values()}
    assert "writable_now(sdo.index, sdo.subindex)" in every - words


def test_every_input_is_met_but_what_comes_again_and_again() -> None:
    _, prover = guessed()
    met, further = prover.met()
    inputs = {(m.moment.scope.machine, m.moment.scope.input) for m in met}
    assert {("mailbox", "mail"), ("sdo", "commit"), ("al", "watchdog")} <= inputs
    assert {name.machine for name in further} == {"sdo_information"}
