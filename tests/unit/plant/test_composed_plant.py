"""Zeros, poles and gain of the sum of a device and a tool."""

import numpy as np
import pytest

import zwidth
from zwidth.model.circle_functions import circle_points
from zwidth.plant.composed_plant import add_plants, factor_tool


@pytest.mark.parametrize("seed", range(20))
def test_sum_of_responses(seed):
    rng = np.random.default_rng(seed)
    mass, damping, delay = 10 ** rng.uniform(-2, 1), rng.choice([0.0, 5.0]), rng.choice([0.0, 1.0, 2.3, 40.0])
    scene = zwidth.Scene(
        zwidth.Device(0.1, damping, modes=[zwidth.Mode(120, 0.02, 0.5)] if seed % 3 == 0 else []),
        zwidth.Timing(1e-3, f"{delay} periods"),
    )
    damping, stiffness = rng.choice([0.0, 1.0], 2)
    tool = zwidth.Tool(mass, damping, stiffness, ("semi-implicit", "implicit")[seed % 2])
    device, second = scene.loop.roots, factor_tool(tool.respond(scene.mass, 1e-3))
    points = circle_points(np.geomspace(1e-4, 3.1, 50))
    total = add_plants(device, second).evaluate_response(points)
    parts = device.evaluate_response(points), second.evaluate_response(points)
    size = sum(np.abs(part.value) for part in parts)
    assert np.max(np.abs(total.value - parts[0].value - parts[1].value) / size) < 1e-11


def test_common_poles_at_one_count_once():
    scene = zwidth.Scene(zwidth.Device(0.1, 0), zwidth.Timing(1e-3))
    free = add_plants(scene.loop.roots, factor_tool(zwidth.Tool(1.0).respond(0.1, 1e-3)))
    assert np.sum(free.poles == 0) == 2
    assert free.poles.size == 2
