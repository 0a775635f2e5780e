"""The only place for testing devices: adapters, runner, verdicts, reports, command line."""
