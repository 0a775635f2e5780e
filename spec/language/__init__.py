"""The only place for the language of the texts: grammar, IR, names, checks, pretty printer."""
