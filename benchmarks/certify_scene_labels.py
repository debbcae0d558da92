"""Compare stability labels of random walls with certified labels for every kind of scene: differences and time.

PYTHONPATH=src:tests/support:tests/oracles python benchmarks/certify_scene_labels.py --walls 100000
"""

import argparse
import time

import numpy as np
from independent_scenes import KINDS, random_scene, random_walls

from zwidth.core.status import Status

_WALLS_OF_ONE = 500


def compare(kind: str, walls: int, seed: int) -> list[float]:
    """Return the numbers of walls, stable walls, different and undecided labels, and both times per wall in us."""
    rng = np.random.default_rng(seed)
    total = np.zeros(6)
    while total[0] < walls:
        scene = random_scene(kind, rng)
        stiffness, damping = random_walls(scene, rng, _WALLS_OF_ONE)
        damping[::10] = 0.0
        began = time.perf_counter()
        labels = scene.is_stable(stiffness, damping)
        between = time.perf_counter()
        proved = scene.decide_stability(stiffness, damping, method="certified")
        ended = time.perf_counter()
        decided = proved.status == Status.OK
        differ = np.sum((labels != proved.stable) & decided)
        if differ:
            print(kind, scene, stiffness[(labels != proved.stable) & decided], flush=True)
        counts = [labels.size, proved.stable.sum(), differ, np.sum(~decided)]
        total += [*counts, 1e6 * (between - began), 1e6 * (ended - between)]
    return [*total[:4], total[4] / total[0], total[5] / total[0]]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--walls", type=int, default=100_000, help="of each kind of scene")
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    print("| scene | walls | stable | labels that differ | open | label us | certified us |")
    print("|---|---|---|---|---|---|---|")
    for kind in KINDS:
        row = compare(kind, chosen.walls, chosen.seed)
        counts, times = " | ".join(f"{value:.0f}" for value in row[:4]), " | ".join(f"{value:.1f}" for value in row[4:])
        print(f"| {kind} | {counts} | {times} |", flush=True)


if __name__ == "__main__":
    main()
