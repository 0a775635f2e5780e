"""The texts as formulas: symbolic runs, proofs, and boundary values by a solver."""
