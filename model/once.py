"""The only place for remembering what a function of a model and of frozen arguments gave."""

from __future__ import annotations

from functools import wraps
from typing import TYPE_CHECKING, Concatenate, ParamSpec, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

    from ecatspec.model.compiled import Model

_P = ParamSpec("_P")
_R = TypeVar("_R")
_MOST = 16384
"""So many answers of one function are kept; then it begins anew."""


def once(
    function: Callable[Concatenate[Model, _P], _R],
) -> Callable[Concatenate[Model, _P], _R]:
    """Give the same function, evaluated once for the same arguments; the model keeps the answers.

    The arguments are hashable, and the answer must not be changed by anybody.
    """

    @wraps(function)
    def remember(model: Model, /, *arguments: _P.args, **named: _P.kwargs) -> _R:
        # somebody may close the dictionary at any time
        answers = model.answers[model.dictionary.closed][function]
        key = (*arguments, *named.items()) if named else arguments
        if key in answers:
            answer: _R = answers[key]
            return answer
        if len(answers) >= _MOST:
            answers.clear()
        answer = answers[key] = function(model, *arguments, **named)
        return answer

    return remember
