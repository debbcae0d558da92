#!/usr/bin/env python3
"""Count the recommended walls of fits that are equal in all commands, and stable on the true device.

    python benchmarks/bench_handover.py [--devices 300] [--first 0] [--every 10]

Each device has resonances, an actuator lag or both, which are partly undetected in the log. The wall of the fit is
compared with those of its configuration, of a run of the configuration, and of the program in C; every tenth run also
writes a report. Further walls within the safe limit are random. A wall counts as stable if it and softer walls with the
same damping are stable on the true device by eigenvalues, computed without zwidth.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

import zwidth
from device_counts import build_parser, count_devices
from zwidth.identification.fit_report import write_scene
from zwidth.studies.document import load_config, load_scene

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "oracles"))

from measured_devices import TrueDevice, draw_hidden

DRAWN = 40  # random walls within the safe limit, per device
SOFTER = (1.0, 0.7, 0.4, 0.1, 0.01)  # relative stiffnesses at which stability is checked
REQUIREMENTS: tuple[dict[str, Any], ...] = ({"stiffness_fraction": 0.9}, {"phase_margin": 10.0, "gain_margin": 1.3})


def is_stable(true: TrueDevice, stiffness: float, virtual_damping: float) -> bool:
    """Return True if a wall and softer ones are stable on the true device."""
    return all(true.is_stable(share * stiffness, virtual_damping) for share in SOFTER)


def read_code(text: str) -> tuple[float, float]:
    """Return K and B of a program in C."""
    found = re.search(r"-\((\S+) \* x \+ (\S+) \* v\)", text)
    assert found is not None, text
    return float(found[1]), float(found[2])


def hand_over(seed: int, folder: Path, with_run: bool) -> Counter[str]:
    """Fit one device and count the checks that its wall passes."""
    true, force, position = draw_hidden(seed)
    counts: Counter[str] = Counter(devices=1)
    try:
        fit = zwidth.fit_log(true.period, position, force)
    except zwidth.ZwidthError:
        return counts + Counter(refused=1)
    file = folder / f"device_{seed}.yaml"
    file.write_text("\n".join(write_scene(fit, "log.csv")), encoding="utf-8")
    scene, found = load_scene(file), fit.recommended
    config = load_config(file)
    study: Any = config.studies[0]
    outcome = study.compute(config.scene, True)
    documents = outcome.documents
    if found.status != zwidth.Status.OK:
        none = scene.recommend().status != zwidth.Status.OK and "no wall" in documents["recommendation.md"]
        return counts + Counter(without_a_wall=1, also_without_in_the_run=none, unreliable=fit.is_unreliable)
    wall = found.stiffness, found.virtual_damping
    other = scene.recommend()
    document = json.loads(documents["recommendation.json"])["recommended"]
    same = {
        "configuration": (other.stiffness, other.virtual_damping) == wall,
        "run": (document["stiffness"], document["virtual_damping"]) == wall,
        "C code": read_code(found.code("c")) == wall == read_code(other.code("c")),
        "printed": found.spell_wall() in documents["recommendation.md"],
    }
    if with_run:
        out = folder / f"run_{seed}"
        zwidth.run(file, out=out)
        page = zwidth.write_report(out).read_text(encoding="utf-8")
        kept = json.loads((out / "recommendation.json").read_text(encoding="utf-8"))["recommended"]
        counts += Counter(reports=1)
        same["report"] = found.spell_wall() in page and (kept["stiffness"], kept["virtual_damping"]) == wall
    counts += Counter(walls=1, **{f"same in {name}": bool(holds) for name, holds in same.items()})
    counts += Counter({"stable on the true device": is_stable(true, *wall)})
    limit, random = fit.scene.safe_limit, np.random.default_rng(seed)
    assert limit is not None, "a fit has one"
    for _ in range(DRAWN):
        share = float(random.uniform())
        damping = float(random.uniform(*sorted((share * limit.virtual_damping, limit.virtual_damping))))
        stable = true.is_stable(share * limit.stiffness, damping)
        counts += Counter({"drawn within the limit": 1, "stable ones": stable})
    for wanted in REQUIREMENTS:
        softer = scene.recommend(**wanted)
        if softer.status == zwidth.Status.OK:
            stable = is_stable(true, softer.stiffness, softer.virtual_damping)
            counts += Counter({"with other requirements": 1, "stable of those": stable})
    free = scene.recommend(beyond_safe=True)
    if free.status == zwidth.Status.OK:
        stable = is_stable(true, free.stiffness, free.virtual_damping)
        counts += Counter({"beyond the safe limit": 1, "unstable beyond": not stable})
    return counts


def check_device(seed: int, folder: Path, every: int) -> tuple[Counter[str], list[str]]:
    """Return the counts of one device, and its failures: names of results that differ, and "unstable"."""
    counts = hand_over(seed, folder, seed % every == 0)
    broken = [name for name in counts if name.startswith("same") and not counts[name]]
    if counts["walls"] and not counts["stable on the true device"]:
        broken.append("unstable")
    return counts, broken


def main() -> None:
    parser = build_parser(__doc__, 300)
    parser.add_argument("--every", type=int, default=10, help="number of devices per run with a report")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        count_devices(given, lambda seed: check_device(seed, Path(folder), given.every))


if __name__ == "__main__":
    main()
