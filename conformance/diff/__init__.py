"""Compares two specifications, or two devices."""
