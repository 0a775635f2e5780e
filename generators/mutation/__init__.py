"""Mistakes made on purpose: in messages, in rules and in data of the texts."""
