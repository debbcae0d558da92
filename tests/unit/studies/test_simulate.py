"""The simulate study, against zwidth.simulate; its notes on final states, and its figures."""

import csv

import numpy as np
import pytest

import zwidth
from zwidth import plotting
from zwidth.config.scenes import PhysicalWall
from zwidth.plotting.table import select
from zwidth.studies.simulate import SimulateStudy

DEVICE = {"mass": 0.1, "damping": 0.1, "period": 1e-3, "delay": "1 periods"}
IMPACT = {"start_position": -1e-3, "start_velocity": 0.1, "external_force": 0.5, "contact": "unilateral"}


def make_study(**keys):
    return SimulateStudy.model_validate({"kind": "simulate", "name": "s", "device": DEVICE, **keys})


@pytest.fixture(scope="module")
def impact():
    study = make_study(**IMPACT, stiffness_fraction=[0.6, 0.95, 1.05], duration="0.3 s", substeps=2)
    return study.compute(None, True)


@pytest.fixture(scope="module")
def motion():
    scene = zwidth.Scene(zwidth.Device(0.1, 0.1), zwidth.Timing(period=1e-3, delay=1e-3))
    top = scene.max_stiffness()
    walls = np.array([0.6, 0.95, 1.05]) * top.stiffness
    return zwidth.simulate(scene, walls, top.virtual_damping, periods=300, substeps=2, **IMPACT)


def read_summary(outcome):
    return list(csv.DictReader(outcome.documents["s_summary.csv"].splitlines()))


def test_table_agrees_with_the_simulation(impact, motion):
    table = impact.table
    assert table["label"][:: 2 * 300].tolist() == ["0.6 of K_max", "0.95 of K_max", "1.05 of K_max"]
    names = {"position_m": "position", "wall_force_N": "wall_force", "wall_work_J": "wall_work", "energy_J": "energy"}
    for column, name in {**names, "velocity_m_per_s": "velocity"}.items():
        np.testing.assert_array_equal(table[column], getattr(motion, name).ravel())
    np.testing.assert_array_equal(table["time_s"], np.tile(motion.time, 3))
    # The command is constant over the instants of a sampling period.
    np.testing.assert_array_equal(table["command_N"], np.repeat(motion.command.ravel(), 2))


def test_summary_agrees_with_the_simulation(impact, motion):
    rows = read_summary(impact)
    for name, column in {
        "penetration": "penetration_m",
        "wall_work_max": "wall_work_max_J",
        "bounces": "bounces",
    }.items():
        np.testing.assert_array_equal([float(row[column]) for row in rows], getattr(motion, name))
    assert [row["linearly_stable"] for row in rows] == ["True", "True", "False"]
    # A response at rest has no frequency.
    assert rows[0]["frequency_Hz"] == "nan"
    assert float(rows[1]["frequency_Hz"]) == motion.frequency[1]


def test_notes_state_the_final_state(impact):
    assert impact.notes[:2] == (
        "0.6 of K_max (linearly stable): comes to rest within 300 ms",
        "0.95 of K_max (linearly stable): still decays after 300 ms, amplitude 15.2 µm",
    )
    assert impact.notes[2].startswith("1.05 of K_max (linearly unstable): bounces: impact velocity from 144")


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ({"start_position": 1e-4, "walls": [{"stiffness": 30e3}]}, "unstable): grows within 1.00 s"),
        (
            {"start_position": 1e-4, "duration": "180 periods", "walls": [{"stiffness": 1e7}]},
            "unstable): grows without bound",
        ),
        (
            {"start_position": -1e-4, "start_velocity": 0.1, "contact": "unilateral", "walls": [{"stiffness": 1e3}]},
            "unstable): leaves the wall after 1 contact",
        ),
        (
            {"start_position": 1e-4, "max_force": 8.5, "walls": [{"stiffness": 16e3, "virtual_damping": 42.5}]},
            "unstable): keeps oscillating at 81.",
        ),
    ],
    ids=["growing", "diverged", "leaves the wall", "limit cycle"],
)
def test_notes_on_other_final_states(keys, text):
    (note,) = make_study(**keys).compute(None, True).notes
    assert text in note


