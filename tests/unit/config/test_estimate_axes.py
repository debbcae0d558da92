"""Sweeps over parameters of position estimates and further feedback, and bandwidths in rad/s, as a user types them."""

from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import zwidth
from zwidth.cli import cli
from zwidth.config.fields import ConfigFileError

DEVICE, TIMING = zwidth.Device(0.1, 10), zwidth.Timing("1 ms", "1 ms")
untyped: Any = zwidth  # for arguments of wrong types
OPTIONS = ("--mass", "100g", "--damping", "10", "--period", "1ms", "--delay", "1ms", "--stiffness", "1kN/m")
SCENE = "version: 1\nname: sweep\nscene: {mass: 100 g, damping: 10, rate: 1 kHz, delay: 1 ms, %s}\nstudies:\n  - {%s}\n"


def sweep(tmp_path, part, axes):
    study = f"kind: sweep, name: filter, outputs: [stiffness_max], axes: {{{axes}}}"
    (tmp_path / "sweep.yaml").write_text(SCENE % (part, study))
    assert zwidth.run(tmp_path / "sweep.yaml", out=tmp_path / "out").ok
    return zwidth.open_dataset(tmp_path / "out").stiffness_max.values


def test_sweep_over_the_coefficient_of_a_position_filter(tmp_path):
    swept = sweep(tmp_path, "position: {kind: exponential, coefficient: 0.2}", "position.coefficient: [0.1, 0.2, 0.5]")
    scenes = [zwidth.Scene(DEVICE, TIMING, position=zwidth.ExponentialFilter(a)) for a in (0.1, 0.2, 0.5)]
    np.testing.assert_allclose(swept, [scene.max_stiffness().stiffness for scene in scenes], rtol=1e-12)


def test_sweep_over_a_bandwidth_in_rad_per_second_and_an_integral_gain(tmp_path):
    part = "position: {kind: pll, bandwidth: 500 rad/s}, feedback: {kind: integral, gain: 10}"
    swept = sweep(tmp_path, part, "position.bandwidth: [500 rad/s, 700], feedback.gain: [100, 1000]")
    for row, bandwidth in zip(swept, (500, 700), strict=True):
        for stiffness, gain in zip(row, (100, 1000), strict=True):
            parts = {"position": zwidth.Pll(bandwidth), "feedback": zwidth.IntegralFeedback(gain)}
            assert stiffness == pytest.approx(zwidth.Scene(DEVICE, TIMING, **parts).max_stiffness().stiffness)


def test_unknown_axis_is_named_if_it_is_the_only_one(tmp_path):
    study = "kind: sweep, name: filter, outputs: [stiffness_max], axes: {position.coeff: [0.1]}"
    (tmp_path / "sweep.yaml").write_text(SCENE % ("position: {kind: exponential, coefficient: 0.2}", study))
    with pytest.raises(ConfigFileError, match=r"axes\.position\.coeff: unknown key"):
        zwidth.load_config(tmp_path / "sweep.yaml")


@pytest.mark.parametrize("bandwidth", [500, "500 rad/s", "0.5 krad/s", f"{500 / (2 * np.pi)!r} Hz"])
def test_bandwidths_do_not_make_a_device_rotary(bandwidth):
    pll = zwidth.Pll(bandwidth)
    assert pll.bandwidth == pytest.approx(500)
    assert not zwidth.Scene(DEVICE, TIMING, position=pll).device.rotary
    options = [*OPTIONS, "--virtual-damping", "10", "--position-kind", "pll", "--position-bandwidth", str(bandwidth)]
    result = CliRunner().invoke(cli, ["check", *options])
    assert "STABLE" in result.output
    assert "bandwidth 500.0 rad/s" in result.output


def test_gains_with_units_are_refused_with_a_remedy():
    with pytest.raises(zwidth.InputError, match=r"pos_gain: got the text '20 1/s'; pass a number"):
        untyped.cascade("20 1/s", 0.16)
    with pytest.raises(zwidth.InputError, match=r"kp: got the text '3.2 N m/turn'; pass a number"):
        untyped.pid("3.2 N m/turn")


def test_conversions_accept_texts_with_units():
    assert zwidth.ExponentialFilter.simplefoc("5 ms", "1 ms") == zwidth.ExponentialFilter.simplefoc(5e-3, 1e-3)
    assert untyped.pid(100, derivative_filter="5 ms").velocity == zwidth.LowPass(time_constant=5e-3)
    gains = untyped.pid_gains("2 N m/rad", "50 mN m s/rad", units="turns")
    assert gains == pytest.approx(zwidth.pid_gains(2.0, 0.05, units="turns"))
    cascade = untyped.cascade_gains("2 N m/rad", "50 mN m s/rad")
    assert cascade == pytest.approx(zwidth.cascade_gains(2.0, 0.05))
    assert cascade.pos_gain == pytest.approx(40)
    with pytest.raises(zwidth.InputError, match="time_constant: got '5 N'"):
        zwidth.ExponentialFilter.simplefoc("5 N", "1 ms")
