"""The only place that turns what a user named into a specification."""

from __future__ import annotations

from ecatspec.spec.language.ir import Protocol
from ecatspec.spec.language.load import load_device, load_file


def load(name_or_path: str) -> Protocol:
    """Load a shipped device text by name or a text file by path."""
    return load_file(name_or_path) if name_or_path.endswith(".ecs") else load_device(name_or_path)
