"""The limit_cycle study, against single simulations, harmonic balance and its own arrays."""

import numpy as np
import pytest
from pydantic import ValidationError

import zwidth
from zwidth import plotting
from zwidth.config.fields import list_problems
from zwidth.config.values import read_in_units
from zwidth.plotting.style import style_sheet
from zwidth.studies.limit_cycle import LimitCycleStudy
from zwidth.units.unit_system import ROTARY

DEVICE = {"mass": 0.1, "damping": 0.1, "period": 1e-3, "delay": "1 periods"}
SCENE = zwidth.Scene(zwidth.Device(0.1, 0.1), zwidth.Timing(period=1e-3, delay=1e-3))
PLANE = {
    "stiffness": {"linear": {"start": "1 kN/m", "stop": "25 kN/m", "num": 9}},
    "virtual_damping": {"linear": {"start": -5, "stop": 100, "num": 8}},
}
CONDITIONS = [{"label": "linear"}, {"label": "encoder", "resolution": "20 um"}]


def make_study(axes=PLANE, **keys):
    return LimitCycleStudy.model_validate({"kind": "limit_cycle", "name": "c", "device": DEVICE, "axes": axes, **keys})


@pytest.fixture(scope="module")
def plane():
    return make_study(conditions=CONDITIONS, start_position="0.1 mm", duration="400 periods").compute(None, True)


@pytest.fixture(scope="module")
def curves():
    axes = {
        "stiffness": ["5 kN/m", "16 kN/m"],
        "virtual_damping": 42.5,
        "resolution": {"log": {"start": "1 um", "stop": "100 um", "num": 5}},
    }
    keys = {"start_position": "0.1 mm", "max_force": "8.5 N", "duration": "400 periods", "smallest_amplitude": "0.1 um"}
    return make_study(axes, **keys).compute(None, True)


def test_arrays_agree_with_simulations(plane):
    arrays = plane.arrays
    assert arrays["condition"].tolist() == ["linear", "encoder"]
    K, B = arrays["stiffness_N_per_m"][:, None], arrays["virtual_damping_N_s_per_m"]
    assert (K[0, 0], K[-1, 0], B[0], B[-1]) == (1e3, 25e3, -5.0, 100.0)
    for k, resolution in enumerate((0.0, 2e-5)):
        expected = zwidth.simulate(SCENE, K, B, start_position=1e-4, periods=400, record=False, resolution=resolution)
        names = {"amplitude": "_m", "frequency": "_Hz", "wall_work_max": "_J", "outcome": "", "status": ""}
        for name, unit in names.items():
            np.testing.assert_array_equal(arrays[name + unit][k], getattr(expected, name))
        np.testing.assert_array_equal(arrays["linearly_stable"][k], SCENE.is_stable(K, B))


def test_notes_count_the_final_states_of_the_arrays(plane):
    arrays = plane.arrays
    assert len(plane.notes) == 3
    for k, note in enumerate(plane.notes[:2]):
        amplitude, stable = arrays["amplitude_m"][k], arrays["linearly_stable"][k] == 1
        silent, too_large = amplitude < 1e-6, (amplitude > 1e-3) | (arrays["outcome"][k] == zwidth.MotionKind.DIVERGED)
        for selected, name in ((stable, "stable"), (~stable, "unstable")):
            counts = [
                np.count_nonzero(final_state[selected]) for final_state in (silent, ~silent & ~too_large, too_large)
            ]
            counted = ", ".join(
                f"{a:,} {b}" for a, b in zip(counts, ("at rest", "in a limit cycle", "larger than 1 mm"), strict=True)
            )
            assert f"of {selected.sum():,} linearly {name} walls {counted}" in note
    # Quantization by the encoder causes limit cycles at most stable walls.
    stable = arrays["linearly_stable"][0] == 1
    assert np.mean(arrays["amplitude_m"][0][stable] < 1e-6) > 0.7
    assert np.mean(arrays["amplitude_m"][1][stable] < 1e-6) < 0.3


