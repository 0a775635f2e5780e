"""Covers: the fixed cases, one module for each part of the protocol."""
