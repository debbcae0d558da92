"""Sweeps over parameters of filters, operators and couplings, against independent matrices and single scenes."""

import numpy as np
import pytest
from any_loop import closed_loop_matrix
from sweeping import make_config, run_sweeps, study

import zwidth
from zwidth.config.fields import ConfigFileError
from zwidth.config.sweep import SweepStudy
from zwidth.core.status import Status
from zwidth.runs.draw import draw_stores
from zwidth.studies.document import Config
from zwidth.sweep.dataset import open_dataset, to_csv, to_netcdf, verify
from zwidth.sweep.jobs import perform

CUTOFFS, DAMPINGS = [10.0, 30.0, 100.0], [0.0, 10.0]
STIFFNESS, VIRTUAL = np.linspace(100, 15_000, 23), np.linspace(-5, 60, 14)
DEVICE = {"mass": 0.1, "period": 1e-3, "delay": "1 periods", "damping": DAMPINGS}
FILTER = {"velocity": {"kind": "low_pass", "cutoff": "1 Hz"}}
WALLS = {"stiffness": STIFFNESS.tolist(), "virtual_damping": VIRTUAL.tolist()}
AXES = {**DEVICE, "velocity.cutoff": CUTOFFS}


def scene_of(cutoff, damping):
    return zwidth.Scene(zwidth.Device(0.1, damping), zwidth.Timing(1e-3, 1e-3), velocity=zwidth.LowPass(cutoff=cutoff))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    config = make_config(
        study("walls", {**AXES, **WALLS}, ("stable",), **FILTER),
        study("devices", AXES, ("stiffness_max", "virtual_damping_at_max"), **FILTER),
    )
    out = tmp_path_factory.mktemp("scenes")
    assert zwidth.run(config, out=out).ok
    return out


def test_labels_agree_with_eigenvalues(folder):
    """Compare with eigenvalues of a closed-loop state space that is independent of the library."""
    data = open_dataset(folder / "walls.zarr")
    assert data.stable.dims == ("damping", "velocity_cutoff", "stiffness", "virtual_damping")
    assert (data.status == Status.OK).all()
    wrong = undecided = 0
    for damping in DAMPINGS:
        for cutoff in CUTOFFS:
            scene = scene_of(cutoff, damping)
            stable = data.stable.sel(damping=damping, velocity_cutoff=cutoff).values
            for k, stiffness in enumerate(STIFFNESS):
                for j, virtual in enumerate(VIRTUAL):
                    radius = np.abs(np.linalg.eigvals(closed_loop_matrix(scene, stiffness, virtual))).max()
                    undecided += abs(radius - 1) < 1e-9
                    wrong += abs(radius - 1) >= 1e-9 and stable[k, j] != (radius < 1)
    # No wall may be near the boundary; without physical damping, B = 0 is close to it.
    assert (wrong, undecided) == (0, 0)


def test_maximum_stiffness_is_on_the_boundary(folder):
    data = open_dataset(folder / "devices.zarr").load()
    for damping in DAMPINGS:
        for cutoff in CUTOFFS:
            selected = data.sel(damping=damping, velocity_cutoff=cutoff)
            stiffness, virtual = float(selected.stiffness_max), float(selected.virtual_damping_at_max)
            scene = scene_of(cutoff, damping)
            assert virtual >= 0
            assert list(scene.is_stable(stiffness * np.array([1 - 1e-6, 1 + 1e-6]), virtual)) == [True, False]
            # No line of constant B of a fine grid reaches a larger stiffness.
            ends = scene.stable_stiffness(np.linspace(0, 100, 2001))
            assert np.nanmax(ends) <= stiffness * (1 + 1e-9)