def test_grid_is_drawn_with_the_linear_boundary(plane):
    panels = plane.figures[""]()
    assert [ax.get_title("left") for ax in panels] == ["linear", "encoder"]
    (outline,) = SCENE.stable_region()
    for k, ax in enumerate(panels):
        (line,) = [line for line in ax.lines if line.get_label() == "linear, 1"]
        np.testing.assert_allclose(line.get_xdata()[:-1], outline.stiffness / 1e3)
        np.testing.assert_allclose(line.get_ydata()[:-1], outline.virtual_damping)
        (mesh,) = [artist for artist in ax.collections if hasattr(artist, "get_coordinates")]
        drawn, amplitude = mesh.get_array(), plane.arrays["amplitude_m"][k].T
        too_large = (amplitude > 1e-3) | (plane.arrays["outcome"][k].T == zwidth.MotionKind.DIVERGED)
        np.testing.assert_array_equal(np.ma.getmaskarray(drawn), too_large)
        np.testing.assert_allclose(drawn[~too_large], np.maximum(amplitude[~too_large], 1e-300) * 1e6)
        # Walls at rest lie below the color scale.
        assert mesh.norm.vmin == pytest.approx(1.0)


def test_curves_are_drawn_over_the_other_axis(curves):
    arrays = curves.arrays
    assert arrays["amplitude_m"].shape == (1, 2, 5)
    above, below = curves.figures[""]()
    for k, label in enumerate(("$K = 5$ kN/m", "$K = 16$ kN/m, unstable")):
        (line,) = [line for line in above.lines if line.get_label() == label]
        np.testing.assert_allclose(line.get_xdata(), arrays["resolution_m"] * 1e6)
        np.testing.assert_allclose(line.get_ydata(), arrays["amplitude_m"][0, k] * 1e6)
        (line,) = [line for line in below.lines if line.get_label() == label]
        np.testing.assert_allclose(line.get_ydata(), arrays["frequency_Hz"][0, k])


def test_curve_without_points_is_named_in_the_figure():
    arrays = {
        "condition": ["rubbing"], "stiffness_N_per_m": [5e3, 1e4], "resolution_m": [1e-6, 1e-5, 1e-4],
        "amplitude_m": np.array([[[1e-9, 1e-9, 1e-8], [1e-6, 1e-5, 1e-8]]]), "frequency_Hz": np.full((1, 2, 3), 80.0),
        "outcome": np.full((1, 2, 3), 2), "linearly_stable": np.ones((1, 2, 3), bool),
    }  # fmt: skip
    columns = {name: np.asarray(values) for name, values in arrays.items()}
    upper, lower = plotting.draw_limit_cycle_curves(columns, {}, (1e-7, 1e-3), "stiffness_N_per_m")
    assert [text.get_text() for text in upper.texts] == ["at rest everywhere:\n$K = 5$ kN/m"]
    assert not lower.texts
    (legend,) = upper.figure.legends
    assert [text.get_text() for text in legend.get_texts()][-1] == "gap: at rest, or larger than 1 mm"


def test_figure_states_that_every_wall_is_at_rest():
    axes = {"stiffness": ["1 kN/m", "2 kN/m", "5 kN/m"], "virtual_damping": 42.5}
    silent = make_study(axes, start_position="0.1 mm", coulomb="10 N", duration="200 periods").compute(None, True)
    assert (silent.arrays["amplitude_m"] < 1e-6).all()
    (draw,) = silent.figures.values()
    upper, _ = draw()
    upper.figure.draw_without_rendering()
    assert upper.texts[0].get_text() == "at rest everywhere"


KNOB = {"mass": 6e-6, "damping": 2e-5, "period": 1e-3, "delay": "0.7 periods", "rotary": True}


