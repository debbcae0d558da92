"""Measure safety and stiffness of walls recommended from two records of devices without a known model.

    .venv/bin/python benchmarks/measured_walls.py [DEVICES] [FIRST]

Random devices are simulated exactly (`tests/oracles/measured_devices.py`): rigid, with an amplifier lag, or with one or
two resonances of 0.5 to 10 % damping, with encoders of 1 to 40 um and a force limit. Each device is excited by the
signal of `zwidth.excite`, `zwidth.respond` estimates the response, and the stiffest safe wall is checked by eigenvalues
of the true closed loop. Results for 300 devices are in ``results/measured_walls.md``.
"""

from __future__ import annotations

import sys
from multiprocessing import get_context
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "oracles"))

from measured_devices import KINDS, Trial, measure

RESULT = Path(__file__).parent / "results" / "measured_walls.md"
ROWS = {
    "safe walls that are unstable on the true device": lambda stable, share: f"{stable.count(False)}",
    "devices without a safe wall": lambda stable, share: f"{stable.count(None)}",
    "stiffness of the safe wall, divided by K_max of the true device: median": lambda stable, share: (
        f"{np.median(share):.3f}"
    ),
    "the same ratio: 10 % quantile": lambda stable, share: f"{np.quantile(share, 0.1):.3f}",
    "devices with a ratio of at least 0.8": lambda stable, share: f"{np.mean(share >= 0.8):.1%}",
}


def main() -> None:
    count, first = (int(text) for text in (*sys.argv[1:3], *("300", "0")[len(sys.argv) - 1 :]))
    with get_context("spawn").Pool(2) as pool:
        trials = pool.map(measure, range(first, first + count), chunksize=5)
    for kind in KINDS:
        own = [trial for trial in trials if trial.device.kind == kind]
        print(f"{kind} ({len(own)} devices)\n", *(describe(own) if own else ()), sep="\n")
    missed = np.mean([trial.outside for trial in trials])
    gap = np.median([abs(trial.promised - trial.share[1]) for trial in trials])
    text = [
        f"The table contains the results for {count} devices:\n",
        *describe(trials),
        "",
        f"The predicted and the actual safe stiffness of the second record differ by {gap:.1%} of K_max in the median.",
        f"The true response is outside the error band at {missed:.1e} of all frequencies.",
    ]
    print(*text, sep="\n")
    if len(sys.argv) == 1:
        RESULT.write_text("\n".join(text) + "\n", encoding="utf-8")


def describe(trials: list[Trial]) -> list[str]:
    """Return the lines of a table of both records."""
    both = [
        ([trial.stable[turn] for trial in trials], np.array([trial.share[turn] for trial in trials])) for turn in (0, 1)
    ]
    rows = [(name, *(tell(*each) for each in both)) for name, tell in ROWS.items()]
    return ["| | first record | second record |", "|---|--:|--:|", *(f"| {' | '.join(row)} |" for row in rows)]


if __name__ == "__main__":
    main()
