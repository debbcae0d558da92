#!/usr/bin/env python3
"""Write docs/extremes.md: which method holds where, measured against certified labels."""

from __future__ import annotations

from pathlib import Path

from zwidth.bench import extremes


def main() -> None:
    """Measure and write."""
    target = Path(__file__).resolve().parents[1] / "docs" / "extremes.md"
    target.write_text(extremes.report(), encoding="utf-8")


if __name__ == "__main__":
    main()
