"""Writes files whole or not at all."""

from __future__ import annotations

import errno
import os
import tempfile
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import IO

_READABLE: Final = 0o666
"""What files are by default, before the user's mask."""


def write_whole(path: Path, text: str) -> None:
    """Write a text file in place of the one before; a reader never sees half of it.

    Raises:
        OSError: The file cannot be written; what was there before is still there.

    """
    with whole(path) as file:
        file.write(text.encode())


@contextmanager
def whole(path: Path) -> Iterator[IO[bytes]]:
    """Give a file to write to, which takes the place of the one before once all is written.

    Raises:
        OSError: The file cannot be written; what was there before is still there.

    """
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "it is no file", str(path))
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            yield file
        mask = os.umask(0)  # it can only be read by setting it
        os.umask(mask)
        Path(name).chmod(_READABLE & ~mask)
        Path(name).replace(path)
    except BaseException:
        with suppress(OSError):
            Path(name).unlink()
        raise
