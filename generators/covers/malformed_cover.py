"""Makes cases of malformed messages: the families of every request."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.generators.cases.bringup import case_in
from ecatspec.generators.cases.message_mutation import Family, Variant, family_of, request_frames
from ecatspec.generators.cases.transfers import initiate, pattern, segment_room
from ecatspec.generators.covers.mailbox_cover import probe_entry
from ecatspec.generators.covers.transfer_cover import transfer_target
from ecatspec.model.core.object_dictionary import size_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.generators.cases.case import Case, Limits, Stimulus
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.values import Value


def family_cover(model: Model, limits: Limits) -> Iterator[Case]:
    """Yield each variant of each request once, where a valid one would be served."""
    known = probe_entry(model)
    if known is None:
        return
    target = transfer_target(model) or known
    least = model.parameter("smallest_data_field")
    size = min(size_of(target), least + 1, segment_room(model, limits))
    place: dict[str, Value] = {"index": target.index, "subindex": target.subindex}
    begin = initiate(target.index, target.subindex, size, b"")
    bases: dict[str, tuple[dict[str, Value], list[Stimulus]]] = {
        "sdo_upload_request": ({"index": known.index, "subindex": known.subindex}, []),
        "sdo_download_expedited": ({**place, "size_indicated": True, "value": b"\1"}, []),
        "sdo_download_normal": (
            {**place, "size_indicated": True, "size": size, "value": pattern(size)},
            [],
        ),
        "sdo_download_segment": ({"last": True, "value": pattern(size)}, [begin]),
        "sdo_upload_segment": ({}, []),
        "sdo_abort": (place, []),
        "information_list_request": ({"list_type": model.row("object_list_type", "all")}, []),
        "information_object_request": ({"index": known.index}, []),
        "information_entry_request": ({"index": known.index, "subindex": known.subindex}, []),
    }
    for frame in request_frames(model):
        if frame not in bases:
            continue
        base, before = bases[frame]
        for variant in family_of(model, frame, base):
            layer = "sdo_information" if frame.startswith("information") else "sdo"
            name = f"{layer}/{variant.family}/{frame}/{variant.name}"
            title = f"{variant.family} {frame}: {variant.name.replace('_', ' ')}"
            yield case_in(
                model,
                name,
                title,
                [*before, variant.stimulus],
                flag=variant.flag,
                feature=_feature(variant, least),
            )


def _feature(variant: Variant, least: int) -> str:
    """Give what the way to a device must carry for this variant."""
    frame, fields = variant.stimulus.frame, variant.stimulus.fields
    if variant.family is Family.MALFORMED:
        return "malformed"
    if fields.get("complete_access"):
        return "complete_access"
    if frame == "sdo_download_normal":
        return "data_in_initiate"
    value = fields.get("value")
    longer = frame == "sdo_download_segment" and isinstance(value, bytes) and len(value) > least
    return "oversized" if longer or fields.get("excess") else ""
