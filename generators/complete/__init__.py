"""Complete test suites of finite machines, and the proof of what they promise."""
