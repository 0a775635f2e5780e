"""The only place for Hypothesis strategies made from the texts."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hypothesis import strategies as st

from ecatspec.generators.case import SendFrame, Stimulus
from ecatspec.generators.sdo_cover import EXPEDITED, download, upload

if TYPE_CHECKING:
    from ecatspec.model.compiled import Model


def indexes(model: Model) -> st.SearchStrategy[tuple[int, int]]:
    """Draw declared entries, near misses of them, and anything."""
    declared = [(entry.index, entry.subindex) for entry in model.protocol.objects]
    near = [(index, subindex + 1) for index, subindex in declared]
    anything = st.tuples(st.integers(0, (1 << 16) - 1), st.integers(0, (1 << 8) - 1))
    return st.one_of(st.sampled_from(declared), st.sampled_from(near), anything)


def uploads(model: Model) -> st.SearchStrategy[SendFrame]:
    """Draw upload requests."""
    return indexes(model).map(lambda key: upload(*key))


def downloads(model: Model) -> st.SearchStrategy[SendFrame]:
    """Draw expedited downloads of 1 to 4 bytes."""
    values = st.binary(min_size=1, max_size=EXPEDITED)
    return st.tuples(indexes(model), values, st.booleans()).map(
        lambda drawn: download(*drawn[0], drawn[1], sized=drawn[2])
    )


def commands(model: Model) -> st.SearchStrategy[SendFrame]:
    """Draw SDO requests with any command specifier and any content."""
    width = model.protocol.tables["client_command"].width
    drawn = st.tuples(st.integers(0, (1 << width) - 1), st.binary(min_size=7, max_size=7))
    return drawn.map(lambda pair: SendFrame("sdo_request", {"command": pair[0], "rest": pair[1]}))


def requests(model: Model, steps: int) -> st.SearchStrategy[list[Stimulus]]:
    """Draw runs of 1 to `steps` requests."""
    one = st.one_of(uploads(model), downloads(model), commands(model))
    return st.lists(one, min_size=1, max_size=steps)
