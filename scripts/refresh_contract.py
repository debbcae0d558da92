#!/usr/bin/env python3
"""Write docs/contract.md, the guarantees of every public function, from the cases of the contract tests."""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from contract.table import build_page  # noqa: E402


def main() -> None:
    """Write the page."""
    (ROOT / "docs" / "contract.md").write_text(build_page(), encoding="utf-8")


if __name__ == "__main__":
    main()
