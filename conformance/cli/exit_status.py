"""Exit statuses of the commands."""

from __future__ import annotations

from typing import Final

CONFORMS: Final = 0


DOES_NOT_CONFORM: Final = 1


WRONG_INPUT: Final = 2


INTERRUPTED: Final = 130
