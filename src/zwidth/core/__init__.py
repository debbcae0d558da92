"""Definitions for all packages: errors, status codes, type aliases, and the array namespace (NumPy or JAX)."""
