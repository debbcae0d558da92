"""Labels that are proved, of walls within the domain and beyond it."""

import numpy as np

import zwidth


def certified_stable(alpha, beta, delta, d):
    """`zwidth.decide_stability` by the certified method, which refuses numbers beyond its domain but no arrays."""
    return zwidth.decide_stability(*map(np.asarray, (alpha, beta, delta, d)), method="certified")
