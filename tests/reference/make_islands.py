"""Rows of scenes on which several intervals of stiffness are stable, to 20 digits: writes islands.json beside it.

    PYTHONPATH=src:tests/support:tests/oracles python tests/reference/make_islands.py

Random scenes are drawn until enough have such a row (the library only points to them). Then nothing of the library is
used: each end is bisected in balls of 80 digits, by poles of the polynomial in `proved_loop.ball_parts` that are proved
outside the unit circle, and 300 further stiffnesses of the row are counted one by one: where their labels are not
those of the intervals, nothing is written.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import any_loop
import flint
import numpy as np
import proved_loop

COUNT, STEPS, DIGITS = 40, 70, 80
PERIOD, MASS = 1e-3, 0.1


def draw_parts(generator: np.random.Generator) -> dict[str, Any]:
    """Couplings with the sensor at the tip or at the motor, windows, filters, soft hands."""
    draw = generator.uniform
    mass, force, rub = MASS, MASS / PERIOD**2, MASS / PERIOD
    device: dict[str, Any] = {"mass": mass, "damping": rub * float(generator.choice([0.0, 10 ** draw(-3, 0.3)]))}
    if draw() < 0.7:
        device["coupling"] = {
            "mass": mass * 10 ** draw(-1.5, 1), "stiffness": force * 10 ** draw(-3, 1),
            "damping": rub * 10 ** draw(-5, -0.5), "sensor": str(generator.choice(["tip", "motor"])),
        }  # fmt: skip
    velocity = (
        {"kind": "BackwardDifference"},
        {"kind": "WindowedDifference", "samples": int(generator.integers(2, 12))},
        {"kind": "LowPass", "cutoff": 10 ** draw(1, 2.6)},
        {"kind": "Butterworth", "cutoff": 10 ** draw(1, 2.6), "order": int(generator.integers(1, 5))},
    )[generator.integers(0, 4)]
    parts = {
        "device": device,
        "timing": {"period": PERIOD, "delay": float(generator.choice([0, 1, 0.4, 2, 2.5, 5])) * PERIOD},
        "velocity": velocity,
    }
    if draw() < 0.5:
        parts["operator"] = {
            "mass": 10 ** draw(-2, 1), "damping": 10 ** draw(-1, 1), "stiffness": 10 ** draw(1, 4),
            "coupling_stiffness": 10 ** draw(2, 5), "coupling_damping": 10 ** draw(-2, 1),
        }  # fmt: skip
    return parts


def widest_row(scene: Any) -> tuple[float, np.ndarray] | None:
    """The damping at which the second interval is widest, as the library sees it."""
    pieces = scene.stable_region()
    if not pieces:
        return None
    damping = np.concatenate([piece.virtual_damping for piece in pieces])
    rows = np.linspace(damping.min(), damping.max(), 200)[1:-1]
    ends = scene.stable_stiffness(rows)
    if ends.shape[1] < 2:
        return None
    width = np.diff(ends, axis=-1)[..., 0] / np.nanmax(np.abs(ends))
    second = np.nan_to_num(np.sort(np.nan_to_num(width), axis=1)[:, -2])
    k = int(np.argmax(second))
    if second[k] < 1e-4:
        return None
    row = ends[k]
    return float(rows[k]), row[np.isfinite(row[:, 0])]


def bisect(scene: Any, damping: float, inside: flint.arb, outside: flint.arb) -> flint.arb:
    """The end of the stable interval between a stable and an unstable stiffness."""
    device, spring, damper = proved_loop.ball_parts(scene)
    fixed = device + damper * flint.arb(damping)
    for _ in range(STEPS):
        middle = ((inside + outside) / 2).mid()
        roots = proved_loop.nonzero(fixed + spring * middle).roots(tol=1e-40)
        if all(abs(root) < 1 for root in roots):
            inside = middle
        elif any(abs(root) > 1 for root in roots):
            outside = middle
        else:
            break
    return ((inside + outside) / 2).mid()


def labels_agree(scene: Any, damping: float, ends: np.ndarray) -> bool:
    """Whether 300 stiffnesses of the row, counted one by one, are stable exactly inside the intervals."""
    low, high = ends.min(), ends.max()
    size = high - low
    for stiffness in np.linspace(low - 0.2 * size, high + 0.5 * size, 300):
        if np.min(np.abs(ends - stiffness)) < 1e-6 * size:
            continue
        inside = bool(np.any((stiffness > ends[:, 0]) & (stiffness < ends[:, 1])))
        if (proved_loop.count_outside(scene, float(stiffness), damping) == 0) != inside:
            return False
    return True


def main() -> None:
    flint.ctx.dps = DIGITS
    generator = np.random.default_rng(2006)
    rows = []
    while len(rows) < COUNT:
        parts = draw_parts(generator)
        scene = any_loop.scene_of(parts)
        found = widest_row(scene)
        if found is None:
            continue
        damping, ends = found
        if np.any(ends[1:, 0] - ends[:-1, 1] < 1e-6 * np.max(np.abs(ends))):
            continue
        exact = []
        for low, high in ends:
            middle, far = flint.arb(0.5 * (low + high)), flint.arb(1e-4 * (high - low))
            exact.append(
                [bisect(scene, damping, middle, flint.arb(end) + side * far) for end, side in ((low, -1), (high, 1))]
            )
        numbers = np.array([[float(end) for end in pair] for pair in exact])
        if not labels_agree(scene, damping, numbers):
            raise SystemExit(f"the row {damping} of {parts} has other intervals than {ends.tolist()}")
        stiffness = [[end.str(20, radius=False) for end in pair] for pair in exact]
        rows.append({"scene": parts, "virtual_damping": damping, "stiffness": stiffness})
    text = json.dumps(rows, indent=1)
    Path(__file__).with_name("islands.json").write_text(text + "\n")


if __name__ == "__main__":
    main()
