"""The depths of a run. It imports nothing, since every help page names them."""

DEPTHS = ("quick", "default", "exhaustive")
