"""Draws a machine as self-contained SVG, without scripts, fonts or links."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.drawings.graph import ERRORS, graph_of
from ecatspec.conformance.drawings.layout import LINE, SIZE, Label, layout, width

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from ecatspec.conformance.drawings.graph import Entry, Graph
    from ecatspec.conformance.drawings.layout import Layout, Route
    from ecatspec.spec.language.ir import Protocol

    Point = tuple[int, int]

_MARGIN: Final = 24
_WIDEST: Final = 900
"""The legend is at least so wide where the machine is narrower."""
_INDENT: Final = 14
_ENTRY: Final = LINE + 4
_CURVE: Final = 6
_HEAD: Final = (9, 4)
"""Length and half the breadth of the head of an arrow."""
_DOT: Final = 5
_LETTERS: Final = "ui-monospace, 'DejaVu Sans Mono', Menlo, Consolas, 'Liberation Mono', monospace"
_NO_XML: Final = re.compile("[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")

_COLOURS: Final = """
.ecs-paper{fill:#ffffff}
.ecs text{fill:#1f2328}
.ecs .ecs-quiet text{fill:#59636e}
.ecs .ecs-arrow path{fill:none;stroke:#59636e;stroke-width:2}
.ecs .ecs-arrow polygon,.ecs .ecs-arrow circle{fill:#59636e}
.ecs .ecs-state rect{fill:#ddf4ff;stroke:#0969da;stroke-width:1.5}
.ecs .ecs-error rect{fill:#ffebe9;stroke:#cf222e}
.ecs .ecs-aside rect{fill:#f6f8fa;stroke:#59636e}
.ecs .ecs-unreached rect{stroke-dasharray:5 4}
@media (prefers-color-scheme:dark){
.ecs-paper{fill:#0d1117}
.ecs text{fill:#e6edf3}
.ecs .ecs-quiet text{fill:#9198a1}
.ecs .ecs-arrow path{stroke:#9198a1}
.ecs .ecs-arrow polygon,.ecs .ecs-arrow circle{fill:#9198a1}
.ecs .ecs-state rect{fill:#121d2f;stroke:#4493f8}
.ecs .ecs-error rect{fill:#25171c;stroke:#f85149}
.ecs .ecs-aside rect{fill:#151b23;stroke:#9198a1}
}
"""


def drawing(
    protocol: Protocol,
    machine: str,
    marked: Mapping[str, str] | None = None,
    *,
    brief: bool = False,
) -> str:
    """Draw a machine; `marked` gives rules a CSS class, at their names and at their arrows.

    A `brief` drawing stands beside a list of the rules: its arrows name their rules and how they
    are marked, without inputs and guards.

    Raises:
        UserError: There is no such machine.

    """
    graph = graph_of(protocol, machine)
    page = _Page(graph, layout(graph, marked or {}), marked or {}, brief=brief)
    root = page.draw()
    ET.indent(root, " ")
    text: bytes = ET.tostring(root, encoding="us-ascii", xml_declaration=False)
    return text.decode("ascii") + "\n"


def _named(graph: Graph, marked: Mapping[str, str]) -> Graph:
    """Say of each rule its name and its mark, and nothing more."""
    names = [rule.name for rule in graph.machine.rules]
    said = {name: f"{name}: {marked[name]}" if name in marked else name for name in names}
    return replace(graph, tips=graph.tips | said)


class _Page:
    def __init__(
        self, graph: Graph, placed: Layout, marked: Mapping[str, str], *, brief: bool
    ) -> None:
        self.graph = _named(graph, marked) if brief else graph
        self.brief = brief
        self.placed = placed
        self.marked = marked
        self.width = max(placed.width, _WIDEST, width(graph.title, SIZE + 2)) + 2 * _MARGIN
        self.left = (self.width - placed.width) // 2
        self.top = _MARGIN + 2 * LINE
        self.root = ET.Element("svg")

    def draw(self) -> ET.Element:
        """Give the whole drawing."""
        _text_in(self.root, "title", self.graph.title)
        _text_in(self.root, "desc", self._description())
        _text_in(self.root, "style", _COLOURS)
        paper = ET.SubElement(self.root, "rect", {"class": "ecs-paper"})
        heading = ET.SubElement(self.root, "g", {"class": "ecs-heading"})
        self._write(heading, self.graph.title, (_MARGIN, _MARGIN + SIZE), size=SIZE + 2, bold=True)
        self._start(ET.SubElement(self.root, "g", {"class": "ecs-arrow ecs-start"}))
        # what is marked lies above the rest, since arrows to one state share a lane
        routes = sorted(self.placed.routes, key=lambda route: bool(self._marks(route)))
        for route in routes:
            self._arrow(route)
        self._states()
        bottom = self._legend(self.top + self.placed.height + 2 * LINE + SIZE)
        size = {"width": str(self.width), "height": str(bottom + _MARGIN)}
        paper.attrib |= size
        self.root.attrib |= {
            "xmlns": "http://www.w3.org/2000/svg",
            "class": "ecs",
            "role": "img",
            "viewBox": f"0 0 {self.width} {bottom + _MARGIN}",
            **size,
            "font-family": _LETTERS,
            "font-size": str(SIZE),
        }
        return self.root

    def _description(self) -> str:
        line = ", ".join(self.graph.line)
        aside = f"; beside them {', '.join(self.graph.aside)}" if self.graph.aside else ""
        return f"States from top to bottom: {line}{aside}. {self.graph.legend[0].words}"

    def _marks(self, route: Route) -> tuple[str, ...]:
        found = (self.marked.get(rule.name) for rule in route.arrow.rules)
        return tuple(dict.fromkeys(mark for mark in found if mark))

    # --- the machine ------------------------------------------------------------------------------

    def _at(self, point: Point) -> Point:
        return point[0] + self.left, point[1] + self.top

    def _start(self, into: ET.Element) -> None:
        begin, end = map(self._at, self.placed.start)
        _text_in(into, "title", f"after power-on: {self.graph.machine.initial}")
        attributes = {"cx": str(begin[0]), "cy": str(begin[1]), "r": str(_DOT)}
        ET.SubElement(into, "circle", attributes)
        _line(into, (begin, end))

    def _arrow(self, route: Route) -> None:
        kind = " ".join(("ecs-arrow", *self._marks(route)))
        ends = {"data-source": route.arrow.source, "data-target": route.arrow.target}
        group = ET.SubElement(self.root, "g", {"class": kind, **ends})
        _text_in(group, "title", self.graph.tip(route.arrow))
        _line(group, [self._at(point) for point in route.points])
        self._label(group, route.label)

    def _label(self, into: ET.Element, label: Label) -> None:
        for place, name in enumerate(label.lines):
            at = self._at((label.x, label.y + place * LINE))
            self._write(into, name, at, anchor=label.anchor, mark=self.marked.get(name, ""))

    def _states(self) -> None:
        for box in self.placed.boxes:
            kind = "ecs-state"
            if box.state in self.graph.aside:
                kind += " ecs-error" if box.state in ERRORS else " ecs-aside"
            if box.state in self.graph.unreached:
                kind += " ecs-unreached"
            group = ET.SubElement(self.root, "g", {"class": kind, "data-state": box.state})
            _text_in(group, "title", self.graph.tips.get(box.state, box.state))
            x, y = self._at((box.x, box.y))
            size = {"width": str(box.width), "height": str(box.height), "rx": "8"}
            ET.SubElement(group, "rect", {"x": str(x), "y": str(y), **size})
            middle = (x + box.width // 2, y + box.height // 2 + SIZE // 3)
            self._write(group, box.state, middle, size=SIZE + 1, anchor="middle", bold=True)

    # --- the legend -------------------------------------------------------------------------------

    def _legend(self, top: int) -> int:
        """Write all entries below each other and give the base of the last line."""
        legend = ET.SubElement(self.root, "g", {"class": "ecs-legend"})
        x, y = _MARGIN, top - _ENTRY
        for entry in self.graph.legend:
            x, y = _MARGIN, y + _ENTRY
            group = ET.SubElement(legend, "g", {"class": "ecs-quiet"})
            for line in self._folded(entry):
                y += 0 if x == _MARGIN else LINE
                self._write(group, line, (_MARGIN, y))
                x = _MARGIN + width(line) + _INDENT
            for name in entry.names:
                if x + width(name) > self.width - _MARGIN:
                    x, y = _MARGIN + 2 * _INDENT, y + LINE
                self._name(legend, name, (x, y))
                x += width(name) + _INDENT
        return y

    def _folded(self, entry: Entry) -> Iterator[str]:
        line = ""
        for word in entry.words.split():
            longer = f"{line} {word}".strip()
            if line and width(longer) > self.width - 2 * _MARGIN - _INDENT:
                yield line
                line = word
            else:
                line = longer
        yield line + (":" if entry.names else "")

    def _name(self, into: ET.Element, name: str, at: Point) -> None:
        group = into if self.brief else ET.SubElement(into, "g")
        if name in self.graph.tips and not self.brief:
            _text_in(group, "title", self.graph.tips[name])
        self._write(group, name, at, mark=self.marked.get(name, ""))

    def _write(
        self,
        into: ET.Element,
        text: str,
        at: Point,
        *,
        size: int = SIZE,
        anchor: str = "start",
        bold: bool = False,
        mark: str = "",
    ) -> None:
        attributes = {"x": str(at[0]), "y": str(at[1])}
        if size != SIZE:
            attributes["font-size"] = str(size)
        if anchor != "start":
            attributes["text-anchor"] = anchor
        if bold:
            attributes["font-weight"] = "bold"
        if mark:
            attributes["class"] = mark
        _text_in(into, "text", text, attributes)


def _text_in(
    into: ET.Element, tag: str, text: str, attributes: Mapping[str, str] | None = None
) -> None:
    ET.SubElement(into, tag, dict(attributes or {})).text = _NO_XML.sub("\ufffd", text)


def _line(into: ET.Element, points: Sequence[Point]) -> None:
    """Draw an arrow through points, each corner a curve, with its head at the last."""
    (before, tip) = points[-2:]
    along = _towards(tip, before)
    base = _moved(tip, along, _HEAD[0])
    path = [f"M{_pair(points[0])}"]
    for one, corner, other in zip(points, points[1:], points[2:], strict=False):
        curve = min(_CURVE, _length(one, corner) // 2, _length(corner, other) // 2)
        into_it = _moved(corner, _towards(corner, one), curve)
        out_of_it = _moved(corner, _towards(corner, other), curve)
        path.append(f"L{_pair(into_it)}Q{_pair(corner)} {_pair(out_of_it)}")
    ET.SubElement(into, "path", {"d": "".join((*path, f"L{_pair(base)}"))})
    across = (along[1], along[0])
    corners = (tip, _moved(base, across, _HEAD[1]), _moved(base, across, -_HEAD[1]))
    ET.SubElement(into, "polygon", {"points": " ".join(map(_pair, corners))})


def _length(one: Point, other: Point) -> int:
    return abs(one[0] - other[0]) + abs(one[1] - other[1])


def _towards(one: Point, other: Point) -> Point:
    x, y = other[0] - one[0], other[1] - one[1]
    return (x > 0) - (x < 0), (y > 0) - (y < 0)


def _moved(point: Point, direction: Point, far: int) -> Point:
    return point[0] + direction[0] * far, point[1] + direction[1] * far


def _pair(point: Point) -> str:
    return f"{point[0]},{point[1]}"