def test_radii_and_passivity_agree_with_single_scenes(tmp_path):
    walls = {"stiffness": [500.0, 5000.0], "virtual_damping": [0.0, 5.0, 60.0]}
    outputs = ("stable", "spectral_radius", "pole_angle", "frequency", "passive")
    config = make_config(study("s", {**DEVICE, "velocity.cutoff": [30, 100], **walls}, outputs, **FILTER))
    assert zwidth.run(config, out=tmp_path).ok
    data = open_dataset(tmp_path).load()
    assert (data.status == Status.OK).all()
    np.testing.assert_array_equal(data.stable, data.spectral_radius < 1)
    for damping in DAMPINGS:
        for cutoff in (30.0, 100.0):
            selected, scene = data.sel(damping=damping, velocity_cutoff=cutoff), scene_of(cutoff, damping)
            grid = np.meshgrid(*walls.values(), indexing="ij")
            np.testing.assert_array_equal(selected.passive, scene.is_passive(*grid))
            z = scene.poles(*grid)
            np.testing.assert_allclose(selected.spectral_radius, np.abs(z).max(-1), rtol=1e-9)
            dominant = np.take_along_axis(z, np.abs(z).argmax(-1)[..., None], -1)[..., 0]
            np.testing.assert_allclose(selected.pole_angle, np.abs(np.angle(dominant)), atol=1e-9)
            np.testing.assert_allclose(selected.frequency, selected.pole_angle / (2e-3 * np.pi), rtol=1e-12)
    assert 0 < data.passive.mean() < 1


def test_decay_and_stability_margins_of_a_filtered_device_from_a_yaml_file(tmp_path):
    """Compare with the poles and margins of single scenes; one wall of the grid is unstable."""
    text = """
version: 1
name: margins
studies:
  - kind: sweep
    name: margins
    outputs: [decay_rate, settling_time, margin, gain_margin, phase_margin, delay_margin, modulus_margin]
    velocity: {kind: low_pass, cutoff: 100 Hz}
    axes: {mass: 100 g, damping: 10, rate: 1 kHz, delay: 1 ms, stiffness: [500, 2 kN/m, 2e4], virtual_damping: [5, 30]}
"""
    path = tmp_path / "margins.yaml"
    path.write_text(text)
    assert zwidth.run(path, out=tmp_path / "out").ok
    data = open_dataset(tmp_path / "out").load().squeeze()
    assert (data.status == Status.OK).all()
    scene = scene_of(100, 10)
    for k, stiffness in enumerate([500, 2000, 20000]):
        for j, virtual_damping in enumerate([5, 30]):
            point = data.isel(stiffness=k, virtual_damping=j)
            radius = np.abs(scene.poles(stiffness, virtual_damping)).max()
            assert point.decay_rate == pytest.approx(-np.log(radius) / 1e-3, rel=1e-7, abs=1e-6)
            assert point.margin == pytest.approx(1.0 - radius, rel=1e-7, abs=1e-9)
            decay = np.log(50) / -np.log(radius) * 1e-3 if radius < 1 else np.inf
            assert point.settling_time == pytest.approx(decay, rel=1e-7)
            margins = scene.margins(stiffness, virtual_damping)
            for name in ("gain_margin", "phase_margin", "delay_margin", "modulus_margin"):
                assert float(point[name]) == pytest.approx(float(getattr(margins, name)), rel=1e-9, nan_ok=True), name
    assert (data.decay_rate < 0).any()


@pytest.mark.parametrize("parts", ["", "velocity: {kind: low_pass, cutoff: 100 Hz}"])
def test_frequency_of_the_dominant_pole_from_a_yaml_file(parts, tmp_path):
    """As a user types it: integers, units, and few or many walls."""
    for name, stiffness in (("few", "[0, 1000, 20 kN/m]"), ("many", "{linear: {start: 0, stop: 20000, num: 90}}")):
        text = f"""
version: 1
name: dominant
studies:
  - kind: sweep
    name: {name}
    outputs: [pole_angle, frequency, spectral_radius]
    {parts}
    axes:
      mass: 100 g
      damping: 10
      rate: 1 kHz
      delay: [0 ms, 1.5 ms]
      stiffness: {stiffness}
      virtual_damping: [0, 5, 40]
"""
        (tmp_path / f"{name}.yaml").write_text(text)
        assert zwidth.run(tmp_path / f"{name}.yaml", out=tmp_path / name).ok
        data = open_dataset(tmp_path / name).load()
        assert data.pole_angle.attrs["units"] == "rad/period"
        assert data.frequency.attrs["units"] == "Hz"
        assert (data.status == Status.OK).all()
        velocity = zwidth.LowPass(cutoff=100) if parts else zwidth.BackwardDifference()
        for delay in (0, 1.5e-3):
            scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, delay), velocity=velocity)
            selected = data.sel(delay=delay)
            K, B = np.meshgrid(selected.stiffness, selected.virtual_damping, indexing="ij")
            angle = np.abs(np.angle(scene.poles(K, B)))
            # The angle must be that of a pole with the largest modulus.
            dominant = np.abs(np.abs(scene.poles(K, B)) - selected.spectral_radius.values[..., None]) < 1e-6
            error = np.where(dominant, np.abs(angle - selected.pole_angle.values[..., None]), np.inf).min(-1)
            assert error.max() < 1e-6
            np.testing.assert_allclose(selected.frequency, selected.pole_angle / (2e-3 * np.pi), rtol=1e-12)


