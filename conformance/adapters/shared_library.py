"""Loads shared libraries: checks the file, and preloads sanitizer runtimes."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ecatspec.conformance.base.adapter import AdapterError

if TYPE_CHECKING:
    from collections.abc import Mapping

HEADERS: Final = Path(__file__).resolve().parent
"""The folder of ecatspec_dut.h and ecatspec_chip.h."""
_MARK: Final = b"\0__asan_init\0"
"""What a library with an address sanitizer wants of the program that loads it."""
_RUNTIME: Final = re.compile(rb"\0(lib(?:clang_rt\.)?asan[-\w]*\.so[.\d]*)\0")
_OPTIONS: Final = "detect_leaks=0:abort_on_error=0"
"""Python itself leaves memory behind, and a report that ends the process is enough."""


def library_file(path: str) -> Path:
    """Give the file of a library; it is never looked up elsewhere."""
    if not path:
        message = "the path of the library is empty; give e.g. lib:./libdut.so"
        raise AdapterError(message)
    file = Path(path).absolute()
    if not file.is_file():
        message = f"there is no file {path!r}; give the path of a shared library"
        raise AdapterError(message)
    return file


def environment(file: Path) -> Mapping[str, str]:
    """Give what the environment of a host must have, so that the library can be loaded.

    An address sanitizer has to be in a process before everything else.  A library names the one it
    was linked with, but for compilers that leave it to the program: then the user has to preload.
    """
    data = file.read_bytes()
    if _MARK not in data:
        return {}
    given = os.environ.get("LD_PRELOAD", "")
    if "asan" not in given:
        runtime = _RUNTIME.search(data)
        if runtime is None:
            message = f"{file.name} has an address sanitizer, but does not name its library; "
            message += "link with -shared-libasan, or set LD_PRELOAD to it"
            raise AdapterError(message)
        given = " ".join(filter(None, (runtime[1].decode("ascii"), given)))
    options = ":".join(filter(None, (_OPTIONS, os.environ.get("ASAN_OPTIONS"))))
    return {"LD_PRELOAD": given, "ASAN_OPTIONS": options}
