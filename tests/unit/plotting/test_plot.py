"""`zwidth.plot`: figures of scenes against the scenes' own results."""

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
def close_figures():
    """Close all pyplot figures before and after a test, because functions draw into the current axes."""
    plt.close("all")
    yield
    plt.close("all")


def test_current_axes_are_the_default():
    _, (left, right) = plt.subplots(1, 2)
    plt.sca(left)
    assert plot.region(RIGID) is left
    plt.sca(right)
    assert plot.nyquist(RIGID, *WALL) is right
    assert plot.poles(RIGID, *WALL, ax=left) is left
    assert len(plt.get_fignums()) == 1


@pytest.mark.parametrize("wall", [WALL, (25e3, 40.0)])
@pytest.mark.parametrize("scene", [RIGID, FILTERED])
def test_bode_plot_agrees_with_frequency_response_and_margins(scene, wall):
    upper, lower = plot.bode(scene, *wall)
    (number,) = plt.get_fignums()
    assert upper.figure is plt.figure(number)
    hertz, size = get_line(upper, "$|L|$")
    _, phase = get_line(lower, "phase of $L$")
    response = scene.frequency_response(*wall, hertz)
    np.testing.assert_allclose(size * np.exp(1j * np.radians(phase)), response, rtol=1e-9)
    assert np.abs(np.diff(phase)).max() < 90.0
    margins = scene.margins(*wall)
    # Labels have three digits, rounded down.
    names = {"gain": (upper, margins.gain_margin), "phase": (lower, margins.phase_margin)}
    labels = {}
    for name, (ax, margin) in names.items():
        (labels[name],) = [
            str(artist.get_label()) for artist in ax.lines if f"{name} margin" in str(artist.get_label())
        ]
        labeled_margin = float(labels[name].split()[-1].rstrip("°"))
        assert margin - 0.01 * abs(margin) < labeled_margin <= margin
    frequency, ends = get_line(upper, labels["gain"])
    np.testing.assert_allclose(frequency, margins.phase_crossover)
    np.testing.assert_allclose(ends, (1.0, 1.0 / margins.gain_margin))
    frequency, ends = get_line(lower, labels["phase"])
    np.testing.assert_allclose(frequency, margins.gain_crossover)
    assert ends[1] - ends[0] == pytest.approx(margins.phase_margin, abs=0.1)
    assert (ends[0] + 180.0) / 360.0 == pytest.approx(round((ends[0] + 180.0) / 360.0), abs=1e-9)


def test_recommendation_is_drawn_with_its_response():
    recommended = FILTERED.recommend(stiffness_fraction=0.5)
    walls, response = plot.recommendation(recommended)
    assert len(plt.get_fignums()) == 1
    stiffness_of_mark, _ = get_line(walls, "recommended (50 %)")
    assert float(stiffness_of_mark[0]) * 1e3 == pytest.approx(recommended.stiffness)
    _, ends = get_line(walls, "virtual_damping_interval")
    assert recommended.verdict is not None
    np.testing.assert_allclose(
        ends, (recommended.verdict.virtual_damping_lower, recommended.verdict.virtual_damping_upper)
    )
    (top, _) = get_line(walls, "stiffest")
    assert float(top[0]) * 1e3 == pytest.approx(float(recommended.stiffest.stiffness))
    time, position = np.asarray(response.lines[0].get_data())
    expected = recommended.scene.state_space().step(time.size)
    np.testing.assert_allclose(position * 1e-6, expected, rtol=1e-9, atol=1e-12)
    assert response.get_legend() is None
    rigid = RIGID.recommend(stiffness_fraction=0.5)
    (mark,) = plot.recommendation(rigid)[1].get_legend().get_texts()
    verdict, period = rigid.verdict, RIGID.timing.period
    assert verdict is not None
    settled = zwidth.step_response(verdict.alpha, verdict.beta, RIGID.delta, RIGID.d).settling_time * period
    assert mark.get_text() == f"settled to 2 % after {settled * 1e3:.3g} ms"
    (single_axes,) = plot.recommendation(RIGID.replace(damping=0.0).recommend(passive=True))
    assert single_axes is plt.gca()


@pytest.mark.parametrize("size", [(6.4, 4.8), (4.0, 3.0), (2.6, 2.4)])
def test_text_of_the_stiffest_wall_is_inside_the_frame(size):
    knob = zwidth.Scene(zwidth.Device("60 g cm^2", "0.02 mN m s"), TIMING)
    for scene in (RIGID, knob):
        _, ax = plt.subplots(figsize=size)
        plot.region(scene, ax)
        (text,) = ax.texts
        frame, box = ax.get_window_extent(), text.get_window_extent()
        assert frame.x0 <= box.x0, size
        assert box.x1 <= frame.x1, size


def test_gray_line_of_a_recommendation_is_explained():
    walls, _ = plot.recommendation(RIGID.recommend(stiffness_fraction=0.5))
    assert [text.get_text() for text in walls.get_legend().get_texts()] == ["passive", "stable $B$ at this $K$"]


