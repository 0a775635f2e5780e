"""Programs of tests that run where sets have another order."""

from __future__ import annotations

import os
import subprocess
import sys


def printed_twice(program: str) -> tuple[str, str]:
    """Run a program in two processes with different hash seeds; give what each printed."""
    first, second = (
        subprocess.run(
            [sys.executable, "-P", "-c", program],
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
            check=True,
            text=True,
        ).stdout
        for seed in ("1", "2")
    )
    return first, second
