"""Judging: which states explain all that was exchanged with a device so far."""
