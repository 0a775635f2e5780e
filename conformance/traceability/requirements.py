"""Writes clauses as ReqIF, for requirements management tools."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final
from uuid import NAMESPACE_URL, uuid5

from reqif.models.reqif_core_content import ReqIFCoreContent
from reqif.models.reqif_data_type import ReqIFDataTypeDefinitionString
from reqif.models.reqif_namespace_info import ReqIFNamespaceInfo
from reqif.models.reqif_req_if_content import ReqIFReqIFContent
from reqif.models.reqif_reqif_header import ReqIFReqIFHeader
from reqif.models.reqif_spec_hierarchy import ReqIFSpecHierarchy
from reqif.models.reqif_spec_object import ReqIFSpecObject, SpecObjectAttribute
from reqif.models.reqif_spec_object_type import ReqIFSpecObjectType, SpecAttributeDefinition
from reqif.models.reqif_specification import ReqIFSpecification
from reqif.models.reqif_specification_type import ReqIFSpecificationType
from reqif.models.reqif_types import SpecObjectAttributeType
from reqif.object_lookup import ReqIFObjectLookup
from reqif.reqif_bundle import ReqIFBundle
from reqif.unparser import ReqIFUnparser

from ecatspec.conformance.traceability.trace import shown_cases

if TYPE_CHECKING:
    from collections.abc import Sequence
    from datetime import datetime

    from ecatspec.conformance.traceability.trace import Trace, Traced

_STRING: Final = "ecatspec-string"
_CLAUSE: Final = "ecatspec-clause"
_DEVICE: Final = "ecatspec-device"
_LONGEST: Final = "65535"
_ATTRIBUTES: Final = {
    "level": "ecatspec.Level",
    "text": "ReqIF.Text",
    "id": "ReqIF.ForeignID",
    "source": "ecatspec.Source",
    "claims": "ecatspec.Claims",
    "specified": "ecatspec.Specified",
    "standing": "ecatspec.Standing",
    "because": "ecatspec.Because",
    "violation": "ecatspec.Violation",
    "cases": "ecatspec.Cases",
    "verdict": "ecatspec.LastRun",
}
"""What a clause tells, and the name under which requirement tools show it."""


def reqif(traces: Sequence[Trace], now: datetime) -> str:
    """Give the clauses as a ReqIF 1.0 file, one specification for each device.

    Identifiers stay the same from export to export, so that a tool sees changes and no copies.
    `now` is when the file was made, with its time zone.
    """
    when = now.isoformat(timespec="seconds")
    objects = [_object(row, trace, when) for trace in traces for row in trace.rows]
    content = ReqIFReqIFContent(
        data_types=[
            ReqIFDataTypeDefinitionString(
                _STRING, last_change=when, long_name="text", max_length=_LONGEST
            )
        ],
        spec_types=[
            ReqIFSpecObjectType(
                _CLAUSE,
                last_change=when,
                long_name="clause",
                attribute_definitions=[
                    SpecAttributeDefinition(
                        SpecObjectAttributeType.STRING,
                        _attribute(name),
                        _STRING,
                        last_change=when,
                        long_name=long_name,
                    )
                    for name, long_name in _ATTRIBUTES.items()
                ],
            ),
            ReqIFSpecificationType(_DEVICE, last_change=when, long_name="device"),
        ],
        spec_objects=objects,
        spec_relations=[],
        specifications=[_specification(trace, when) for trace in traces],
        spec_relation_groups=[],
    )
    header = ReqIFReqIFHeader(
        identifier=_identifier("header", *(trace.protocol.name for trace in traces)),
        creation_time=when,
        repository_id="ecatspec",
        req_if_tool_id="ecatspec",
        req_if_version="1.0",
        source_tool_id="ecatspec",
        title="ecatspec: " + ", ".join(trace.protocol.name for trace in traces),
    )
    bundle = ReqIFBundle(
        namespace_info=ReqIFNamespaceInfo.create_default(),
        req_if_header=header,
        core_content=ReqIFCoreContent(content),
        tool_extensions_tag_exists=False,
        lookup=ReqIFObjectLookup.empty(),
        exceptions=[],
    )
    return str(ReqIFUnparser.unparse(bundle))


def _attribute(name: str) -> str:
    return f"ecatspec-{name}"


def _identifier(*parts: str) -> str:
    return f"_{uuid5(NAMESPACE_URL, '/'.join(('ecatspec', *parts)))}"


def _object(row: Traced, trace: Trace, when: str) -> ReqIFSpecObject:
    clause = row.clause
    values = {
        "level": clause.level.value,
        "text": clause.wording,
        "id": clause.id,
        "source": clause.source,
        "claims": ", ".join(clause.claims),
        "specified": "; ".join(f"{p.kind} {p.name} ({p.at})" for p in row.places),
        "standing": row.standing.value,
        "because": clause.because or "",
        "violation": "" if row.evidence is None else row.evidence.violation,
        "cases": ", ".join(shown_cases(row)),
        "verdict": row.verdict,
    }
    attributes = [
        SpecObjectAttribute(SpecObjectAttributeType.STRING, _attribute(name), value)
        for name, value in values.items()
        if value
    ]
    return ReqIFSpecObject(
        _identifier(trace.protocol.name, clause.id),
        attributes,
        _CLAUSE,
        last_change=when,
        long_name=clause.id,
    )


def _specification(trace: Trace, when: str) -> ReqIFSpecification:
    name = trace.protocol.name
    children = [
        ReqIFSpecHierarchy(
            identifier=_identifier(name, row.clause.id, "place"),
            spec_object=_identifier(name, row.clause.id),
            level=1,
            last_change=when,
        )
        for row in trace.rows
    ]
    return ReqIFSpecification(
        _identifier(name),
        last_change=when,
        long_name=trace.protocol.wording,
        specification_type=_DEVICE,
        children=children,
    )
