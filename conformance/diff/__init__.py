"""The only place for what two specifications, or two devices, do differently."""
