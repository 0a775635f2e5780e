"""Symbols for the answers of the object dictionary.

An answer that the texts fix is that value. Another is a symbol, with what follows from the declared
objects; where the objects are not known (the standard has none) only with what follows from the
meaning of the functions.
"""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, Final

from ecatspec.model.core.expressions import Environment
from ecatspec.model.core.object_dictionary import size_of, size_varies
from ecatspec.model.symbolic.symbolic_state import Anything, Content
from ecatspec.model.symbolic.terms import (
    Symbols,
    Term,
    all_of,
    any_of,
    compared,
    equal,
    key_of,
    negated,
    within,
)
from ecatspec.spec.language.functions import FUNCTIONS
from ecatspec.spec.language.ir import Access, Bool, Bytes, SInt

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.values import ObjectKey
    from ecatspec.model.symbolic.symbolic_state import Maker, Meant, World
    from ecatspec.spec.language.ir import ObjectEntry

STATIC: Final = frozenset(
    {
        "declared", "object_exists", "is_plain_variable", "readable", "writable", "range_known",
        "size_of", "size_varies", "size_unsaid", "object_code_of", "highest_subindex",
        "data_type_of", "bit_length_of", "complete_size", "mappable",
    }
)  # fmt: skip
"""What depends on the declared objects only."""

PRESENT: Final = frozenset(
    {
        "number_of", "has_value", "value_of", "image_size", "mapped", "assigned_pdos", "pdo_bits",
        "repeated", "can_hold", "holds", "present_size", "counted_size", "complete_value",
        "complete_readable", "complete_writable", "readable_now", "writable_now",
    }
)  # fmt: skip
"""What depends on what objects hold, or on the AL state, at the time."""

_RANGE: Final = ("in_range", "too_high", "too_low")
_AL_STATE: Final = "al.state"


