"""Ball arithmetic by python-flint, an optional package."""

from __future__ import annotations

from importlib.util import find_spec

BITS = tuple(128 << k for k in range(7))  # working precisions, tried in this order until a verdict is certain


def available() -> bool:
    """Return whether python-flint is installed."""
    return find_spec("flint") is not None