def test_integer_parameter_is_drawn_as_points():
    ax = plot.ridge(RIGID.replace(velocity=zwidth.WindowedDifference(1)), "velocity.samples", [1, 2, 3, 4])
    (points,) = ax.lines
    assert (points.get_linestyle(), points.get_marker()) == ("None", "o")
    assert "in 1" not in ax.get_xlabel()


@pytest.mark.parametrize(("name", "arguments"), [("ridge", ("damping", [1.0])), ("step", (1.0,)),
                                            ("bode", ()), ("nyquist", ()), ("poles", ())])  # fmt: skip
def test_invalid_scene_raises(name, arguments, unpainted):
    with pytest.raises(zwidth.InputError, match=r"scene: got 3\.0; pass a zwidth\.Scene"):
        getattr(plot, name)(3.0, *arguments)


def test_dir_lists_the_public_names():
    assert dir(plot) == sorted(plot.__all__)
    assert "bode" in dir(plot)


def get_line(ax, label):
    """Return the data of the line with this label."""
    (artist_found,) = [artist for artist in ax.lines if artist.get_label() == label]
    return np.asarray(artist_found.get_xdata(), float), np.asarray(artist_found.get_ydata(), float)


@pytest.mark.parametrize("scene", [RIGID, FILTERED])
@pytest.mark.parametrize("normalized", [False, True])
def test_outline_separates_stable_walls(scene, normalized):
    ax = plot.region(scene, normalized=normalized)
    x, y = get_line(ax, "outline 1")
    units = tuple(scene.units) if normalized else (1e3, 1.0)
    K, B = x * units[0], y * units[1]
    inside = 1e-3 * K.max() < K
    middle = K[inside].mean(), B[inside].mean()
    shrunk, grown = (
        [m + scale * (v[inside] - m) for m, v in zip(middle, (K, B), strict=True)] for scale in (0.99, 1.01)
    )
    assert np.all(scene.is_stable(*shrunk))
    assert not np.any(scene.is_stable(*grown))
    top = get_line(ax, "stiffest")
    assert float(top[0][0]) * units[0] == pytest.approx(float(scene.max_stiffness().stiffness))


def test_passive_outline_separates_passive_walls():
    ax = plot.region(RIGID, passive=True)
    (edge,) = [artist for artist in ax.lines if artist.get_linestyle() not in ("-", "None")]
    K, B = np.asarray(edge.get_xdata(), float) * 1e3, np.asarray(edge.get_ydata(), float)
    assert np.all(RIGID.is_passive(0.999 * K, 0.999 * B))
    assert not np.any(RIGID.is_passive(1.001 * K, 1.001 * B))


def test_several_scenes_have_their_labels():
    ax = plot.region({"difference": RIGID, "low-pass": FILTERED})
    legend = ax.get_legend()
    assert legend is not None
    assert {"difference", "low-pass"} <= {text.get_text() for text in legend.get_texts()}


@pytest.mark.parametrize("label", ["$a_$", "$x$", "_hidden", "50 $ a_b"])
def test_labels_are_shown_literally(label):
    drawn = [
        plot.region({label: RIGID, "other": FILTERED}),
        plot.motion(RIGID.simulate(5e3, 20.0, external_force=1.0, periods=50), labels=[label]),
    ]
    for ax in drawn:
        plotting.style.figure_of(ax).draw_without_rendering()
        legend = ax.get_legend()
        assert legend is not None
        (shown, *_) = [text for text in legend.get_texts() if label in text.get_text().replace(r"\$", "$")]
        # No pair of dollar signs is interpreted as mathematics.
        assert not cbook.is_math_text(shown.get_text())


def test_ridge_over_a_logarithmic_axis_has_plain_numbers():
    ax = plot.ridge(RIGID, "damping", np.geomspace(2.0, 8.0, 5))
    assert ax.get_xscale() == "log"
    plotting.style.figure_of(ax).draw_without_rendering()
    labels = [tick.get_text() for minor in (False, True) for tick in ax.xaxis.get_ticklabels(minor=minor)]
    assert {label for label in labels if label} >= {"2", "5"}
    assert not any("$" in label for label in labels)


def test_ridge_agrees_with_max_stiffness():
    ax = plot.ridge(RIGID, "damping", [0.0, 5.0, 10.0])
    x, y = get_line(ax, "stiffest stable wall")
    expected = [float(RIGID.replace(damping=b).max_stiffness().stiffness) / 1e3 for b in x]
    np.testing.assert_allclose(y, expected)
    assert ax.get_xlabel() == "physical damping  $b$  in N s/m"


def test_step_agrees_with_simulate():
    ax = plot.step(FILTERED, *WALL, periods=60)
    y = np.asarray(ax.lines[0].get_ydata(), float) * 1e-6
    np.testing.assert_allclose(y, FILTERED.simulate(*WALL, external_force=1.0, periods=60).position, atol=1e-14)


