"""The table of costs and errors: how a method is chosen, and that the shipped numbers are true."""

import json

import pytest
from zwidth.stability.methods import Method, stability_of

import zwidth
from zwidth import accuracy
from zwidth.accuracy import Cost, choose
from zwidth.bench import suite
from zwidth.errors import InputError


def cost(method, error, rate=1e6, first=1.0, d=1.0, dtype="float64", layout="map"):
    return Cost("stable", method, dtype, layout, d, first, rate, error)


COSTS = [
    cost("boundary", 1e-15, rate=1e6),
    cost("schur_cohn", 1e-12, rate=1e7, first=5.0),
    cost("schur_cohn", 1e-4, rate=1e8, dtype="float32"),
    cost("companion", 1e-14, rate=1e4, first=0.1),
]


def chosen(points, wanted, d=1.0, costs=COSTS):
    choice = choose("stable", d=d, points=points, layout="map", accuracy=wanted, costs=costs)
    return choice.method, choice.dtype


def test_the_cheapest_within_the_tolerance():
    assert chosen(10**9, 1e-3) == ("schur_cohn", "float32")
    assert chosen(10**9, 1e-11) == ("schur_cohn", "float64")
    assert chosen(10**9, 1e-15) == ("boundary", "float64")
    # Few points do not pay for a compilation.
    assert chosen(100, 1e-11) == ("companion", "float64")


def test_proof_for_no_error_and_the_best_where_none_is_good_enough():
    assert chosen(10, 0.0) == ("certified", "float64")
    best = choose("stable", d=1.0, points=10, layout="map", accuracy=1e-18, costs=COSTS)
    assert best.method == "boundary"
    assert "no method was seen" in best.why
    assert chosen(10, None) == ("boundary", "float64")


def test_other_delays():
    costs = [cost("boundary", 1e-15, d=1.0), cost("boundary", 1e-13, d=8.0, rate=1e5)]
    at = {d: choose("stable", d=d, points=10**6, layout="map", accuracy=1e-12, costs=costs) for d in (0.5, 1, 4, 8, 30)}
    assert at[0.5].seconds == at[1].seconds == pytest.approx(2.0)
    # Between two delays the longer one's cost, and the larger error.
    assert at[4].seconds == at[8].seconds == pytest.approx(11.0)
    assert at[4].error == 1e-13
    assert at[30].seconds == pytest.approx(1.0 + 10 * (33 / 11) ** 2)


def test_reasons_name_the_others():
    choice = choose("stable", d=1.0, points=10**9, layout="map", accuracy=1e-11, costs=COSTS)
    assert "cheapest within 1e-11" in choice.why
    assert "schur_cohn float32 errs by 1e-04" in choice.why
    assert "boundary 9" in choice.why


def test_the_shipped_table_has_every_method():
    table = accuracy.table(shipped=True)
    named = {(entry.quantity, entry.method, entry.dtype) for entry in table}
    assert named == {
        *(("stable", name, "float64") for name in ("boundary", "schur_cohn", "companion", "certified")),
        ("stable", "schur_cohn", "float32"),
        *(("spectral_radius", name, "float64") for name in ("newton", "bisection", "companion")),
    }
    assert all(entry.rate > 0 and 0 <= entry.error < 1 for entry in table)
    assert {entry.error for entry in table if entry.method == "certified"} == {0.0}


@pytest.mark.parametrize("method, dtype", [("boundary", None), ("schur_cohn", None), ("schur_cohn", "float32")])
def test_labels_of_the_shipped_table_are_measured_again(method, dtype):
    def classify(walls):
        return zwidth.is_stable(*walls, method=method, dtype=dtype)

    error, _, checked = suite.label_error(classify, 1.0, suite.FULL.checked)
    assert checked > 1000
    (entry, *_) = (
        entry
        for entry in accuracy.table(shipped=True)
        if (entry.quantity, entry.method, entry.dtype, entry.d) == ("stable", method, dtype or "float64", 1.0)
    )
    # Another processor may round differently, by little.
    assert error <= 2 * entry.error + 1e-15
    if dtype == "float32":
        assert error > 1e-7


def test_radii_of_the_shipped_table_are_measured_again():
    error, _, checked = suite.radius_error(lambda walls: zwidth.spectral_radius(*walls), 1.0, suite.FULL.roots)
    assert checked == suite.FULL.roots
    (entry, *_) = (
        entry
        for entry in accuracy.table(shipped=True)
        if (entry.quantity, entry.method, entry.d) == ("spectral_radius", "companion", 1.0)
    )
    assert error <= 2 * entry.error + 1e-14


def test_an_accuracy_chooses_for_the_caller():
    walls = ([0.1, 0.9], 0.3, 0.1, 1)
    assert stability_of(*walls, accuracy=0).method.tolist() == [Method.CERTIFIED] * 2
    assert stability_of(*walls, accuracy=1e-14).stable.tolist() == [True, False]
    assert zwidth.is_stable(*walls, accuracy=1e-2).tolist() == [True, False]
    exact = zwidth.spectral_radius(*walls)
    for wanted in (1e-3, 1e-9, 1e-12):
        assert zwidth.spectral_radius(*walls, accuracy=wanted) == pytest.approx(exact, rel=wanted)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"accuracy": -1.0}, "at least 0"),
        ({"accuracy": float("nan")}, "accuracy: got nan"),
        ({"accuracy": 1e-3, "method": "boundary"}, "leave"),
        ({"accuracy": 1e-3, "dtype": "float32"}, "leave"),
    ],
)
def test_what_contradicts_is_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        zwidth.is_stable(0.1, 0.3, 0.1, 1, **arguments)


def test_a_table_of_ones_own_comes_first(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    accuracy.table.cache_clear()
    own = accuracy.user_table()
    own.parent.mkdir(parents=True)
    entry = {"quantity": "stable", "method": "boundary", "dtype": "float64", "layout": "map"}
    numbers = {"d": 0.0, "first_seconds": 1.0, "rate": 2.0, "error": 0.0}
    own.write_text(json.dumps({"costs": [{**entry, **numbers}]}))
    assert [found.rate for found in accuracy.table()] == [2.0]
    accuracy.table.cache_clear()
    own.write_text("{")
    with pytest.raises(InputError, match=r"accuracy\.json.*run zwidth bench again"):
        accuracy.table()
    monkeypatch.undo()
    accuracy.table.cache_clear()
