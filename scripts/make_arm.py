#!/usr/bin/env python3
"""Write configs/arm.csv for configs/arm.yaml: effective mass and damping at the handle of a two-link arm per pose.

The arm has two links of equal length with a motor and a viscous bearing at each joint; the handle is at the end of the
second link, and the wall is normal to x. With the joint inertia M(q), the joint damping C and the Jacobian J(q), the
effective mass at the handle along u is 1/(u^T J M^-1 J^T u) (Khatib 1987), and the effective damping is the square of
this mass times u^T J M^-1 C M^-1 J^T u.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

FILE = Path(__file__).resolve().parents[1] / "configs" / "arm.csv"
LENGTH, LINK, MOTOR, BEARING = 0.25, 0.12, 1.5e-3, 0.02  # m, kg, kg m^2, N m s/rad
SHOULDERS, ELBOWS = np.linspace(0.0, 120.0, 25), np.linspace(30.0, 150.0, 25)  # degrees


def find_handle(shoulder: float, elbow: float) -> tuple[float, float]:
    """Return effective mass in kg and damping in N s/m at the handle along x for a pose in rad."""
    both = shoulder + elbow
    across = -LENGTH * np.array([np.sin(shoulder) + np.sin(both), np.sin(both)])
    own, cross = LINK * LENGTH**2 / 3, LINK * LENGTH**2 / 2 * np.cos(elbow)
    first = MOTOR + 2 * own + LINK * LENGTH**2 + 2 * cross
    moved = np.linalg.solve([[first, own + cross], [own + cross, MOTOR + own]], across)
    mass = 1.0 / float(across @ moved)
    return mass, mass**2 * BEARING * float(moved @ moved)


def make_table() -> str:
    """Return the text of the file."""
    lines = ["# Written by scripts/make_arm.py: mass and damping at the handle, for a wall perpendicular to x.",
             "shoulder [deg],elbow [deg],mass [g],damping [N s/m]"]  # fmt: skip
    for elbow in ELBOWS:
        for shoulder in SHOULDERS:
            mass, damping = find_handle(np.radians(shoulder), np.radians(elbow))
            lines.append(f"{shoulder:g},{elbow:g},{1e3 * mass:.5g},{damping:.5g}")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    FILE.write_text(make_table(), encoding="utf-8")
