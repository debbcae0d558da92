"""Keys of simulations, and velocity estimates without a linear form: accepted values and located errors."""

import inspect
import math

import pytest

import zwidth
from zwidth.config.fields import ConfigFileError
from zwidth.studies.document import Config
from zwidth.studies.simulate import SimulationConditions

DEVICE = "mass: 100 g, period: 1 ms, delay: 1 periods"
FOAW = "velocity: {kind: foaw, noise: 20 um, samples: 12}"


def simulate(keys, scene=DEVICE, kind="simulate", wall="walls: [{stiffness: 5 kN/m}]"):
    return f"scene: {{{scene}}}\nstudies: [{{kind: {kind}, name: s, {wall}{keys and ', ' + keys}}}]\n"


LIMIT_CYCLE = {"kind": "limit_cycle", "wall": "axes: {stiffness: [1 kN/m, 2 kN/m], virtual_damping: 5}"}


def test_fields_with_units_become_arguments_of_simulate():
    conditions = SimulationConditions.model_validate(
        {
            "duration": "0.2 s",
            "start_position": "-1 mm",
            "start_velocity": "10 cm/s",
            "external_force": "500 mN",
            "contact": "push_only",
            "resolution": "20 um",
            "noise": 1e-6,
            "coulomb": "0.3 N",
            "static": "0.4 N",
            "max_force": "8.5 N",
            "max_rate": "2 kN/s",
            "jitter": "0.2 periods",
            "seed": 7,
        }
    )
    options = conditions.list_options(1e-3)
    assert {name: value for name, value in options.items() if isinstance(value, str | int)} == {
        "periods": 200,
        "contact": "push_only",
        "seed": 7,
    }
    numbers = {name: value for name, value in options.items() if isinstance(value, float)}
    assert numbers == pytest.approx(
        {
            **{
                "start_position": -1e-3,
                "start_velocity": 0.1,
                "external_force": 0.5,
                "resolution": 2e-5,
                "noise": 1e-6,
            },
            **{"coulomb": 0.3, "static": 0.4, "max_force": 8.5, "max_rate": 2e3, "jitter": 2e-4},
        }
    )


def test_omitted_fields_have_the_defaults_of_simulate():
    defaults = {name: parameter.default for name, parameter in inspect.signature(zwidth.simulate).parameters.items()}
    # simulate computes 1000 periods if it is called without periods and without duration.
    assert (defaults["periods"], defaults["duration"]) == (None, None)
    scene = zwidth.Scene(zwidth.Device(0.1), zwidth.Timing(1e-3, 1e-3))
    assert len(scene.simulate(1e3, 5).measured) == 1000
    defaults["periods"] = 1000
    for name, value in SimulationConditions().list_options(1e-3).items():
        assert value == defaults[name], name
    assert {"static", "max_force", "max_rate"}.isdisjoint(SimulationConditions().list_options(1e-3))
    assert [defaults[name] for name in ("static", "max_force", "max_rate")] == [None, math.inf, math.inf]


@pytest.mark.parametrize("kind", [{}, LIMIT_CYCLE], ids=["simulate", "limit_cycle"])
def test_simulations_accept_nonlinear_velocity_estimates(load, kind):
    for text in (simulate("", f"{DEVICE}, {FOAW}", **kind), simulate(FOAW, **kind)):
        config = load(text)
        study = config.studies[0]
        assert study.set_velocity(study.device.to_scene()).velocity == zwidth.FOAW(2e-5, 12)
        # The dumped configuration is equal.
        assert Config.model_validate(config.model_dump(mode="json", exclude_none=True)) == config


@pytest.mark.parametrize(
    "study",
    [
        "kind: boundary, name: s",
        "kind: recommend, name: s",
        "kind: ridge, name: s",
        "kind: step, name: s, stiffness_fraction: 0.5",
        "kind: compare, name: s, devices: [{label: a}, {label: b}]",
        "kind: filters, name: s, cutoff: 10",
        "kind: sweep, name: s, axes: {stiffness: [1, 2]}",
    ],
)
def test_linear_study_of_a_nonlinear_scene_raises(load, study):
    with pytest.raises(ConfigFileError) as caught:
        load(f"scene: {{{DEVICE}, {FOAW}}}\nstudies: [{{{study}}}]\n")
    (fault,) = caught.value.faults
    assert fault.field == "studies[0]"
    assert "scene.velocity of kind 'foaw'" in str(fault)
    assert "no linear form; use the kind 'simulate' or 'limit_cycle'" in str(fault)


@pytest.mark.parametrize(
    "study",
    [
        "kind: ridge, name: r, delta: 1, d: 0",
        "kind: step, name: r, devices: [{mass: 1, period: 1 ms}], stiffness_fraction: 0.5",
    ],
)
def test_study_independent_of_a_nonlinear_scene_is_accepted(load, study):
    assert load(f"scene: {{{DEVICE}, {FOAW}}}\nstudies: [{{{study}}}]\n").studies


@pytest.mark.parametrize(
    ("study", "field"),
    [
        (f"kind: boundary, name: s, device: {{{DEVICE}, {FOAW}}}", "studies[0].device.velocity.kind"),
        (f"kind: sweep, name: s, {FOAW}, axes: {{stiffness: [1, 2]}}", "studies[0].velocity.kind"),
        (f"kind: compare, name: s, devices: [{{label: a, {FOAW}}}]", "studies[0].devices[0].velocity.kind"),
    ],
)
def test_nonlinear_device_raises_at_its_location(load, study, field):
    with pytest.raises(ConfigFileError, match="no linear form; use the kind 'simulate'") as caught:
        load(f"scene: {{{DEVICE}}}\nstudies: [{{{study}}}]\n")
    assert [fault.field for fault in caught.value.faults] == [field]


FAULTS = {
    "resolution: 20 N": ("resolution", "units allowed are m"),
    "resolution: -1 um": ("resolution", "at least 0"),
    "start_velocity: 1 m": ("start_velocity", "units allowed are m/s"),
    "max_rate: 5 N": ("max_rate", "units allowed are N/s"),
    "max_force: 0 N": ("max_force", "greater than 0"),
    "contact: one-sided": ("contact", "'bilateral', 'unilateral', 'push_only'"),
    "coulomb: 0.3 N, static: 0.2 N": ("static", "at least the sliding friction"),
    "jitter: 1 periods": ("jitter", "less than one period"),
    "jitter: 2 ms": ("jitter", "less than one period"),
    "duration: 2000 s": ("duration", "2e+06 periods"),
    "duration: 0.1 periods": ("duration", "1 to 1000000 periods"),
    "seed: -1": ("seed", "at least 0"),
    "velocity: {kind: foaw, noise: 0 um}": ("velocity.noise", "greater than 0"),
    "velocity: {kind: foaw, noise: 1 um, samples: 65}": ("velocity.samples", "at most 64"),
    "velocity: {kind: low_pass, cutoff: 600 Hz}": ("velocity.cutoff", "below half the sampling rate"),
    "friction: 1 N": ("friction", "unknown key"),
}


@pytest.mark.parametrize("kind", [{}, LIMIT_CYCLE], ids=["simulate", "limit_cycle"])
@pytest.mark.parametrize("text", FAULTS)
def test_invalid_fields_raise_at_their_location(load, text, kind):
    field, message = FAULTS[text]
    with pytest.raises(ConfigFileError) as caught:
        load(simulate(text, **kind))
    (fault,) = caught.value.faults
    assert fault.field == f"studies[0].{field}"
    assert message in str(fault)
