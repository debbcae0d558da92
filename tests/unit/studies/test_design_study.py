"""The design study, against root finding on the rigid closed form, K_max next to the solution, and Monte Carlo runs."""

import numpy as np
import pytest
from required_values import find_required

import zwidth
from zwidth import plotting
from zwidth.core.errors import ConfigError
from zwidth.plotting.table import SI_COLUMNS
from zwidth.studies.design import DesignStudy
from zwidth.studies.document import load_config
from zwidth.units.formatting import with_unit

DEVICE = {"mass": 0.1, "damping": 10.0, "rate": 1000, "delay": 1e-3}
FILTERED = {**DEVICE, "velocity": {"kind": "low_pass", "cutoff": 100}}


def design(find, stiffness, device=DEVICE, **more):
    raw = {"kind": "design", "name": "d", "device": device, "find": find, "stiffness": stiffness, **more}
    return DesignStudy.model_validate(raw)


UNITS = {"damping": "N_s_per_m", "rate": "Hz", "delay": "s", "velocity.cutoff": "Hz", "mass": "kg"}


def test_required_damping_rate_and_delay_agree_with_the_closed_form():
    rigid = {"mass": 0.1, "period": 1e-3, "delay": 1e-3}
    expected = {
        "damping": find_required("damping", 30e3, 1.0, 100.0, **rigid),
        "rate": 1.0 / find_required("period", 30e3, 1e-4, 1e-2, mass=0.1, damping=10.0, delay=1e-3),
        "delay": find_required("delay", 30e3, 0.0, 5e-3, mass=0.1, damping=10.0, period=1e-3),
    }
    for find, value in expected.items():
        outcome = design(find, "30 kN/m", num=3).compute(None, True)
        table, unit = outcome.table, UNITS[find].replace("_per_", "/").replace("_", " ")
        assert outcome.answer[0].startswith(f"K_max = 30.00 kN/m: {find} of {with_unit(value, unit)} or ")
        assert table[f"value_{UNITS[find]}"][0] == pytest.approx(value, rel=1e-9)
        assert table["sufficient_side"][0] == ("below" if find == "delay" else "above")
        assert table["stiffness_max_N_per_m"][0] >= 30e3


@pytest.mark.parametrize("find, stiffness", [("velocity.cutoff", 15e3), ("mass", 10e3)])
def test_required_value_separates_sufficient_from_insufficient(find, stiffness):
    study = design(find, stiffness, FILTERED, num=3)
    table = study.compute(None, True).table
    (value,), (enough,) = table[f"value_{UNITS[find]}"], table["sufficient_side"]
    nominal = study.device.to_scene()
    side = {"above": 1, "below": -1}[enough]
    sufficient, insufficient = (
        nominal.replace(**{find: value * (1 + k * side * 1e-3)}).max_stiffness().stiffness for k in (1, -1)
    )
    assert insufficient < stiffness < sufficient


def test_rate_is_searched_within_the_given_range():
    table = design("rate", [25e3, 90e3], within=["200 Hz", "20 kHz"], num=3).compute(None, True).table
    assert table["range_low_Hz"] == pytest.approx([200, 200])
    assert table["range_high_Hz"] == pytest.approx([20e3, 20e3])
    assert table["present_Hz"].tolist() == pytest.approx([1000, 1000])
    # The delay of 1 ms is fixed in seconds, so that no rate suffices.
    assert table["status"].tolist() == ["OK", "UNREACHABLE"]
    assert np.isnan(table["value_Hz"][1])
    assert table["sufficient_side"][1] == "nowhere"


def test_unreachable_and_always_sufficient_values_are_reported():
    outcome = design("damping", [1e3, 30e3, 1e9], within=[1, 100], num=3).compute(None, True)
    assert outcome.table["sufficient_side"].tolist() == ["everywhere", "above", "nowhere"]
    assert len(outcome.notes) == 2
    assert len(outcome.figures[""]()) == 1


def test_tolerances_are_simulated_at_the_required_value():
    tolerances = {"mass": 0.05, "damping": 0.2}
    table = design("damping", 30e3, reserve=1.1, tolerances=tolerances, samples=2000, num=3).compute(None, True).table
    device = zwidth.Device(0.1, float(table["value_N_s_per_m"][0]))
    scene = zwidth.Scene(device, zwidth.Timing(1e-3, 1e-3))
    top = scene.max_stiffness()
    assert top.stiffness == pytest.approx(33e3, rel=1e-9)
    wall = zwidth.VirtualWall(30e3, float(top.virtual_damping))
    drawn = zwidth.simulate_tolerances(scene.replace(wall=wall), tolerances, samples=2000)
    assert table["stable_share"][0] == drawn.stable
    assert table["borne_by_99_percent_N_per_m"][0] == drawn.stiffness
    assert 0.5 < drawn.stable < 1


