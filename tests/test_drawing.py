"""Tests of drawings: nothing overlaps, nothing is lost, all forms are sound."""

from __future__ import annotations

import html
import json
import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations, pairwise
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st
from seeds import printed_twice

from ecatspec.conformance import cli
from ecatspec.conformance.cli.show import show
from ecatspec.conformance.drawings import DRAWINGS, svg
from ecatspec.conformance.drawings.graph import ASIDE, ERRORS, NAMES, graph_of
from ecatspec.spec.language.load import device_names, load_device

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from ecatspec.spec.language.ir import Protocol, Rule

SVG = "{http://www.w3.org/2000/svg}"
WIDEST_LETTER = 0.61  # DejaVu Sans Mono 0.602, Courier and Liberation Mono 0.6, Consolas 0.55
ABOVE, BELOW = 0.8, 0.25  # of the size of the letters, from the base line
STROKE = 1.0  # half the breadth of a line

each_device = pytest.mark.parametrize("device", ["standard", *device_names()])
each_form = pytest.mark.parametrize("form", DRAWINGS)


@cache
def loaded(device: str) -> Protocol:
    return load_device(device)


@cache
def drawn(device: str, machine: str, form: str) -> str:
    return DRAWINGS[form](loaded(device), machine)


# --- what an SVG shows ----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Area:
    """A rectangle of the drawing and what lies in it."""

    what: str
    left: float
    top: float
    right: float
    bottom: float

    def meets(self, other: Area) -> bool:
        across = self.left < other.right and other.left < self.right
        return across and self.top < other.bottom and other.top < self.bottom

    def within(self, other: Area) -> bool:
        across = other.left <= self.left and self.right <= other.right
        return across and other.top <= self.top and self.bottom <= other.bottom

    def grown(self, by: float) -> Area:
        return Area(self.what, self.left - by, self.top - by, self.right + by, self.bottom + by)


@dataclass(frozen=True, slots=True)
class Line:
    """One arrow of the drawing: the corners of its path, the control points of curves too."""

    source: str
    target: str
    points: tuple[tuple[float, float], ...]
    head: Area

    def segments(self) -> Iterator[Area]:
        for (x, y), (u, v) in pairwise(self.points):
            what = f"{self.source} to {self.target}"
            yield Area(what, min(x, u), min(y, v), max(x, u), max(y, v))


@dataclass(frozen=True, slots=True)
class Picture:
    """Everything that could lie on something else."""

    page: Area
    texts: tuple[Area, ...]
    states: tuple[Area, ...]
    names: tuple[Area, ...]  # of the states, in their order
    lines: tuple[Line, ...]


def text_area(element: ET.Element) -> Area:
    size = float(element.get("font-size", "12"))
    text = element.text or ""
    wide = len(text) * size * WIDEST_LETTER
    x, y = float(element.attrib["x"]), float(element.attrib["y"])
    x -= {"start": 0.0, "middle": 0.5, "end": 1.0}[element.get("text-anchor", "start")] * wide
    return Area(text, x, y - ABOVE * size, x + wide, y + BELOW * size)


def rectangle(element: ET.Element, what: str) -> Area:
    x, y = float(element.get("x", "0")), float(element.get("y", "0"))
    wide, high = float(element.attrib["width"]), float(element.attrib["height"])
    return Area(what, x, y, x + wide, y + high)


