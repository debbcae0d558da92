"""Configuration files in YAML: models of their sections, reading and validation.

All faults of a file are reported together, each with line and column, the allowed values and a remedy. The kinds of
studies are defined in `zwidth.studies`, except sweeps (`zwidth.config.sweep`).
"""