def test_nyquist_plot_marks_the_gain_crossover():
    ax = plot.nyquist(RIGID, *WALL)
    x, y = get_line(ax, "gain crossover")
    expected = RIGID.frequency_response(*WALL, RIGID.margins(*WALL).gain_crossover)
    assert complex(x[0], y[0]) == pytest.approx(complex(expected), abs=1e-4)


def test_unstable_poles_are_drawn_separately():
    ax = plot.poles(RIGID, 25e3, 40.0)
    outside = np.hypot(*get_line(ax, "poles on or outside the unit circle"))
    assert outside.min() > 1.0
    assert outside.size + get_line(ax, "poles inside the unit circle")[0].size == RIGID.poles(25e3, 40.0).size


def test_motion_plot_agrees_with_simulate():
    motion_result = RIGID.simulate([5e3, 10e3], 20.0, external_force=1.0, periods=50)
    ax = plot.motion(motion_result, labels=["soft", "stiff"])
    np.testing.assert_allclose(get_line(ax, "stiff")[1] * 1e-6, np.asarray(motion_result.position)[1])
    with pytest.raises(zwidth.InputError, match="got 1 for 2 motions"):
        plot.motion(motion_result, labels=["one"])
    with pytest.raises(zwidth.InputError, match="record=True"):
        plot.motion(RIGID.simulate(5e3, 20.0, periods=5, record=False))


def test_motion_plot_shows_the_tool():
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3), tool=zwidth.Tool(0.3))
    motion = scene.simulate(5e3, 20, start_velocity=0.1, periods=50, substeps=2)
    ax = zwidth.plot.motion(motion)
    positions, tool = (np.asarray(ax.lines[k].get_ydata(), float) for k in (0, 1))
    scale = positions.max() / motion.position.max()
    np.testing.assert_allclose(tool, scale * np.repeat(motion.tool_position, 2), rtol=1e-12)


def test_given_axes_are_used_without_changing_settings():
    before = dict(matplotlib.rcParams)
    ax = Figure().subplots()
    assert plot.region(RIGID, ax) is ax
    assert dict(matplotlib.rcParams) == before
    with pytest.raises(zwidth.InputError, match="values: got shape"):
        plot.ridge(RIGID, "damping", 3.0)


def test_rotary_device_is_drawn_in_rotary_units():
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


def test_short_contact_covers_a_third_of_the_time_axis():
    """A contact of about 20 ms in a simulation of 1 s, and a faster one with a larger rebound: both are shown
    completely.
    """
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
    for values in (np.asarray(artist.get_ydata()) for artist in ax.lines):
        assert low <= values.min()
        assert values.max() <= high
    # A lasting contact is shown to the end.
    pressed = RIGID.simulate(1e3, 5.0, start_position=1e-4, external_force=1.0, contact="unilateral", periods=1000)
    assert plot.motion(pressed, plt.figure().subplots()).get_xlim()[1] == pytest.approx(999.0)


def test_diverging_response_is_clipped():
    motion_result = RIGID.simulate([5e3, 40e3], 20.0, start_position=1e-3, periods=200)
    ax = plot.motion(motion_result, plt.figure().subplots(), labels=["stable", "unstable"])
    assert max(abs(end) for end in ax.get_ylim()) <= 1.1 * 8.0


def test_tables_of_rotary_devices_are_drawn_in_rotary_units(tmp_path, unpainted):
    """CSV files of a run have columns in rad and N m, from which the figures can be drawn again."""
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
    # Tables of linear devices are drawn in linear units.
    linear = {"kind": "step", "name": "step", "stiffness_fraction": 0.5}
    scene = {"mass": 0.1, "damping": 1.0, "period": 1e-3}
    assert zwidth.run({"version": 1, "name": "moves", "scene": scene, "studies": [linear]}, out=tmp_path / "linear").ok
    labels = [ax.get_ylabel() for ax in plotting.draw_step(pandas.read_csv(tmp_path / "linear" / "step.csv"))]
    assert not any("rad" in label for label in labels)


def test_several_rotary_scenes_have_rotary_units_and_mixed_scenes_are_rejected(tmp_path):
    timing = zwidth.Timing(rate="2 kHz", delay="1.5 periods")
    knob = zwidth.Scene(zwidth.Device("35 g cm^2", "0.4 mN m s/rad"), timing, velocity=zwidth.LowPass("80 Hz"))
    ax = plot.region({"2 kHz": knob, "4 kHz": knob.replace(rate="4 kHz")})
    assert "N m/rad" in ax.get_xlabel()
    assert "N m s/rad" in ax.get_ylabel()
    files = plotting.save(ax, str(tmp_path / "walls"))
    assert [file.name for file in files] == ["walls.png", "walls.svg"]
    with pytest.raises(zwidth.InputError, match="linear and rotary devices"):
        plot.region({"knob": knob, "mass": RIGID})
