"""Reports a comparison: tables for a terminal, Markdown, and data for JSON."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, TypeAlias

from ecatspec.conformance.base.devices import nearest
from ecatspec.conformance.render.tables import Sheet, cell_words
from ecatspec.model.analysis.fact_diff import Effect
from ecatspec.model.analysis.facts import TITLES, Section

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from ecatspec.conformance.diff.behaviour import Behaviour
    from ecatspec.conformance.diff.comparison import Comparison, Tried
    from ecatspec.spec.language.ir import Protocol

Pair: TypeAlias = tuple[tuple[str, ...], tuple[str, ...]]
_FEW = 3
"""Maximum number of clauses of a side that are listed with their places."""
_SOME = 4
"""Maximum number of names listed of what cannot be compared."""
METHOD = "product of all reachable pairs of states, exact"


def sections_of(names: Iterable[str]) -> frozenset[Section]:
    """Give the sections that a user named; all without a name.

    Raises:
        UserError: There is no such section.

    """
    known = tuple(section.value for section in Section)
    wanted = tuple(names)
    for name in wanted:
        if name not in known:
            raise nearest("section", name, known)
    return frozenset(map(Section, wanted or known))


def headline(found: Comparison) -> str:
    """Give one line: how many differences there are, and how many break."""
    first, second = found.names
    effects = Counter(difference.effect for difference in found.differences)
    effects.update(behaviour.effect for behaviour in found.behaviours)
    if not found.count:
        return f"{first} and {second}: no differences"
    told = ", ".join(f"{effects[effect]} {_plural(effect, effects[effect])}" for effect in Effect)
    facts, behaviours = len(found.differences), len(found.behaviours)
    return (
        f"{first} against {second}: facts that differ {facts}, answers {behaviours}. "
        f"For a MainDevice written for {first}: {told}."
    )


def _plural(effect: Effect, count: int) -> str:
    words = {
        Effect.BREAKS: ("breaks", "break"),
        Effect.MAY: ("may break", "may break"),
        Effect.HARMLESS: ("does not break", "do not break"),
    }
    return words[effect][count != 1]


def sheets(found: Comparison) -> Iterator[Sheet]:
    """Yield the tables: facts and answers by section, then what was tried, and what was not."""
    for section in Section:
        yield from _facts(found, section)
        yield from _answers(found, section)
    yield _tried(found)
    yield from _rest(found)


def _facts(found: Comparison, section: Section) -> Iterator[Sheet]:
    rows = tuple(
        (
            each.subject,
            *each.values,
            _effect(each.effect, misprint=each.misprint),
            (*_told(found, each.clauses), *each.anomalies),
        )
        for each in found.differences
        if each.section is section
    )
    if rows:
        columns = ("what", *found.names, "effect", "clauses")
        yield Sheet(section.value, f"{TITLES[section]}: facts", columns, rows)


def _effect(effect: Effect, *, misprint: bool) -> str:
    return f"{effect.value}; rests on how a misprint is read" if misprint else effect.value


def _answers(found: Comparison, section: Section) -> Iterator[Sheet]:
    rows = tuple(
        (
            number,
            each.inputs,
            *each.answers,
            _answer_effect(each),
            _told(found, each.clauses),
        )
        for number, each in enumerate(found.behaviours, 1)
        if each.section is section
    )
    if rows:
        title = f"{TITLES[section]}: answers, with the shortest stimuli from power-on or OP"
        columns = ("no", "stimuli", *found.names, "effect", "clauses")
        yield Sheet(f"{section.value} answers", title, columns, rows)


def _answer_effect(behaviour: Behaviour) -> str:
    parts = [behaviour.effect.value]
    if behaviour.freer:
        parts.append("a common answer is allowed")
    if behaviour.depends:
        parts.append(f"depends on {', '.join(behaviour.depends)}")
    return "; ".join(parts)


def _told(found: Comparison, clauses: Pair) -> tuple[str, ...]:
    """Give the clauses of both sides, those of the devices before those of the standard."""
    ids = (_first(p, own) for p, own in zip(found.protocols, clauses, strict=True))
    return tuple(dict.fromkeys(clause for own in ids for clause in own))


def _first(protocol: Protocol, clauses: tuple[str, ...]) -> tuple[str, ...]:
    own = tuple(clause for clause in clauses if protocol.clauses[clause].claims)
    return (own or clauses)[:_FEW]


def _tried(found: Comparison) -> Sheet:
    rows = tuple(
        (
            each.machine,
            f"{each.states[0]} and {each.states[1]}",
            len(each.inputs),
            each.pairs,
            _outcome(each),
        )
        for each in found.tried
    )
    columns = ("machine", "states", "inputs", "pairs reached", "outcome")
    return Sheet("tried", f"what was tried out ({METHOD})", columns, rows)


def _outcome(tried: Tried) -> str:
    if tried.differences:
        return f"{tried.differences} places differ; behind them nothing is looked at"
    return "proved equal"


def _rest(found: Comparison) -> Iterator[Sheet]:
    silent: dict[Section, list[str]] = {}
    for each in found.silences:
        silent.setdefault(each.section, []).append(each.subject)
    rows: list[tuple[str | int, ...]] = []
    for section, subjects in silent.items():
        told = ", ".join(subjects[:_SOME])
        more = f" and {len(subjects) - _SOME} more" if len(subjects) > _SOME else ""
        rows.append((TITLES[section], len(subjects), f"{told}{more}"))
    if rows:
        title = "not comparable: one side says nothing, which is no difference"
        yield Sheet("silences", title, ("section", "facts", "among them"), tuple(rows))
    shared = tuple(
        (each.id, each.subject, each.printed[0], each.read_as)
        for each in found.misprints
        if each.shared
    )
    if shared:
        title = "both manuals share these anomalies, which are no differences"
        yield Sheet("misprints", title, ("id", "subject", "printed", "read as"), shared)
    lines = [*found.untried]
    for name, way in sorted((found.choices[0] | found.choices[1]).items()):
        lines.append(f"the open choice {name} was taken to go as the other side says: {way}")
    lines += [
        f"{tried.machine}: only {name} knows {', '.join(odd)}"
        for tried in found.tried
        for name, odd in zip(found.names, tried.odd, strict=True)
        if odd
    ]
    yield Sheet("untried", "not tried out", ("what",), tuple((line,) for line in lines))


def markdown(found: Comparison) -> str:
    """Give the whole comparison as Markdown, with the manual sections of the clauses cited."""
    title = f"{found.names[0]} against {found.names[1]}"
    parts = [f"# {_escaped(title)}", _escaped(headline(found))]
    parts += [f"## {sheet.title}\n\n{_grid(sheet)}" for sheet in sheets(found)]
    cited = tuple(_cited(found))
    if cited:
        rows = "\n".join(f"- **{clause}**: {source}" for clause, source in cited)
        parts.append(f"## Clauses\n\n{rows}")
    return "\n\n".join(parts) + "\n"


def _grid(sheet: Sheet) -> str:
    lines = [" | ".join(sheet.columns), " | ".join("---" for _ in sheet.columns)]
    lines += [" | ".join(_escaped(cell_words(cell)) for cell in row) for row in sheet.rows]
    return "\n".join(f"| {line} |" for line in lines)


def _escaped(words: str) -> str:
    for sign in "\\`*_{}[]<>|#":
        words = words.replace(sign, f"\\{sign}")
    return words


def _cited(found: Comparison) -> Iterator[tuple[str, str]]:
    known: dict[str, str] = {}
    every = [difference.clauses for difference in found.differences]
    every += [behaviour.clauses for behaviour in found.behaviours]
    for pair in every:
        for protocol, clauses in zip(found.protocols, pair, strict=True):
            for clause in _first(protocol, clauses):
                known[clause] = protocol.clauses[clause].source
    yield from sorted(known.items())


# --- data -----------------------------------------------------------------------------------------


def as_data(found: Comparison) -> dict[str, object]:
    """Give all of a comparison for JSON: nothing is shortened."""
    return {
        "devices": [
            {"name": name, "digest": protocol.digest, "choices": dict(sorted(choices.items()))}
            for name, protocol, choices in zip(
                found.names, found.protocols, found.choices, strict=True
            )
        ],
        "facts": [
            {
                "section": each.section.value,
                "subject": each.subject,
                "values": list(each.values),
                "clauses": _clauses(found, each.clauses),
                "effect": each.effect.value,
                "anomalies": list(each.anomalies),
                "misprint": each.misprint,
            }
            for each in found.differences
        ],
        "answers": [
            {
                "section": each.section.value,
                "machine": each.machine,
                "inputs": list(each.inputs),
                "answers": list(each.answers),
                "rules": [list(rules) for rules in each.rules],
                "roots": [list(rules) for rules in each.roots],
                "clauses": _clauses(found, each.clauses),
                "effect": each.effect.value,
                "freer": each.freer,
                "depends": list(each.depends),
                "transitions": each.transitions,
            }
            for each in found.behaviours
        ],
        "tried": [
            {
                "machine": each.machine,
                "states": list(each.states),
                "inputs": list(each.inputs),
                "pairs": each.pairs,
                "differences": each.differences,
                "method": METHOD,
                "only": [list(odd) for odd in each.odd],
            }
            for each in found.tried
        ],
        "not_tried": list(found.untried),
        "not_comparable": [
            {"section": s.section.value, "subject": s.subject, "values": list(s.values)}
            for s in found.silences
        ],
        "misprints": [
            {
                "id": m.id,
                "subject": m.subject,
                "printed": list(m.printed),
                "read_as": m.read_as,
                "shared": m.shared,
            }
            for m in found.misprints
        ],
    }


def _clauses(found: Comparison, clauses: Pair) -> list[list[dict[str, object]]]:
    return [
        [
            {
                "id": clause,
                "source": protocol.clauses[clause].source,
                "claims": list(protocol.clauses[clause].claims),
            }
            for clause in own
        ]
        for protocol, own in zip(found.protocols, clauses, strict=True)
    ]