class Answers:
    """The answers of the dictionary of one specification."""

    def __init__(self, model: Model, symbols: Symbols, *, abstract: bool) -> None:
        """Take the model whose dictionary answers where the arguments are known."""
        self._model = model
        self._symbols = symbols
        self._abstract = abstract
        self._entries: dict[ObjectKey, ObjectEntry] = model.dictionary.entries
        self._functions = model.dictionary.functions | model.image.functions
        self.asked: dict[str, tuple[str, tuple[Meant, ...]]] = {}
        """By the name of a symbol the question that it answers."""

    def truth(self, function: str, arguments: tuple[object, ...], label: str) -> Term:
        """Give the symbol of an answer that is true or false."""
        return self._symbols.truth(f"{function}{arguments}", label, Bool(), abstract=True)

    def ask(
        self, meaning: Maker, name: str, values: tuple[Meant, ...], world: World, label: str
    ) -> Meant:
        """Give the answer to a question of the dictionary."""
        assert not any(isinstance(value, Anything) for value in values)
        if name == "dictionary_closed":
            closed = self._model.dictionary.closed
            return self.truth(name, (), label) if self._abstract and not closed else closed
        if name in {"is_assignment", "is_mapping"} and not isinstance(values[0], bytes):
            return self._configures(name, values[0])
        if name == "number" and isinstance(values[0], Content):
            return self._number(meaning, values[0], label)
        known = [value for value in values if isinstance(value, int)]
        numbers = len(known) == len(values)
        if numbers and name in STATIC and not self._abstract:
            found = self._functions[name](Environment((), {}, {}), tuple(known))
            if isinstance(found, int):
                return found
        if numbers and name == "number_of" and not self._abstract:
            entry = self._entries.get((known[0], known[1]))
            if entry is not None and entry.constant and isinstance(entry.default, int):
                return entry.default
        parts = tuple(
            value.name if isinstance(value, Content) else key_of(value) for value in values
        )
        stamp = world.stamp if name in PRESENT else ""
        symbol_name = f"{name}{parts}{stamp and f' @{stamp}'}"
        if name in {"readable_now", "writable_now"}:
            symbol_name += f" {key_of(world.get(_AL_STATE))}"
        new = symbol_name not in self._symbols.known
        self.asked[symbol_name] = (name, values)
        result = FUNCTIONS[name].result
        answer = meaning.of_kind(symbol_name, label, result, abstract=True)
        if new and not isinstance(result, Bytes):
            self._tell(meaning, name, values, world, answer, label)
        return answer

    def _number(self, meaning: Maker, content: Content, label: str) -> Term:
        """Give bytes as a number, which is as large as its bytes allow."""
        name = f"number({content.name})"
        new = name not in self._symbols.known
        number = meaning.of_kind(name, label, FUNCTIONS["number"].result)
        for size in range(4) if new else ():
            short = compared("<=", content.length, size)
            self._symbols.fact(number, _implies(short, compared("<", number, 1 << 8 * size)))
        return number

    def _configures(self, name: str, index: Term) -> Term:
        image = self._model.image
        if name == "is_assignment":
            return any_of(equal(index, number) for number in image.assignments.values())
        ranges = image.pdos.values()
        return any_of(within(index, pdos[0], pdos[-1]) for pdos in ranges)

    # --- what is told -----------------------------------------------------------------------------

    def _tell(
        self,
        meaning: Maker,
        name: str,
        values: tuple[Meant, ...],
        world: World,
        answer: Term,
        label: str,
    ) -> None:
        def also(function: str, count: int) -> Term:
            inner = f"{function}{label[label.index('(') :]}"
            return self.ask(meaning, function, values[:count], world, inner)

        def holds(term: Term) -> None:
            self._symbols.fact(answer, term)

        match name:
            case "declared":
                holds(_implies(answer, also("object_exists", 1)))
            case "is_plain_variable":
                holds(_implies(answer, also("object_exists", 1)))
            case "readable_now" | "writable_now":
                holds(_implies(answer, also(name.removesuffix("_now"), 2)))
                self._in_states(name, values, world, answer)
            case "size_of":
                holds(any_of((also("size_varies", 2), compared(">", answer, 0))))
            case "size_unsaid":
                holds(_implies(answer, also("size_varies", 2)))
            case "size_allowed":
                varies, size = also("size_varies", 2), also("size_of", 2)
                fits = compared("<=", values[2], size)
                holds(_implies(varies, equal(answer, fits)))
                holds(_implies(negated(varies), equal(answer, equal(values[2], size))))
            case "present_size":
                varies, size = also("size_varies", 2), also("size_of", 2)
                holds(compared("<=", answer, size))
                holds(_implies(negated(varies), equal(answer, size)))
            case "in_range" | "too_high" | "too_low":
                one, two, three = (also(function, 3) for function in _RANGE)
                holds(any_of((one, two, three)))
                holds(negated(any_of((all_of((one, two)), all_of((one, three))))))
                holds(negated(all_of((two, three))))
                holds(any_of((also("range_known", 2), one)))
                if not self._abstract and isinstance(values[2], Content):
                    number = self._number(meaning, values[2], f"number({label})")
                    self._ranges(values, number, answer, two, three)
            case "pdo_bits":
                holds(any_of((also("is_mapping", 1), equal(answer, 0))))
            case "complete_in_range" if not self._abstract:
                holds(_implies(_place(values, self._unbounded(), of_index=False), answer))
            case "number_of":
                match values:
                    case (int(index), int(subindex)):
                        self._bounded((index, subindex), answer)
                    case _:
                        pass
            case _:
                pass
        if name in STATIC and not self._abstract:
            self._table(name, values, answer)

    def _unbounded(self) -> list[ObjectKey]:
        """Give the entries from which on no entry of the object has a range."""
        ends = dict(sorted(k for k, e in self._entries.items() if e.low is not None))
        return [key for key in self._entries if key[1] > ends.get(key[0], -1)]

    def _bounded(self, key: ObjectKey, answer: Term) -> None:
        entry = self._entries.get(key)
        if entry is None or size_varies(entry):
            return
        width = 8 * size_of(entry)
        signed = isinstance(entry.type, SInt)
        low = -(1 << (width - 1)) if signed else 0
        self._symbols.fact(answer, within(answer, low, low + (1 << width) - 1))

    def _table(self, name: str, values: tuple[Meant, ...], answer: Term) -> None:
        """Tell the answers for all declared objects, and what follows for all others."""
        keys: Iterable[ObjectKey] = self._entries
        of_index = len(FUNCTIONS[name].arguments) == 1
        if of_index:
            keys = [(index, 0) for index in sorted({index for index, _ in self._entries})]
        rows: dict[int, list[ObjectKey]] = defaultdict(list)
        for key in keys:
            arguments = key[:1] if of_index else key
            found = self._functions[name](Environment((), {}, {}), arguments)
            if isinstance(found, int):
                rows[found].append(key)
        places = {value: _place(values, held, of_index) for value, held in rows.items()}
        if name in {"declared", "object_exists"}:
            self._symbols.fact(answer, equal(answer, places.get(True, False)))
            return
        for value, place in places.items():
            self._symbols.fact(answer, _implies(place, equal(answer, value)))

    def _ranges(
        self, values: tuple[Meant, ...], number: Term, answer: Term, high: Term, low: Term
    ) -> None:
        """Tell what is above and below the ranges of declared numbers without a sign."""
        for key, entry in self._entries.items():
            if entry.low is not None and entry.high is not None and entry.low >= 0:
                place = _place(values, [key], of_index=False)
                above, below = compared(">", number, entry.high), compared("<", number, entry.low)
                fits = all_of((equal(high, above), equal(low, below)))
                self._symbols.fact(answer, _implies(place, fits))

    def _in_states(self, name: str, values: tuple[Meant, ...], world: World, answer: Term) -> None:
        """Tell in which AL states declared objects can be read or written."""
        if self._abstract:
            return
        reading = name == "readable_now"
        wanted: dict[tuple[str, ...], list[ObjectKey]] = defaultdict(list)
        never = Access.WRITE if reading else Access.READ
        for key, entry in self._entries.items():
            if entry.access not in {never, Access.NONE}:
                wanted[entry.read_states if reading else entry.states].append(key)
        now = world.get(_AL_STATE)
        for states, keys in wanted.items():
            fits = (
                any_of(equal(now, self._model.row("al_state", name)) for name in states)
                if states
                else True
            )
            self._symbols.fact(
                answer, _implies(_place(values, keys, of_index=False), equal(answer, fits))
            )


def _implies(first: Term, second: Term) -> Term:
    return any_of((negated(first), second))


def _place(values: tuple[Meant, ...], keys: list[ObjectKey], of_index: bool) -> Term:  # noqa: FBT001
    """Give what holds where index and subindex are one of the keys."""
    places: dict[int, list[int]] = defaultdict(list)
    for index, subindex in keys:
        places[index].append(subindex)
    parts = []
    for index, subindices in places.items():
        if of_index:
            parts.append(equal(values[0], index))
        else:
            inner = any_of(within(values[1], low, high) for low, high in _runs(subindices))
            parts.append(all_of((equal(values[0], index), inner)))
    return any_of(parts)


def _runs(numbers: list[int]) -> list[tuple[int, int]]:
    runs: list[tuple[int, int]] = []
    for number in sorted(numbers):
        if runs and runs[-1][1] == number - 1:
            runs[-1] = (runs[-1][0], number)
        else:
            runs.append((number, number))
    return runs
