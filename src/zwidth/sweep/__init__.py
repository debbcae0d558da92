"""Compute parameter sweeps: divide a grid into chunks, compute the chunks, and store their results.

The package imports none of its modules, so that planning a sweep loads neither JAX nor Zarr; import them by name.
"""
