"""Places the boxes, labels and routes of a drawing without overlaps.

States stand in a column from top to bottom, those aside in a second one to its right. Between
neighbours of a column an arrow goes straight. Any other leaves a state at its side, in a row of its
own that carries the label, and joins a lane beside the column; all arrows to one state share a
lane, and enter it together. Labels lie between a column and its lanes, where nothing but their own
row passes.
"""

from __future__ import annotations

import unicodedata
from collections import defaultdict
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence

    from ecatspec.conformance.drawings.graph import Arrow, Graph

SIZE: Final = 12
"""Size of the letters."""
LINE: Final = 15
"""From one line of text to the next."""
_ADVANCE: Final = (62, 100)
"""No common monospace font has letters wider than this part of their size."""

_LANE: Final = 18
_PAD: Final = 12
_ROW: Final = 18
_CLEAR: Final = 6
"""Rows that have nothing to do with each other are so far apart."""
_UNDER: Final = 5
_BOX: Final = 40
_NARROWEST: Final = 140
_GAP: Final = 40
_SPREAD: Final = 16
"""Arrows between neighbours run so far from the middle of the column."""
_OFF: Final = 7
"""From an arrow to its label."""
_START: Final = 22
"""Length of the arrow to the first state."""

_LEFT, _RIGHT = "left", "right"


