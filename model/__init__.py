"""The only place for what the texts mean: values, steps and the virtual SubDevice."""
