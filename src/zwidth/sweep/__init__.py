"""Runs described by a YAML file: what to compute, in which order, and where the results are kept.

The modules are imported by name, so that reading a configuration does not wait for JAX or a store.
"""
