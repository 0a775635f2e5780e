"""The only place that writes files: whole or not at all."""

from __future__ import annotations

import os
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Final

_READABLE: Final = 0o666
"""What files are by default, before the user's mask."""


def write_whole(path: Path, text: str) -> None:
    """Write a text file in place of the one before; a reader never sees half of it.

    Raises:
        OSError: The file cannot be written; what was there before is still there.

    """
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
        mask = os.umask(0)  # it can only be read by setting it
        os.umask(mask)
        Path(name).chmod(_READABLE & ~mask)
        Path(name).replace(path)
    except BaseException:
        with suppress(OSError):
            Path(name).unlink()
        raise
