"""The only place that knows which version is installed."""

from __future__ import annotations

from importlib import metadata


def version() -> str:
    """Give the version of the installed package, or say that it is not installed."""
    try:
        return metadata.version("ecatspec")
    except metadata.PackageNotFoundError:
        return "(not installed)"