def test_figure_marks_the_required_values_on_the_curve():
    outcome = design("damping", [20e3, 30e3], reserve=1.1, within=[1, 100], num=41).compute(None, True)
    (ax,) = outcome.figures[""]()
    drawn = {}
    for line in ax.lines:
        drawn.setdefault(line.get_label(), []).append(line)
    values = outcome.table["value_N_s_per_m"].tolist()
    assert [float(line.get_xdata()[0]) for line in drawn["required"]] == values
    assert [float(line.get_ydata()[0]) for line in drawn["required"]] == pytest.approx([22.0, 33.0])
    assert float(drawn["present"][0].get_xdata()[0]) == 10.0
    for line, value in zip(drawn["sufficient"], values, strict=True):
        x, y = np.asarray(line.get_xdata()), np.asarray(line.get_ydata())
        assert x[np.isfinite(y)].min() == value
    # The label has three digits, rounded towards the sufficient side.
    for text, value in zip(ax.texts, values, strict=True):
        written = float(text.get_text().split(" ")[0])
        assert value <= written < 1.01 * value
    curve = {"parameter": np.array(["damping"] * 2), "value_N_s_per_m": np.array([1.0, 50.0])}
    curve[SI_COLUMNS[0]] = np.array([15e3, 45e3])
    with_share = outcome.table | {"stable_share": np.array([0.9996, 1.0])}
    assert list(plotting.draw_requirement(curve, with_share, ax)) == [ax]
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert [text.partition(": ")[2] for text in labels[:2]] == [
        "stable on 99.9 % of devices",
        "stable on 100 % of devices",
    ]


def test_always_sufficient_range_is_reported_with_units():
    outcome = design("damping", [5e3], within=[1, 100], num=5).compute(None, True)
    assert outcome.notes == ("5.000 kN/m: any damping from 1.000 N s/m to 100.0 N s/m is enough",)


MESSAGES = {
    "num: 5": "add 'find: damping', or another",
    "find: dampin": "did you mean 'damping'",  # codespell:ignore
    "find: velocity.cutoff": "this device has",
    "find: velocity.samples": "allowed are 'period'",
    "find: delay": "add 'within: [0.1, 100]'",
    "find: damping, within: [2, 1]": "write the lower end first",
    "find: damping, within: [1 kg, 2 kg]": "kg",
    "find: dmping, within: [1 N s/m, 2 N s/m]": "got a list of 2 items; its unit is that of the parameter in 'find'",
    "find: damping, tolerances: {mas: 0.1}": "this device has",
    "find: damping, tolerances: 0.1": "got 0.1; it must be a mapping; write 'key: value' lines, or {key: value}",
    "find: damping, tolerances: {mass: 1.1}": "write 75 % as 0.75",
    "find: damping, tolerances: {mass: 0.5}, distribution: normal": "it must be less than 0.333",
    "find: damping, stiffness: 0": "it must be greater than 0",
}


@pytest.mark.parametrize("fields", MESSAGES)
def test_invalid_fields_raise(fields, tmp_path):
    wall = "" if "stiffness" in fields else ", stiffness: 20 kN/m"
    text = "{version: 1, name: a, scene: {mass: 0.1, damping: 1, rate: 1000}, studies: [{kind: design, name: d, %s%s}]}"
    file = tmp_path / "a.yaml"
    file.write_text(text % (fields, wall))
    with pytest.raises(ConfigError) as refusal:
        load_config(file)
    assert MESSAGES[fields] in str(refusal.value)


def test_scene_supplies_device_and_stiffness(tmp_path):
    file = tmp_path / "a.yaml"
    scene = "{mass: 0.1, damping: 1, rate: 1000, stiffness: 5 kN/m, velocity: {kind: low_pass, cutoff: 50}}"
    file.write_text(f"{{version: 1, name: a, scene: {scene}, studies: [{{kind: design, name: d, find: damping}}]}}")
    (study,) = load_config(file).studies
    assert isinstance(study, DesignStudy)
    assert study.stiffness.values().tolist() == [5e3]
    assert study.device.velocity is not None
    assert study.draws == 0
