"""Stability of virtual walls in any linear loop, computed from the walls that put poles on the unit circle."""
