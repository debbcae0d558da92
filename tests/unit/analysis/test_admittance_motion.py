"""Simulated contacts of admittance displays against a composed state space, and programs against the simulation."""

import ctypes
import shutil
import subprocess

import numpy as np
import pytest
from composed_displays import PROGRAMS, make_display, make_step

import zwidth

LAG = zwidth.Actuator(time_constant="20 ms")
TIMING = zwidth.Timing(rate="500 Hz", delay="4 periods")


@pytest.mark.parametrize("seed", range(100))
def test_motions_equal_those_of_a_composed_state_space(seed):
    rng = np.random.default_rng(1000 + seed)
    display, robot = make_display(rng)
    damper = float(rng.choice([0.0, 0.5 * display.virtual_damping]))
    limit = display.max_environment_stiffness(damper)
    K = rng.uniform(0.1, 1.2) * (limit.stiffness if limit.status == zwidth.Status.OK else 1e2)
    forces = rng.normal(size=201)
    motion = display.simulate(K, damper, duration="200 periods", force=forces)
    step, size = make_step(display, robot, K, damper)
    state, rows = np.zeros(size), []
    for external in forces:
        state, row = step(state, external)
        rows.append(row)
    expected = np.array(rows).T
    given = motion.position, motion.velocity, motion.force, motion.command
    for values, reference in zip(given, expected, strict=True):
        np.testing.assert_allclose(values, reference, rtol=0, atol=1e-12 * np.abs(reference).max())


@pytest.mark.parametrize("seed", range(12))
def test_motions_decay_below_the_limit_and_grow_above(seed):
    rng = np.random.default_rng(seed)
    display, _ = make_display(rng)
    limit = display.max_environment_stiffness()
    assert limit.status == zwidth.Status.OK
    periods = int(60 / (limit.frequency * display.timing.period))
    pulse = np.zeros(periods + 1)
    pulse[0] = 1.0
    for share, grows in ((0.98, False), (1.02, True)):
        motion = display.simulate(share * limit.stiffness, duration=f"{periods} periods", force=pulse)
        middle, last = (np.abs(motion.position[part * periods // 3 :][: periods // 3]).max() for part in (1, 2))
        assert (last > middle) == grows


def test_contact_comes_to_rest_with_units():
    display = zwidth.AdmittanceDisplay("0.5 kg m^2", "2 N m s/rad", LAG, TIMING)
    motion = display.simulate("10 N m/rad", "1 N m s/rad", duration="10 s", force="0.2 N m")
    assert motion.position[-1] == pytest.approx(0.02, rel=1e-6)
    assert motion.force[-1] == pytest.approx(0, abs=1e-7)
    assert motion.time[-1] == 10.0
    assert "rad" in repr(motion)


def test_sampled_robot_has_no_velocity():
    sampled = zwidth.LinearDevice(([1 - np.exp(-0.1)], [1, -np.exp(-0.1)]), sampled=2e-3)
    by_model, by_samples = (zwidth.AdmittanceDisplay(20, 60, robot, TIMING).simulate(500) for robot in (LAG, sampled))
    np.testing.assert_allclose(by_samples.position, by_model.position, rtol=1e-9, atol=1e-12)
    assert np.all(np.isnan(by_samples.velocity))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"environment_stiffness": -1}, "environment_stiffness: got -1"),
        ({"duration": "1 kg"}, "duration: got '1 kg'"),
        ({"duration": 0}, "duration: got 0"),
        ({"duration": 1e9}, "it must be 1 to"),
        ({"force": [1, 2]}, "pass one number, or one per sample"),
        ({"force": "1 kg"}, "force: got '1 kg'"),
    ],
)
def test_invalid_arguments_raise(arguments, message):
    display = zwidth.AdmittanceDisplay(20, 60, LAG, TIMING)
    with pytest.raises(zwidth.InputError, match=message):
        display.simulate(**{"environment_stiffness": 100, **arguments})


def drive(display, motion, language, folder):
    """Return the commands of the program for the contact forces of a motion."""
    source = display.code(language)
    if language == "python":
        names: dict = {}
        exec(source, names)
        program = names["Display"]()
        return [program.command(force) for force in motion.force.tolist()]
    if shutil.which("cc") is None:
        pytest.skip("no C compiler on this machine")
    start = "display_start(&state, 0.0);" if display.command == "position" else "display_start(&state);"
    loop = "for (int k = 0; k < n; k++) u[k] = display_command(&state, f[k]);"
    main = f"void run(int n, const double *f, double *u)\n{{\n    Display state;\n    {start}\n    {loop}\n}}\n"
    file = folder / "display.c"
    file.write_text(f"{source}\n{main}")
    library = folder / "display.so"
    subprocess.run(
        ["cc", "-std=c99", "-Wall", "-Wextra", "-Werror", "-O1", "-fPIC", "-shared", "-o", library, file], check=True
    )
    commands = np.empty(motion.force.size)
    pointer = ctypes.POINTER(ctypes.c_double)
    forces = np.ascontiguousarray(motion.force)
    ctypes.CDLL(str(library)).run(forces.size, forces.ctypes.data_as(pointer), commands.ctypes.data_as(pointer))
    return commands


@pytest.mark.parametrize("language", ["c", "python"])
@pytest.mark.parametrize("program", PROGRAMS)
def test_programs_return_the_commands_of_the_simulation(program, language, tmp_path):
    display = zwidth.AdmittanceDisplay(20, 60, LAG, TIMING, *program)
    motion = display.simulate("1 kN/m", 5, duration="1000 periods", force=3)
    commands = drive(display, motion, language, tmp_path)
    np.testing.assert_allclose(commands, motion.command, rtol=0, atol=1e-12 * np.abs(motion.command).max())


def test_code_of_another_language_is_refused():
    with pytest.raises(zwidth.InputError, match="language: got 'rust'"):
        zwidth.AdmittanceDisplay(20, 60, LAG, TIMING).code("rust")
