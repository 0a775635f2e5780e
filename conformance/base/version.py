"""Reads the version that is installed."""

from __future__ import annotations


def version() -> str:
    """Give the version of the installed package, or say that it is not installed."""
    from importlib import metadata  # slow to import, and seldom needed

    try:
        return metadata.version("ecatspec")
    except metadata.PackageNotFoundError:
        return "(not installed)"