def test_names_in_stores_csv_and_netcdf_have_no_dots(folder, tmp_path):
    to_csv(folder / "devices.zarr", tmp_path / "devices.csv")
    header = (tmp_path / "devices.csv").read_text().splitlines()[0].split(",")
    assert header[:2] == ["damping_N_s_per_m", "velocity_cutoff_Hz"]
    to_netcdf(folder / "walls.zarr", tmp_path / "walls.nc")
    data = open_dataset(folder / "walls.zarr")
    assert data.velocity_cutoff.attrs["units"] == "Hz"
    assert not [name for name in data.variables if "." in str(name)]


def test_figures_are_sliced_by_parameter_path(folder, tmp_path):
    files = {file.name for file in draw_stores(folder, tmp_path, selection={"velocity.cutoff": 40.0})}
    assert {"walls_stable.png", "walls_boundaries.png", "devices_stiffness_max.png"} <= files


def test_interrupted_run_is_resumed_and_verified(folder, tmp_path):
    config = make_config(
        study("walls", {**AXES, **WALLS}, ("stable",), **FILTER), study("other", AXES, ("stiffness_max",), **FILTER)
    )
    result = []

    def stop_after_one(path, family, index):
        if result:
            raise KeyboardInterrupt
        perform(path, family, index)
        result.append(family)

    run_sweeps(config, tmp_path, perform=stop_after_one)
    assert zwidth.run(config, out=tmp_path, resume=True).ok
    assert all(each.ok for each in verify(tmp_path))
    first, second = (open_dataset(path / "walls.zarr").load() for path in (folder, tmp_path))
    np.testing.assert_array_equal(first.stable, second.stable)


@pytest.mark.parametrize(
    ("path", "values", "parts"),
    [
        ("velocity.samples", [1, 5, 15], {"velocity": {"kind": "windowed_difference", "samples": 3}}),
        ("velocity.time_constant", ["1 ms", "5 ms"], {"velocity": {"kind": "low_pass", "time_constant": 1}}),
        ("velocity.order", [1, 2], {"velocity": {"kind": "low_pass", "cutoff": 50}}),
        ("velocity.coded_period", ["0.1 ms", "1 ms"], {"velocity": {"kind": "backward_difference"}}),
        ("operator.mass", [0, "0.5 kg"], {}),
        ("operator.damping", [0, 6.45], {"operator": {"mass": 0.5}}),
        ("operator.stiffness", [0, 135], {"operator": {"mass": 0.5}}),
        ("operator.coupling_stiffness", [500, "5 kN/m"], {"operator": {"mass": 0.5, "damping": 5}}),
        ("operator.coupling_damping", [1, 5], {"operator": {"mass": 0.5, "coupling_stiffness": 1000}}),
        ("coupling.mass", ["20 g", "50 g"], {"coupling": {"mass": 0.1, "stiffness": 2e4, "damping": 1}}),
        ("coupling.stiffness", ["20 kN/m", "50 kN/m"], {"coupling": {"mass": 0.1, "stiffness": 2e4, "damping": 1}}),
        ("coupling.damping", [0.5, 2], {"coupling": {"mass": 0.1, "stiffness": 2e4, "sensor": "tip"}}),
    ],
)
def test_every_parameter_of_a_component_may_be_an_axis(path, values, parts, tmp_path):
    axes = {"mass": 0.1, "damping": 2, "period": 1e-3, path: values}
    config = make_config(study("s", axes, ("stiffness_max",), **parts))
    assert zwidth.run(config, out=tmp_path).ok
    data = open_dataset(tmp_path).load()
    assert (data.ridge_status == Status.OK).all()
    sweep = config.studies[0]
    assert isinstance(sweep, SweepStudy)
    axis = getattr(sweep.axes, path).values().tolist()
    for value, stiffness in zip(axis, data.stiffness_max.values, strict=True):
        scene = sweep.make_scene({"mass": 0.1, "damping": 2.0, "period": 1e-3, path: value})
        assert scene.parameters()[path] == value
        # Stable lines that start at K = 0 belong to no island.
        low, high = np.moveaxis(scene.stable_stiffness(np.linspace(0, 300, 601)), -1, 0)
        assert np.max(high[low <= 0]) <= stiffness * (1 + 1e-9)


