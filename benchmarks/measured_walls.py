"""How safe and how stiff the walls are that two records tell of a device nobody modelled.

    .venv/bin/python benchmarks/measured_walls.py [DEVICES] [FIRST]

Random devices, rigid, behind an amplifier, with one or two resonances of 0.5 to 10 % damping, with encoders of 1 to 40
um and a force limit, are simulated exactly (`tests/oracles/measured_devices.py`). For each the record of
`zwidth.excite` is played, `zwidth.respond` finds the response, and the stiffest safe wall is judged by eigenvalues of
the true closed loop.
"""

from __future__ import annotations

import sys
from multiprocessing import get_context
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "oracles"))

from measured_devices import KINDS, Trial, measure


def main() -> None:
    count, first = (int(text) for text in (*sys.argv[1:3], *("300", "0")[len(sys.argv) - 1 :]))
    with get_context("spawn").Pool(2) as pool:
        trials = pool.map(measure, range(first, first + count), chunksize=5)
    for kind in (*KINDS, "all"):
        own = [trial for trial in trials if kind in ("all", trial.device.kind)]
        print(f"{kind} ({len(own)} devices)")
        for turn, name in enumerate(("first record", "second record")):
            describe(name, own, turn)
    missed = np.mean([trial.outside for trial in trials])
    gaps = [abs(trial.promised - trial.share[1]) for trial in trials]
    print(f"lines outside of their band: {missed:.1e}; safe wall off what was promised: median {np.median(gaps):.3f}")


def describe(name: str, trials: list[Trial], turn: int) -> None:
    """One line of a table."""
    stable = [trial.stable[turn] for trial in trials]
    share = np.array([trial.share[turn] for trial in trials])
    enough = np.mean(share >= 0.8)
    print(
        f"  {name:14s} unstable {stable.count(False)}, undecided {stable.count(None)}, share of K_max: median "
        f"{np.median(share):.3f}, a tenth below {np.quantile(share, 0.1):.3f}, at least 0.8 in {enough:.1%}"
    )


if __name__ == "__main__":
    main()
