"""Parts and scenes as JAX pytrees: leaves, structure, and registration without importing JAX."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zwidth
from zwidth import (
    Actuator,
    Butterworth,
    Coupling,
    Device,
    LowPass,
    Mode,
    Operator,
    SafeLimit,
    Scene,
    Timing,
    VirtualWall,
)
from zwidth.core.errors import InputError

FULL = Scene(
    Device(0.1, 10, Coupling(0.05, 3e4, 1.0, "tip"), Actuator(300, order=2), [Mode(120, 0.02, -0.5)]),
    Timing("1 ms", "1.5 periods"),
    VirtualWall(1e3, 2),
    LowPass(cutoff=100, order=2),
    Operator(0.5, 6, 135, 800, 4),
    SafeLimit(484, 1.13, reason="a resonance may hide", warnings=["short log"]),
)
SCENES = {
    "full": FULL,
    "rigid": Scene(Device(0.1, 10), Timing(1e-3, 1e-3)),
    "rigid grasp": Scene(Device(0.1, 10), Timing(1e-3), operator=Operator(0.5)),
    "rotary": Scene(Device("12 g cm^2", "0.02 mN m s/rad"), Timing(1e-3), VirtualWall("0.3 N m/rad")),
    "coefficients": Scene(Device(0.1), Timing(1e-3), velocity=zwidth.VelocityFilter([1000, -1000], [1, 0])),
    "linear": Scene(zwidth.LinearDevice("1 / 0.1 10 0"), Timing(1e-3, 1e-3), velocity=Butterworth(100)),
}


@pytest.mark.parametrize("name", SCENES)
def test_scene_is_rebuilt_from_its_leaves(name):
    scene = SCENES[name]
    leaves, structure = jax.tree.flatten(scene)
    assert all(isinstance(leaf, float) for leaf in leaves)
    again = jax.tree.map(lambda x: x, scene)
    assert again == scene
    assert repr(again) == repr(scene)
    assert again.unit_system == scene.unit_system
    # Leaves may be any objects, as JAX uses them to prepare in_axes and shapes.
    for replaced in (object(), None, jax.ShapeDtypeStruct((), float)):
        assert (
            jax.tree.structure(jax.tree.map(lambda _, r=replaced: r, scene), is_leaf=lambda x: x is None) == structure
        )


def test_leaves_have_names():
    names = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_flatten_with_path(FULL)[0]]
    assert names[:3] == [".device.mass", ".device.damping", ".device.coupling.mass"]
    assert {".device.modes[0].frequency", ".timing.delay", ".velocity.cutoff", ".safe_limit.stiffness"} <= {*names}


def test_structure_does_not_depend_on_numbers_units_or_texts():
    changed = FULL.replace(**{"mass": "250 g", "delay": "2.5 periods", "velocity.cutoff": 30, "coupling.mass": 0.01})
    limit = SafeLimit("1 N/m", reason="another reason")
    assert jax.tree.structure(changed.replace(safe_limit=limit)) == jax.tree.structure(FULL)
    assert hash(jax.tree.structure(changed)) == hash(jax.tree.structure(FULL))
    for path, value in {"velocity.order": 1, "coupling.sensor": "motor", "delay": 1e-3, "operator": None}.items():
        assert jax.tree.structure(FULL.replace(**{path: value})) != jax.tree.structure(FULL), path


def test_delay_in_periods_is_a_leaf_in_periods(x64):
    timing = jax.tree.map(lambda x: 2.0 * x, Timing(1e-3, "1.5 periods"))
    assert (timing.period, timing.d, timing.delay) == (2e-3, 3.0, 6e-3)
    assert jax.jit(lambda timing: timing.d)(timing) == 3.0
    assert float(jax.grad(lambda timing: timing.d)(timing).period) == 0.0


def test_traced_scene_drops_texts_and_can_be_printed():
    returned = jax.jit(lambda scene: (repr(scene), scene)[1])(FULL)
    assert returned.safe_limit.reason == ""
    assert returned.safe_limit.warnings == ()
    assert jax.tree.structure(returned) == jax.tree.structure(FULL)


def test_scene_of_arrays_asks_for_vmap():
    many = jax.tree.map(lambda x: np.full(3, x), SCENES["rigid"])
    with pytest.raises(InputError, match=r"scene: got numbers of shape \(3,\); map over scenes with jax.vmap"):
        many.max_stiffness()


def test_numbers_of_jax_are_checked_before_a_computation():
    negative = jax.tree.map(lambda x: jnp.asarray(-x), SCENES["linear"])
    with pytest.raises(InputError, match="must be greater than 0"):
        negative.max_stiffness()


AFTERWARDS = """
import sys, zwidth
scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3), velocity=zwidth.LowPass(100))
assert "jax" not in sys.modules
{load}
import jax
assert len(jax.tree.leaves(scene)) == 5
assert jax.tree.map(lambda x: x, scene) == scene
assert not any(type(finder).__module__.startswith("zwidth") for finder in sys.meta_path)
"""


@pytest.mark.parametrize("load", ["", "import lazy_loader; lazy_loader.load('jax')", "import jax.numpy"])
def test_scenes_built_before_the_import_of_jax_are_pytrees(load):
    subprocess.run([sys.executable, "-c", AFTERWARDS.format(load=load)], check=True)
