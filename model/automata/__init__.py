"""Finite machines: made by exploring a device, and compared."""
