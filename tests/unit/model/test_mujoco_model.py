"""Devices from MuJoCo models: simulations of the joint-space loop in MuJoCo, forms of arguments, and messages."""

from typing import Any

import numpy as np
import pytest

import zwidth

# The annotation is Any, because the type stubs of MuJoCo lack most functions.
mujoco: Any = pytest.importorskip("mujoco", reason="the extra mujoco is not installed")
TIMING = zwidth.Timing(period="1 ms", delay="1 ms")
# The integrator's step is a tenth of the sampling period and its errors are of fourth order, so that they are far below
# the distance of 2 % from the boundary.
STEP = 1e-4
OPTION = f'<compiler angle="radian"/><option gravity="0 0 0" timestep="{STEP}" integrator="RK4"/>'
TWO_LINKS = f"""
<mujoco>{OPTION}
  <worldbody>
    <body>
      <joint name="shoulder" axis="0 0 1" damping="0.02" armature="0.0015"/>
      <geom type="capsule" fromto="0 0 0 .25 0 0" size=".01" mass=".12" contype="0" conaffinity="0"/>
      <body pos=".25 0 0">
        <joint name="elbow" axis="0 0 1" damping="0.05" armature="0.0015"/>
        <geom type="capsule" fromto="0 0 0 .25 0 0" size=".01" mass=".12" contype="0" conaffinity="0"/>
        <site name="handle" pos=".25 0 0"/>
      </body>
    </body>
  </worldbody>
  {{}}
</mujoco>"""
MOTORS = '<actuator><motor joint="shoulder"/><motor joint="elbow"/></actuator>'
HOME = '<keyframe><key name="home" qpos="0.4 1.1"/></keyframe>'


def make_seven_joints() -> str:
    """Return a model of an arm with seven joints, whose axes alternate between z and y."""
    opened = "".join(
        f'<body pos="0 0 {0.15 if k else 0.0}"><joint axis="{"0 1 0" if k % 2 else "0 0 1"}" damping="{0.3 + 0.1 * k}" '
        f'armature="0.02"/><geom type="capsule" fromto="0 0 0 0.0{k} 0 .15" size="0.03" mass="{1.2 - 0.1 * k}" '
        'contype="0" conaffinity="0"/>'
        for k in range(7)
    )
    tip = '<site name="handle" pos="0.05 0 .1"/>'
    return f"<mujoco>{OPTION}<worldbody>{opened}{tip}{'</body>' * 7}</worldbody></mujoco>"


def measure_growth(model, direction, pose, stiffness, virtual_damping, samples=1200):
    """Return the growth of a motion per sample in the joint-space loop with one period of delay, simulated in MuJoCo.

    The torques are J' n f with the force f of the wall, and the wall measures n' J (q - q0).
    """
    data = mujoco.MjData(model)
    data.qpos[:] = pose
    mujoco.mj_forward(model, data)
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jacSite(model, data, jacobian, None, model.site("handle").id)
    vector = jacobian.T @ (np.array(direction) / np.linalg.norm(direction))
    data.qvel[:] = 1e-6 * vector / np.linalg.norm(vector)
    position = force = 0.0
    positions = []
    for _ in range(samples):
        previous, position = position, vector @ (data.qpos - pose)
        data.qfrc_applied[:] = vector * force
        force = -(stiffness * position + virtual_damping * (position - previous) / TIMING.period)
        for _ in range(round(TIMING.period / STEP)):
            mujoco.mj_step(model, data)
        positions.append(position)
    quarter = samples // 4
    early, late = np.array(positions[quarter : 2 * quarter]), np.array(positions[-quarter:])
    return np.log(np.ptp(late) / np.ptp(early)) / (samples - 2 * quarter)


