"""Kill analysis: which mistakes in a device its suite finds."""
