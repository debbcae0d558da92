#!/usr/bin/env python3
"""Draw the pictures of README.md anew: run their configurations and copy the SVG files to docs/figures."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import zwidth
from zwidth.runs.draw import draw_stores

ROOT = Path(__file__).resolve().parents[1]
TARGET = ROOT / "docs" / "figures"

# configuration -> the figures that are shown
SHOWN = {
    "paper": ("fig5", "fig10", "fig11", "passivity_cost"),
    "phantom": ("recommend",),
    "velocity_filter": ("stiffest",),
}
# The figure of configs/dense.yaml that is shown.
STORED = "region_stable.svg"


def main() -> None:
    """Run every configuration and copy what is shown of it."""
    TARGET.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for name, figures in SHOWN.items():
            result = zwidth.run(ROOT / "configs" / f"{name}.yaml", out=Path(folder, name))
            if not result.ok:
                raise SystemExit("\n".join(f"{study.name}: {study.error}" for study in result.failed))
            for figure in figures:
                shutil.copy(result.folder / f"{figure}.svg", TARGET)
                print(TARGET.relative_to(ROOT) / f"{figure}.svg")
        out = Path(folder, "dense")
        zwidth.run(ROOT / "configs" / "dense.yaml", out=out)
        drawn = {file.name: file for file in draw_stores(out)}
        shutil.copy(drawn[STORED], TARGET)
        print(TARGET.relative_to(ROOT) / STORED)


if __name__ == "__main__":
    main()
