"""The only place for what a capture file holds: transactions, per SubDevice."""
