"""The comparison of computed values with the numbers printed in the paper."""

import json

import numpy as np
import pytest

import zwidth
from zwidth.studies import published


def comparison(printed, computed):
    return published.Comparison("x", "section", printed, computed)


@pytest.mark.parametrize(
    "printed, computed, agrees",
    [
        ("0.6863", 0.68629150, True),
        ("0.6863", 0.68634999, True),
        ("0.6863", 0.68635001, False),
        ("2.3", 2.3105713, True),
        ("2.3", 2.36, False),
        ("6", 6.055, True),
        ("0", 0.0, True),
        ("0.1", float("nan"), False),
    ],
)
def test_agreement_within_half_a_unit_of_the_last_digit(printed, computed, agrees):
    assert comparison(printed, computed).agrees is agrees


def test_every_printed_number_agrees():
    rows = published.published_numbers()
    # Eqs. (24), (25); nine numbers and two factors of section VIII; remark 3; "delta > 6" of section VII.
    assert [row.agrees for row in rows].count(True) == 15
    # "K_max = 3.5 kN/m" and "a lag of 50 ms", cited in section VIII.
    assert [(row.printed, row.note[:10]) for row in rows if row.agrees is None] == [
        ("3.5", "cited from"),
        ("50", "cited from"),
    ]
    assert len(rows) == 17


def test_thresholds_of_remark_3():
    # References in 60-digit arithmetic: 2.31057135675369424..., 3.659361627421783507...
    assert published.line_appears() == pytest.approx(2.310571356753694, abs=4e-15)
    assert published.corner_takes_over() == pytest.approx(3.6593616274217835, abs=4e-15)


def test_onset_of_the_linear_range():
    # Reference in 40-digit arithmetic: d alpha_max/d delta = 1.1 g of the corner, 6.14367335767816036...
    assert published.linear_from() == pytest.approx(6.14367335767816, abs=1e-9)


def test_line_of_minus_one_appears_at_the_threshold():
    threshold = published.line_appears()
    below = zwidth.stable_region(threshold - 1e-3, 0)
    above = zwidth.stable_region(threshold + 1e-3, 0)
    assert np.count_nonzero(below.piece == 1) == 0
    assert np.count_nonzero(above.piece == 1) > 0


def test_precise_values_include_exact_ones():
    computed = {row.quantity: row.computed for row in published.sharpened_numbers()}
    assert computed["alpha_max(delta = 0, d = 0)"] == pytest.approx(12 - 8 * np.sqrt(2), rel=1e-14)
    assert computed["beta at alpha_max(delta = 0, d = 0)"] == pytest.approx(2 * np.sqrt(2) - 2, rel=1e-7)
    assert computed["slope g, d = 0"] == pytest.approx(4.0, rel=1e-12)
    assert computed["slope g, d = 1"] == pytest.approx(1.0, rel=1e-12)


def test_json_and_markdown_agree():
    rows = [comparison("0.5", 0.51), comparison("0.5", 0.6)]
    sharpened = [published.Sharpened("y", "there", 1.25, "solved")]
    content = json.loads(published.as_json(rows, sharpened))
    assert content["all_agree"] is False
    assert [row["agrees"] for row in content["published"]] == [True, False]
    assert content["sharpened"][0]["computed"] == 1.25
    text = published.as_markdown(rows, sharpened)
    assert "2 printed numbers, 2 of them results: 1 of 2 agree" in text
    assert "| x | section | 0.5 | 0.6000000000 | **NO** |" in text
    assert "| y | there | 1.250000000000000 | solved |" in text


def test_cited_number_is_not_compared():
    rows = [comparison("0.5", 0.51), published.Comparison("z", "there", "50", None, "cited from [12]")]
    assert json.loads(published.as_json(rows, []))["all_agree"] is True
    text = published.as_markdown(rows, [])
    assert "2 printed numbers, 1 of them results: 1 of 1 agree" in text
    assert "Cited from other papers: 1." in text
    assert "| z | there | 50 | cited from [12] | cited |" in text
