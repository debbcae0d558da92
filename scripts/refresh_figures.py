#!/usr/bin/env python3
"""Redraw the figures of README.md and of the gallery: run all configurations, or those given by name.

Figures of a configuration are written to docs/figures/CONFIGURATION as PNG files with a reduced palette to limit their
size; figures of README.md are written to docs/figures as SVG. Run scripts/refresh_docs.py afterwards to update
docs/gallery.md.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from pathlib import Path

from PIL import Image

import zwidth
from zwidth.runs.draw import draw_stores

ROOT = Path(__file__).resolve().parents[1]
TARGET = ROOT / "docs" / "figures"

# Figures shown in README.md, by configuration.
SHOWN = {
    "paper": ("fig10", "passivity_cost"),
}
# Palette size: enough for antialiased lines and for color maps, which need the most colors.
COLORS = 192


def draw(config: Path, out: Path) -> list[Path]:
    """Run or resume a configuration and return its PNG figures; an SVG file lies next to each."""
    result = zwidth.run(config, out=out, resume=True)
    if not result.ok:
        raise SystemExit("\n".join(f"{study.name}: {study.error}" for study in result.failed))
    files = [out / file for study in result.studies for file in study.files]
    if result.sweeps:
        files += draw_stores(out)
    return [file for file in files if file.suffix == ".png"]


def main() -> None:
    """Run the configurations and copy their figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("names", nargs="*", help="configurations without folder and suffix; default: all")
    parser.add_argument("--runs", type=Path, help="folder that keeps the runs, which go on where they are there")
    options = parser.parse_args()
    names = options.names or sorted(path.stem for path in (ROOT / "configs").glob("*.yaml"))
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            pictures = draw(ROOT / "configs" / f"{name}.yaml", (options.runs or Path(folder)) / name)
            shutil.rmtree(TARGET / name, ignore_errors=True)
            (TARGET / name).mkdir(parents=True)
            for picture in pictures:
                small = Image.open(picture).convert("RGB").quantize(COLORS, dither=Image.Dither.NONE)
                small.save(TARGET / name / picture.name, optimize=True)
                if picture.stem in SHOWN.get(name, ()):
                    shutil.copy(picture.with_suffix(".svg"), TARGET)
            print(f"{name}: {len(pictures)} figures")


if __name__ == "__main__":
    main()
