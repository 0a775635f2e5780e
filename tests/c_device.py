"""What tests know of examples/c_slave, and of the compiler that builds it."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from ecatspec.conformance.adapters.shared_library import HEADERS

SOURCES = Path(__file__).resolve().parent.parent / "examples" / "c_slave"
TEXT = str(SOURCES / "slave.ecs")

WHERE = {
    "AL_CODE_FORGOTTEN": "al/",
    "AL_ERROR_NOT_LATCHED": "al/",
    "AL_UNKNOWN_STATE": "al/",
    "AL_MAILBOX_UNCHECKED": "al/",
    "MAILBOX_COUNTER_IGNORED": "mailbox/",
    "MAILBOX_LENGTH_UNCHECKED": "sdo/malformed/",
    "MAILBOX_COUNTER_STUCK": "mailbox/",
    "REPEAT_UNACKNOWLEDGED": "mailbox/",
    "SDO_SIZE_UNCHECKED": "sdo/download_",
    "SDO_WRONG_ABORT": "sdo/no_subindex/",
    "SDO_RANGE_ONE_SIDED": "sdo/range_",
    "SDO_STATE_UNCHECKED": "sdo/upload_in_",
    "SEGMENT_TOGGLE_UNCHECKED": "sdo/transfer/",
    "SEGMENT_LAST_TOO_EARLY": "sdo/transfer/",
    "SEGMENT_LAST_FORGOTTEN": "sdo/transfer/",
    "WATCHDOG_IGNORED": "process_data/",
    "OUTPUTS_IN_SAFEOP": "ds402/up_again/",
    "PDO_LENGTH_UNCHECKED": "process_data/",
    "RESET_BY_LEVEL": "ds402/reset_held/",
    "QUICK_STOP_IGNORED": "ds402/shutdown/enable_operation/",
}
"""The cases of a quick run that show a fault, so that not all of them run for each."""


def sanitizes(folder: Path) -> bool:
    """Tell whether the compiler can link sanitizers; some systems have none."""
    compiler, source = shutil.which("cc"), folder / "empty.c"
    if compiler is None:
        return False
    source.write_text("int main(void) { return 0; }\n")
    command = [compiler, "-fsanitize=address,undefined", "-o", str(folder / "empty"), str(source)]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


def build(folder: Path, *arguments: str, sources: Path = SOURCES) -> Path:
    """Make the program, or what else the arguments ask for; give the folder that holds it."""
    make, compiler = shutil.which("make"), shutil.which("cc")
    if make is None or compiler is None:
        pytest.skip("no C compiler: needs make and cc")
    command = [make, "-s", "-C", str(sources), f"BUILD={folder}", f"CC={compiler}"]
    made = subprocess.run(
        [*command, f"INCLUDE={HEADERS}", *arguments], capture_output=True, text=True, check=False
    )
    assert made.returncode == 0, made.stderr
    return folder


def library(
    source: str, file: Path, *options: str, standard: str = "c99", program: str = "cc"
) -> Path:
    """Compile a library that is one file in C, or in C++."""
    compiler = shutil.which(program)
    if compiler is None:
        pytest.skip(f"no C compiler: needs {program}")
    language = "c++" if "++" in standard else "c"
    command = [
        compiler,
        f"-std={standard}",
        "-Wall",
        "-Wextra",
        "-Werror",
        "-g",
        "-shared",
        "-fPIC",
    ]
    made = subprocess.run(
        [*command, *options, "-I", str(HEADERS), "-o", str(file), "-x", language, "-"],
        input=source,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "LC_ALL": "C"},
    )
    assert made.returncode == 0, made.stderr
    return file
