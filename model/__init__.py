"""The meaning of the texts: values, steps, and the virtual SubDevice."""
