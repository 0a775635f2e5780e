"""The only place for making tests out of the model."""