def width(text: str, size: int = SIZE) -> int:
    """Give the width that a text takes at most."""
    columns = sum(2 if unicodedata.east_asian_width(sign) in "WF" else 1 for sign in text)
    return -(-columns * size * _ADVANCE[0] // _ADVANCE[1])


@dataclass(frozen=True, slots=True)
class Box:
    """A state: its upper left corner and its size."""

    state: str
    x: int
    y: int
    width: int
    height: int


@dataclass(frozen=True, slots=True)
class Label:
    """Lines of text; `y` is the base of the first, `anchor` as in SVG."""

    lines: tuple[str, ...]
    x: int
    y: int
    anchor: str


@dataclass(frozen=True, slots=True)
class Route:
    """An arrow: the corners that it passes, and what stands at it."""

    arrow: Arrow
    points: tuple[tuple[int, int], ...]
    label: Label


@dataclass(frozen=True, slots=True)
class Layout:
    """Everything in its place, from 0, 0 to `width`, `height`; `start` leads to the first state."""

    width: int
    height: int
    boxes: tuple[Box, ...]
    routes: tuple[Route, ...]
    start: tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class _Lane:
    """What all arrows to one state share, on one side of the main column."""

    side: str
    target: str
    arrows: tuple[Arrow, ...]


@dataclass(frozen=True, slots=True)
class _Port:
    """A row at the side of a state: an arrow leaves, a lane arrives, or the device starts."""

    state: str
    side: str
    lane: _Lane | None
    arrow: Arrow | None


def layout(graph: Graph, first: Collection[str] = ()) -> Layout:
    """Place a machine; the rules `first` are named before others where not all can be."""
    return _Placing(graph, first).layout()


class _Placing:
    """The steps, each of which reads what those before have found."""

    def __init__(self, graph: Graph, first: Collection[str]) -> None:
        self.graph = graph
        self.line = graph.line
        self.aside = graph.aside
        self.states = (*self.line, *self.aside)
        self.labels = {arrow: arrow.names(first) for arrow in graph.arrows}
        self.straight = tuple(arrow for arrow in graph.arrows if self._adjacent(arrow))
        self.lanes = tuple(self._lanes())
        self.partner = {state: self._partner(state) for state in self.aside}
        self.rank = self._ranks()
        self.ports = {state: self._ports(state) for state in self.states}
        self.offsets, self.heights = self._rows()
        self.tops = self._tops()
        # a lane whose only arrow goes straight across takes no room
        bent = [lane for lane in self.lanes if len({self._y(p) for p in self._ends(lane)}) > 1]
        self.order = {side: self._order(side, bent) for side in (_LEFT, _RIGHT)}
        self._across()

    def _adjacent(self, arrow: Arrow) -> bool:
        return {arrow.source, arrow.target} in [
            {one, other} for column in (self.line, self.aside) for one, other in pairwise(column)
        ]

    # --- lanes and ports --------------------------------------------------------------------------

    def _side(self, arrow: Arrow) -> str:
        ends = (arrow.source, arrow.target)
        if any(state in self.aside for state in ends):
            return _RIGHT
        return _LEFT if self.line.index(ends[0]) > self.line.index(ends[1]) else _RIGHT

    def _lanes(self) -> Iterator[_Lane]:
        found: dict[tuple[str, str], list[Arrow]] = defaultdict(list)
        for arrow in self.graph.arrows:
            if arrow not in self.straight:
                found[self._side(arrow), arrow.target].append(arrow)
        for (side, target), arrows in found.items():
            yield _Lane(side, target, tuple(arrows))

    def _pair(self, lane: _Lane) -> bool:
        """One arrow between the columns, which goes straight across if it can."""
        ends = (lane.arrows[0].source, lane.target)
        return len(lane.arrows) == 1 and sum(state in self.aside for state in ends) == 1

    def _partner(self, state: str) -> _Lane | None:
        pairs = (lane for lane in self.lanes if self._pair(lane))
        return next((p for p in pairs if state in {p.target, p.arrows[0].source}), None)

    def _ranks(self) -> dict[str, float]:
        rank: dict[str, float] = {state: place for place, state in enumerate(self.line)}
        before = -1.0
        for state in self.aside:
            lane = self.partner[state]
            ends = () if lane is None else (lane.target, lane.arrows[0].source)
            wanted = (rank[end] for end in ends if end in self.line)
            before = rank[state] = max(before + 1, next(wanted, before + 1))
        return rank

    def _ports(self, state: str) -> tuple[_Port, ...]:
        found = []
        for lane in self.lanes:
            side = lane.side if state in self.line else _LEFT
            if lane.target == state:
                found.append(_Port(state, side, lane, None))
            found += [_Port(state, side, lane, a) for a in lane.arrows if a.source == state]
        found.sort(key=self._height)
        if state == self.graph.machine.initial:
            side = _LEFT if state in self.line else _RIGHT
            found.insert(0, _Port(state, side, None, None))
        return tuple(found)

    def _height(self, port: _Port) -> tuple[int, float]:
        """Sort what leads up above what leads down, and so that rows cross few lanes."""
        assert port.lane is not None
        if port.arrow is None:
            ranks = [self.rank[arrow.source] for arrow in port.lane.arrows]
            other = sum(ranks) / len(ranks)
        else:
            other = self.rank[port.arrow.target]
        here = self.rank[port.state]
        return (other > here) - (other < here), -other

    def _ends(self, lane: _Lane) -> list[_Port]:
        return [port for ports in self.ports.values() for port in ports if port.lane == lane]

    # --- from top to bottom -----------------------------------------------------------------------

    def _room(self, port: _Port) -> int:
        if port.arrow is None and not (port.lane and self._pair(port.lane)):
            return _ROW
        arrow = port.arrow or (port.lane.arrows[0] if port.lane else None)
        return _ROW if arrow is None else len(self.labels[arrow]) * LINE + _UNDER + 4

    def _rows(self) -> tuple[dict[_Port, int], dict[str, int]]:
        offsets: dict[_Port, int] = {}
        heights: dict[str, int] = {}
        for state, ports in self.ports.items():
            sides = [[p for p in ports if p.side == side] for side in (_LEFT, _RIGHT)]
            rooms = [sum(map(self._room, side)) for side in sides]
            heights[state] = max(_BOX, *(room + _PAD for room in rooms))
            for side, room in zip(sides, rooms, strict=True):
                down = (heights[state] - room) // 2
                for port in side:
                    down += self._room(port)
                    offsets[port] = down - _UNDER - (0 if room > _ROW else 4)
        return offsets, heights

    def _between(self, one: str, other: str) -> int:
        ends = {one, other}
        lines = [len(self.labels[a]) for a in self.straight if {a.source, a.target} == ends]
        return max(_GAP, max(lines, default=0) * LINE + 2 * _PAD)

    def _tops(self) -> dict[str, int]:
        tops: dict[str, int] = {}
        for column in (self.line, self.aside):
            for before, state in zip((None, *column), column, strict=False):
                top = self._wanted(state, tops)
                if before is not None:
                    least = tops[before] + self.heights[before] + self._between(before, state)
                    top = least if top is None else max(top, least)
                tops[state] = top or 0
                while column is self.aside and self._hidden(state, tops):
                    tops[state] += _CLEAR
        return tops

    def _hidden(self, state: str, tops: Mapping[str, int]) -> bool:
        """Two rows of different lanes lie on one height, where they look like one arrow."""
        facing = [p for other in self.line for p in self.ports[other] if p.side == _RIGHT]
        return any(
            abs(tops[state] + self.offsets[port] - tops[other.state] - self.offsets[other]) < _CLEAR
            for port in self.ports[state]
            for other in facing
            if port.side == _LEFT and port.lane != other.lane
        )

    def _wanted(self, state: str, tops: Mapping[str, int]) -> int | None:
        """Give the height at which the arrow between the columns goes straight across."""
        lane = self.partner.get(state)
        if lane is None:
            return None
        (here,) = (port for port in self._ends(lane) if port.state == state)
        (there,) = (port for port in self._ends(lane) if port.state != state)
        return tops[there.state] + self.offsets[there] - self.offsets[here]

    def _y(self, port: _Port) -> int:
        return self.tops[port.state] + self.offsets[port]

    # --- lanes from the column outwards -----------------------------------------------------------

    def _order(self, side: str, lanes: Sequence[_Lane]) -> list[_Lane]:
        order: list[_Lane] = []
        for lane in sorted((one for one in lanes if one.side == side), key=self._span):
            ways = [[*order[:at], lane, *order[at:]] for at in range(len(order), -1, -1)]
            order = min(ways, key=self._crossings)
        return order

    def _span(self, lane: _Lane) -> int:
        heights = [self._y(port) for port in self._ends(lane)]
        return max(heights) - min(heights)

    def _crossings(self, order: Sequence[_Lane]) -> int:
        found = 0
        for place, lane in enumerate(order):
            heights = [self._y(port) for port in self._ends(lane)]
            for other_place, other in enumerate(order):
                for port in self._ends(other):
                    outwards = place < other_place and port.state in self.line
                    inwards = place > other_place and port.state in self.aside
                    if outwards or inwards:
                        found += min(heights) <= self._y(port) <= max(heights)
        return found

    # --- from left to right -----------------------------------------------------------------------

    def _wide(self, column: Sequence[str]) -> int:
        names = [width(state, SIZE + 1) + 2 * _PAD for state in column]
        return max(_NARROWEST, *names) if names else 0

    def _gutter(self, column: Sequence[str], side: str) -> int:
        """Give the room that labels need beside a column."""
        room = [0]
        ports = [port for state in column for port in self.ports[state] if port.side == side]
        texts = [self.labels[port.arrow] if port.arrow else () for port in ports]
        room += [max(map(width, text), default=0) + 2 * _PAD + _START for text in texts]
        half = self._wide(column) // 2 - _SPREAD - _OFF - _PAD
        for arrow in self.straight:
            if arrow.source in column and (self._down(arrow) == (side == _LEFT)):
                room.append(max(map(width, self.labels[arrow])) - half)
        return max(room)

    def _down(self, arrow: Arrow) -> bool:
        return self.states.index(arrow.source) < self.states.index(arrow.target)

    def _across(self) -> None:
        left = len(self.order[_LEFT]) * _LANE
        self.main = left + self._gutter(self.line, _LEFT)
        lanes = self.main + self._wide(self.line) + self._gutter(self.line, _RIGHT)
        inner = lanes + len(self.order[_RIGHT]) * _LANE
        self.second = inner + (self._gutter(self.aside, _LEFT) + _LANE if self.aside else 0)
        self.right = self.second + self._wide(self.aside) + self._gutter(self.aside, _RIGHT)
        self.lane_x = {
            lane: left - place * _LANE - _LANE // 2 for place, lane in enumerate(self.order[_LEFT])
        } | {
            lane: lanes + place * _LANE + _LANE // 2
            for place, lane in enumerate(self.order[_RIGHT])
        }

    # --- everything in its place ------------------------------------------------------------------

    def _edge(self, port: _Port) -> int:
        column = self.line if port.state in self.line else self.aside
        x = self.main if port.state in self.line else self.second
        return x if port.side == _LEFT else x + self._wide(column)

    def layout(self) -> Layout:
        """Give the finished layout, moved so that nothing lies above 0."""
        top = min(self.tops.values())
        self.tops = {state: y - top for state, y in self.tops.items()}
        boxes = tuple(self._boxes())
        routes = [self._straight(arrow) for arrow in self.straight]
        routes += [self._bent(lane, arrow) for lane in self.lanes for arrow in lane.arrows]
        places = {arrow: place for place, arrow in enumerate(self.graph.arrows)}
        routes.sort(key=lambda route: places[route.arrow])
        bottom = max(box.y + box.height for box in boxes)
        return Layout(self.right, bottom, boxes, tuple(routes), self._start())

    def _boxes(self) -> Iterator[Box]:
        for column, x in ((self.line, self.main), (self.aside, self.second)):
            for state in column:
                yield Box(state, x, self.tops[state], self._wide(column), self.heights[state])

    def _straight(self, arrow: Arrow) -> Route:
        column, x = (
            (self.line, self.main) if arrow.source in self.line else (self.aside, self.second)
        )
        down = self._down(arrow)
        x += self._wide(column) // 2 + (-_SPREAD if down else _SPREAD)
        upper, lower = (arrow.source, arrow.target) if down else (arrow.target, arrow.source)
        ends = (self.tops[upper] + self.heights[upper], self.tops[lower])
        text = self.labels[arrow]
        middle = (ends[0] + ends[1] - (len(text) - 1) * LINE) // 2 + SIZE // 3
        label = Label(text, x + (-_OFF if down else _OFF), middle, "end" if down else "start")
        points = ((x, ends[0]), (x, ends[1]))
        return Route(arrow, points if down else points[::-1], label)

    def _bent(self, lane: _Lane, arrow: Arrow) -> Route:
        ends = self._ends(lane)
        (leaves,) = (port for port in ends if port.arrow == arrow)
        (arrives,) = (port for port in ends if port.arrow is None)
        one, other = (self._edge(leaves), self._y(leaves)), (self._edge(arrives), self._y(arrives))
        text = self.labels[arrow]
        left = leaves.side == _LEFT
        label = Label(
            text,
            one[0] + (-_PAD if left else _PAD),
            one[1] - _UNDER - (len(text) - 1) * LINE,
            "end" if left else "start",
        )
        corners: tuple[tuple[int, int], ...] = ()
        if one[1] != other[1]:
            corners = ((self.lane_x[lane], one[1]), (self.lane_x[lane], other[1]))
        return Route(arrow, (one, *corners, other), label)

    def _start(self) -> tuple[tuple[int, int], ...]:
        ports = self.ports[self.graph.machine.initial]
        port = next(port for port in ports if port.lane is None)
        x, y = self._edge(port), self._y(port)
        return (x - _START if port.side == _LEFT else x + _START, y), (x, y)
