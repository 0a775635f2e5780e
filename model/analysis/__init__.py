"""Questions about the texts alone: citations, facts, differences, what cannot be reached."""
