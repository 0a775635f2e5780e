"""The language of the texts: grammar, IR, names, checks, pretty printer."""
