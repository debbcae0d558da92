"""Sweeps: chunks of a grid, who computes them, and the stores that keep them.

The modules are imported by name, so that a plan does not wait for JAX or a store.
"""
