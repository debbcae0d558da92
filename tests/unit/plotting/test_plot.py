"""Pictures of scenes show what the scenes answer."""

from __future__ import annotations

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pandas
import pytest
from matplotlib import cbook
from matplotlib.figure import Figure

import zwidth
from zwidth import plot, plotting

TIMING = zwidth.Timing(period=1e-3, delay=1e-3)
RIGID = zwidth.Scene(zwidth.Device(0.1, 10), TIMING)
FILTERED = RIGID.replace(velocity=zwidth.LowPass(cutoff=100))
WALL = 10e3, 20.0


@pytest.fixture(autouse=True)
def fresh():
    """What draws into pyplot's current Axes begins with an empty one, and leaves none."""
    plt.close("all")
    yield
    plt.close("all")


def test_without_axes_pyplot_s_current_ones_are_drawn_into():
    _, (left, right) = plt.subplots(1, 2)
    plt.sca(left)
    assert plot.region(RIGID) is left
    plt.sca(right)
    assert plot.nyquist(RIGID, *WALL) is right
    assert plot.poles(RIGID, *WALL, ax=left) is left
    assert len(plt.get_fignums()) == 1


@pytest.mark.parametrize("wall", [WALL, (25e3, 40.0)])
@pytest.mark.parametrize("scene", [RIGID, FILTERED])
def test_bode_is_the_open_loop_with_its_margins(scene, wall):
    upper, lower = plot.bode(scene, *wall)
    (number,) = plt.get_fignums()
    assert upper.figure is plt.figure(number)
    hertz, size = line(upper, "$|L|$")
    _, phase = line(lower, "phase of $L$")
    found = scene.frequency_response(*wall, hertz)
    np.testing.assert_allclose(size * np.exp(1j * np.radians(phase)), found, rtol=1e-9)
    assert np.abs(np.diff(phase)).max() < 90.0
    margins = scene.margins(*wall)
    # Of three digits, no more than there is.
    names = {"gain": (upper, margins.gain_margin), "phase": (lower, margins.phase_margin)}
    labels = {}
    for name, (ax, margin) in names.items():
        (labels[name],) = [str(each.get_label()) for each in ax.lines if f"{name} margin" in str(each.get_label())]
        read = float(labels[name].split()[-1].rstrip("°"))
        assert margin - 0.01 * abs(margin) < read <= margin
    at, ends = line(upper, labels["gain"])
    np.testing.assert_allclose(at, margins.phase_crossover)
    np.testing.assert_allclose(ends, (1.0, 1.0 / margins.gain_margin))
    at, ends = line(lower, labels["phase"])
    np.testing.assert_allclose(at, margins.gain_crossover)
    assert ends[1] - ends[0] == pytest.approx(margins.phase_margin, abs=0.1)
    assert (ends[0] + 180.0) / 360.0 == pytest.approx(round((ends[0] + 180.0) / 360.0), abs=1e-9)


def test_a_recommendation_is_drawn_with_its_response():
    found = FILTERED.recommend(stiffness_fraction=0.5)
    walls, response = plot.recommendation(found)
    assert len(plt.get_fignums()) == 1
    at, _ = line(walls, "recommended (50 %)")
    assert float(at[0]) * 1e3 == pytest.approx(found.stiffness)
    _, ends = line(walls, "virtual_damping_interval")
    assert found.verdict is not None
    np.testing.assert_allclose(ends, (found.verdict.virtual_damping_lower, found.verdict.virtual_damping_upper))
    (top, _) = line(walls, "stiffest")
    assert float(top[0]) * 1e3 == pytest.approx(float(found.stiffest.stiffness))
    time, position = np.asarray(response.lines[0].get_data())
    expected = found.scene.state_space().step(time.size)
    np.testing.assert_allclose(position * 1e-6, expected, rtol=1e-9, atol=1e-12)
    assert response.get_legend() is None
    rigid = RIGID.recommend(stiffness_fraction=0.5)
    (mark,) = plot.recommendation(rigid)[1].get_legend().get_texts()
    verdict, period = rigid.verdict, RIGID.timing.period
    assert verdict is not None
    settled = zwidth.step_response(verdict.alpha, verdict.beta, RIGID.delta, RIGID.d).settling_time * period
    assert mark.get_text() == f"settled to 2 % after {settled * 1e3:.3g} ms"
    (alone,) = plot.recommendation(RIGID.replace(damping=0.0).recommend(passive=True))
    assert alone is plt.gca()


def test_whole_numbers_are_points():
    ax = plot.ridge(RIGID.replace(velocity=zwidth.WindowedDifference(1)), "velocity.samples", [1, 2, 3, 4])
    (points,) = ax.lines
    assert (points.get_linestyle(), points.get_marker()) == ("None", "o")
    assert "in 1" not in ax.get_xlabel()


@pytest.mark.parametrize(("name", "more"), [("ridge", ("damping", [1.0])), ("step", (1.0,)),
                                            ("bode", ()), ("nyquist", ()), ("poles", ())])  # fmt: skip
