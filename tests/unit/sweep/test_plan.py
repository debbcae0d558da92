"""Plans of sweeps: chunks cover every point once, and runs that exceed the resources are rejected."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sweeping import make_config, make_sweep, study

from zwidth.core.errors import ResourceError
from zwidth.runs import plan_run
from zwidth.sweep.plan import MEMORY, FamilyPlan, Plan, Task, check_resources, chunk_shape, make_plan, restore_plan

HUGE = {
    "alpha": {"linear": {"start": 0, "stop": 1, "num": 100_000}},
    "beta": {"linear": {"start": 0, "stop": 1, "num": 100_000}},
    "delta": {"linear": {"start": 0, "stop": 1, "num": 10}},
    "d": 1,
}


def make_plans(sweep) -> list[Plan]:
    """Return the plans of a run of one sweep."""
    plans = plan_run(make_config(sweep))
    return [plan for plan in plans if isinstance(plan, Plan)]


@given(st.lists(st.integers(1, 9), max_size=4), st.integers(1, 300))
def test_chunks_cover_every_point_once(shape, target):
    shape = tuple(shape)
    chunks = chunk_shape(shape, target)
    assert math.prod(chunks) <= target
    plan = FamilyPlan("wall", ("stable",), tuple("abcd"[: len(shape)]), shape, chunks)
    count = np.zeros(shape, int)
    for index in range(plan.count):
        task = Task(plan, index)
        count[task.slices] += 1
        assert task.points == count[task.slices].size
    assert (count == 1).all()
    assert plan.count == math.prod(plan.counts)


@pytest.mark.parametrize("outputs", [("stable",), ("spectral_radius", "passive"), ("alpha_max", "stable")])
@pytest.mark.parametrize("memory", [2**27, MEMORY, 2**30])
def test_chunk_stays_within_its_memory_limit(outputs, memory):
    plan = make_plan(make_sweep(study(axes=HUGE, outputs=outputs)), memory=memory)
    assert plan.memory <= memory


def test_stored_plan_is_restored_unchanged():
    small = make_sweep(study(outputs=("stable", "alpha_max")))
    plan = make_plan(small, memory=2**27)
    assert restore_plan(small, plan.as_dict()).families == plan.families
    assert restore_plan(small, plan.as_dict()).methods == plan.methods


def test_grid_of_one_billion_points_needs_megabytes():
    axes = {**HUGE, "alpha": {"linear": {"start": 0, "stop": 1, "num": 10_000}}, "delta": 1}
    (plan,) = make_plans(study(axes=axes))
    assert plan.family("wall").shape == (10_000, 100_000)
    assert plan.disk < 256 * 2**20


def test_run_exceeding_disk_or_memory_raises(tmp_path):
    plans = make_plans(study(axes=HUGE, outputs=("spectral_radius", "margin", "passivity_margin")))
    message = r"free, but the results may take 2\.\d+ TiB, most of them for studies\[map\]\.axes \(.* x beta \d+\)"
    with pytest.raises(ResourceError, match=message):
        check_resources(plans, tmp_path / "not" / "there", workers=1)
    with pytest.raises(ResourceError, match=r"workers: 100000 workers may take .*; choose fewer with --workers"):
        check_resources(make_plans(study()), tmp_path, workers=100_000)


def test_plan_lists_points_chunks_methods_and_resources():
    text = "\n".join(make_plans(study(outputs=("stable", "alpha_max")))[0].lines())
    for word in (
        "study map",
        "192,000",
        "d 4 x delta 4 x alpha 40 x beta 300",
        "chunks",
        "crossover",
        "disk",
        "memory",
    ):
        assert word in text


def test_plan_states_method_and_certified_accuracy_of_radii():
    axes = {**HUGE, "d": [1, 70.5]}
    plan = make_plan(make_sweep(study(axes=axes, outputs=("margin", "stable"), accuracy=1e-6)))
    assert plan.as_dict()["methods"] == {"spectral_radius": "newton", "stable": "crossover"}
    lines = "\n".join(plan.lines())
    assert "spectral_radius by newton: certified to 1e-06" in lines
    assert "stable by crossover: stability limit of each line of constant B" in lines
    assert "polynomials of degree up to 74" in lines
    default_plan = make_plan(make_sweep(study(axes=HUGE, outputs=("margin",))))
    assert "certified to 1e-09" in default_plan.methods["spectral_radius"][1]
