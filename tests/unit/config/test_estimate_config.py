"""Position estimate and further feedback as keys of a scene: accepted values, located errors, and written files."""

import pytest

import zwidth
from zwidth.app.explorer.controls import Controls, read_link, to_link
from zwidth.config.fields import ConfigFileError
from zwidth.studies.document import Config

SCENE = "scene: {mass: 100 g, damping: 10 N s/m, period: 1 ms, delay: 1 ms"
STUDIES = "studies: [{kind: boundary, name: b}]\n"
DEVICE, TIMING = zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3)
PARTS = {
    "position: {kind: exponential, coefficient: 0.3}": {"position": zwidth.ExponentialFilter(0.3)},
    "position: {kind: exponential, time_constant: 2 ms, velocity_from: measured}": {
        "position": zwidth.ExponentialFilter(time_constant=2e-3, velocity_from="measured")
    },
    "position: {kind: low_pass, cutoff: 0.1 kHz, order: 2}": {"position": zwidth.LowPass(cutoff=100, order=2)},
    "position: {kind: butterworth, cutoff: 50}": {"position": zwidth.Butterworth(50)},
    "position: {kind: filter, numerator: [0.5, 0.5], denominator: [1, 0]}": {
        "position": zwidth.PositionFilter([0.5, 0.5], [1, 0])
    },
    "position: {kind: pll, bandwidth: 500}": {"position": zwidth.Pll(500)},
    "position: {kind: observer, position: [0.5, -0.4, 0], velocity: [100, -100, 0], denominator: [1, -1.4, 0.5]}": {
        "position": zwidth.Observer([0.5, -0.4, 0], [100, -100, 0], [1, -1.4, 0.5])
    },
    "feedback: {kind: integral, gain: 1000}": {"feedback": zwidth.IntegralFeedback(1000)},
    "feedback: {kind: integral, gain: 1000, rule: trapezoidal, position: 1, velocity: 0.01}": {
        "feedback": zwidth.IntegralFeedback(1000, "trapezoidal", 1, 0.01)
    },
    "feedback: {kind: filter, numerator: [5e3, -5e3], denominator: [1, 0]}": {
        "feedback": zwidth.Feedback([5e3, -5e3], [1, 0])
    },
    "position: {kind: pll, bandwidth: 500}, feedback: {kind: integral, gain: 3, rule: forward, position: 20}": {
        "position": zwidth.Pll(500),
        "feedback": zwidth.IntegralFeedback(3, "forward", 20),
    },
}


@pytest.mark.parametrize("text", PARTS)
def test_every_kind_is_read_and_written(load, text):
    config = load(f"{SCENE}, {text}}}\n{STUDIES}")
    scene = config.scene.to_scene()
    assert scene == zwidth.Scene(DEVICE, TIMING, zwidth.VirtualWall(0, 0), **PARTS[text])
    # The dumped configuration is equal.
    assert Config.model_validate(config.model_dump(mode="json", exclude_none=True)) == config
    # The address of the explorer, which is the scene of a configuration, contains the parts, too.
    wall = scene.replace(wall=zwidth.VirtualWall(100, 1), timing=zwidth.Timing(1e-3, 1e-3))
    assert read_link(to_link(Controls(wall))).scene == wall


FAULTS = {
    "position: 0.3": ("position", "write {kind: exponential, coefficient: 0.3}"),
    "position: {coefficient: 0.3}": ("position.kind", "add 'kind: exponential'"),
    "position: {kind: windowed_difference, samples: 3}": ("position.kind", "got 'windowed_difference'"),
    "position: {kind: exponential}": ("position", "got none of coefficient, time_constant, cutoff"),
    "position: {kind: exponential, coefficient: 2}": ("position.coefficient", "greater than 0 and at most 1"),
    "position: {kind: exponential, coefficient: 1, velocity_from: raw}": ("position.velocity_from", "'measured'"),
    "position: {kind: low_pass, cutoff: 600 Hz}": ("position.cutoff", "below half the sampling rate"),
    "position: {kind: pll, bandwidth: 900}": ("position.bandwidth", "unstable from 828.427 rad/s on"),
    "position: {kind: filter, numerator: [1], denominator: [1, -1]}": ("position.denominator", "magnitude 1"),
    "position: {kind: pll, bandwidth: 500}, velocity: {kind: low_pass, cutoff: 100}": ("velocity", "omit velocity"),
    "feedback: {kind: integral}": ("feedback.gain", "missing"),
    "feedback: {kind: integral, gain: 1, rule: tustin}": ("feedback.rule", "'trapezoidal'"),
    "feedback: {kind: filter, numerator: [1, 2], denominator: [1]}": ("feedback.numerator", "future samples"),
}


@pytest.mark.parametrize("text", FAULTS)
def test_faults_are_located(load, text):
    path, words = FAULTS[text]
    with pytest.raises(ConfigFileError) as error:
        load(f"{SCENE}, {text}}}\n{STUDIES}")
    assert f"scene.{path}: " in str(error.value)
    assert words in str(error.value)


def test_kind_of_study_without_parts_refuses_the_estimates(load):
    words = "got a device with position and feedback; the kind 'passivity' accepts only"
    with pytest.raises(ConfigFileError, match=words):
        load(
            f"{SCENE}, position: {{kind: pll, bandwidth: 500}}, feedback: {{kind: integral, gain: 1}}}}\n"
            "studies: [{kind: passivity, name: r}]\n"
        )


def test_simulation_of_a_file_uses_the_estimates(load):
    parts = "position: {kind: exponential, coefficient: 0.3}, feedback: {kind: integral, gain: 500}"
    wall = "{stiffness: 2 kN/m, virtual_damping: 20}"
    config = load(f"{SCENE}, {parts}}}\nstudies: [{{kind: simulate, name: s, walls: [{wall}]}}]\n")
    scene = zwidth.Scene(DEVICE, TIMING, position=zwidth.ExponentialFilter(0.3), feedback=zwidth.IntegralFeedback(500))
    table = config.studies[0].compute(config.scene, True).table
    motion = scene.simulate(2e3, 20, start_position=table["position_m"][0], periods=len(table["position_m"]))
    assert table["position_m"].tolist() == motion.position.tolist()
