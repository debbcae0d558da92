"""Parameter sweeps: division of a grid into chunks, computation of the chunks, and the stores of their results.

Import the modules by name. This package imports none of them, so that planning a sweep loads neither JAX nor Zarr.
"""
