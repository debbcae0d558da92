"""Definitions for all packages: errors, status codes, types, units, quantities, formatting, tables, NumPy and JAX."""
