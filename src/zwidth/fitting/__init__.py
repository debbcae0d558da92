"""A device's mass, damping and delay from what can be recorded of it."""
