"""The texts of the specification, and the code that reads them."""
