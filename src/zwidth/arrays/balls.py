"""Settings for ball arithmetic with error bounds by python-flint, an optional package."""

from __future__ import annotations

from importlib.util import find_spec

# Working precisions in bits, tried in this order until a result is certain.
BITS = tuple(128 << k for k in range(7))


def available() -> bool:
    """Return whether python-flint is installed."""
    return find_spec("flint") is not None
