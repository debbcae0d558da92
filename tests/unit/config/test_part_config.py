"""Velocity filter, operator and coupling as keys of a scene: accepted values and located errors."""

import json

import pytest

import zwidth
from zwidth.config.fields import ConfigFileError
from zwidth.config.study import KINDS
from zwidth.studies.document import Config

SCENE = "scene: {mass: 100 g, damping: 10 N s/m, period: 1 ms, delay: 1 ms"
BOUNDARY = "studies: [{kind: boundary, name: b}]\n"


def add_to_scene(text, studies=BOUNDARY):
    return f"{SCENE}, {text}}}\n{studies}"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{kind: backward_difference, coded_period: 0.1 ms}", zwidth.BackwardDifference(coded_period=1e-4)),
        ("{kind: windowed_difference, samples: 15}", zwidth.WindowedDifference(15)),
        ("{kind: low_pass, cutoff: 0.1 kHz, order: 2}", zwidth.LowPass(cutoff=100, order=2)),
        ("{kind: low_pass, time_constant: 50 ms}", zwidth.LowPass(time_constant=0.05)),
        ("{kind: butterworth, cutoff: 25, order: 4}", zwidth.Butterworth(25, 4)),
        ("{kind: foaw, noise: 20 um}", zwidth.FOAW(2e-5, 15)),
        ("{kind: filter, numerator: [1000, -1000], denominator: [1, 0]}", zwidth.VelocityFilter([1e3, -1e3], [1, 0])),
    ],
)
def test_every_velocity_estimate(load, text, expected):
    config = load(
        add_to_scene(f"velocity: {text}", "studies: [{kind: simulate, name: s, walls: [{stiffness: 1000}]}]\n")
    )
    assert config.scene.to_scene().velocity == expected
    # The dumped configuration is equal.
    assert Config.model_validate(config.model_dump(mode="json", exclude_none=True)) == config


def test_operator_and_coupling_with_units(load):
    hand = "operator: {mass: 554 g, damping: 6.45, stiffness: 135, coupling_stiffness: 1 N/mm, coupling_damping: 5}"
    scene = load(
        add_to_scene(f"{hand}, coupling: {{mass: 50 g, stiffness: 20 kN/m, damping: 1, sensor: tip}}")
    ).scene.to_scene()
    assert scene.operator == zwidth.Operator(0.554, 6.45, 135, 1000, 5)
    assert scene.device.coupling == zwidth.Coupling(0.05, 20e3, 1, "tip")


def test_delay_in_periods_is_exact(load):
    """The delay in seconds divided by the period would be 0.8869999999999999."""
    scene = "scene: {mass: 0.1, period: 3e-4, delay: 0.887 periods, velocity: {kind: low_pass, cutoff: 100}}\n"
    config = load(scene + "studies: [{kind: recommend, name: r}]\n")
    assert zwidth.Timing(3e-4, 0.887 * 3e-4).d != 0.887
    assert config.scene.to_scene().d == 0.887


def test_rigidly_coupled_operator_adds_to_the_mass(load):
    """The scene equals a rigid one with the sum of both masses."""
    studies = "studies: [{kind: recommend, name: r}]\n"
    with_operator, heavy = (
        load(text)
        for text in (
            add_to_scene("operator: {mass: 0.4}", studies),
            "scene: {mass: 0.5, damping: 10, period: 1 ms, delay: 1 ms}\n" + studies,
        )
    )
    documents = [config.studies[0].compute(config.scene, True).documents for config in (with_operator, heavy)]
    reports = [json.loads(document["recommendation.json"]) for document in documents]
    assert [reports[0][name] for name in ("maximum", "recommended")] == [
        reports[1][n] for n in ("maximum", "recommended")
    ]


FAULTS = {
    "velocity: {kind: low_pas}": ("velocity.kind", "did you mean 'low_pass'?"),
    "velocity: {cutoff: 100}": ("velocity.kind", "missing"),
    "velocity: 100 Hz": ("velocity", "a mapping with one of the kinds"),
    "velocity: {kind: low_pass}": ("velocity", "either cutoff"),
    "velocity: {kind: low_pass, cutoff: 10, time_constant: 1 ms}": ("velocity", "only one of them"),
    "velocity: {kind: low_pass, cutoff: 10 ms}": ("velocity.cutoff", "units allowed are Hz"),
    "velocity: {kind: low_pass, cutoff: 500 Hz}": ("velocity.cutoff", "below half the sampling rate"),
    "velocity: {kind: low_pass, cutoff: 10, order: 3}": ("velocity.order", "at least 1 and at most 2"),
    "velocity: {kind: windowed_difference, samples: 2.5}": ("velocity.samples", "whole number"),
    "velocity: {kind: windowed_difference, samples: 2, cutoff: 3}": ("velocity.cutoff", "unknown key"),
    "velocity: {kind: filter, numerator: [1, 0], denominator: [1]}": ("velocity.numerator", "future samples"),
    "velocity: {kind: filter, numerator: [1], denominator: [1, -1]}": ("velocity.denominator", "it must be below 1"),
    "velocity: {kind: filter, numerator: 3, denominator: [1]}": ("velocity.numerator", "a list, highest power first"),
    "operator: {mass: -1}": ("operator.mass", "at least 0"),
    "operator: {coupling_stiffness: 1000}": ("operator.mass", "greater than 0"),
    "operator: {mass: 1, coupling_damping: 1}": ("operator.coupling_damping", "without a coupling spring"),
    "coupling: {mass: 1}": ("coupling.stiffness", "missing"),
    "coupling: {mass: 1, stiffness: 1 kN/m, sensor: middle}": ("coupling.sensor", "'motor', 'tip'"),
    "velocity: {kind: butterworth, cutoff: 30}, delay_model: held": ("delay_model", "remove it"),
}


