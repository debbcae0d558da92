"""Array arithmetic without reference to walls, and the vectorized evaluation of kernels."""
