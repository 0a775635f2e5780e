"""Keeps the evidence for clauses: violations, each with the case that finds it.

What a violation is: a planted fault of the clause, or a mutant of what rests on it. Evidence is
measured (`measure`) and kept in a file per device; here it is read, and held against the texts as
they are now: it counts no more once the clause, the violation or the case is another one.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, fields, is_dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.base.atomic_write import write_whole
from ecatspec.conformance.base.devices import UserError
from ecatspec.generators.mutation.data_mutants import data_mutants, frame_mutants
from ecatspec.generators.mutation.mutants import DEFINE, definitions_in, mutants
from ecatspec.model.analysis.as_built import as_built
from ecatspec.model.analysis.citations import object_name
from ecatspec.spec.language.diagnostics import SpecError
from ecatspec.spec.language.ir import Name, Remove, Replace, ReplaceField, Span
from ecatspec.spec.language.load import load_faults, load_standard, plant
from ecatspec.spec.language.nodes import nodes_in

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping

    from ecatspec.generators.mutation.mutants import Mutant
    from ecatspec.model.core.compilation import Model
    from ecatspec.spec.language.ir import Fault, Protocol

FAULT: Final = "fault "
_DIGITS: Final = 16
_FOLDER: Final = "evidence"


@dataclass(frozen=True, slots=True)
class Evidence:
    """That a run notices when a clause is violated: by this violation, in this case.

    `digest` is that of the clause when it was measured. `cited`: the verdict names the clause.
    """

    digest: str
    violation: str
    case: str
    cited: bool


@dataclass(frozen=True, slots=True)
class Violation:
    """A device that violates a clause: a planted fault, or a mutant of what rests on it.

    `about` are the rules, objects and registers where it shows, by the names of cases' footprints;
    `alone`: nothing else that a manual claims rests on what is wrong there.
    """

    name: str
    about: frozenset[str]
    alone: bool
    fault: Fault | None
    protocol: Protocol


def digest_of(protocol: Protocol, clause: str) -> str:
    """Give what changes with a clause."""
    return hashlib.sha256(_plain(protocol.clauses[clause]).encode()).hexdigest()[:_DIGITS]


def _plain(node: object) -> str:
    """Give data as text, without places."""
    match node:
        case tuple():
            return f"({','.join(map(_plain, node))})"
        case _ if is_dataclass(node) and not isinstance(node, type):
            values = (getattr(node, f.name) for f in fields(node))
            return f"({','.join(_plain(value) for value in values if not isinstance(value, Span))})"
        case _:
            return repr(node)


# --- the files ------------------------------------------------------------------------------------


def shipped() -> Path:
    """Give the folder with what was measured of the devices that are shipped."""
    return Path(str(files("ecatspec.conformance").joinpath(_FOLDER)))


def read(folder: Path, device: str) -> dict[str, Evidence]:
    """Give what was measured of a device, by clause.

    Raises:
        UserError: The file is no such file.

    """
    file = folder / f"{device}.json"
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
        return {name: Evidence(**row) for name, row in found["clauses"].items()}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise UserError(f"{file} is no file of evidence; measure again without it") from error


def write(folder: Path, device: str, measured: Mapping[str, Evidence]) -> None:
    """Keep what was measured of a device.

    Raises:
        OSError: The file cannot be written.

    """
    rows = {
        name: {f.name: getattr(each, f.name) for f in fields(each)}
        for name, each in sorted(measured.items())
    }
    data = {"device": device, "clauses": rows}
    text = json.dumps(data, indent=1, ensure_ascii=False)
    write_whole(folder / f"{device}.json", f"{text}\n")


# --- violations -----------------------------------------------------------------------------------


class _Where:
    """Where what is wrong shows: the rules, objects and registers that it has to do with."""

    def __init__(self, model: Model, built: Protocol, standard: Protocol) -> None:
        self._model = model
        self._standard = standard
        self._rules = {
            f"{machine.name}.{rule.name}": (machine.name, rule)
            for machine in built.machines.values()
            for rule in machine.rules
        }
        self._naming: dict[str, set[str]] = {}
        self._citing: dict[str, set[str]] = {}
        self._taking: dict[str, set[str]] = {}
        self._sending: dict[str, set[str]] = {}
        origins = {
            (machine.name, source.name): source.origin
            for machine in built.machines.values()
            for source in machine.inputs
        }
        definitions = built.definitions
        for place, (machine, rule) in self._rules.items():
            spoken = definitions_in(built, rule)
            parts = (rule, *(definitions[name].value for name in spoken))
            for path in {n.path for part in parts for n in nodes_in(part) if isinstance(n, Name)}:
                for name in (path, path.partition(".")[0], path.rpartition(".")[2]):
                    self._naming.setdefault(name, set()).add(place)
            for name in spoken:
                self._naming.setdefault(name, set()).add(place)
            for clause in rule.clauses:
                self._citing.setdefault(clause, set()).add(place)
            for origin in origins.get((machine, rule.input), ()):
                self._taking.setdefault(origin, set()).add(place)
            for send in rule.sends:
                self._sending.setdefault(send.frame, set()).add(place)
        self._inside = {name: set(_above(built, name)) for name in built.frames}

    def of(self, place: str) -> frozenset[str]:
        """Give what a place in the texts has to do with."""
        word, _, name = place.partition(" ")
        layout, _, field = name.partition(".")
        match word:
            case "define" | "pin" | "condition" | "parameter":
                return frozenset(self._naming.get(name, ()))
            case "object":
                return frozenset({name})
            case "register":
                named = self._naming.get(name, set())
                return frozenset({place, *self._taking.get(name, ()), *named})
            case "field":
                shown = {f"register {layout}", *self._taking.get(layout, ())}
                word_of = self._model.protocol.words.get(layout)
                if word_of is not None and word_of.key is not None:
                    shown.add(object_name(word_of.key))
                return frozenset(shown | self._naming.get(name, set()))
            case "frame":
                return self.sending({f for f, above in self._inside.items() if name in above})
            case "row":
                return frozenset(self._naming.get(name, self._naming.get(field, ())))
            case "remove" | "replace":
                return self._like(name)
            case "dictionary":
                return frozenset()
            case _:
                return self._like(place)

    def _like(self, place: str) -> frozenset[str]:
        """Give the rules that take the same input as a rule does, in some state of it."""
        machine, _, name = place.partition(".")
        own = self._rules.get(place)
        rule = None if own is None else own[1]
        if rule is None and machine in self._standard.machines:
            rows = self._standard.machines[machine].rules
            rule = next((row for row in rows if row.name == name), None)
        if rule is None:
            return frozenset()
        return frozenset(
            other
            for other, (of, row) in self._rules.items()
            if (of, row.input) == (machine, rule.input)
            and not set(row.sources).isdisjoint(rule.sources)
        )

    def of_fault(self, fault: Fault) -> frozenset[str]:
        """Give what the changes of a fault have to do with."""
        found: set[str] = set()
        for change in fault.changes:
            match change:
                case Replace(machine, rule) | Remove(machine, rule):
                    found |= self._like(f"{machine}.{rule}")
                case ReplaceField(frame):
                    found |= self.of(f"frame {frame}")
                case _:
                    pass
        return frozenset(found)

    def citing(self, clause: str) -> frozenset[str]:
        """Give the rules that rest on a clause."""
        return frozenset(self._citing.get(clause, ()))

    def sending(self, frames: Collection[str]) -> frozenset[str]:
        """Give the rules that send one of these frames."""
        return frozenset(place for name in frames for place in self._sending.get(name, ()))

    def decoded(self, message: bytes) -> tuple[str, ...]:
        """Give the frames of a message, the innermost first."""
        found = self._model.decode(message)
        return () if found is None else tuple(reversed(found.trail))


def _above(protocol: Protocol, name: str) -> Iterator[str]:
    place: str | None = name
    while place is not None:
        yield place
        place = protocol.frames[place].parent


class Violations:
    """What can be wrong in a device, by the clause that it violates."""

    def __init__(self, model: Model) -> None:
        """Make the mutants of all rules."""
        self._protocol = model.protocol
        self._standard = load_standard()
        built = as_built(model.protocol)
        self._where = _Where(model, built, self._standard)
        self._claimed = {name for name, clause in model.protocol.clauses.items() if clause.claims}
        self._of_rules: dict[str, list[Mutant]] = {}
        self._by_place: dict[str, list[Mutant]] = {}
        clauses = {f"{DEFINE}{name}": d.clauses for name, d in built.definitions.items()}
        for machine in built.machines.values():
            clauses |= {f"{machine.name}.{rule.name}": rule.clauses for rule in machine.rules}
        self._clauses = clauses
        for mutant in mutants(built):
            self._by_place.setdefault(mutant.place, []).append(mutant)
            for clause in clauses[mutant.place]:
                self._of_rules.setdefault(clause, []).append(mutant)
        self._faults = load_faults().values()

    def of(self, clause: str) -> Iterator[Violation]:
        """Yield what violates a clause: planted faults, mutants of rules, of data, of examples."""
        for fault in self._faults:
            if clause in fault.clauses:
                try:
                    planted = plant(self._protocol, fault)
                except SpecError:
                    continue  # of another device
                about = self._where.of_fault(fault) | self._where.citing(clause)
                alone = self._alone(fault.clauses)
                yield Violation(f"{FAULT}{fault.name}", about, alone, fault, planted)
        for mutant in self._of_rules.get(clause, ()):
            yield self._of_rule(mutant, self._clauses[mutant.place])
        for each in data_mutants(self._protocol, self._standard, clause):
            about = self._where.of(each.place)
            yield Violation(str(each), about, self._alone(each.clauses), None, each.protocol)
        yield from self._of_examples(clause)

    def _of_rule(self, mutant: Mutant, clauses: Collection[str]) -> Violation:
        about = self._where.of(mutant.place)
        return Violation(str(mutant), about, self._alone(clauses), None, mutant.protocol)

    def _of_examples(self, clause: str) -> Iterator[Violation]:
        """Yield devices whose answer to an example is another one, if any."""
        for example in self._protocol.examples:
            if clause not in example.clauses:
                continue
            shown = frozenset({f"example {example.name}"})
            alone = self._alone(example.clauses)
            answer = self._where.decoded(example.response)
            for mutant in self._by_place_sending(answer[:1]):
                name = f"example {example.name}: {mutant}"
                yield Violation(name, shown, alone, None, mutant.protocol)
            for frame in answer:
                for each in frame_mutants(self._protocol, self._protocol.frames[frame]):
                    name = f"example {example.name}: {each}"
                    yield Violation(name, shown, alone, None, each.protocol)

    def _by_place_sending(self, frames: Collection[str]) -> Iterator[Mutant]:
        for place in self._where.sending(frames):
            yield from self._by_place.get(place, ())

    def _alone(self, clauses: Collection[str]) -> bool:
        return len(self._claimed.intersection(clauses)) == 1


def fresh(
    model: Model, known: Mapping[str, Evidence], cases: Collection[str]
) -> dict[str, Evidence]:
    """Give the evidence whose clause is what it was, and whose violation and case are there."""
    protocol = model.protocol
    standing = {
        clause: each
        for clause, each in known.items()
        if clause in protocol.clauses
        and each.case in cases
        and each.digest == digest_of(protocol, clause)
    }
    if not standing:
        return {}
    violations = Violations(model)
    return {
        clause: each
        for clause, each in standing.items()
        if any(each.violation == violation.name for violation in violations.of(clause))
    }
