"""Finds what a case exercises: the rules that fire, and what its stimuli touch."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.conformance.run.watch import WATCHED
from ecatspec.generators.cases.case import (
    ReadConfiguration,
    ReadInitial,
    ReadRegister,
    SendFrame,
    SetUpProcessData,
    WriteOutputs,
    WriteRegister,
    WriteRegisters,
    WriteUntilTaken,
)
from ecatspec.model.analysis.citations import Foundations, object_name

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from ecatspec.generators.cases.case import Case, Stimulus
    from ecatspec.model.core.compilation import Model
    from ecatspec.model.core.values import ObjectKey


class Touch:
    """What stimuli touch, by the names of `model.citations.Foundations`."""

    def __init__(self, model: Model) -> None:
        """Look up which entries objects have, and which the process data hold."""
        self._model = model
        self._entries: dict[int, list[ObjectKey]] = {}
        for entry in model.protocol.objects:
            self._entries.setdefault(entry.index, []).append((entry.index, entry.subindex))
        self._mapped = frozenset(self._process_data())

    def of(self, case: Case) -> frozenset[str]:
        """Give the objects and registers that a case reads or writes."""
        watched = [f"register {name}" for name in WATCHED]
        _, _, example = case.name.partition("/example/")
        if example:
            watched.append(f"example {example}")
        touched = (name for stimulus in case.stimuli for name in self._of(stimulus))
        return frozenset((*watched, *touched))

    def _of(self, stimulus: Stimulus) -> Iterator[str]:
        match stimulus:
            case WriteRegister() | ReadRegister():
                yield f"register {stimulus.register}"
            case WriteRegisters():
                for write in stimulus.writes:
                    yield f"register {write.register}"
            case SendFrame():
                yield from map(object_name, self._of_request(stimulus))
            case ReadInitial() | WriteUntilTaken():
                yield object_name((stimulus.index, stimulus.subindex))
            case ReadConfiguration() | SetUpProcessData() | WriteOutputs():
                yield from map(object_name, self._mapped)
            case _:
                pass

    def _of_request(self, stimulus: SendFrame) -> Iterator[ObjectKey]:
        index, subindex = (stimulus.fields.get(name) for name in ("index", "subindex"))
        if not isinstance(index, int):
            return
        entries = self._entries.get(index, [])
        whole = stimulus.fields.get("complete_access") or not isinstance(subindex, int)
        yield from (key for key in entries if whole or key[1] == subindex)
        value = stimulus.fields.get("value")
        if index in self._model.image.assignments.values() and isinstance(value, bytes):
            yield from self._of_pdo(int.from_bytes(value, "little"))

    def _process_data(self) -> Iterator[ObjectKey]:
        """Give what is assigned and mapped by default, and what that maps."""
        objects = {(e.index, e.subindex): e for e in self._model.protocol.objects}
        for index in self._model.image.assignments.values():
            for key in self._entries.get(index, ()):
                yield key
                default = objects[key].default
                if key[1] and isinstance(default, int):
                    yield from self._of_pdo(default)

    def _of_pdo(self, index: int) -> Iterator[ObjectKey]:
        for entry in self._model.protocol.objects:
            if entry.index != index:
                continue
            yield entry.index, entry.subindex
            if entry.subindex and isinstance(entry.default, int):
                key, _ = self._model.image.target(entry.default)
                if key is not None:
                    yield key


class Exercise:
    """The clauses that cases exercise, by what they touch and by the rules they went by."""

    def __init__(self, model: Model) -> None:
        """Look up what rests on which clauses."""
        self._touch = Touch(model)
        self._foundations = Foundations(model.protocol)

    def clauses(self, case: Case, rules: Iterable[str]) -> frozenset[str]:
        """Give the clauses of a case that went by these rules."""
        return self.of_rules((*self._touch.of(case), *rules))

    def of_rules(self, names: Iterable[str]) -> frozenset[str]:
        """Give the clauses on which rules rest, or objects and registers by their names."""
        return frozenset(c for name in names for c in self._foundations.of.get(name, ()))