@pytest.mark.parametrize(
    ("xml", "pose", "directions"),
    [
        (TWO_LINKS.format(""), [0.4, 1.1], ([1, 0, 0], [0, 1, 0], [1, 1, 0])),
        (make_seven_joints(), [0.1, 0.4, 0.2, -0.9, 0.3, 0.6, 0.1], ([1, 0, 0], [0, 1, 0], [1, 1, 1])),
    ],
    ids=["two joints", "seven joints"],
)
def test_largest_stiffness_separates_stable_from_unstable_simulations(xml, pose, directions):
    model = mujoco.MjModel.from_xml_string(xml)
    for direction in directions:
        scene = zwidth.Scene(zwidth.from_mujoco(model, "handle", direction, pose=pose), TIMING)
        top = scene.max_stiffness()
        for factor, stable in ((0.98, True), (1.02, False)):
            growth = measure_growth(model, direction, pose, factor * top.stiffness, top.virtual_damping)
            assert (growth < 0) == stable == bool(scene.is_stable(factor * top.stiffness, top.virtual_damping))
            if not stable:
                # The slowest decaying pole is another one on the stable side, so only growth is compared.
                radius = float(scene.spectral_radius(factor * top.stiffness, top.virtual_damping))
                # Maxima of sampled oscillations underestimate the amplitude by up to a percent.
                assert growth == pytest.approx(np.log(radius), rel=0.03)


def test_model_from_path_text_and_actuators(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(TWO_LINKS.format(HOME + MOTORS))
    model = mujoco.MjModel.from_xml_path(str(path))
    expected = zwidth.from_mujoco(model, "handle", "x", pose=[0.4, 1.1])
    for source in (path, str(path)):
        assert zwidth.from_mujoco(source, "handle", "x", pose="home") == expected
    # With one motor, the other joint moves passively, so force and displacement come from one joint alone.
    path.write_text(TWO_LINKS.format(HOME + '<actuator><motor joint="shoulder"/></actuator>'))
    inertia, jacobian = np.zeros((2, 2)), np.zeros((3, 2))
    data = mujoco.MjData(model)
    data.qpos[:] = 0.4, 1.1
    mujoco.mj_forward(model, data)
    for column, unit in zip(inertia, np.eye(2), strict=True):
        mujoco.mj_mulM(model, data, column, unit)
    mujoco.mj_jacSite(model, data, jacobian, None, 0)
    jacobian[:, 1] = 0
    driven = zwidth.from_mass_matrix(inertia, [0.02, 0.05], direction="x", jacobian=jacobian)
    assert zwidth.from_mujoco(path, "handle", "x", pose="home") == driven


def test_wheel_of_a_model_is_rotary():
    xml = """<mujoco><worldbody><body name="wheel"><joint axis="0 0 1" damping="0.3"/>
    <geom type="cylinder" size=".15 .01" mass="2"/></body></worldbody></mujoco>"""
    wheel = zwidth.from_mujoco(mujoco.MjModel.from_xml_string(xml), "wheel", "z", rotary=True)
    assert wheel.rotary
    assert wheel.mass == pytest.approx(2 * 0.15**2 / 2)
    assert wheel.damping == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"model": "missing.xml"}, "model: got 'missing.xml', which is not a file"),
        ({"model": 3}, "model: got 3"),
        ({"site": "tool"}, "site: got 'tool', allowed are 'handle'"),
        ({"pose": [1, 2, 3]}, "pose: got [1, 2, 3]; it must be 2 joint positions"),
        ({"pose": "hom"}, "did you mean 'home'?"),
        ({"direction": "z"}, "direction: no joint moves the point"),
    ],
)
def test_invalid_arguments_of_a_model_are_named(arguments, message):
    model = mujoco.MjModel.from_xml_string(TWO_LINKS.format(HOME))
    with pytest.raises(zwidth.InputError) as error:
        zwidth.from_mujoco(**{"model": model, "site": "handle", "direction": "x"} | arguments)
    assert message in str(error.value)


def test_constraints_and_actuators_of_tendons_are_refused():
    equality = '<equality><joint joint1="shoulder" joint2="elbow"/></equality>'
    with pytest.raises(zwidth.InputError, match="equality constraints"):
        zwidth.from_mujoco(mujoco.MjModel.from_xml_string(TWO_LINKS.format(equality)), "handle", "x")
    tendon = '<tendon><fixed name="t"><joint joint="elbow" coef="1"/></fixed></tendon>'
    pulled = mujoco.MjModel.from_xml_string(TWO_LINKS.format(tendon + '<actuator><motor tendon="t"/></actuator>'))
    with pytest.raises(zwidth.InputError, match="does not act on a joint"):
        zwidth.from_mujoco(pulled, "handle", "x")
