"""The command of the benchmarks: one table of everything beside its rival.

    python bench/run.py [--quick] [--only NAME ...] [--json FILE] [--write] [--profile NAME ...]

NAME is a topic or a row. `--write` fills docs/performance.md and draws docs/growth.svg.
Nothing here passes or fails: a target that is missed is told with its profile.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

import adapters
import captures
import commands
import complete
import diff
import exchanges
import growth
import transfers
import walks
import wire
from measure import HEADS, ROOT, Absent, Effort, Found, Profile, machine, measured, number
from rich.console import Console
from rich.table import Table as Drawn

from ecatspec.conformance.base.atomic_write import write_whole

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from measure import Curve, Part, Row, Table

TOPICS: Final[Mapping[str, tuple[Part, ...]]] = {
    "exchanges": exchanges.PARTS,
    "adapters": adapters.PARTS,
    "walks": walks.PARTS,
    "suites": complete.PARTS,
    "compare": diff.PARTS,
    "monitor": captures.PARTS,
    "transfers": transfers.PARTS,
    "commands": commands.PARTS,
    "cable": wire.PARTS,
    "growth": growth.PARTS,
}
PAGE: Final = ROOT / "docs" / "performance.md"
PLOT: Final = ROOT / "docs" / "growth.svg"
BEGIN: Final = "<!-- measured: bench/run.py writes from here -->"
END: Final = "<!-- measured: to here -->"
_PIPE_WIDTH: Final = 160


@dataclass(slots=True)
class Report:
    """All that was measured in one process run."""

    command: str
    machine: Mapping[str, str]
    rows: list[Row] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    curves: list[Curve] = field(default_factory=list)
    profiles: dict[str, Profile] = field(default_factory=dict)

    def add(self, found: Found) -> None:
        self.rows += found.rows
        self.tables += found.tables
        self.curves += found.curves

    def missed(self) -> list[Row]:
        return [row for row in self.rows if row.reached is False]


def chosen(names: Sequence[str]) -> list[Part]:
    """Give the parts of topics and rows, all for no names, in the order of the table.

    Raises:
        ValueError: A name is neither.

    """
    known = {row.name for parts in TOPICS.values() for part in parts for row in part.rows}
    for name in names:
        if name not in TOPICS and name not in known:
            rows = ", ".join(sorted(known))
            raise ValueError(
                f"there is nothing called {name}; topics: {', '.join(TOPICS)}; rows: {rows}"
            )
    return [
        part
        for topic, parts in TOPICS.items()
        for part in parts
        if not names or topic in names or any(row.name in names for row in part.rows)
    ]


def take(
    report: Report, parts: Sequence[Part], effort: Effort, tell: Callable[[str], None]
) -> None:
    """Measure parts, and profile what misses its target."""
    for number_, part in enumerate(parts, 1):
        tell(f"{number_} of {len(parts)}: {part.rows[0].what}")
        found = measured(part, effort)
        report.add(found)
        for row in found.rows:
            if row.reached is False and row.name in part.profiles:
                tell(f"{number_} of {len(parts)}: profile of {row.what}")
                report.profiles[row.name] = part.profiles[row.name](effort)


def profile(
    report: Report, names: Sequence[str], effort: Effort, tell: Callable[[str], None]
) -> None:
    """Take profiles without measuring.

    Raises:
        ValueError: There is no such row, or it has no profile.

    """
    for part in chosen(names):
        for name, taken in part.profiles.items():
            if name in names:
                tell(f"profile of {name}")
                report.profiles[name] = taken(effort)
    if missing := set(names) - report.profiles.keys():
        raise ValueError(f"there is no profile of {', '.join(sorted(missing))}")


# --- as JSON --------------------------------------------------------------------------------------


def as_json(report: Report) -> str:
    """Give all figures as data."""
    data = {
        "schema": "ecatspec.bench",
        "schema_version": 1,
        "command": report.command,
        "machine": dict(report.machine),
        "rows": [_row_data(row) for row in report.rows],
        "tables": [asdict(table) for table in report.tables],
        "curves": [
            {**asdict(curve), "slope": curve.slope, "worst": curve.worst} for curve in report.curves
        ],
        "profiles": {name: asdict(taken) for name, taken in report.profiles.items()},
    }
    return json.dumps(data, indent=2) + "\n"


def _row_data(row: Row) -> dict[str, object]:
    data = asdict(row)
    if row.target is not None:
        data["target"] |= {"of": row.target.of.name.lower(), "words": row.target.words(row.unit)}
    return {**data, "ratio": row.ratio, "measured": row.measured, "reached": row.reached}


# --- as a page ------------------------------------------------------------------------------------


def as_page(report: Report) -> str:
    """Give what stands between the markers of the page."""
    on = report.machine
    where = f"{on['processor']}, {on['cores']} cores, {on['system']}, Python {on['python']}"
    blocks = [
        f"Measured on {on['date']} by `{report.command}` on {where}, load {on['load']} before.",
        _grid(HEADS, [row.cells() for row in report.rows]),
        _reached(report),
        "## What each figure is",
        "\n".join(f"- **{row.what}**: {row.note}." for row in report.rows if row.note),
    ]
    if missed := report.missed():
        blocks.append("## Targets that are missed")
        for row in missed:
            blocks.append(f"**{row.what}** {_how_far(row)} {row.why}".rstrip())
            if row.name in report.profiles:
                taken = report.profiles[row.name]
                blocks += [f"{taken.how}, {number(taken.seconds)} s:", _shares(taken)]
    if report.curves:
        blocks += [
            "## Growth",
            f"![time against size, both doubling; dashed: a straight line]({PLOT.name})",
            _grid(
                ("time", "of", "seconds", "power", "worst doubling / 2"),
                [
                    (
                        curve.name,
                        curve.unit,
                        ", ".join(f"{size:,}: {number(took)}" for size, took in curve.points),
                        f"{curve.slope:.2f}",
                        f"{curve.worst:.2f}",
                    )
                    for curve in report.curves
                ],
            ),
        ]
    for table in report.tables:
        blocks += [f"## {table.title}", _grid(table.heads, table.rows)]
        blocks += [table.note] if table.note else []
    return "\n\n".join(blocks)


def _reached(report: Report) -> str:
    held = [row.reached for row in report.rows if row.target is not None]
    counts = f"reached {held.count(True)}, missed {held.count(False)}, not measured "
    return f"Of {len(held)} targets: {counts}{held.count(None)}."


def _how_far(row: Row) -> str:
    assert row.target is not None
    assert row.measured is not None
    return f"is {number(row.measured)} where {row.target.words(row.unit)} was wanted."


def _shares(taken: Profile) -> str:
    rows = [
        (f"{s.part:.1%}", "" if s.calls is None else f"{s.calls:,}", f"`{s.where}`")
        for s in taken.shares
    ]
    return _grid(("share", "calls", "where"), rows)


def _grid(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', '/') for cell in line)} |" for line in lines)


def write(report: Report) -> None:
    """Put the tables between the markers of the page, and draw the curves.

    Raises:
        ValueError: The page has no markers.

    """
    page = PAGE.read_text("utf-8")
    before, begun, rest = page.partition(BEGIN)
    _, ended, after = rest.partition(END)
    if not (begun and ended):
        raise ValueError(f"{PAGE.name} has lost its markers: {BEGIN} and {END}")
    write_whole(PLOT, growth.drawing(report.curves))
    write_whole(PAGE, f"{before}{BEGIN}\n\n{as_page(report)}\n\n{END}{after}")


# --- on a terminal --------------------------------------------------------------------------------


def show(report: Report, console: Console) -> None:
    """Print the table, then the details."""
    on = report.machine
    caption = f"{on['date']}, {on['processor']}, {on['cores']} cores, Python {on['python']}"
    if report.rows:
        console.print(
            _drawn("ecatspec beside its rivals", HEADS, [r.cells() for r in report.rows], caption)
        )
        for row in report.rows:
            if row.note:
                console.print(f"{row.name}: {row.note}", markup=False, highlight=False)
        console.print(_reached(report))
    for table in report.tables:
        console.print(_drawn(table.title, table.heads, table.rows, table.note))
    for name, taken in report.profiles.items():
        shares = [
            (f"{s.part:.1%}", "" if s.calls is None else f"{s.calls:,}", s.where)
            for s in taken.shares
        ]
        title = f"{name}: {taken.how}, {number(taken.seconds)} s"
        console.print(_drawn(title, ("share", "calls", "where"), shares, ""))


def _drawn(title: str, heads: Sequence[str], rows: Sequence[Sequence[str]], caption: str) -> Drawn:
    table = Drawn(title=title, caption=caption, show_lines=True)
    for head in heads:
        table.add_column(head)
    for row in rows:
        table.add_row(*(cell.replace("`", "").replace("[", "\\[") for cell in row))
    return table


@contextmanager
def telling(console: Console) -> Iterator[Callable[[str], None]]:
    """Give what tells how far it is; on a terminal only."""
    if not console.is_terminal:
        yield lambda _: None
        return
    with console.status("") as status:
        yield status.update


def _command(asked: argparse.Namespace) -> str:
    """Give the command without the names of files, which are those of this machine."""
    words = ["python", "bench/run.py"]
    words += [f"--{name}" for name in ("quick", "write") if getattr(asked, name)]
    for name in ("only", "profile"):
        chosen_names: list[str] = getattr(asked, name)
        words += [f"--{name}", *chosen_names] if chosen_names else []
    return shlex.join(words)


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description="Measure ecatspec beside its rivals.")
    parser.add_argument(
        "--quick", action="store_true", help="less work: a look, no figures to keep"
    )
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="topics or rows")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures as data")
    parser.add_argument("--write", action="store_true", help=f"write docs/{PAGE.name}")
    parser.add_argument("--profile", nargs="+", default=[], metavar="NAME", help="only profiles")
    asked = parser.parse_args(arguments)
    if asked.write and (asked.only or asked.profile):
        parser.error("the page has all figures of one run: leave out --only and --profile")
    effort = Effort.QUICK if asked.quick else Effort.WHOLE
    report = Report(_command(asked), machine())
    console, errors = Console(), Console(stderr=True)
    if not console.is_terminal:
        console.width = _PIPE_WIDTH
    try:
        with telling(errors) as tell:
            if asked.profile:
                profile(report, asked.profile, effort, tell)
            else:
                take(report, chosen(asked.only), effort, tell)
        if asked.write:
            write(report)
        if asked.json is not None:
            write_whole(asked.json, as_json(report))
    except (Absent, OSError, ValueError) as error:
        print(f"bench: {error}", file=sys.stderr)
        return 2
    show(report, console)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
