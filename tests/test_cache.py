"""Tests of caches of limited size, and of the models that have them."""

import pytest

from ecatspec.model.core import compilation
from ecatspec.model.core.cache import Cache
from ecatspec.model.core.compilation import Model
from ecatspec.model.core.memo import once
from ecatspec.spec.language.load import load_device


def test_a_full_cache_forgets_its_oldest_entry_alone() -> None:
    cache: Cache[int, str] = Cache(2)
    for key in (1, 2, 3):
        cache.keep(key, str(key))
    assert dict(cache) == {2: "2", 3: "3"}


def test_each_model_keeps_its_own_answers_and_not_more_than_the_limit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(compilation, "_ANSWERS", 2)
    asked: list[tuple[bool, int]] = []

    @once
    def answer(model: Model, number: int) -> int:
        asked.append((model.dictionary.closed, number))
        return number

    model = Model(load_device("kollmorgen-akd"))
    for each, number in ((model, 1), (model, 2), (model, 1), (model.as_closed, 1)):
        assert answer(each, number) == number
    assert asked == [(False, 1), (False, 2), (True, 1)]
    assert [answer(model, number) for number in (3, 2, 1)] == [3, 2, 1]
    assert asked[3:] == [(False, 3), (False, 1)]


def test_a_model_is_open_or_closed_for_good() -> None:
    model = Model(load_device("kollmorgen-akd"))
    closed = model.as_closed
    assert (model.dictionary.closed, closed.dictionary.closed) == (False, True)
    assert closed is model.as_closed is closed.as_closed
    assert Model(model.protocol, assuming=True).as_closed.assuming
