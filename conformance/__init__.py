"""Tests devices: adapters, runs, verdicts, reports, and the command line."""