def test_invalid_device_does_not_affect_others(tmp_path):
    """A cutoff of 80 Hz is above the Nyquist frequency of 100 Hz sampling, but valid at 1 kHz."""
    axes = {**DEVICE, "damping": 10, "period": ["1 ms", "10 ms"], "velocity.cutoff": [20, 80], "stiffness": [100, 200]}
    config = make_config(study("s", axes, ("stable", "stiffness_max"), **FILTER))
    assert zwidth.run(config, out=tmp_path).ok
    data = open_dataset(tmp_path).load()
    bad = np.array([[False, False], [False, True]])
    np.testing.assert_array_equal(data.ridge_status == Status.INVALID_INPUT, bad)
    np.testing.assert_array_equal(np.isnan(data.stiffness_max), bad)
    np.testing.assert_array_equal((data.status == Status.INVALID_INPUT).all("stiffness"), bad)


def test_table_of_devices_may_vary_component_parameters(tmp_path):
    devices = {"label": ["a", "b"], "mass": [0.1, 0.2], "velocity.cutoff": ["30 Hz", "0.1 kHz"]}
    axes = {"devices": devices, "period": 1e-3, "delay": 1e-3, "damping": 0}
    config = make_config(study("s", axes, ("stiffness_max",), **FILTER))
    assert zwidth.run(config, out=tmp_path).ok
    stiffness = open_dataset(tmp_path).stiffness_max.values
    np.testing.assert_allclose(stiffness, [2795.31, 2 * 7279.64], rtol=1e-5)


FAULTS = {
    ("velocity.cutoff: [1, 2]", ""): ("axes.velocity.cutoff", "velocity.cutoff"),
    ("velocity.samples: [3]", "velocity: {kind: low_pass, cutoff: 10}"): ("axes.velocity.samples", "velocity.samples"),
    ("velocity.cutoff: [10, 600]", "velocity: {kind: low_pass, cutoff: 10}"): ("axes.velocity.cutoff", "600 Hz"),
    ("velocity.samples: [1.5]", "velocity: {kind: windowed_difference, samples: 3}"): (
        "axes.velocity.samples[0]",
        "whole number",
    ),
    ("velocity.cutof: [10]", ""): ("axes.velocity.cutof", "did you mean 'velocity.cutoff'?"),
    ("coupling.mass: [1]", ""): ("axes.coupling.mass", "coupling.mass"),
}


@pytest.mark.parametrize("axes", FAULTS)
def test_axes_of_missing_components_raise(axes, tmp_path):
    file = tmp_path / "c.yaml"
    axis, parts = axes
    rest = f", {parts}" if parts else ""
    file.write_text(
        "version: 1\nname: c\nstudies:\n"
        f"  - {{kind: sweep, name: s, axes: {{stiffness: 1, mass: 1, period: 1 ms, {axis}}}{rest}}}\n"
    )
    field, text = FAULTS[axes]
    with pytest.raises(ConfigFileError) as caught:
        zwidth.load_config(file)
    assert {fault.field for fault in caught.value.faults} == {f"studies[0].{field}"}
    assert caught.value.faults[0].line == 4
    assert text in str(caught.value)


def test_rigid_scene_uses_the_rigid_solver():
    config = Config.model_validate(
        {
            **{"version": 1, "name": "c", "scene": {"mass": 0.1, "period": 1e-3}},
            "studies": [study("s", {"stiffness": [1.0]})],
        }
    )
    sweep = config.studies[0]
    assert isinstance(sweep, SweepStudy)
    assert not sweep.with_parts


