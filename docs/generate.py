"""Writes what is generated under docs/: chapters, reference, table of swaps.

`make docs` runs it. Tests compare the pages with what it writes, and the digests of the table.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from importlib import resources
from pathlib import Path

from ecatspec.conformance.adapters.model import make
from ecatspec.conformance.base.atomic_write import write_whole
from ecatspec.conformance.base.verdict import Finding, Outcome, Result
from ecatspec.conformance.describe.device_page import chapter
from ecatspec.conformance.describe.reference_pages import grammar_page, standard_page
from ecatspec.conformance.run.runner import Runner
from ecatspec.generators.cases.case import NO_LIMITS
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model
from ecatspec.spec import language
from ecatspec.spec.language.load import device_names, load_device, standard_texts

DOCS = Path(__file__).resolve().parent
SHOWN = 3
"""Maximum number of findings of a pair that are given in words."""


def devices() -> tuple[str, ...]:
    """Give the devices that have a manual."""
    return tuple(name for name in device_names() if load_device(name).manuals)


def pages() -> dict[Path, str]:
    """Give what is made in a moment, by its files: chapters, reference, and lists of pages."""
    grammar = resources.files(language).joinpath("grammar.lark").read_text(encoding="utf-8")
    standard = load_device("standard")
    decisions = {file: _title(file) for file in sorted((DOCS / "decisions").glob("[0-9]*.md"))}
    chapters = {DOCS / "devices" / f"{name}.md": chapter(load_device(name)) for name in devices()}
    texts = {
        DOCS / "standard" / f"{text.name}.md": standard_page(text, standard)
        for text in standard_texts()
    }
    return {
        DOCS / "grammar.md": grammar_page(grammar),
        DOCS / "standard" / "README.md": _listed(
            "The standard",
            "Made by `make docs` from the texts in `spec/standard/`.",
            {file.name: page.partition("\n")[0].removeprefix("# ") for file, page in texts.items()},
        ),
        DOCS / "devices" / "README.md": _listed(
            "Devices",
            "Made by `make docs` from the texts in `spec/devices/`.",
            {f"{name}.md": load_device(name).wording for name in devices()},
        ),
        DOCS / "decisions" / "README.md": _listed(
            "Decisions",
            "What was asked, what was chosen, what was given up. `make docs` makes this list.",
            {file.name: title for file, title in decisions.items()},
        ),
        **chapters,
        **texts,
    }


def _title(file: Path) -> str:
    return file.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")


def _listed(title: str, about: str, names: dict[str, str]) -> str:
    """Give the page that lists others; the last lines are for the site, which wants a tree."""
    lines = [f"# {title}", "", about, ""]
    lines += [f"- [{wording}]({file})" for file, wording in names.items()]
    lines += ["", "```{toctree}", ":hidden:", "", *(n.removesuffix(".md") for n in names), "```"]
    return "\n".join(lines) + "\n"


def swapped(text: str, device: str) -> Result:
    """Run the suite of one text against the virtual SubDevice of another."""
    model = Model(load_device(text))
    adapter = make(device, {})
    description = adapter.describe()
    runner = Runner(model, adapter, description)
    runner.run(all_cases(model, NO_LIMITS, "quick"), None, 0)
    return Result(text, device, tuple(runner.verdicts), (), 0, (), 0, 0.0)


def swaps() -> str:
    """Give the page of swaps: what each text finds in the virtual SubDevice of each device."""
    names = devices()
    pairs = [(text, device) for text in names for device in names]
    with ProcessPoolExecutor() as pool:
        every = pool.map(swapped, *zip(*pairs, strict=True))
        results = dict(zip(pairs, every, strict=True))
    lines = [
        "# Swapped devices",
        "",
        "What `ecatspec run TEXT` finds when another device answers: causes that blame the device,",
        "by the quick suite. On the diagonal each text meets its own virtual SubDevice.",
        "Made by `make docs`.",
        "",
        "| text \\ device | " + " | ".join(names) + " |",
        "| --- |" + " --- |" * len(names),
    ]
    for text in names:
        cells = (str(len(_blaming(results[text, device]))) for device in names)
        lines.append(f"| {text} | " + " | ".join(cells) + " |")
    lines += ["", "The texts that this was made of:", ""]
    lines += [f"- {name} `{load_device(name).digest}`" for name in names]
    for text in names:
        lines += ["", f"## The text of {text}"]
        for device in names:
            found = _blaming(results[text, device])
            if found:
                lines += ["", f"Against {device}, first of {len(found)}:", ""]
                lines += [_told(finding) for finding in found[:SHOWN]]
    return "\n".join(lines) + "\n"


def _blaming(result: Result) -> list[Finding]:
    blaming = {Outcome.FAIL, Outcome.CRASH}
    return [finding for finding in result.findings() if finding.verdict.outcome in blaming]


def _told(finding: Finding) -> str:
    verdict = finding.verdict
    cited = ", ".join(verdict.clauses)
    expected = " or ".join(verdict.expected[:2])
    return f"- {verdict.title}: {verdict.observed} instead of {expected} ({cited})"


def main() -> None:
    """Write all pages."""
    for file, text in pages().items():
        file.parent.mkdir(exist_ok=True)
        write_whole(file, text)
    write_whole(DOCS / "swaps.md", swaps())


if __name__ == "__main__":
    main()