def test_walls_are_labeled_and_may_be_normalized():
    walls = [{"stiffness": 2e3, "virtual_damping": 5}, {"alpha": 0.05, "beta": 0.1}]
    outcome = make_study(walls=walls, start_position=1e-4, duration="50 periods").compute(None, True)
    assert [row["label"] for row in read_summary(outcome)] == [
        "K = 2.000 kN/m, B = 5.000 N s/m",
        "K = 5.000 kN/m, B = 10.00 N s/m",
    ]
    # With T = 1 ms and m = 0.1 kg, alpha = 1 is 100 kN/m and beta = 1 is 100 N s/m.
    scene = zwidth.Scene(zwidth.Device(0.1, 0.1), zwidth.Timing(period=1e-3, delay=1e-3))
    expected = zwidth.simulate(scene, [2e3, 5e3], [5.0, 10.0], start_position=1e-4, periods=50)
    assert expected.position is not None, "it is recorded"
    np.testing.assert_allclose(outcome.table["position_m"], expected.position.ravel(), rtol=1e-12)


def test_adaptive_window_is_simulated_but_has_no_maximum():
    keys = {"velocity": {"kind": "foaw", "noise": "20 um", "samples": 8}, "resolution": "20 um"}
    outcome = make_study(**keys, walls=[{"stiffness": 5e3, "virtual_damping": 20}], start_position=1e-3).compute(
        None, True
    )
    scene = zwidth.Scene(zwidth.Device(0.1, 0.1), zwidth.Timing(period=1e-3, delay=1e-3), velocity=zwidth.FOAW(2e-5, 8))
    expected = zwidth.simulate(scene, 5e3, 20, resolution=2e-5, start_position=1e-3).position
    np.testing.assert_array_equal(outcome.table["position_m"], expected)
    assert "linearly" not in outcome.notes[0]
    with pytest.raises(ValueError, match="no linear form and no such maximum; write walls"):
        make_study(**keys, stiffness_fraction=0.5)


def test_scene_supplies_device_and_wall(tmp_path):
    file = tmp_path / "a.yaml"
    text = (
        "scene: {mass: 0.1, period: 1 ms, stiffness: 3 kN/m, virtual_damping: 7}\nstudies: [{kind: simulate, name: s}]"
    )
    file.write_text(f"version: 1\nname: a\n{text}\n", encoding="utf-8")
    (study,) = zwidth.load_config(file).studies
    assert isinstance(study, SimulateStudy)
    assert study.walls == (PhysicalWall(stiffness=3e3, virtual_damping=7.0),)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({}, "stiffness_fraction or walls is missing"),
        ({"stiffness_fraction": 0.5, "walls": [{"stiffness": 1}]}, "are both given"),
        ({"stiffness_fraction": -0.5}, "greater than 0"),
        ({"walls": [{"stiffness": 1}], "duration": "900000 periods", "substeps": 200}, "shorten the duration"),
        ({"walls": [{"stiffness": 1}], "delay_model": "held"}, "remove it; for the paper's"),
    ],
)
def test_invalid_fields_raise(keys, message):
    with pytest.raises(ValueError, match=message):
        make_study(**keys)


def test_normalized_scene_raises(tmp_path):
    file = tmp_path / "a.yaml"
    file.write_text(
        "version: 1\nname: a\nscene: {delta: 0.1, d: 1}\nstudies: [{kind: simulate, name: s, walls: [{alpha: 0.1}]}]\n",
        encoding="utf-8",
    )
    with pytest.raises(zwidth.ConfigError, match=r"studies\[0\]\.device: missing; a simulate study needs a device"):
        zwidth.load_config(file)


def test_figures_agree_with_the_table(impact):
    table = impact.table
    assert list(impact.figures) == ["", "_phase", "_energy"]
    position, force = impact.figures[""]()
    (plane,) = impact.figures["_phase"]()
    energies = impact.figures["_energy"]()
    for label in ("0.6 of K_max", "1.05 of K_max"):
        rows = select(table, label=label)
        for ax, column, factor in ((position, "position_m", 1e3), (force, "wall_force_N", 1.0)):
            (line,) = [line for line in ax.lines if line.get_label() == label]
            np.testing.assert_allclose(line.get_xdata(), rows["time_s"] * 1e3)
            np.testing.assert_allclose(line.get_ydata(), rows[column] * factor)
        (line,) = [line for line in plane.lines if line.get_label() == label]
        np.testing.assert_allclose(line.get_xdata(), rows["position_m"] * 1e3)
        np.testing.assert_allclose(line.get_ydata(), rows["velocity_m_per_s"] * 1e3)
    assert len(energies) == 3
    lines = {line.get_label(): line.get_ydata() for line in energies[2].lines}
    rows = select(table, label="1.05 of K_max")
    np.testing.assert_allclose(lines["work of the wall"], rows["wall_work_J"] * 1e3)
    # Without friction its energy is not drawn.
    assert "dissipated by friction" not in lines


