#!/usr/bin/env python3
"""Write docs/extremes.md: errors of each method in extreme cases, compared with certified stability results."""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))


def main() -> None:
    """Run the comparison and write the page."""
    from methods import extremes

    (ROOT / "docs" / "extremes.md").write_text(extremes.report(), encoding="utf-8")


if __name__ == "__main__":
    main()
