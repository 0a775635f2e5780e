"""The only place that writes what is generated under docs/: chapters, and the table of swaps.

`make docs` runs it. Tests compare the chapters with what it writes, and the digests of the table.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from ecatspec.conformance.adapters.model import make
from ecatspec.conformance.chapter import chapter
from ecatspec.conformance.files import write_whole
from ecatspec.conformance.runner import Runner
from ecatspec.conformance.verdict import Finding, Outcome, Result
from ecatspec.generators.case import NO_LIMITS
from ecatspec.generators.suite import all_cases
from ecatspec.model.compiled import Model
from ecatspec.spec.language.load import device_names, load_device

DOCS = Path(__file__).resolve().parent
SHOWN = 3
"""So many findings of a pair are told in words."""


def devices() -> tuple[str, ...]:
    """Give the devices that have a manual."""
    return tuple(name for name in device_names() if load_device(name).manuals)


def chapters() -> dict[Path, str]:
    """Give the chapters by their files, and the page that lists them."""
    pages = {DOCS / "devices" / f"{name}.md": chapter(load_device(name)) for name in devices()}
    lines = ["# Devices", "", "Made by `make docs` from the texts in `spec/devices/`.", ""]
    lines += [f"- [{load_device(name).wording}]({name}.md)" for name in devices()]
    return {DOCS / "devices" / "README.md": "\n".join(lines) + "\n", **pages}


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
    (DOCS / "devices").mkdir(exist_ok=True)
    for file, text in chapters().items():
        write_whole(file, text)
    write_whole(DOCS / "swaps.md", swaps())


if __name__ == "__main__":
    main()
