"""Stability of the loop: one method a file."""
