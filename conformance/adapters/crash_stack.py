"""Reads the stack of a device that died from its error stream: the kind of crash and its frames.

Sanitizers report in one format, and so does `dying` for a library that ends by a signal: a head
that says the kind of the error, then a line for each frame. What varies from run to run (addresses,
process numbers, folders) is left out, so that two crashes of one cause have the same words.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from collections import Counter
from dataclasses import dataclass
from functools import cache
from pathlib import PurePath
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

HEAD: Final = "ecatspec: C stack at "
"""What `dying` writes before the name of the signal."""
SHOWN: Final = 10
"""Frames of a stack that are kept, the innermost first."""
_OVERFLOW: Final = "stack-overflow"
_ADDR2LINE_LIMIT: Final = 10.0
"""Seconds that addr2line may take for one stack."""

_REPORT: Final = re.compile(
    rf"^(?:==\d+==)?ERROR: \w+Sanitizer: (?:attempting )?(?P<error>\S+)"
    rf"|^(?P<file>.+?):(?P<line>\d+)(?::\d+)?: runtime error: "
    rf"|^{HEAD}(?P<signal>\w+)$",
    re.MULTILINE,
)
"""How each report begins."""
_SUMMARY: Final = re.compile(r"^SUMMARY: \w+Sanitizer: (\d+ byte|data race|\S+)", re.MULTILINE)
_FRAME: Final = re.compile(r"^\s*#\d+ 0x[0-9a-f]+ (?:in )?(?P<rest>.*\S)\s*$")
_IN_MODULE: Final = re.compile(
    r"^(?:(?P<function>.*) )?\((?P<module>.+)\+0x(?P<offset>[0-9a-f]+)\)(?: \(BuildId: \w+\))?$"
)
_IN_SOURCE: Final = re.compile(r"^(?P<function>.*?) (?P<file>/.*?|\S+?):(?P<line>\d+)(?::\d+)?$")

_RUNTIME_MODULE: Final = re.compile(
    r"(?:lib(?:clang_rt\.)?(?:a|hwa|l|m|t|ub)san|lib(?:c|m|dl|rt|pthread|ffi|gcc_s|unwind|c\+\+"
    r"|c\+\+abi|stdc\+\+))[-_.]|ld-|ld\.so|libpython\d|python[\d.]*$|_ctypes\.|linux-vdso|\["
)
_RUNTIME_SOURCE: Final = re.compile(
    r"(?:^|/)(?:compiler-rt|libsanitizer|nptl|sysdeps)/"
    r"|^\.{1,2}/(?:assert|csu|debug|libio|malloc|signal|stdio-common|stdlib|string)/"
    r"|(?:^\.?|^\.\.|^\./[-\w]+/\.\.|/[Pp]ython[-.\w]*)/?(?:Include|Modules|Objects|Programs|Python)/"
)
_RUNTIME_FUNCTION: Final = re.compile(
    r"_*(?:interceptor|asan|hwasan|lsan|msan|tsan|ubsan|sanitizer|libc)(?:_|::)|_start$"
    r"|operator (?:new|delete)|ecatspec_chip_"
)
"""Functions that are never the device's: the last are those of ecatspec_chip.h."""
_STANDS_IN: Final = re.compile(
    r"^(?:mem|str)[a-z]+$|^bcmp$|^v?s?n?f?printf$|^(?:c|m|re)alloc$|^free$"
)
"""Functions of the C library that a sanitizer brings into the program itself."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One call on the way to a crash; what a report does not tell is empty."""

    function: str
    file: str = ""
    line: str = ""
    module: str = ""
    offset: str = ""

    @property
    def runtime(self) -> bool:
        """Tell whether the frame is not of the device: sanitizer, C library, Python, our chip."""
        if self.module and _RUNTIME_MODULE.match(PurePath(self.module).name):
            return True
        if _RUNTIME_FUNCTION.match(self.function):
            return True
        where, pattern = (self.file, _RUNTIME_SOURCE) if self.file else (self.function, _STANDS_IN)
        return pattern.search(where) is not None

    def __str__(self) -> str:
        if self.file:
            place = f"{PurePath(self.file).name}:{self.line}"
            return f"{self.function} ({place})" if self.function else place
        module = PurePath(self.module).name
        return f"{self.function} ({module})" if self.function else f"{module}+0x{self.offset}"


@dataclass(frozen=True, slots=True)
class Crash:
    """How a device died: the same words in every run that dies of the same."""

    kind: str
    stack: tuple[Frame, ...]
    """Frames of the device, the innermost first."""

    @property
    def cause(self) -> str:
        """Say the kind, and where; where a stack overflows is a matter of chance."""
        if not self.stack:
            return f"killed by {self.kind} outside of its own code"
        if self.kind == _OVERFLOW:
            calls = Counter(frame.function or str(frame) for frame in self.stack)
            again = sorted(name for name, count in calls.items() if count > 1)
            return f"{self.kind} in {', '.join(again) or self.stack[0]}"
        return f"{self.kind} in {self.stack[0]}"


def own_words(tail: str) -> str:
    """Give what the device said itself, without the stack that its host added."""
    return tail.partition(f"\n{HEAD}")[0]


def crash(tail: str) -> Crash | None:
    """Read the last report in the last words; None: there is none."""
    reports = [*_REPORT.finditer(tail)]
    if not reports:
        return None
    report = reports[-1]
    rest = tail[report.end() :]
    frames = [named for frame in _frames(rest) for named in _named(frame)]
    if not frames and report["file"]:
        frames = [Frame("", report["file"], report["line"])]
    own = tuple(frame for frame in frames if not frame.runtime)[:SHOWN]
    return Crash(_kind(report, rest), own)


def _kind(report: re.Match[str], rest: str) -> str:
    if report["signal"]:
        return report["signal"]
    summary = _SUMMARY.search(rest)
    kind = summary[1] if summary else report["error"] or "undefined-behavior"
    return "memory-leak" if kind[0].isdigit() else kind.replace(" ", "-").rstrip(":")


def _frames(text: str) -> Iterator[Frame]:
    """Read the first block of frames; what follows tells where memory came from."""
    begun = False
    for line in text.split("\n"):
        match = _FRAME.match(line)
        if match is None:
            if begun:
                return
            continue
        begun = True
        rest = match["rest"]
        if place := _IN_MODULE.match(rest) or _IN_SOURCE.match(rest):
            fields = place.groupdict()
            yield Frame(**{name: text or "" for name, text in fields.items()})


def _named(frame: Frame) -> tuple[Frame, ...]:
    """Give the frames that debug information knows for one that names its module only."""
    if frame.file or frame.runtime:
        return (frame,)
    known = _addr2line(frame.module, frame.offset)
    return known or (frame,)


@cache
def _addr2line(module: str, offset: str) -> tuple[Frame, ...]:
    """Ask binutils; functions that were inlined are frames of their own."""
    program = shutil.which("addr2line")
    if program is None:
        return ()
    command = [program, "-C", "-f", "-i", "-e", module, f"0x{offset}"]
    try:
        done = subprocess.run(  # noqa: S603  the module is the device under test
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_ADDR2LINE_LIMIT,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return ()
    lines = done.stdout.splitlines()
    found = []
    for function, place in zip(lines[::2], lines[1::2], strict=False):
        if function == "??":
            return ()
        file, _, line = place.partition(" (")[0].rpartition(":")
        source = (file, line) if line.isdigit() and line != "0" else ("", "")
        found.append(Frame(function, *source, module, offset))
    return tuple(found)
