"""The check of prose (scripts/check_prose.py) finds forbidden openings and phrases, and accepts clear texts."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

LIST = """\
# a comment
[openings]
What
Whether

[phrases]
for want of = more ... needed
half the rate = the Nyquist frequency

[exceptions]
"""

VIOLATING = '''\
"""What the module computes."""

LIMIT = 3  # half the rate


class Device:
    """A device."""

    mass: float
    """Whether it moves."""

    def check(self):
        """Raise an error if the device
        cannot move, For want
        of force.
        """
        raise ValueError(f"{self.mass}: none, for want of mass")


# Whether the
# check runs.
'''

CLEAR = '''\
"""Compute the state of a device.

What is in the middle of a docstring is not checked as an opening.
"""

LIMIT = 3  # Nyquist frequency
WHAT = ["What", "for", "want"]  # one string per word


def is_stable(halfthe: str) -> str:
    """Return whether the device is stable."""
    # The condition is exact,
    # whether the delay is zero or not.
    return f"forward, {halfthe} rates"
'''

PAGE = "# Delay\n\nSampled at half\nthe rate.\n"
CONFIGURATION = "# The filter works at half\n# the rate.\nname: fit\n"


@pytest.fixture
def checker(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "scripts")
    return importlib.import_module("check_prose")


def check(checker, folder, name, text, rules=LIST):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return checker.check([path], checker.read_rules(rules))


def test_every_kind_of_text_is_checked(checker, tmp_path):
    assert sorted(check(checker, tmp_path, "device.py", VIOLATING)) == [
        "device.py:10: starts with 'Whether'; start with a verb or a noun",
        "device.py:14: 'for want of'; write more ... needed",
        "device.py:17: 'for want of'; write more ... needed",
        "device.py:1: starts with 'What'; start with a verb or a noun",
        "device.py:20: starts with 'Whether'; start with a verb or a noun",
        "device.py:3: 'half the rate'; write the Nyquist frequency",
    ]


def test_clear_text_passes(checker, tmp_path):
    assert check(checker, tmp_path, "device.py", CLEAR) == []


@pytest.mark.parametrize("name, text, line", [("delay.md", PAGE, 3), ("fit.yaml", CONFIGURATION, 1)])
def test_phrases_are_found_across_lines(checker, tmp_path, name, text, line):
    assert check(checker, tmp_path, name, text) == [f"{name}:{line}: 'half the rate'; write the Nyquist frequency"]


def test_an_exception_permits_one_phrase_in_one_file(checker, tmp_path):
    rules = LIST + "delay.md: half the rate\n"
    assert check(checker, tmp_path, "delay.md", PAGE, rules) == []
    assert check(checker, tmp_path, "other.md", PAGE, rules) != []


def test_a_phrase_needs_a_replacement(checker):
    with pytest.raises(ValueError, match=r"prose\.txt: 'surely' has no ' = '"):
        checker.read_rules("[phrases]\nsurely\n")


def test_every_exception_of_the_list_is_needed(checker):
    rules = checker.read_rules(checker.LIST.read_text(encoding="utf-8"))
    strict = rules._replace(exceptions=frozenset())
    for name, phrase in rules.exceptions:
        assert any(f"{phrase!r}" in problem for problem in checker.check([ROOT / name], strict)), (name, phrase)
