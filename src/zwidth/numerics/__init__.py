"""Numerics that know nothing of walls: special functions, sums of floats, roots and minima."""
