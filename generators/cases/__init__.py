"""Test cases: their shape, the stimuli that they are made of, and common ways through a device."""