@pytest.mark.parametrize("text", FAULTS)
def test_invalid_fields_raise_at_their_location(load, text):
    field, message = FAULTS[text]
    with pytest.raises(ConfigFileError) as caught:
        load(add_to_scene(text))
    (fault,) = caught.value.faults
    assert fault.field == f"scene.{field}"
    # Line 3 of the file, to the right of the scene's other keys.
    assert fault.line == 3
    assert fault.column is not None
    assert fault.column > len(SCENE)
    assert message in str(fault)


def test_normalized_scene_with_a_filter_raises(load):
    with pytest.raises(ConfigFileError, match="a scene that is normalized has no parts") as caught:
        load("scene: {delta: 0.1, d: 1, velocity: {kind: low_pass, cutoff: 100}}\n" + BOUNDARY)
    assert [fault.field for fault in caught.value.faults] == ["scene.velocity"]


def test_sweep_of_passivity_with_the_sensor_at_the_tip_raises(load):
    walls = "axes: {stiffness: [1 kN/m, 5 kN/m], virtual_damping: [0, 10]}"
    sweep = f"studies: [{{kind: sweep, name: s, {walls}, outputs: [stable, passive]}}]\n"
    coupling = "coupling: {mass: 50 g, stiffness: 20 kN/m, sensor: SENSOR}"
    assert load(add_to_scene(coupling.replace("SENSOR", "motor"), sweep)).studies
    with pytest.raises(ConfigFileError, match="got 'passive' with the sensor at the tip") as caught:
        load(add_to_scene(coupling.replace("SENSOR", "tip"), sweep))
    assert [fault.field for fault in caught.value.faults] == ["studies[0].outputs[1]"]


def test_sweep_of_passivity_of_a_linear_device_raises(load):
    """Regression: such a sweep failed at every wall and lost the labels of the other outputs."""
    walls = "axes: {period: 1 ms, stiffness: [1 kN/m, 5 kN/m], virtual_damping: 10}"
    sweep = f"studies: [{{kind: sweep, name: s, device: 1 / 0.1 10 0, {walls}, outputs: OUTPUTS}}]\n"
    assert load(sweep.replace("OUTPUTS", "[stable]")).studies
    with pytest.raises(ConfigFileError, match="got 'passive' with a linear device") as caught:
        load(sweep.replace("OUTPUTS", "[stable, passive]"))
    assert [fault.field for fault in caught.value.faults] == ["studies[0].outputs[1]"]


# Required fields of some kinds.
NEEDED = {"step": ", stiffness_fraction: 0.5", "map": ", alpha: 1, beta: 1"}


# Kinds that use the scene but ignore filters and operators; a fit and the paper's figures use no scene.
@pytest.mark.parametrize("kind", [name for name, model in KINDS.items() if model.from_scene and not model.takes_parts])
def test_kinds_without_filters_name_suitable_kinds(load, kind):
    studies = f"studies: [{{kind: {kind}, name: s{NEEDED.get(kind, '')}}}]\n"
    with pytest.raises(
        ConfigFileError, match=r"got a device with velocity and operator; .* 'boundary', 'compare'"
    ) as caught:
        load(add_to_scene("velocity: {kind: low_pass, cutoff: 100}, operator: {stiffness: 10}", studies))
    assert [fault.field for fault in caught.value.faults] == ["studies[0]"]


@pytest.mark.parametrize(
    ("study", "field", "message"),
    [
        ("kind: boundary, name: b, delta: 1", "studies[0]", "remove 'delta', or give both"),
        ("kind: boundary, name: b, passivity: true", "studies[0].passivity", "two samples, without velocity"),
        (
            "kind: boundary, name: b, device: {mass: 1, period: 1}, delta: 3",
            "studies[0].delta",
            "the device has its own",
        ),
        (
            "kind: step, name: s, stiffness_fraction: 0.5, devices: [{mass: 1, period: 1, operator: {stiffness: 1}}]",
            "studies[0].devices[0]",
            "got a device with operator",
        ),
        ("kind: sweep, name: s, axes: {alpha: 1}", "studies[0]", "its parts are in SI units"),
        (
            "kind: sweep, name: s, axes: {stiffness: 1}, outputs: [passivity_margin]",
            "studies[0].outputs[0]",
            "parts are 'stable'",
        ),
        ("kind: compare, name: c, devices: [{mass: 1}]", "studies[0].devices[0].label", "missing"),
        ("kind: compare, name: c, devices: [{label: a}, {label: a, mass: 1}]", "studies[0].devices[1].label", "twice"),
        ("kind: filters, name: f", "studies[0]", "cutoff and samples are missing"),
        ("kind: filters, name: f, cutoff: [600]", "studies[0].cutoff", "below half the sampling rate"),
        ("kind: filters, name: f, samples: [3], noise_limit: 1 mm/s", "studies[0].noise_limit", "add 'resolution'"),
        ("kind: filters, name: f, samples: {linear: {start: 1, stop: 4, num: 3}}", "studies[0].samples", "2.5 as one"),
    ],
)
def test_invalid_studies_of_a_filtered_scene_raise_at_their_location(load, study, field, message):
    with pytest.raises(ConfigFileError) as caught:
        load(add_to_scene("velocity: {kind: low_pass, cutoff: 100}", f"studies: [{{{study}}}]\n"))
    assert [fault.field for fault in caught.value.faults] == [field]
    assert message in str(caught.value)