def make_knob_study(**keys):
    keys = {"device": KNOB, "resolution": "0.0005 rev", "start_position": "1 deg", "duration": "600 periods"} | keys
    return make_study({"stiffness": ["0.1 N m/rad", "0.3 N m/rad"], "virtual_damping": "1 mN m s/rad"}, **keys)


def test_amplitude_bounds_of_a_rotary_device_are_angles():
    """An encoder of 2,000 counts has steps of 3.14 mrad; limit cycles within one step count and are drawn."""
    with read_in_units(ROTARY), style_sheet(system=ROTARY):
        study = make_knob_study()
        assert study.bound_amplitudes(study.device.to_scene()) == (1e-6, pytest.approx(np.radians(20)))
        outcome = study.compute(None, True)
        (draw,) = outcome.figures.values()
        upper, _ = draw()
    assert "2 in a limit cycle, 0 larger than 349 mrad" in outcome.notes[0]
    assert outcome.notes[-1].endswith("limit cycle: amplitude from 1 µrad to 349 mrad")
    amplitude = outcome.arrays["amplitude_m"]
    assert ((amplitude > 1e-4) & (amplitude < 1e-2)).all()
    (legend,) = upper.figure.legends
    assert [text.get_text() for text in legend.get_texts()][-1] == "gap: at rest, or larger than 349 mrad"


def test_amplitude_bounds_depend_on_the_encoder_resolution():
    study = make_study(conditions=[{"label": "a"}, {"label": "b", "resolution": "1 mm"}])
    assert study.bound_amplitudes(SCENE) == (1e-6, pytest.approx(1e-2))


def test_figure_without_limit_cycles_states_the_reason():
    with read_in_units(ROTARY), style_sheet(system=ROTARY):
        outcome = make_knob_study(largest_amplitude="0.1 mrad").compute(None, True)
        (draw,) = outcome.figures.values()
        upper, _ = draw()
    assert "2 larger than 100 µrad" in outcome.notes[0]
    assert upper.texts[0].get_text() == "larger than 100 µrad everywhere"


def test_saturated_limit_cycle_agrees_with_harmonic_balance(curves):
    """At the frequency where the loop has a phase of -180 degrees, the describing function equals the inverse
    loop gain.
    """
    stiffness, damping = 16e3, 42.5
    omega = 2 * np.pi * np.linspace(60, 110, 200_001)
    z = np.exp(1j * omega * 1e-3)
    # x = -G(K + B (1 - 1/z)/T) x: find the frequency at which the loop is real.
    wall = stiffness + damping * (1 - 1 / z) / 1e-3
    zoh = (1 - np.exp(-1j * omega * 1e-3)) / (1j * omega * 1e-3)
    loop = wall * zoh / z / (-0.1 * omega**2 + 0.1j * omega)
    k = np.flatnonzero(np.diff(np.sign(loop.imag)) != 0)[0]
    frequency = curves.arrays["frequency_Hz"][0, 1, 0]
    assert frequency == pytest.approx(omega[k] / 2 / np.pi, rel=0.02)
    # A saturation of amplitude ratio r has the describing function N(r); its input has the amplitude |wall| A.
    ratios = np.linspace(1e-3, 1, 100_001)
    gains = 2 / np.pi * (np.arcsin(ratios) + ratios * np.sqrt(1 - ratios**2))
    ratio = np.interp(-1 / loop[k].real, gains, ratios)
    assert curves.arrays["amplitude_m"][0, 1, 0] == pytest.approx(8.5 / ratio / abs(wall[k]), rel=0.05)


def test_boundary_over_a_single_stiffness_axis_is_a_line():
    axes = {
        "stiffness": {"linear": {"start": "5 kN/m", "stop": "25 kN/m", "num": 3}},
        "virtual_damping": 40,
        "coulomb": {"linear": {"start": 0, "stop": "1 N", "num": 2}},
    }
    outcome = make_study(axes, start_position="0.1 mm", duration="50 periods").compute(None, True)
    (ax,) = outcome.figures[""]()
    lines = [line.get_xdata()[0] for line in ax.lines if line.get_label().startswith("linear")]
    expected = SCENE.stable_stiffness(40.0).ravel() / 1e3
    np.testing.assert_allclose(sorted(lines), expected, rtol=1e-14)


