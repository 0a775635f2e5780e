"""Runs that were kept: their files, their history, comparison, known deviations."""
