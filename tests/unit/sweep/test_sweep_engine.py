"""Sweeps from configuration to stored values: correct, independent of chunks and workers, resumable and repairable."""

import numpy as np
import pytest
from chunks import fail_on_2, fill_disk_on_2, interrupt_on_2, kill_worker_on_2, kill_worker_once_on_2, replay_from
from sweeping import (
    AXES,
    DEVICES,
    FEW,
    WALLS,
    assert_equal_stores,
    chunk_file,
    flip_byte,
    limit_chunk_sizes,
    list_status_files,
    make_config,
    make_full_config,
    read_values,
    run_sweeps,
    study,
)

import zwidth
from zwidth.core.errors import InputError, StoreError
from zwidth.core.status import Status
from zwidth.sweep.dataset import open_dataset, verify
from zwidth.sweep.engine import refuse_changes
from zwidth.sweep.store import Store


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Return configuration and folder of an undisturbed run."""
    folder = tmp_path_factory.mktemp("finished")
    config = make_config()
    result = run_sweeps(config, folder)
    assert result.ok
    assert result.computed == result.total > 5
    return config, folder


def copy_of(finished, folder):
    """Copy the finished run to a folder, to be damaged there; return its configuration and store."""
    import shutil

    config, source = finished
    shutil.copytree(source, folder, dirs_exist_ok=True)
    return config, folder / "map.zarr"


def test_values_agree_with_the_library(tmp_path):
    run_sweeps(make_config(study(axes=FEW, outputs=(*WALLS, *DEVICES))), tmp_path)
    data = open_dataset(tmp_path).load()
    assert data.stable.dims == ("d", "delta", "alpha", "beta")
    assert data.stable.dtype == bool
    alpha, beta, delta, d = (np.array(FEW[name], float) for name in ("alpha", "beta", "delta", "d"))
    points = np.broadcast_arrays(alpha[:, None], beta, delta[:, None, None], d[:, None, None, None])
    radius = np.abs(zwidth.poles(*points))
    radius = np.nanmax(radius, axis=-1)
    np.testing.assert_allclose(data.spectral_radius, radius, rtol=1e-12)
    # alpha = 0 has a pole at 1, whose eigenvalue may be on either side.
    decided = np.abs(radius - 1) > 1e-9
    np.testing.assert_array_equal(data.stable.values[decided], (radius < 1)[decided])
    assert not data.stable.sel(alpha=0.0).any()
    np.testing.assert_allclose(data.margin, 1 - radius, atol=1e-12)
    np.testing.assert_allclose(data.passivity_margin, zwidth.passivity_margin(*points), atol=1e-14)
    np.testing.assert_array_equal(data.passive, np.asarray(zwidth.is_passive(*points)))
    settling = data.settling_time.values[radius < 1 - 1e-9]
    np.testing.assert_allclose(settling, np.log(50) / -np.log(radius[radius < 1 - 1e-9]), rtol=1e-6)
    assert np.isinf(data.settling_time.values[radius > 1 + 1e-9]).all()
    ridge = zwidth.alpha_max(delta, d[:, None])
    np.testing.assert_allclose(data.alpha_max, ridge.alpha, rtol=1e-14)
    np.testing.assert_allclose(data.beta_at_max, ridge.beta, rtol=1e-12)
    np.testing.assert_array_equal(data.kind, ridge.kind)
    assert (data.status == Status.OK).all()
    assert (data.ridge_status == Status.OK).all()


def test_physical_results_are_in_si_units(tmp_path):
    axes = {"mass": "100 g", "damping": [0, 10], "rate": "1 kHz", "delay": "1 ms", "stiffness": [1000, 20_000]}
    run_sweeps(make_config(study(axes=axes, outputs=("stable", "settling_time", "stiffness_max"))), tmp_path)
    data = open_dataset(tmp_path).load()
    scene = [zwidth.Scene(zwidth.Device(0.1, damping), zwidth.Timing(1e-3, 1e-3)) for damping in (0.0, 10.0)]
    best = [float(zwidth.alpha_max(each.delta, each.d).alpha) for each in scene]
    np.testing.assert_allclose(
        data.stiffness_max, [each.to_si(alpha=a).stiffness for each, a in zip(scene, best, strict=True)]
    )
    assert data.stiffness_max.attrs["units"] == "N/m"
    assert data.settling_time.attrs["units"] == "s"
    assert data.damping.attrs["units"] == "N s/m"
    assert data.mass == 0.1
    radius = np.max(np.abs(zwidth.poles(0.01, 0.0, scene[1].delta, 1)))
    np.testing.assert_allclose(data.settling_time.sel(damping=10, stiffness=1000), -np.log(50) / np.log(radius) * 1e-3)


# `cut` expects grids of walls with four dimensions.
MANY_ROWS = {
    "alpha": [0.1],
    "beta": {"linear": {"start": -0.1, "stop": 0.5, "num": 260}},
    "delta": [0.3],
    "d": [0.5, 2],
}
# A chunk has files of fourteen outputs: small chunks of few walls, and chunks below and above the size of a piece.
ONE_BY_ONE = {**FEW, "beta": [-0.05, 0.4], "d": [0.5, 2]}


@pytest.mark.parametrize("axes, targets", [(ONE_BY_ONE, (1, 7)), (MANY_ROWS, (33, 100))])
def test_values_are_independent_of_chunks(tmp_path, monkeypatch, axes, targets):
    # Pieces of 64 points, so that chunks fill several.
    for size in ("_PIECE", "_WALL_PIECE"):
        monkeypatch.setattr(f"zwidth.sweep.compute.{size}", 64)
    config = make_config(study(axes=axes, outputs=(*WALLS, *DEVICES)))
    run_sweeps(config, tmp_path / "whole")
    chunks = []
    for target in targets:
        with monkeypatch.context() as patch:
            limit_chunk_sizes(patch, target, 2)
            chunks.append(run_sweeps(config, tmp_path / f"parts of {target}").computed)
        assert_equal_stores(tmp_path / "whole", tmp_path / f"parts of {target}")
    assert chunks[0] > 2 * chunks[1] > 8


@pytest.fixture(scope="module")
def everything(tmp_path_factory):
    """Return the folder of a run of every output in the largest possible chunks."""
    folder = tmp_path_factory.mktemp("everything")
    assert run_sweeps(make_full_config(), folder).ok
    return folder


# Compiled kernels process pieces of fixed size. The test detects values that depend on neighboring points, on their
# number, or on the number of processors of a worker.
def test_values_are_independent_of_workers_and_chunks(everything, tmp_path, monkeypatch):
    limit_chunk_sizes(monkeypatch, 11, 3)
    result = run_sweeps(make_full_config(), tmp_path, workers=2)
    assert result.ok
    assert result.computed > 20
    assert_equal_stores(everything, tmp_path)


def test_failed_chunk_is_reported_and_the_others_complete(finished, tmp_path):
    config, folder = finished
    result = run_sweeps(config, tmp_path, perform=fail_on_2)
    assert not result.ok
    ((chunk, error),) = result.failed.items()
    assert chunk.startswith("map/wall/2 (d ")
    assert error == "ArithmeticError: no number is good enough"
    assert open_dataset(tmp_path).attrs["complete"] == 0
    assert (open_dataset(tmp_path).status.values == 255).any()
    before = list_status_files(tmp_path)
    assert run_sweeps(config, tmp_path, resume=True).computed == 1
    assert before.items() <= list_status_files(tmp_path).items()
    assert_equal_stores(folder, tmp_path)


def test_killed_worker_is_replaced(finished, tmp_path):
    config, folder = finished
    replay_from(folder, tmp_path)
    result = run_sweeps(config, tmp_path, workers=1, perform=kill_worker_once_on_2)
    assert result.ok
    assert_equal_stores(folder, tmp_path)


def test_chunk_that_kills_every_worker_is_reported(finished, tmp_path):
    config, folder = finished
    replay_from(folder, tmp_path)
    result = run_sweeps(config, tmp_path, workers=1, perform=kill_worker_on_2)
    ((chunk, error),) = result.failed.items()
    assert chunk.startswith("map/wall/2 ")
    assert error == "the worker process died in all 3 attempts (signal SIGKILL)"
    assert result.computed == result.total - 1


def test_interrupt_keeps_finished_chunks(finished, tmp_path):
    config, folder = finished
    result = run_sweeps(config, tmp_path, perform=interrupt_on_2)
    assert result.interrupted
    assert result.computed == 2
    resumed = run_sweeps(config, tmp_path, resume=True)
    assert (resumed.skipped, resumed.ok) == (2, True)
    assert_equal_stores(folder, tmp_path)


def test_full_disk_ends_the_run(finished, tmp_path):
    config, _ = finished
    result = run_sweeps(config, tmp_path, perform=fill_disk_on_2)
    assert "No space left on device" in result.fatal_error
    assert result.computed == 2


def test_progress_events_report_chunks_and_points(tmp_path):
    events = []
    run_sweeps(make_config(), tmp_path, progress=events.append)
    assert events[0].result is events[0].progress is None
    assert events[-1].result.state == "done"
    reports = [event.progress for event in events[1:-1]]
    assert [progress.chunks for progress in reports] == list(range(1, len(reports) + 1))
    assert reports[-1].points == reports[-1].total_points == 4 * 4 * 40 * 300
    assert reports[-1].seconds_left == 0
    assert all(progress.rate > 0 and progress.study == "map" for progress in reports)


@pytest.mark.parametrize(
    "change, key, arguments",
    [
        ({"axes": {**AXES, "d": [0, 0.5, 1, 3]}}, "axes.d[3]", "2.0, the configuration has 3.0"),
        ({"axes": {**AXES, "d": [0, 1]}}, "axes.d", "a list of 4 items, the configuration has a list of 2 items"),
        ({"outputs": ("stable", "alpha_max")}, "outputs", "a list of 1 item, the configuration has a list of 2 items"),
        ({"accuracy": 1e-3}, "accuracy", "1e-09, the configuration has 0.001"),
    ],
)
def test_resuming_with_another_configuration_raises(finished, change, key, arguments):
    _, folder = finished
    before = list_status_files(folder)
    changed = make_config(study(**change))
    with pytest.raises(StoreError) as caught:
        run_sweeps(changed, folder, resume=True)
    assert f"studies[map].{key}: the run was created with" in str(caught.value)
    assert arguments in str(caught.value)
    assert list_status_files(folder) == before


def test_delay_models_of_earlier_releases_are_accepted_if_held(tmp_path):
    path, new = tmp_path / "a.zarr", {"kind": "sweep", "scene": {"d": 0.5}}
    refuse_changes(path, "a", "store", {**new, "delay_model": "held", "delay_models": ["held"]}, new)
    refuse_changes(path, "a", "store", {**new, "scene": {"d": 0.5, "delay_model": "held"}}, new)
    with pytest.raises(StoreError, match=r"studies\[a\].label: the store was created with"):
        refuse_changes(path, "a", "store", {**new, "label": "held"}, new)
    with pytest.raises(StoreError, match=r"studies\[a\].delay_models: the store was created with a list of 2 items"):
        refuse_changes(path, "a", "store", {**new, "delay_models": ["held", "fractional_power"]}, new)


def test_only_damaged_chunks_are_reported_and_repaired(finished, tmp_path):
    config, path = copy_of(finished, tmp_path)
    damages = {
        "stable/1": lambda: flip_byte(chunk_file(path, "stable", 1)),
        "status/3": lambda: chunk_file(path, "status", 3).write_bytes(chunk_file(path, "status", 3).read_bytes()[:-3]),
        "stable/5": lambda: chunk_file(path, "stable", 5).unlink(),
    }
    for damage in damages.values():
        damage()
    before = list_status_files(path)
    (report,) = verify(path)
    assert not report.ok
    assert len(report.damaged) == 3
    text = "\n".join(report.damaged)
    for arguments in ("stable is damaged", "status is damaged", "stable is missing"):
        assert arguments in text
    result = run_sweeps(config, tmp_path, resume=True)
    assert sorted(f"map/{chunk}" for chunk in report.damaged) == sorted(result.repaired)
    assert result.computed == 3
    assert len(before.items() & list_status_files(path).items()) == len(before) - 3
    assert verify(path)[0].ok
    assert_equal_stores(finished[1], tmp_path)


def test_missing_status_and_damaged_coordinates_are_repaired(finished, tmp_path):
    config, path = copy_of(finished, tmp_path)
    chunk_file(path, "status", 1).unlink()
    flip_byte(path / "alpha" / "c" / "0")
    assert verify(path)[0].damaged == ("alpha/c/0 is damaged or missing",)
    result = run_sweeps(config, tmp_path, resume=True)
    assert (len(result.repaired), result.computed) == (1, 1)
    assert verify(path)[0].ok
    assert_equal_stores(finished[1], tmp_path)


@pytest.mark.parametrize("names", [["zarr.json"], ["zwidth.json"]])
def test_damaged_group_metadata_is_restored(finished, tmp_path, names):
    config, path = copy_of(finished, tmp_path)
    good = (path / "zarr.json").read_bytes()
    for name in names:
        text = (path / name).read_text()
        (path / name).write_text(text.replace('"precision": "float64"', '"precision": "float32"'))
    assert verify(tmp_path)[0].damaged
    assert run_sweeps(config, tmp_path, resume=True).computed == 0
    assert verify(tmp_path)[0].ok
    assert (path / "zarr.json").read_bytes() == (path / "zwidth.json").read_bytes() == good
    assert_equal_stores(finished[1], tmp_path)


def test_damaged_metadata_and_copy_raise(finished, tmp_path):
    config, path = copy_of(finished, tmp_path)
    for name in ("zarr.json", "zwidth.json"):
        text = (path / name).read_text()
        (path / name).write_text(text.replace('"precision": "float64"', '"precision": "float32"'))
    assert "damaged, its checksum is wrong" in verify(tmp_path)[0].error
    with pytest.raises(StoreError, match="damaged, its checksum is wrong"):
        run_sweeps(config, tmp_path, resume=True)


def test_missing_store_libraries_raise_with_the_install_command(tmp_path, monkeypatch):
    monkeypatch.setattr("zwidth.sweep.store.find_spec", lambda name: None if name == "zarr" else name)
    with pytest.raises(InputError, match=r"sweep: needs zarr, .*(zwidth\[store\]|scripts/setup store)"):
        run_sweeps(make_config(), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_partial_files_of_a_killed_run_are_removed(finished, tmp_path):
    config, path = copy_of(finished, tmp_path)
    partial = [path / "stable" / "c" / "0" / "0" / "0" / "0.123.partial", tmp_path / ".map.zarr.12345678.partial"]
    partial[0].write_bytes(b"half")
    partial[1].mkdir()
    run_sweeps(config, tmp_path, resume=True)
    assert not any(path_left.exists() for path_left in partial)


def test_invalid_worker_options_raise(tmp_path):
    for options in ({"workers": 1, "scheduler": "tcp://x"}, {"workers": 0}):
        with pytest.raises(InputError):
            run_sweeps(make_config(), tmp_path, **options)
    assert list(tmp_path.iterdir()) == []


def test_single_point(tmp_path):
    axes = {"alpha": 0.1, "beta": 0.1, "delta": 0.1, "d": 1}
    run_sweeps(make_config(study(axes=axes)), tmp_path)
    values = read_values(tmp_path)
    assert values["stable"] == np.array(True)
    assert values["status"].shape == ()
    (task,) = Store(tmp_path / "map.zarr").plan.tasks()
    assert Store(tmp_path / "map.zarr").is_done(task)