def numbers(words: str) -> tuple[tuple[float, float], ...]:
    found = [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?", words)]
    return tuple(zip(found[::2], found[1::2], strict=True))


def picture(text: str) -> Picture:
    root = ET.fromstring(text)
    lines = []
    for group in root.iter(f"{SVG}g"):
        if "ecs-arrow" in group.get("class", "").split():
            (path,) = group.iter(f"{SVG}path")
            (head,) = group.iter(f"{SVG}polygon")
            assert set(re.findall("[A-Za-z]", path.attrib["d"])) <= set("MLQ")
            xs, ys = zip(*numbers(head.attrib["points"]), strict=True)
            ends = group.get("data-source", "start"), group.get("data-target", "")
            tip = Area("head", min(xs), min(ys), max(xs), max(ys))
            lines.append(Line(*ends, numbers(path.attrib["d"]), tip))
    groups = [group for group in root.iter(f"{SVG}g") if "data-state" in group.attrib]
    states = [rectangle(next(g.iter(f"{SVG}rect")), g.attrib["data-state"]) for g in groups]
    names = [text_area(next(g.iter(f"{SVG}text"))) for g in groups]
    texts = tuple(map(text_area, root.iter(f"{SVG}text")))
    page = rectangle(root, "page")
    return Picture(page, texts, tuple(states), tuple(names), tuple(lines))


def assert_readable(text: str) -> None:
    """Nothing lies on anything else, as far as an SVG can be measured without its letters."""
    seen = picture(text)
    for one, other in combinations(seen.texts, 2):
        assert not one.meets(other), (one, other)
    for one, other in combinations(seen.states, 2):
        assert not one.meets(other), (one, other)
    for label in seen.texts:
        assert label.within(seen.page), label
        for state, name in zip(seen.states, seen.names, strict=True):
            assert label.within(state) if label == name else not label.meets(state), (label, state)
    for line in seen.lines:
        for segment in line.segments():
            assert segment.left == segment.right or segment.top == segment.bottom, "a slope"
            assert segment.within(seen.page), segment
            for area in (*seen.states, *seen.texts):
                # a line may touch the edge of a state, and keeps away from letters
                near = area if area in seen.states else area.grown(STROKE)
                assert not segment.meets(near), (segment, area)
        for area in (*seen.states, *seen.texts):
            assert not line.head.meets(area), (line, area)
    for one_line, other_line in combinations(seen.lines, 2):
        if one_line.target != other_line.target:
            assert_apart(one_line, other_line)


def assert_apart(one: Line, other: Line) -> None:
    """Arrows to different states cross, but never run along each other."""
    for first in one.segments():
        for second in other.segments():
            across = min(first.right, second.right) - max(first.left, second.left)
            down = min(first.bottom, second.bottom) - max(first.top, second.top)
            upright = first.left == first.right and second.left == second.right
            level = first.top == first.bottom and second.top == second.bottom
            together = (upright and across == 0 and down > 0) or (
                level and down == 0 and across > 0
            )
            assert not together, (first, second)


# --- readable -------------------------------------------------------------------------------------


@each_device
def test_nothing_lies_on_anything_else(device: str) -> None:
    for machine in loaded(device).machines:
        assert_readable(drawn(device, machine, "svg"))


def test_the_measure_finds_what_overlaps() -> None:
    text = drawn("standard", "ds402", "svg")
    for wrong in (
        re.sub(r'(<text x=")\d+(" y="\d+"[^>]*>disable_voltage_9)', r"\g<1>700\2", text),
        re.sub(r'(<rect x="\d+" y=")\d+(" width="\d+" height="40")', r"\g<1>300\2", text, count=1),
        re.sub(r'd="M(\d+),(\d+)L', r'd="M\1,\2L\1,90L900,90L', text, count=2),
    ):
        assert wrong != text
        with pytest.raises(AssertionError):
            assert_readable(wrong)


@st.composite
def machines(draw: st.DrawFn) -> tuple[str, str, dict[tuple[str, str], list[int]]]:
    """The name of a machine, its first state, and any arrows with the lengths of their labels."""
    name = draw(st.sampled_from(["al", "ds402", "sdo"]))
    states = loaded("standard").machines[name].states
    pairs = st.sampled_from([(s, t) for s in states for t in states if s != t])
    lengths = st.lists(st.integers(0, 30), min_size=1, max_size=NAMES + 2)
    arrows = draw(st.dictionaries(pairs, lengths, max_size=20))
    return name, draw(st.sampled_from(states)), arrows


@given(machines())
def test_no_machine_has_overlaps(
    made: tuple[str, str, dict[tuple[str, str], list[int]]],
) -> None:
    name, initial, arrows_wanted = made
    standard = loaded("standard")
    machine = standard.machines[name]
    rules: list[Rule] = []
    for (source, target), lengths in arrows_wanted.items():
        for length in lengths:
            word = f"r{len(rules)}_" + "x" * length
            ends = replace(machine.rules[0], sources=(source,), target=target)
            rules.append(replace(ends, name=word, guard=None))
    machine = replace(machine, rules=tuple(rules), initial=initial)
    protocol = replace(standard, machines={**standard.machines, name: machine})
    text = DRAWINGS["svg"](protocol, name)
    assert_readable(text)
    arrows = {(line.source, line.target) for line in picture(text).lines}
    assert arrows == set(arrows_wanted) | {("start", "")}


@pytest.mark.parametrize(
    ("machine", "line"),
    [
        ("al", ["INIT", "PREOP", "SAFEOP", "OP"]),
        (
            "ds402",
            [
                "NOT_READY",
                "SWITCH_ON_DISABLED",
                "READY_TO_SWITCH_ON",
                "SWITCHED_ON",
                "OPERATION_ENABLED",
                "QUICK_STOP_ACTIVE",
            ],
        ),
    ],
)
@each_device
def test_the_usual_order(device: str, machine: str, line: list[str]) -> None:
    states = {area.what: area for area in picture(drawn(device, machine, "svg")).states}
    column = [states[name] for name in line]
    assert len({area.left for area in column}) == 1
    assert column == sorted(column, key=lambda area: area.top)
    aside = [area for name, area in states.items() if name not in line]
    assert {area.what for area in aside} == set(ASIDE[machine])
    assert all(area.left > column[0].right for area in aside)


def test_boot_stands_beside_init_and_its_arrows_are_straight() -> None:
    seen = picture(drawn("kollmorgen-akd", "al", "svg"))
    states = {area.what: area for area in seen.states}
    assert states["BOOT"].top == states["INIT"].top
    straight = [line for line in seen.lines if "BOOT" in {line.source, line.target}]
    assert [len(line.points) for line in straight] == [2, 2]


def test_the_states_aside_are_states() -> None:
    machines = loaded("standard").machines
    for name, states in ASIDE.items():
        assert set(states) < set(machines[name].states)
    assert {state for states in ASIDE.values() for state in states} >= ERRORS


# --- complete -------------------------------------------------------------------------------------


def words_of(text: str, form: str) -> set[str]:
    """The words that a reader sees, so no tooltips."""
    if form == "svg":
        shown = " ".join(element.text or "" for element in ET.fromstring(text).iter(f"{SVG}text"))
    else:
        shown = re.sub(r'tooltip="(?:[^"\\]|\\.)*"', "", text).replace("\\l", " ")
        shown = shown.replace("<br/>", " ")
    return set(re.findall(r"\w+", shown))


@each_form
@each_device
def test_every_state_and_every_rule_is_shown(device: str, form: str) -> None:
    for name, machine in loaded(device).machines.items():
        names = {rule.name for rule in machine.rules}
        assert names | set(machine.states) <= words_of(drawn(device, name, form), form), name


@each_device
def test_each_rule_has_its_arrow_or_its_place_in_the_legend(device: str) -> None:
    for name, machine in loaded(device).machines.items():
        graph = graph_of(loaded(device), name)
        pairs = [(arrow.source, arrow.target) for arrow in graph.arrows]
        assert len(pairs) == len(set(pairs))
        moves = {(a.source, a.target, rule.name) for a in graph.arrows for rule in a.rules}
        stays = {name for e in graph.legend if e.words.startswith("Stay ") for name in e.names}
        never = {n for e in graph.legend if e.words.startswith("Cannot fire") for n in e.names}
        for rule in machine.rules:
            wanted = {(s, rule.target or s, rule.name) for s in rule.sources} - {
                (s, s, rule.name) for s in rule.sources
            }
            on_arrows = {move for move in moves if move[2] == rule.name}
            assert on_arrows == (set() if rule.name in never else wanted), rule.name
            remains = any(rule.target in {None, source} for source in rule.sources)
            assert (rule.name in stays) is (remains and rule.name not in never), rule.name
        for arrow in graph.arrows:
            assert (arrow.number is None) is (len(arrow.rules) <= NAMES)
            if arrow.number is not None:
                words = f"Arrow {arrow.number}, {arrow.source} to {arrow.target}"
                (entry,) = (entry for entry in graph.legend if entry.words == words)
                assert entry.names == tuple(rule.name for rule in arrow.rules)


@each_form
@each_device
def test_gaps_are_counted(device: str, form: str) -> None:
    for name, machine in loaded(device).machines.items():
        count = len(machine.gaps)
        words = f"{count} gap{'' if count == 1 else 's'}"
        text = drawn(device, name, form)
        assert words in re.sub(r"\\l\s*|\s+", " ", text), name
        assert not {gap.name for gap in machine.gaps} & words_of(text, form)


def test_what_the_pins_exclude_is_no_arrow() -> None:
    def on_arrows(protocol: Protocol) -> set[str]:
        graph = graph_of(protocol, "al")
        return {rule.name for arrow in graph.arrows for rule in arrow.rules}

    standard = loaded("standard")
    akd = loaded("kollmorgen-akd")
    assert akd.pins["refused_in_op"].alternative == "stay"
    assert akd.pins["emulation"].alternative == "none"
    rules = standard.machines["al"].rules
    excluded = {"op_skipping_drops", "unknown_state_drops"}
    excluded |= {r.name for r in rules if r.name.startswith("copied_") and r.target is not None}
    assert excluded <= on_arrows(standard)
    assert not excluded & on_arrows(akd)
    (entry,) = (e for e in graph_of(akd, "al").legend if e.words.startswith("Cannot fire"))
    assert set(entry.names) == excluded | {
        "copied_no_state",
        "sync_lost_without_controller",
        "watchdog_without_controller",
    }


def test_a_state_that_is_never_reached_is_shown_as_such() -> None:
    protocol = loaded("reference-drive")
    assert protocol.pins["bootstrap"].alternative == "unsupported"
    graph = graph_of(protocol, "al")
    assert graph.unreached == ("BOOT",)
    assert [e.names for e in graph.legend if e.words.startswith("Never reached")] == [("BOOT",)]
    assert marks(drawn("reference-drive", "al", "svg"), "g")["ecs-unreached"] == 1
    assert not graph_of(loaded("standard"), "al").unreached
    assert "ecs-unreached" not in marks(drawn("standard", "al", "svg"), "g")


@each_device
def test_every_arrow_tells_guard_and_clauses(device: str) -> None:
    for name, machine in loaded(device).machines.items():
        rules = {rule.name: rule for rule in machine.rules}
        root = ET.fromstring(drawn(device, name, "svg"))
        for group in root.iter(f"{SVG}g"):
            if "data-source" not in group.attrib:
                continue
            ends, *tips = (group.findtext(f"{SVG}title") or "").splitlines()
            assert ends == f"{group.attrib['data-source']} to {group.attrib['data-target']}"
            for tip in tips:
                rule = rules[tip.partition(" ")[0]]
                assert f"[{', '.join(rule.clauses)}]: on {rule.input}" in tip
                assert (" when " in tip) is (rule.guard is not None)


# --- sound ----------------------------------------------------------------------------------------

AWKWARD = 'a "b" \\ <c> & d; #e {f} %% end note \x0b\x1b ü \u6f22 --> ]]>\nnext'


def awkward() -> Protocol:
    protocol = loaded("reference-drive")
    machine = replace(protocol.machines["ds402"], wording=AWKWARD)
    tables = dict(protocol.tables)
    rows = tables[machine.table].rows
    tables[machine.table] = replace(
        tables[machine.table], rows=tuple(replace(row, wording=AWKWARD) for row in rows)
    )
    return replace(
        protocol, name=AWKWARD, machines=protocol.machines | {"ds402": machine}, tables=tables
    )


@each_device
def test_an_svg_stands_by_itself(device: str) -> None:
    for machine in loaded(device).machines:
        text = drawn(device, machine, "svg")
        root = ET.fromstring(text)
        assert root.tag == f"{SVG}svg"
        assert [child.tag for child in root][:2] == [f"{SVG}title", f"{SVG}desc"]
        assert device in (root[0].text or "")
        assert not {e.tag for e in root.iter()} & {f"{SVG}script", f"{SVG}image", f"{SVG}use"}
        assert text.count("http") == 1, "the name space and no address"
        assert not re.search(r"@import|@font-face|url\(|\bid=|\bhref=|\bon\w+=", text)
        assert "prefers-color-scheme:dark" in text


def contrast(one: str, other: str) -> float:
    """How well two colours differ, as the rules for readable pages measure it."""

    def light(colour: str) -> float:
        parts = [int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)]
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    low, high = sorted((light(one), light(other)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_colours_differ_on_light_and_on_dark(scheme: str) -> None:
    style = ET.fromstring(drawn("standard", "ds402", "svg")).findtext(f"{SVG}style") or ""
    rules = style.split("@media")[scheme == "dark"]
    paper = re.findall(r"\.ecs-paper\{fill:(#\w+)", rules)
    texts = re.findall(r"text\{fill:(#\w+)", rules)
    lines = re.findall(r"stroke:(#\w+)", rules)
    boxes = re.findall(r"rect\{fill:(#\w+)", rules)
    assert (len(paper), len(texts), len(boxes)) == (1, 2, 3)
    assert all(contrast(paper[0], text) >= 4.5 for text in texts)
    assert all(contrast(box, texts[0]) >= 4.5 for box in boxes)
    assert all(contrast(paper[0], line) >= 3 for line in lines)


@each_form
def test_awkward_words_are_escaped(form: str) -> None:
    text = DRAWINGS[form](awkward(), "ds402")
    assert text.isascii()
    assert all(sign.isprintable() or sign == "\n" for sign in text)
    if form == "svg":
        root = ET.fromstring(text)
        assert 'a "b" \\ <c> & d; #e {f} %% end note \ufffd\ufffd ü \u6f22' in (root[0].text or "")
    else:
        assert_sound(text, form)


def assert_sound(text: str, form: str) -> None:
    """Each line is one of those that the form has; strings end where they began."""
    if form == "dot":
        string = r'"(?:[^"\\\n]|\\["\\ln])*"'
        attributes = rf"\[(?:\w+=(?:{string}|[\w.]+)(?:, )?)+\]"
        head, *lines, tail = text.splitlines()
        assert re.fullmatch(rf"digraph {string} \{{", head)
        assert tail == "}"
        line_form = rf"  (?:graph|node|edge|{string}(?: -> {string})?)(?: {attributes})?"
    else:
        front, title, end, kind, *lines = text.splitlines()
        assert (front, end, kind) == ("---", "---", "stateDiagram-v2")
        assert json.loads(title.removeprefix("title: "))
        words = r"(?:[\w ,.\-/'?!*+=~^@$_]|#\d+;|<br/>)*"
        line_form = (
            rf'  state "{words}" as s\d+|  (?:\[\*\]|s\d+) --> s\d+(?: : {words})?'
            rf"|  note right of s\d+|    [\w ,.:]+|  end note|  %% [\w ,:\-]+"
            r"|  classDef error [\w:#,\-]+|  class s[\ds,]+ error"
        )
    for line in lines:
        assert re.fullmatch(line_form, line), line


@pytest.mark.parametrize("form", ["dot", "mermaid"])
@each_device
def test_every_line_is_sound(device: str, form: str) -> None:
    for machine in loaded(device).machines:
        assert_sound(drawn(device, machine, form), form)


@pytest.mark.parametrize("form", ["dot", "mermaid"])
@each_device
def test_arrows_are_the_same_in_every_form(device: str, form: str) -> None:
    for name in loaded(device).machines:
        text = drawn(device, name, form)
        graph = graph_of(loaded(device), name)
        known = dict(re.findall(r'state "(\w+)" as (s\d+)', text))
        quoted = {state: f'"{state}"' for state in graph.machine.states}
        ids, arrow = (known, "-->") if form == "mermaid" else (quoted, "->")
        wanted = [f"  {ids[a.source]} {arrow} {ids[a.target]} " for a in graph.arrows]
        found = [line for line in text.splitlines() if arrow in line and "style=invis" not in line]
        starts, arrows = found[:1], found[1:]
        assert starts[0].endswith(ids[graph.machine.initial])
        assert all(line.startswith(w) for line, w in zip(arrows, wanted, strict=True))


def test_the_same_texts_give_the_same_bytes() -> None:
    """Also where sets have another order."""
    program = """
from ecatspec.conformance.drawings import DRAWINGS
from ecatspec.spec.language.load import load_device

protocol = load_device("standard")
for drawing in DRAWINGS.values():
    for machine in protocol.machines:
        print(drawing(protocol, machine), end="")
"""
    given = printed_twice(program)
    names = loaded("standard").machines
    here = "".join(drawn("standard", machine, form) for form in DRAWINGS for machine in names)
    assert given == (here, here)


def marks(text: str, tag: str) -> Mapping[str, int]:
    found: dict[str, int] = {}
    for element in ET.fromstring(text).iter(f"{SVG}{tag}"):
        for word in element.get("class", "").split():
            found[word] = found.get(word, 0) + 1
    return found


def test_rules_can_be_marked() -> None:
    protocol = loaded("standard")
    plain = svg.drawing(protocol, "al")
    assert plain == drawn("standard", "al", "svg")
    marked = svg.drawing(protocol, "al", {"to_init": "gone", "op_kept": "changed"})
    assert_readable(marked)
    # to_init is on four arrows and stays in INIT; op_kept stays in OP
    assert marks(marked, "g")["gone"] == 4
    assert marks(marked, "text") == {"gone": 5, "changed": 1}
    # where not all rules are named, those that are marked come first
    graph = graph_of(protocol, "sdo")
    arrow = next(arrow for arrow in graph.arrows if arrow.number is not None)
    last = arrow.rules[-1].name
    assert last not in arrow.names()
    assert arrow.names((last,))[0] == last


def test_a_brief_drawing_names_rules_without_their_guards() -> None:
    protocol = loaded("standard")
    brief = svg.drawing(protocol, "sdo", {"upload_expedited": "gone"}, brief=True)
    assert_readable(brief)
    graph = graph_of(protocol, "sdo")
    tips = {element.text for element in ET.fromstring(brief).iter(f"{SVG}title")}
    for arrow in graph.arrows:
        names = [
            f"{n}: gone" if n == "upload_expedited" else n for n in (r.name for r in arrow.rules)
        ]
        assert "\n".join((f"{arrow.source} to {arrow.target}", *names)) in tips
    assert not any(tip == graph.tips[rule.name] for tip in tips for rule in graph.machine.rules)
    assert {graph.tips[state] for state in graph.machine.states} <= tips
    (legend,) = ET.fromstring(brief).iterfind(f"{SVG}g[@class='ecs-legend']")
    assert not list(legend.iter(f"{SVG}title"))
    assert len(brief) < len(drawn("standard", "sdo", "svg")) / 2


# --- the command ----------------------------------------------------------------------------------


@each_form
def test_show_draws(capsys: pytest.CaptureFixture[str], form: str) -> None:
    assert cli.main(["show", "standard", "al", "--format", form]) == 0
    out, err = capsys.readouterr()
    assert (out, err) == (drawn("standard", "al", form), "")


def test_show_draws_a_text_given_by_its_path(
    capsys: pytest.CaptureFixture[str], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("texts") / "mine.ecs"
    path.write_text('device mine extends standard "Mine"\n', "utf-8")
    assert cli.main(["show", str(path), "al", "--format", "svg"]) == 0
    assert html.escape("mine, machine al") in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["standard", "--format", "svg"], "name one: ecatspec show DEVICE MACHINE"),
        (["standard", "faults", "--format", "svg"], "which faults are not"),
        (["standard", "al", "--format", "svg", "--json"], "exclude each other"),
        (["standard", "all", "--format", "svg"], "did you mean 'al'?"),
        (["standard", "al", "--format", "png"], "there are svg, mermaid, dot"),
        (["standard", "al", "--format", "mermaids"], "did you mean 'mermaid'?"),
        (["standard", "al", "--format", ""], "no format is called ''"),
        (["standart", "al", "--format", "dot"], "did you mean `standard`?"),
    ],
)
def test_wrong_wishes_are_refused_in_one_line(
    capsys: pytest.CaptureFixture[str], arguments: list[str], word: str
) -> None:
    assert cli.main(["show", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("ecatspec: ")
    assert err.count("\n") == 1
    assert word in err


def test_the_help_names_the_formats() -> None:
    (option,) = [p for p in show.params if p.name == "form"]
    assert option.metavar == "|".join((*DRAWINGS, "markdown"))
