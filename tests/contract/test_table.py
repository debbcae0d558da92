"""docs/contract.md is generated from the cases and names existing test files."""

from pathlib import Path

from contract.cases import CASES, OTHERS
from contract.table import build_page

ROOT = Path(__file__).resolve().parents[2]


def test_contract_page_is_up_to_date():
    assert (ROOT / "docs" / "contract.md").read_text(encoding="utf-8") == build_page(), (
        "run scripts/refresh_contract.py"
    )


def test_every_named_test_file_exists():
    named = {case.gradient_in for case in CASES} - {""}
    named |= {
        word.strip(",") for description in OTHERS.values() for word in description.split() if word.startswith("tests/")
    }
    assert [name for name in sorted(named) if not (ROOT / name).is_file()] == []
