#!/usr/bin/env python3
"""Write docs/extremes.md: which method holds where, measured against certified stability results."""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))


def main() -> None:
    """Measure and write."""
    from methods import extremes

    (ROOT / "docs" / "extremes.md").write_text(extremes.report(), encoding="utf-8")


if __name__ == "__main__":
    main()
