"""The only place for how much a run tries. It stands alone: every help page names it."""

DEPTHS = ("quick", "default", "exhaustive")
