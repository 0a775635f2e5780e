"""Judges what was exchanged with a device, by the explanations that remain."""
