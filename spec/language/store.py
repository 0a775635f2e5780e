"""What takes long to compute may be kept between starts, by the program that uses the core.

The core itself reads and writes no files but the texts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

_T = TypeVar("_T")
_LANGUAGE: Final = ("ecatspec.spec.language",)


class Store(Protocol):
    """Keeps answers between starts."""

    def kept(
        self, name: str, source: bytes, make: Callable[[], _T], program: tuple[str, ...]
    ) -> _T:
        """Give what `make` gives, or gave at an earlier start for the same source and program.

        One answer is kept under each name, which may be that of a file. `program` names the
        packages that decide what `make` gives.
        """


class _Nowhere:
    """Makes everything anew."""

    def kept(
        self,
        name: str,  # noqa: ARG002  of the contract
        source: bytes,  # noqa: ARG002
        make: Callable[[], _T],
        program: tuple[str, ...],  # noqa: ARG002
    ) -> _T:
        return make()


_used: list[Store] = [_Nowhere()]


def keep_in(store: Store) -> None:
    """Let a store keep what is computed from now on."""
    _used[0] = store


def kept(
    name: str, source: bytes, make: Callable[[], _T], program: tuple[str, ...] = _LANGUAGE
) -> _T:
    """Give what `make` gives, by the store in use (`Store.kept`)."""
    return _used[0].kept(name, source, make, program)