def test_diverging_response_does_not_determine_the_axis_limits():
    walls = [{"stiffness": 5e3, "virtual_damping": 20}, {"stiffness": 40e3}]
    table = make_study(walls=walls, start_position=1e-4, duration="300 periods").compute(None, True).table
    assert np.abs(table["position_m"]).max() > 1.0
    position, _ = plotting.draw_motion(table)
    low, high = position.get_ylim()
    # In µm: the initial position is 0.1 mm, and eight times that is shown.
    assert -1000 < low < -500 < 500 < high < 1000


def test_run_writes_all_files(tmp_path):
    file = tmp_path / "a.yaml"
    file.write_text(
        "version: 1\nname: a\nscene: {mass: 0.1 kg, period: 1 ms}\nstudies:\n"
        "  - {kind: simulate, name: s, stiffness_fraction: 0.5, start_position: 10 um, duration: 50 periods}\n",
        encoding="utf-8",
    )
    result = zwidth.run(file, out=tmp_path / "out")
    assert result.ok
    names = [
        "s.csv",
        "s_summary.csv",
        *(f"s{part}.{kind}" for part in ("", "_phase", "_energy") for kind in ("png", "svg")),
    ]
    assert all((tmp_path / "out" / name).stat().st_size for name in names)
    header = (tmp_path / "out" / "s.csv").read_text(encoding="utf-8").splitlines()[0]
    assert header.startswith("label,stiffness_N_per_m,virtual_damping_N_s_per_m,time_s,position_m,velocity_m_per_s")


TOOL = {**DEVICE, "damping": 10, "tool": {"mass": 0.3}}


def test_coupling_to_a_tool():
    study = make_study(
        device=TOOL, stiffness_fraction=[0.98, 1.02], start_position=1e-3, tool_position="0.5 mm", substeps=2
    )
    outcome = study.compute(None, True)
    assert ["decays" in outcome.notes[0], "grows" in outcome.notes[1]] == [True, True]
    tool, force = outcome.table["tool_position_m"], outcome.table["coupling_force_N"]
    assert tool.size == outcome.table["position_m"].size
    assert tool[0] == 0.5e-3
    top = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3), tool=zwidth.Tool(0.3)).max_stiffness()
    assert force[0] == pytest.approx(0.98 * top.stiffness * 0.5e-3, rel=1e-9)
    panels = outcome.figures[""]()
    assert panels[1].get_ylabel().startswith("coupling force")


def test_figure_of_a_tool_names_its_lines():
    wall = {"stiffness": 1e3, "virtual_damping": 5}
    study = make_study(device=TOOL, start_position=1e-3, tool_position=0.0, walls=[wall])
    panels = study.compute(None, True).figures[""]()
    assert panels[0].get_ylabel().startswith("position")
    assert [line.get_label().partition(",")[0] for line in panels[0].lines] == ["K = 1.000 kN/m", "tool_position_m"]
    (curve,) = panels[1].lines
    assert np.asarray(curve.get_ydata())[0] > 0
    (legend,) = (each for each in (*panels[0].figure.legends, panels[0].get_legend()) if each is not None)
    tool_line = legend.get_lines()[-1]
    assert legend.get_texts()[-1].get_text() == "tool"
    assert tool_line.get_color() == panels[0].lines[1].get_color() != panels[0].lines[0].get_color()


@pytest.mark.parametrize(
    ("keys", "field", "message"),
    [
        ({"device": TOOL, "contact": "unilateral"}, "contact", "no surface"),
        (
            {
                "device": {**TOOL, "tool": {"mass": 0.3, "integrator": "implicit"}},
                "velocity": {"kind": "foaw", "noise": "1 um"},
                "walls": [{"stiffness": 1e3, "virtual_damping": 5}],
            },
            "velocity",
            "implicit Euler method needs a linear coupling",
        ),
        ({"tool_position": 0}, "tool_position", "given without a tool"),
    ],
)
def test_unsupported_tools_are_refused(keys, field, message):
    keys = keys if "walls" in keys else {"stiffness_fraction": [0.5], **keys}
    with pytest.raises(ValueError, match=message) as caught:
        make_study(**keys)
    assert field in str(caught.value)
