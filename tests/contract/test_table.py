"""The page of the contract says what the cases say."""

from pathlib import Path

from contract.cases import CASES, OTHERS
from contract.table import page

ROOT = Path(__file__).resolve().parents[2]


def test_the_page_is_up_to_date():
    assert (ROOT / "docs" / "contract.md").read_text(encoding="utf-8") == page(), "run scripts/refresh_contract.py"


def test_every_test_that_is_named_exists():
    named = {case.gradient_in for case in CASES} - {""}
    named |= {word.strip(",") for why in OTHERS.values() for word in why.split() if word.startswith("tests/")}
    assert [name for name in sorted(named) if not (ROOT / name).is_file()] == []
