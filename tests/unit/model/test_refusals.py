"""Test that invalid scenes are rejected with a message that names the field, the allowed values and the remedy."""

from __future__ import annotations

import inspect

import jax
import numpy as np
import pytest

import zwidth
from zwidth.core.errors import InputError

DEVICE, TIMING = zwidth.Device(mass=0.1), zwidth.Timing(period=1e-3)


def scene(velocity):
    return zwidth.Scene(DEVICE, TIMING, velocity=velocity).check_parts()


CASES = {
    "mass that is not a number": (lambda: zwidth.Device(mass=np.nan), "mass", "finite"),
    "infinite damping": (lambda: zwidth.Device(mass=0.1, damping=np.inf), "damping", "finite"),
    "zero period": (lambda: zwidth.Timing(period=0.0), "period", "greater than 0"),
    "period and rate": (lambda: zwidth.Timing(period=1e-3, rate=1000.0), "timing", "only one"),
    "negative stiffness of a coupling": (
        lambda: zwidth.Coupling(mass=0.1, stiffness=-1.0),
        "coupling.stiffness",
        "greater than 0",
    ),
    "coupling without stiffness": (
        lambda: zwidth.Coupling(mass=0.1, stiffness=0.0),
        "coupling.stiffness",
        "greater than 0",
    ),
    "massless tip": (lambda: zwidth.Coupling(mass=0.0, stiffness=1e3), "coupling.mass", "greater than 0"),
    "unknown sensor": (lambda: zwidth.Coupling(0.1, 1e3, sensor="hand"), "coupling.sensor", "motor"),  # type: ignore[arg-type]
    "massless operator with coupling": (
        lambda: zwidth.Operator(mass=0.0, coupling_stiffness=1e3),
        "operator.mass",
        "greater than 0",
    ),
    "coupling damping without stiffness": (
        lambda: zwidth.Operator(mass=0.5, coupling_damping=1.0),
        "operator.coupling_damping",
        "pass operator.coupling_stiffness",
    ),
    "traced coupling damping without stiffness": (
        lambda: jax.jit(lambda c: zwidth.Operator(mass=0.5, coupling_damping=c).mass)(0.0),
        "operator.coupling_damping",
        "pass operator.coupling_stiffness",
    ),
    "negative stiffness of operator": (
        lambda: zwidth.Operator(0.5, stiffness=-1.0),
        "operator.stiffness",
        "at least 0",
    ),
    "window of 0 samples": (lambda: zwidth.WindowedDifference(0), "velocity.samples", "from 1 to 1000"),
    "window too long": (lambda: zwidth.WindowedDifference(1001), "velocity.samples", "from 1 to 1000"),
    "fractional window": (lambda: zwidth.WindowedDifference(2.5), "velocity.samples", "whole number"),  # type: ignore[arg-type]
    "cutoff above Nyquist": (lambda: scene(zwidth.LowPass(cutoff=501.0)), "velocity.cutoff", "500 Hz"),
    "cutoff at Nyquist": (
        lambda: scene(zwidth.Butterworth(cutoff=500.0)),
        "velocity.cutoff",
        "remove the filter",
    ),
    "zero cutoff": (lambda: zwidth.LowPass(cutoff=0.0), "velocity.cutoff", "greater than 0"),
    "cutoff and time constant": (lambda: zwidth.LowPass(cutoff=10.0, time_constant=0.1), "velocity", "only one"),
    "order too high": (lambda: zwidth.Butterworth(cutoff=10.0, order=9), "velocity.order", "from 1 to 8"),
    "unstable filter": (
        lambda: zwidth.VelocityFilter([1.0, -1.0], [1.0, -1.5]),
        "velocity.denominator",
        "1.5",
    ),
    "filter with a pole at z = -1": (
        lambda: zwidth.VelocityFilter([1.0, -1.0], [1.0, 1.0]),
        "velocity.denominator",
        "must be below 1",
    ),
    "noncausal filter": (
        lambda: zwidth.VelocityFilter([1.0, 0.0, -1.0], [1.0, 0.0]),
        "velocity.numerator",
        "multiply the denominator by z",
    ),
    "zero filter": (lambda: zwidth.VelocityFilter([0.0], [1.0]), "velocity.numerator", "not all of them 0"),
    "filter with NaN": (lambda: zwidth.VelocityFilter([1.0, np.nan], [1.0, 0.0]), "velocity.numerator", "finite"),
    "number as velocity": (lambda: zwidth.Scene(DEVICE, TIMING, velocity=5), "velocity", "zwidth.LowPass"),  # type: ignore[arg-type]
    "number as coupling": (lambda: zwidth.Device(0.1, coupling=5), "coupling", "zwidth.Coupling"),  # type: ignore[arg-type]
    "coupling too stiff for float64": (
        lambda: zwidth.Scene(zwidth.Device(0.1, coupling=zwidth.Coupling(0.1, 1e14)), TIMING).check_parts(),
        "coupling.stiffness",
        "omit the coupling",
    ),
    "damping too large for float64": (
        lambda: zwidth.Scene(zwidth.Device(0.1, coupling=zwidth.Coupling(0.1, 1e4, 1e14)), TIMING).check_parts(),
        "coupling.damping",
        "check its unit",
    ),
}


@pytest.mark.parametrize("make, field, remedy", CASES.values(), ids=CASES)
def test_invalid_scenes_are_rejected(make, field, remedy):
    with pytest.raises(InputError) as error:
        make()
    message = str(error.value)
    assert message.startswith(field + ":"), message
    assert remedy in message, message


@pytest.mark.parametrize(
    "kind, arguments, message",
    [
        (
            zwidth.Device,
            {"inertia": 1},
            r"Device: got the argument 'inertia', allowed are 'mass', .*; did you mean 'mass'",
        ),
        (zwidth.Actuator, {"bandwidth": 10}, r"Actuator: got the argument 'bandwidth', .*; did you mean 'cutoff'"),
        (zwidth.AdmittanceDisplay, {"virtual_stiffness": 3}, r"got the argument 'virtual_stiffness', .*'integrator'$"),
        (zwidth.Timing, {"period": 1e-3, "latency": 1e-3}, r"Timing: got the argument 'latency', .* mean 'delay'"),
    ],
)
def test_unknown_arguments_are_refused_with_the_allowed_ones(kind, arguments, message):
    with pytest.raises(zwidth.InputError, match=message) as caught:
        kind(**arguments)
    assert isinstance(caught.value, TypeError)


def test_signature_of_a_part_is_that_of_its_constructor():
    assert list(inspect.signature(zwidth.Timing).parameters) == ["period", "delay", "rate"]
