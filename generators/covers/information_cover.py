"""Cases of SDO information: lists, descriptions, refusals."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.generators.cases.bringup import case_in
from ecatspec.generators.cases.case import Case, Limits, SendFrame, Stimulus
from ecatspec.generators.cases.transfers import entry_request, list_request, object_request, upload
from ecatspec.generators.covers.complete_access_cover import objects
from ecatspec.generators.covers.sdo_cover import (
    compared_indexes,
    missing_indexes,
    missing_subindexes,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.model.core.compilation import Model

_LAST = (1 << 16) - 1
_ALL_VALUES = (1 << 7) - 1


def information_cover(model: Model, _: Limits) -> Iterator[Case]:
    """Yield the cases: every list, every object with its entries, what does not exist."""
    kinds = sorted(r.value for r in model.protocol.tables["object_list_type"].rows)
    stimuli: list[Stimulus] = []
    for kind in (*kinds, kinds[-1] + 1, _LAST):
        yield _case(model, f"list/{kind}", f"object list of type {kind}", [list_request(kind)])
    all_objects = list_request(model.row("object_list_type", "all"))
    yield _case(model, "list_twice", "the list of all objects twice", [all_objects, all_objects])
    for index, entries in objects(model).items():
        stimuli = [object_request(index)]
        stimuli += [entry_request(index, entry.subindex) for entry in entries]
        yield _case(model, f"object/{index:04X}", "description of an object", stimuli)
        last = entry_request(index, entries[-1].subindex, _ALL_VALUES)
        yield _case(model, f"values/{index:04X}", "description with all values", [last])
    declared = objects(model).keys()
    edges = [index for index in compared_indexes(model) if index not in declared]
    for index in dict.fromkeys((*missing_indexes(model), *edges)):
        stimuli = [object_request(index), entry_request(index, 0)]
        yield _case(model, f"no_object/{index:04X}", "description of a missing object", stimuli)
    for index, subindexes in missing_subindexes(model).items():
        name = f"no_subindex/{index:04X}"
        asked: list[Stimulus] = [entry_request(index, subindex) for subindex in subindexes]
        yield _case(model, name, "description of a missing subindex", asked)
    requests = {"list_request", "object_request", "entry_request"}
    table = model.protocol.tables["information_opcode"]
    answers = [r.value for r in table.rows if r.name not in requests]
    for opcode in (0, *answers, table.rows[-1].value + 1, (1 << table.width) - 1):
        odd = SendFrame("sdo_information", {"opcode": opcode, "information": bytes(4)})
        yield _case(model, f"opcode/{opcode}", "an opcode that is no request", [odd])
    first = model.protocol.objects[0]
    ask = upload(first.index, first.subindex)
    title = "SDO requests between SDO information requests"
    mixed: list[Stimulus] = [
        object_request(first.index),
        ask,
        all_objects,
        ask,
        entry_request(first.index, 0),
    ]
    yield _case(model, "mixed", title, mixed)


def _case(model: Model, name: str, title: str, stimuli: list[Stimulus]) -> Case:
    return case_in(model, f"sdo_information/{name}", title, stimuli)