def test_what_is_no_scene_is_refused_by_name(name, more, unpainted):
    with pytest.raises(zwidth.InputError, match=r"scene: got 3\.0; pass a zwidth\.Scene"):
        getattr(plot, name)(3.0, *more)


def test_it_shows_its_own_names():
    assert dir(plot) == sorted(plot.__all__)
    assert "bode" in dir(plot)


def line(ax, label):
    """The data of the line with that label."""
    (found,) = [each for each in ax.lines if each.get_label() == label]
    return np.asarray(found.get_xdata(), float), np.asarray(found.get_ydata(), float)


@pytest.mark.parametrize("scene", [RIGID, FILTERED])
@pytest.mark.parametrize("normalized", [False, True])
def test_the_edge_parts_stable_from_unstable_walls(scene, normalized):
    ax = plot.region(scene, normalized=normalized)
    x, y = line(ax, "outline 1")
    units = tuple(scene.units) if normalized else (1e3, 1.0)
    K, B = x * units[0], y * units[1]
    inside = 1e-3 * K.max() < K
    middle = K[inside].mean(), B[inside].mean()
    shrunk, grown = (
        [m + share * (v[inside] - m) for m, v in zip(middle, (K, B), strict=True)] for share in (0.99, 1.01)
    )
    assert np.all(scene.is_stable(*shrunk))
    assert not np.any(scene.is_stable(*grown))
    top = line(ax, "stiffest")
    assert float(top[0][0]) * units[0] == pytest.approx(float(scene.max_stiffness().stiffness))


def test_the_passive_edge_parts_passive_walls():
    ax = plot.region(RIGID, passive=True)
    (edge,) = [each for each in ax.lines if each.get_linestyle() not in ("-", "None")]
    K, B = np.asarray(edge.get_xdata(), float) * 1e3, np.asarray(edge.get_ydata(), float)
    assert np.all(RIGID.is_passive(0.999 * K, 0.999 * B))
    assert not np.any(RIGID.is_passive(1.001 * K, 1.001 * B))


def test_several_scenes_have_their_labels():
    ax = plot.region({"difference": RIGID, "low-pass": FILTERED})
    legend = ax.get_legend()
    assert legend is not None
    assert {"difference", "low-pass"} <= {text.get_text() for text in legend.get_texts()}


@pytest.mark.parametrize("label", ["$a_$", "$x$", "_hidden", "50 $ a_b"])
def test_labels_are_text(label):
    drawn = [
        plot.region({label: RIGID, "other": FILTERED}),
        plot.motion(RIGID.simulate(5e3, 20.0, external_force=1.0, periods=50), labels=[label]),
    ]
    for ax in drawn:
        plotting.style.figure_of(ax).draw_without_rendering()
        legend = ax.get_legend()
        assert legend is not None
        (shown, *_) = [text for text in legend.get_texts() if label in text.get_text().replace(r"\$", "$")]
        # No pair of dollars that matplotlib takes for mathematics.
        assert not cbook.is_math_text(shown.get_text())


def test_a_ridge_over_equal_ratios_has_plain_numbers_within_a_decade():
    ax = plot.ridge(RIGID, "damping", np.geomspace(2.0, 8.0, 5))
    assert ax.get_xscale() == "log"
    plotting.style.figure_of(ax).draw_without_rendering()
    words = [tick.get_text() for minor in (False, True) for tick in ax.xaxis.get_ticklabels(minor=minor)]
    assert {word for word in words if word} >= {"2", "5"}
    assert not any("$" in word for word in words)


def test_a_ridge_is_the_stiffest_wall_at_every_value():
    ax = plot.ridge(RIGID, "damping", [0.0, 5.0, 10.0])
    x, y = line(ax, "stiffest stable wall")
    expected = [float(RIGID.replace(damping=b).max_stiffness().stiffness) / 1e3 for b in x]
    np.testing.assert_allclose(y, expected)
    assert ax.get_xlabel() == "physical damping  $b$  in N s/m"


def test_a_step_is_the_simulated_one():
    ax = plot.step(FILTERED, *WALL, periods=60)
    y = np.asarray(ax.lines[0].get_ydata(), float) * 1e-6
    np.testing.assert_allclose(y, FILTERED.simulate(*WALL, external_force=1.0, periods=60).position, atol=1e-14)


def test_the_gain_crossover_is_on_the_unit_circle_at_its_margin():
    ax = plot.nyquist(RIGID, *WALL)
    x, y = line(ax, "gain crossover")
    at = RIGID.frequency_response(*WALL, RIGID.margins(*WALL).gain_crossover)
    assert complex(x[0], y[0]) == pytest.approx(complex(at), abs=1e-4)


def test_poles_outside_look_different():
    ax = plot.poles(RIGID, 25e3, 40.0)
    outside = np.hypot(*line(ax, "poles on or outside the unit circle"))
    assert outside.min() > 1.0
    assert outside.size + line(ax, "poles inside the unit circle")[0].size == RIGID.poles(25e3, 40.0).size


