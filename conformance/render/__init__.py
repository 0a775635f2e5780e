"""Forms that several outputs share: tables, annotations, SARIF."""
