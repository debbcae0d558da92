"""Settings of ball arithmetic, i.e. arithmetic with rigorous error bounds, by the optional package python-flint."""

from __future__ import annotations

from importlib.util import find_spec

# Working precisions in bits. A computation tries them in this order until its error bound certifies the result.
BITS = tuple(128 << k for k in range(7))


def available() -> bool:
    """Return whether python-flint is installed."""
    return find_spec("flint") is not None
