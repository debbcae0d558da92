"""Waiting for conditions instead of fixed times; the timeout only ends tests that hang."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

LONGEST = 300.0  # seconds; ten times more than any wait needs on a machine with ten other jobs


def wait_for(
    condition: Callable[[], Any], complaint: Callable[[], object] | str = "nothing happened", pause: float = 0.01
) -> Any:
    """Return the first true value of a condition, evaluated repeatedly with a pause."""
    end = time.monotonic() + LONGEST
    while not (value := condition()):
        if time.monotonic() > end:
            raise AssertionError(f"{complaint if isinstance(complaint, str) else complaint()} in {LONGEST:g} s")
        time.sleep(pause)
    return value
