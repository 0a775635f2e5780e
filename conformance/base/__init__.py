"""What every part of the tool uses: the adapter contract, verdicts, devices by name, files."""
