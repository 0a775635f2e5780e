"""The only place for complete test suites of finite machines, and for what they are worth."""
