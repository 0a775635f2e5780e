"""The only place for the texts of the specification and for the code that reads them."""