def test_linear_and_measured_devices_are_swept(tmp_path):
    """Sweep a linear system over delays and filters, and a measured response whose file is deleted before the run."""
    timing, frequencies = {"period": 1e-3}, np.geomspace(1.0, 450.0, 300)
    rigid = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3, 1e-3), velocity=zwidth.LowPass(cutoff=30.0))
    # With K = 1 and no filter the open loop is the device.
    response = rigid.replace(velocity=zwidth.BackwardDifference()).frequency_response(1.0, 0.0, frequencies)
    zwidth.MeasuredDevice(frequencies, response, 1e-9).save(tmp_path / "response.csv")
    system, measured = "1 / 0.1 10 0", str(tmp_path / "response.csv")
    delays = {"delay": ["0 ms", "1 ms"], "velocity.cutoff": [30.0, 100.0]}
    config = make_config(
        study("system", {**timing, **delays}, ("stiffness_max",), device=system, **FILTER),
        study(
            "measured",
            {**timing, **WALLS},
            ("stable",),
            device=measured,
            velocity={**FILTER["velocity"], "cutoff": 30.0},
        ),
    )
    (tmp_path / "response.csv").unlink()
    assert zwidth.run(config, out=tmp_path / "run", workers=2).ok
    computed = open_dataset(tmp_path / "run" / "system.zarr").stiffness_max
    for delay in (0.0, 1e-3):
        for cutoff in (30.0, 100.0):
            single = rigid.replace(**{"delay": delay, "velocity.cutoff": cutoff}).max_stiffness().stiffness
            assert float(computed.sel(delay=delay, velocity_cutoff=cutoff)) == pytest.approx(float(single), rel=1e-12)
    computed = open_dataset(tmp_path / "run" / "measured.zarr").stable
    stable = rigid.is_stable(STIFFNESS[:, None], VIRTUAL)
    assert not (computed.values & ~stable).any(), "stable for every response in the band, of which this is one"
    assert computed.values.sum() > 0.9 * stable.sum()


@pytest.mark.parametrize("axis", ["mass", "damping", "actuator.cutoff"])
def test_linear_device_with_a_mass_axis_raises(axis):
    with pytest.raises(ValueError, match="together with a system or response"):
        make_config(study("s", {"period": 1e-3, axis: [1.0, 2.0]}, ("stiffness_max",), device="1 / 0.1 10 0"))


def test_walls_within_the_uncertainty_of_a_measurement_are_undecided(tmp_path):
    """Such walls are neither stable nor unstable for every response in the uncertainty band."""
    frequencies = np.geomspace(1.0, 450.0, 300)
    response = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3, 1e-3)).frequency_response(
        1.0, 0.0, frequencies
    )
    device = zwidth.MeasuredDevice(frequencies, response, 0.1 * np.abs(response))
    device.save(tmp_path / "response.csv")
    config = make_config(study("s", {"period": 1e-3, **WALLS}, ("stable",), device=str(tmp_path / "response.csv")))
    result = zwidth.run(config, out=tmp_path / "run")
    assert result.ok
    data = open_dataset(tmp_path / "run")
    decision = zwidth.Scene(device, zwidth.Timing(1e-3)).decide_stability(STIFFNESS[:, None], VIRTUAL)
    assert set(decision.status.ravel().tolist()) == {Status.OK, Status.UNDECIDED}
    np.testing.assert_array_equal(data.stable, decision.stable)
    np.testing.assert_array_equal(data.status, decision.status)
    total, failed = decision.status.size, np.count_nonzero(decision.status)
    note = f"{failed} of {total} walls have no result: {failed} undecided"
    assert (result.studies[0].notes, zwidth.run(config, out=tmp_path / "run", resume=True).studies[0].notes) == (
        (note,),
    ) * 2


def test_walls_out_of_range_have_their_status(tmp_path):
    device = {"mass": 1e-30, "damping": 1e-30, "period": 1e3}
    scene = zwidth.Scene(zwidth.Device(1e-30, 1e-30), zwidth.Timing("1000 s"), velocity=zwidth.LowPass(cutoff=1e-4))
    # alpha = K T^2/m is 1e66.
    stiffness, statuses = [1e-20, 1e30], [Status.OK, Status.OUT_OF_RANGE]
    assert scene.decide_stability(stiffness, 0.0).status.tolist() == statuses
    for output in ("stable", "spectral_radius", "passive"):
        axes = {**device, "stiffness": stiffness}
        config = make_config(study("s", axes, (output,), velocity={"kind": "low_pass", "cutoff": 1e-4}))
        assert zwidth.run(config, out=tmp_path, overwrite=True).ok
        assert open_dataset(tmp_path).status.values.tolist() == statuses
