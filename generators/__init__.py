"""Makes tests from the model."""
