"""From a clause to its rules and cases, and the evidence for each."""
