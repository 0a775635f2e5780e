"""Keeps what functions of a model and of frozen arguments gave."""

from __future__ import annotations

from functools import wraps
from typing import TYPE_CHECKING, Final, TypeVar, TypeVarTuple

if TYPE_CHECKING:
    from collections.abc import Callable

    from ecatspec.model.core.compilation import Model

_Arguments = TypeVarTuple("_Arguments")
_R = TypeVar("_R")
_NONE_YET: Final = object()


def once(
    function: Callable[[Model, *_Arguments], _R],
) -> Callable[[Model, *_Arguments], _R]:
    """Give the same function, evaluated once for the same arguments; the model keeps the answers.

    The arguments are hashable, and the answer must not be changed by anybody.
    """

    @wraps(function)
    def remember(model: Model, /, *arguments: *_Arguments) -> _R:
        answers = model.answers[function]
        # one look only: hashes of tuples are worked out at each
        answer: _R = answers.get(arguments, _NONE_YET)
        if answer is _NONE_YET:
            answer = function(model, *arguments)
            answers.keep(arguments, answer)
        return answer

    return remember
