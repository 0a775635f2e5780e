"""A text in tables and pages for people."""
