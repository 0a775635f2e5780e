"""Forms that several outputs share: tables, colours, annotations, SARIF."""
