"""The meaning of the texts: values, expressions, states, messages, and one step of a device."""
