"""The functions of the language, and the names that it knows by itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from ecatspec.spec.language.ir import (
    Bool,
    Bytes,
    InputKind,
    SInt,
    Time,
    Type,
    UInt,
)


@dataclass(frozen=True, slots=True)
class FunctionSignature:
    """Types of arguments and result of a built-in function, and what it tells."""

    arguments: tuple[Type, ...]
    result: Type
    wording: str


_INDEX: Final = UInt(16)
_SUBINDEX: Final = UInt(8)
_ENTRY: Final = (_INDEX, _SUBINDEX)
_DATA: Final = Bytes(None)
_COUNT: Final = UInt(32)
FUNCTIONS: Final[dict[str, FunctionSignature]] = {
    "declared": FunctionSignature(_ENTRY, Bool(), "a text declares the entry"),
    "object_exists": FunctionSignature((_INDEX,), Bool(), "the device has the object"),
    "readable": FunctionSignature(_ENTRY, Bool(), "the entry can be read in some AL state"),
    "writable": FunctionSignature(_ENTRY, Bool(), "the entry can be written in some AL state"),
    "readable_now": FunctionSignature(_ENTRY, Bool(), "the entry can be read in this AL state"),
    "writable_now": FunctionSignature(_ENTRY, Bool(), "the entry can be written in this AL state"),
    "size_of": FunctionSignature(_ENTRY, UInt(32), "bytes that the entry has at most"),
    "size_varies": FunctionSignature(_ENTRY, Bool(), "the entry may hold fewer bytes than that"),
    "size_unsaid": FunctionSignature(
        _ENTRY, Bool(), "no text says whether the size of the string varies"
    ),
    "present_size": FunctionSignature(_ENTRY, UInt(32), "bytes that an upload may announce now"),
    "size_allowed": FunctionSignature(
        (*_ENTRY, _COUNT), Bool(), "a number of bytes can be written"
    ),
    "value_of": FunctionSignature(_ENTRY, _DATA, "the present value as bytes on the wire"),
    "range_known": FunctionSignature(_ENTRY, Bool(), "a text states the range of the entry"),
    "in_range": FunctionSignature((*_ENTRY, _DATA), Bool(), "the range of the entry allows it"),
    "too_high": FunctionSignature((*_ENTRY, _DATA), Bool(), "above the range of the entry"),
    "too_low": FunctionSignature((*_ENTRY, _DATA), Bool(), "below the range of the entry"),
    "is_plain_variable": FunctionSignature((_INDEX,), Bool(), "the object has subindex 0 only"),
    "complete_size": FunctionSignature(_ENTRY, UInt(32), "bytes from this subindex on, padded"),
    "counted_size": FunctionSignature(
        _ENTRY, UInt(32), "bytes from this subindex to that which subindex 0 counts, padded"
    ),
    "complete_value": FunctionSignature(_ENTRY, _DATA, "the object from this subindex on"),
    "complete_in_range": FunctionSignature((*_ENTRY, _DATA), Bool(), "all ranges allow the bytes"),
    "complete_readable": FunctionSignature(_ENTRY, Bool(), "every entry from there can be read"),
    "complete_writable": FunctionSignature(_ENTRY, Bool(), "every entry from there can be written"),
    "object_list": FunctionSignature((UInt(16),), _DATA, "the list of this type as it travels"),
    "object_code_of": FunctionSignature((_INDEX,), UInt(8), "variable, array or record"),
    "highest_subindex": FunctionSignature((_INDEX,), UInt(8), "the highest subindex to be told"),
    "mappable": FunctionSignature(_ENTRY, Bool(), "the entry can travel as process data"),
    "data_type_of": FunctionSignature(_ENTRY, UInt(16), "the number of the entry's type"),
    "bit_length_of": FunctionSignature(_ENTRY, UInt(16), "bits that the entry has"),
    "readable_in": FunctionSignature((*_ENTRY, UInt(4)), Bool(), "can be read in this AL state"),
    "writable_in": FunctionSignature((*_ENTRY, UInt(4)), Bool(), "can be written in this AL state"),
    "in_work": FunctionSignature((), Bool(), "an earlier request was unanswered when this came"),
    "length": FunctionSignature((_DATA,), UInt(32), "how many bytes there are"),
    "join": FunctionSignature((_DATA, _DATA), _DATA, "the second after the first"),
    "cut": FunctionSignature((_DATA, _COUNT), _DATA, "the first bytes, up to a length"),
    "zeros": FunctionSignature((_COUNT,), _DATA, "a number of zero bytes"),
    "word": FunctionSignature((UInt(16),), _DATA, "the number in two bytes"),
    "piece": FunctionSignature(
        (_DATA, _COUNT, _COUNT, _COUNT),
        _DATA,
        "from an offset on, of a least and a greatest length",
    ),
    "numbered": FunctionSignature(
        (_DATA, _COUNT, _COUNT, _COUNT),
        _DATA,
        "bytes that are a number from, to, or that other one",
    ),
    "lesser": FunctionSignature((_COUNT, _COUNT), _COUNT, "the smaller number"),
    "dictionary_closed": FunctionSignature((), Bool(), "only declared objects exist"),
    "number": FunctionSignature((_DATA,), UInt(32), "the bytes as a number, the lowest first"),
    "number_of": FunctionSignature(_ENTRY, SInt(64), "the present value as a number"),
    "is_assignment": FunctionSignature(
        (_INDEX,), Bool(), "the object assigns PDOs to a SyncManager"
    ),
    "is_mapping": FunctionSignature((_INDEX,), Bool(), "the object maps entries into a PDO"),
    "can_hold": FunctionSignature(
        (*_ENTRY, _DATA), Bool(), "the PDO can be assigned there, or the object mapped"
    ),
    "mapped": FunctionSignature(
        (_INDEX, *_ENTRY), Bool(), "a PDO of the assignment holds the entry"
    ),
    "assigned_pdos": FunctionSignature((_INDEX,), _DATA, "the assigned PDOs, two bytes each"),
    "image_size": FunctionSignature(
        (_INDEX,), UInt(32), "bytes of the process data that an assignment object assigns"
    ),
    "pdo_bits": FunctionSignature(
        _ENTRY, UInt(32), "bits of the first entries of a PDO, up to a count"
    ),
    "repeated": FunctionSignature(
        (_INDEX,), Bool(), "the PDOs of the assignment map an entry more than once"
    ),
    "has_value": FunctionSignature((*_ENTRY, _DATA), Bool(), "the entry has this value already"),
    "holds": FunctionSignature(_ENTRY, Bool(), "a number of entries of the object is possible"),
    "bit": FunctionSignature((_COUNT, UInt(8)), Bool(), "this bit of the number is set"),
    "microseconds": FunctionSignature((_COUNT,), Time(), "a number of microseconds"),
    "rises": FunctionSignature((Bool(),), Bool(), "it is true now and was false before"),
    "falls": FunctionSignature((Bool(),), Bool(), "it is false now and was true before"),
}
EDGES: Final = {"rises": True, "falls": False}
"""What a parameter of the input is after the edge; its argument is such a parameter, by name."""
WITH_BEFORE: Final = frozenset({InputKind.WRITE, InputKind.WORD})
"""The kinds of inputs whose parameters had a value before."""
IMPLIES: Final = (
    ("readable_now", "readable"),
    ("writable_now", "writable"),
    ("declared", "object_exists"),
)
"""For the same entry: where the first holds, the second holds (of its first arguments)."""
EXCLUSIVE: Final = (frozenset({"in_range", "too_high", "too_low"}), frozenset(EDGES))
"""With the same arguments: at most one of these holds."""
STATE: Final = "state"
CYCLIC: Final = "cyclic"
IMAGE: Final = "image"
REPLY: Final = "reply"
AREA_PARTS: Final = {"start": UInt(16), "length": UInt(16)}
