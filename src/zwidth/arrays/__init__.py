"""Arithmetic that knows nothing of walls, and the way from a kernel to functions of whole arrays."""
