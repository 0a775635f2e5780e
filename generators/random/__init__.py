"""Seeded random tests: walks over a device, and Hypothesis strategies."""
