"""How long what follows a drag takes: run it, `python tests/unit/pages/explorer/drag_times.py`; it is no test."""

from __future__ import annotations

import json
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from bokeh.document import Document

from zwidth.pages.explorer.controls import Controls
from zwidth.pages.explorer.page import Page

SCENES = {
    "rigid": {},
    "rigid, delay 2.5 periods": {"delay": 2.5},
    "rigid, delay 60 periods": {"delay": 60},
    "normalized": {"mode": "normalized"},
    "low-pass": {"velocity": "LowPass"},
    "Butterworth of order 8": {"velocity": "Butterworth", "velocity.order": 8},
    "window of 20": {"velocity": "WindowedDifference", "velocity.samples": 20},
    "hand": {"operator": "rigid"},
    "grasp": {"operator": "grasp"},
    "grasp, Butterworth, tip": {"operator": "grasp", "velocity": "Butterworth", "coupling": "tip"},
}
UPDATES = 40


def main() -> None:
    """Print milliseconds of Python an update, from the message to the last source that is set."""
    print(f"{'scene':<28}{'wall clock: median':>20}{'90 %':>8}{'processor: median':>20}{'90 %':>8}")
    with ThreadPoolExecutor(1) as executor:
        for name, change in SCENES.items():
            page = Page(Document(), Controls().change(change), executor)
            moved = "delta" if page.controls.normalized else "damping"
            spent = []
            for k in range(UPDATES):
                before = time.perf_counter(), time.process_time()
                page.receive({"json": [json.dumps({"set": {moved: 0.1 + 0.01 * k}})]})
                spent.append([1e3 * (time.perf_counter() - before[0]), 1e3 * (time.process_time() - before[1])])
            clock, cpu = (np.quantile(np.array(spent)[3:, k], [0.5, 0.9]) for k in (0, 1))
            print(f"{name:<28}{clock[0]:>20.1f}{clock[1]:>8.1f}{cpu[0]:>20.1f}{cpu[1]:>8.1f}")


if __name__ == "__main__":
    main()