def test_motions_over_time():
    found = RIGID.simulate([5e3, 10e3], 20.0, external_force=1.0, periods=50)
    ax = plot.motion(found, labels=["soft", "stiff"])
    np.testing.assert_allclose(line(ax, "stiff")[1] * 1e-6, np.asarray(found.position)[1])
    with pytest.raises(zwidth.InputError, match="got 1 for 2 motions"):
        plot.motion(found, labels=["one"])
    with pytest.raises(zwidth.InputError, match="record=True"):
        plot.motion(RIGID.simulate(5e3, 20.0, periods=5, record=False))


def test_an_axes_of_ones_own_is_drawn_into_and_no_setting_changes():
    before = dict(matplotlib.rcParams)
    ax = Figure().subplots()
    assert plot.region(RIGID, ax) is ax
    assert dict(matplotlib.rcParams) == before
    with pytest.raises(zwidth.InputError, match="values: got shape"):
        plot.ridge(RIGID, "damping", 3.0)


def test_a_rotary_device_is_drawn_in_its_units():
    device, timing = zwidth.Device("12 g cm^2", "0.02 mN m s/rad"), zwidth.Timing("1 ms")
    scene = zwidth.Scene(device, timing, zwidth.VirtualWall("4 mN m/deg", "0.3 mN m s/rad"))
    _, (first, second, third, fourth) = plt.subplots(1, 4)
    zwidth.plot.region(scene, first)
    zwidth.plot.ridge(scene, "mass", ["10 g cm^2", "20 g cm^2"], second)
    zwidth.plot.step(scene, ax=third)
    zwidth.plot.motion(scene.simulate(start_position="2 deg", periods=50), fourth)
    assert first.get_xlabel().endswith("in mN m/rad")
    assert first.get_ylabel().endswith("in mN m s/rad")
    assert second.get_xlabel().endswith("in g cm$^2$")
    np.testing.assert_allclose(second.lines[0].get_xdata(), [10, 20])
    assert third.get_ylabel().endswith("rad for 1 N m")
    assert fourth.get_ylabel() == r"angle  $\theta$  in mrad"
    assert third.get_ylabel().startswith(r"angle  $\theta$  in ")


def test_a_short_contact_fills_a_third_of_the_axis():
    """A hit of some 20 ms in a simulation of 1 s, and a faster one that leaves further: neither is cut."""
    hits = RIGID.simulate(
        [1e3, 10e3], [5.0, 20.0], start_position=-1e-3, start_velocity=0.2, contact="unilateral", periods=1000
    )
    assert hits.contact is not None
    last = max(np.flatnonzero(contact)[-1] for contact in hits.contact) * RIGID.timing.period
    ax = plot.motion(hits, plt.figure().subplots(), labels=["soft", "stiff"])
    shown = ax.get_xlim()[1] / 1e3
    assert 0.01 < last < 0.1
    assert shown == pytest.approx(3 * last, abs=1e-3)
    low, high = ax.get_ylim()
    for values in (np.asarray(each.get_ydata()) for each in ax.lines):
        assert low <= values.min()
        assert values.max() <= high
    # What stays in contact is shown to the end.
    pressed = RIGID.simulate(1e3, 5.0, start_position=1e-4, external_force=1.0, contact="unilateral", periods=1000)
    assert plot.motion(pressed, plt.figure().subplots()).get_xlim()[1] == pytest.approx(999.0)


def test_a_motion_that_grows_without_bound_is_cut():
    found = RIGID.simulate([5e3, 40e3], 20.0, start_position=1e-3, periods=200)
    ax = plot.motion(found, plt.figure().subplots(), labels=["stable", "unstable"])
    assert max(abs(end) for end in ax.get_ylim()) <= 1.1 * 8.0


def test_tables_of_rotary_devices_are_drawn_in_their_units(tmp_path, unpainted):
    """What a run writes of them has columns in rad and N m, and is drawn again as it was."""
    studies = [
        {"kind": "step", "name": "step", "stiffness_fraction": 0.5},
        {"kind": "simulate", "name": "motion", "stiffness_fraction": 0.5, "duration": "50 ms"},
    ]
    scene = {"device": "haptic_wheel", "period": "1 ms", "delay": "1 ms"}
    assert zwidth.run({"version": 1, "name": "turns", "scene": scene, "studies": studies}, out=tmp_path / "run").ok
    for name, draw, unit in (("step", plotting.draw_step, "N m"), ("motion", plotting.draw_motion, "N m")):
        frame = pandas.read_csv(tmp_path / "run" / f"{name}.csv")
        assert "position_rad" in frame
        for table in (frame, {column: frame[column].to_numpy() for column in frame}):
            labels = " ".join(ax.get_ylabel() for ax in draw(table))
            assert "rad" in labels
            assert "wall torque" in labels
            assert labels.endswith(f"in {unit}")
    # Those of linear devices in theirs.
    linear = {"kind": "step", "name": "step", "stiffness_fraction": 0.5}
    scene = {"mass": 0.1, "damping": 1.0, "period": 1e-3}
    assert zwidth.run({"version": 1, "name": "moves", "scene": scene, "studies": [linear]}, out=tmp_path / "linear").ok
    labels = [ax.get_ylabel() for ax in plotting.draw_step(pandas.read_csv(tmp_path / "linear" / "step.csv"))]
    assert not any("rad" in label for label in labels)
