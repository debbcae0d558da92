"""Tests wait for a thing, never for a time: what they wait for has a bound only so that a hang ends."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

# Seconds. On a machine that has ten other things to do, nothing that the tests wait for takes a tenth of it.
LONGEST = 300.0


def wait_for(
    condition: Callable[[], Any], complaint: Callable[[], object] | str = "nothing happened", pause: float = 0.01
) -> Any:
    """The first true answer of a condition, which is asked again after a pause: longer where asking costs much."""
    end = time.monotonic() + LONGEST
    while not (answer := condition()):
        if time.monotonic() > end:
            raise AssertionError(f"{complaint if isinstance(complaint, str) else complaint()} in {LONGEST:g} s")
        time.sleep(pause)
    return answer