def test_adaptive_window_has_no_linear_boundary():
    foaw = {"kind": "foaw", "noise": "20 um", "samples": 4}
    axes = {"stiffness": {"linear": {"start": "1 kN/m", "stop": "9 kN/m", "num": 3}}, "virtual_damping": [5, 20]}
    conditions = [{"label": "difference"}, {"label": "adaptive", "velocity": foaw}]
    keys = {"conditions": conditions, "resolution": "20 um", "start_position": "0.1 mm", "duration": "50 periods"}
    outcome = make_study(axes, **keys).compute(None, True)
    assert (outcome.arrays["linearly_stable"][0] >= 0).all()
    assert (outcome.arrays["linearly_stable"][1] == -1).all()
    assert outcome.notes[1].startswith("adaptive: of 6 walls ")


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"axes": {"stiffness": 1e3, "virtual_damping": 5}}, "got 0 axes with several values"),
        ({"axes": {"stiffness": [1, 2], "virtual_damping": [1, 2], "coulomb": [1, 2]}}, "got 3 axes"),
        ({"axes": {"stiffness": [1, 2]}}, "virtual_damping"),
        ({"conditions": [{"label": "a"}, {"label": "a"}]}, "got 'a' twice"),
        ({"conditions": []}, "at least one of the conditions is needed"),
        ({"conditions": [{"resolution": "20 um"}]}, "label"),
        (
            {"axes": {**PLANE, "coulomb": 0.1}, "conditions": [{"label": "a", "coulomb": 0.2}]},
            "in the condition and as an axis",
        ),
        ({"smallest_amplitude": "2 mm"}, "smallest_amplitude must be less than largest_amplitude"),
        ({"conditions": [{"label": "a", "coulomb": 0.2, "static": 0.1}]}, "below coulomb, 0.2 N"),
    ],
)
def test_invalid_fields_raise(keys, message):
    with pytest.raises(ValueError, match=message):
        make_study(**keys)


def test_errors_of_conditions_are_reported_at_their_location():
    def list_error_paths(**keys):
        with pytest.raises(ValidationError) as caught:
            make_study(**keys)
        return [path for path, _ in list_problems(caught.value)]

    assert list_error_paths(jitter="2 ms", conditions=CONDITIONS) == [("jitter",)]
    assert list_error_paths(conditions=[{"label": "a"}, {"label": "b", "jitter": "2 ms"}]) == [
        ("conditions", 1, "jitter")
    ]


def test_run_writes_all_files(tmp_path):
    file = tmp_path / "a.yaml"
    file.write_text(
        "version: 1\nname: a\nscene: {mass: 0.1 kg, period: 1 ms, delay: 1 periods}\nstudies:\n"
        "  - kind: limit_cycle\n    name: c\n    start_position: 10 um\n    duration: 50 periods\n"
        "    axes: {stiffness: {linear: {start: 1, stop: 20 kN/m, num: 3}}, virtual_damping: [0, 50]}\n"
        "    conditions: [{label: linear}, {label: friction, coulomb: 0.1 N}]\n",
        encoding="utf-8",
    )
    result = zwidth.run(file, out=tmp_path / "out")
    assert result.ok
    assert all((tmp_path / "out" / name).stat().st_size for name in ("c.npz", "c_boundary.csv", "c.png", "c.svg"))
    with np.load(tmp_path / "out" / "c.npz") as stored:
        assert stored["amplitude_m"].shape == (2, 3, 2)


def test_tool_is_refused():
    with pytest.raises(ValidationError, match="limit cycles are found on walls only"):
        make_study(device={**DEVICE, "tool": {"mass": 0.3}})
