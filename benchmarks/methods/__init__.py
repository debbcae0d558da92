"""Measurement of speed and errors of each method, compared with common alternative tools."""
