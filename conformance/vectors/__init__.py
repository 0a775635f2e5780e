"""Test vectors: recorded from the virtual SubDevice, replayed on any device, checked as files."""
