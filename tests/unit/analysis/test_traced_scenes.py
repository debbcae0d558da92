"""All questions about scenes inside JAX transformations, against direct calls and central differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zwidth
from zwidth import Butterworth, Coupling, Device, LowPass, Mode, Operator, Scene, Status, Timing, VirtualWall
from zwidth.core.errors import InputError

FILTERED = Scene(Device(0.1, 10), Timing(1e-3, 1e-3), VirtualWall(3e3, 5), LowPass(cutoff=100))
HELD = Scene(
    Device(0.1, 1, Coupling(0.05, 3e4, 1.0)),
    Timing(1e-3, "0.3 periods"),
    VirtualWall(2e3, 3),
    LowPass(time_constant=1e-3, order=2, coded_period=2e-3),
    Operator(0.5, 6, 135, 800, 4),
)
RIGID = Scene(Device(0.1, 10), Timing(1e-3, "1.5 periods"), VirtualWall(3e3, 5))
SCENES = {"filtered": FILTERED, "held": HELD, "rigid": RIGID}
# Questions with all results; some are answered for several walls or frequencies.
QUESTIONS = {
    "is_stable": lambda scene: scene.is_stable([1e3, 1e5], 5.0),
    "is_passive": lambda scene: scene.is_passive(),
    "spectral_radius": lambda scene: scene.spectral_radius([1e3, 2e3], 5.0),
    "passivity_margin": lambda scene: scene.passivity_margin(),
    "margins": lambda scene: scene.margins(),
    "boundary": lambda scene: scene.boundary([50.0, 100.0]),
    "max_stiffness": lambda scene: scene.max_stiffness(),
    "max_stiffness, B >= 0": lambda scene: scene.max_stiffness(negative_damping=False),
    "sensitivities": lambda scene: scene.sensitivities(),
}


@pytest.mark.parametrize("name", SCENES)
def test_answers_inside_jit_equal_direct_calls(name, x64):
    scene = SCENES[name]
    inside = jax.jit(lambda scene: {key: question(scene) for key, question in QUESTIONS.items()})(scene)
    for key, question in QUESTIONS.items():
        for got, expected in zip(jax.tree.leaves(inside[key]), jax.tree.leaves(question(scene)), strict=True):
            np.testing.assert_allclose(got, expected, rtol=1e-10, atol=1e-12, err_msg=key)
            assert np.shape(got) == np.shape(expected), key


def test_mapped_scenes_equal_direct_calls(x64):
    many = jax.tree.map(lambda x: x * jnp.linspace(1.0, 1.3, 4), FILTERED)
    one_by_one = [jax.tree.map(lambda x, k=k: x[k], many) for k in range(4)]
    for question in (QUESTIONS["max_stiffness"], QUESTIONS["spectral_radius"], lambda scene: scene.is_stable()):
        mapped = jax.vmap(question)(many)
        for k, scene in enumerate(one_by_one):
            for got, expected in zip(jax.tree.leaves(mapped), jax.tree.leaves(question(scene)), strict=True):
                np.testing.assert_allclose(got[k], expected, rtol=1e-12)


def test_invalid_scene_of_a_batch_is_nan_with_status(x64):
    masses = jnp.array([0.1, -1.0, jnp.nan, 0.2])

    def maximum(mass):
        wall = FILTERED.replace(mass=mass).max_stiffness()
        return wall.stiffness, wall.status

    (stiffness, status), slopes = jax.vmap(jax.value_and_grad(maximum, has_aux=True))(masses)
    np.testing.assert_array_equal(status, [Status.OK, Status.INVALID_INPUT, Status.INVALID_INPUT, Status.OK])
    for values in (stiffness, slopes):
        np.testing.assert_array_equal(np.isfinite(values), [True, False, False, True])


# Questions with one number, differentiated in all numbers of the scene.
NUMBERS = {
    "spectral_radius": lambda scene: scene.spectral_radius(),
    "passivity_margin": lambda scene: scene.passivity_margin(),
    "stiffness": lambda scene: scene.max_stiffness().stiffness,
    "virtual_damping": lambda scene: scene.max_stiffness().virtual_damping,
    "frequency": lambda scene: scene.max_stiffness().frequency,
    "boundary": lambda scene: scene.boundary(100.0).virtual_damping,
    **{key: lambda scene, key=key: getattr(scene.margins(), key) for key in zwidth.Scene.margins(RIGID)._fields},
}


def difference(function, scene, k):
    """Return the derivative of a function in a leaf of a scene by a sixth-order central difference."""
    leaves, structure = jax.tree.flatten(scene)
    step = 1e-4 * abs(leaves[k])
    total = 0.0
    for offset, weight in [(1, 3 / 4), (2, -3 / 20), (3, 1 / 60)]:
        for side in (-1, 1):
            moved = [*leaves[:k], leaves[k] + side * offset * step, *leaves[k + 1 :]]
            total += side * weight * function(structure.unflatten(moved))
    return total / step


@pytest.mark.parametrize("key", NUMBERS)
def test_gradients_equal_central_differences(key, x64):
    question = NUMBERS[key]
    # At an integer delay some derivatives are one-sided.
    scene = FILTERED.replace(delay=0.7e-3)
    value, slopes = jax.jit(jax.value_and_grad(question))(scene)
    for k, (leaf, slope) in enumerate(zip(*map(jax.tree.leaves, (scene, slopes)), strict=True)):
        expected = difference(question, scene, k)
        assert float(slope) * leaf == pytest.approx(expected * leaf, rel=1e-6, abs=1e-8 * abs(float(value))), k


def test_gradients_inside_and_outside_jit_are_equal(x64):
    outside, inside = jax.grad(NUMBERS["stiffness"])(HELD), jax.jit(jax.grad(NUMBERS["stiffness"]))(HELD)
    assert all(jax.tree.leaves(jax.tree.map(lambda a, b: a == b, outside, inside)))


def test_hessian_is_symmetric_and_equals_differences_of_gradients(x64):
    leaves, structure = jax.tree.flatten(FILTERED.replace(delay=0.7e-3))

    def maximum(values):
        return structure.unflatten(list(values)).max_stiffness().stiffness

    values = jnp.array(leaves)
    scale = np.array(leaves)
    bends = np.asarray(jax.jit(jax.hessian(maximum))(values)) * scale * scale[:, None]
    np.testing.assert_allclose(bends, bends.T, atol=1e-9 * np.abs(bends).max())
    gradient = jax.jit(jax.grad(maximum))
    for k in (0, 1, 2, 3):
        step = 1e-4 * leaves[k]
        change = (gradient(values.at[k].add(step)) - gradient(values.at[k].add(-step))) / (2 * step)
        np.testing.assert_allclose(np.asarray(change) * scale * leaves[k], bends[k], atol=1e-6 * np.abs(bends).max())


def build_random(generator):
    """Return a random scene of one of five structures."""

    def between(low, high):
        return float(low * (high / low) ** generator.random())

    kind = generator.integers(5)
    device = Device(
        between(0.03, 1.0),
        between(0.1, 20.0),
        Coupling(between(0.01, 0.2), between(1e4, 1e6), between(0.1, 5.0)) if kind == 1 else None,
        zwidth.Actuator(cutoff=between(100, 400)) if kind == 2 else None,
        [Mode(between(50, 300), between(0.02, 0.3), between(0.2, 2.0))] if kind == 3 else (),
    )
    velocity = Butterworth(between(30, 200)) if kind == 4 else LowPass(cutoff=between(30, 200))
    operator = (
        Operator(between(0.1, 1), between(1, 10), between(50, 300), between(500, 2e3), 4.0) if kind == 4 else None
    )
    return Scene(
        device,
        Timing(between(3e-4, 2e-3), f"{generator.uniform(0.1, 0.9):.3f} periods"),
        VirtualWall(1e3, 1.0),
        velocity,
        operator,
    )


@pytest.mark.parametrize("seed", range(5))
def test_gradients_of_random_scenes_equal_central_differences(seed, x64):
    generator, question = np.random.default_rng(seed), NUMBERS["stiffness"]
    slopes_of = jax.jit(jax.value_and_grad(question))
    for _ in range(20):
        scene = build_random(generator)
        value, slopes = slopes_of(scene)
        assert float(value) == pytest.approx(scene.max_stiffness().stiffness, rel=1e-12)
        for k in generator.permutation(len(jax.tree.leaves(scene)))[:2]:
            leaf, slope = jax.tree.leaves(scene)[k], jax.tree.leaves(slopes)[k]
            expected = float(difference(question, scene, k) * leaf)
            assert float(slope) * leaf == pytest.approx(expected, rel=1e-6, abs=1e-7 * float(value)), repr(scene)


def test_required_value_is_differentiable(x64):
    def needed(scene, stiffness):
        return scene.required("damping", stiffness, within=(1, 100))

    direct = needed(FILTERED, 14e3)
    inside = jax.jit(needed)(FILTERED, 14e3)
    assert (float(inside.value), int(inside.sufficient_side), int(inside.status)) == (direct.value, 0, Status.OK)
    slope = jax.jit(jax.grad(lambda scene, stiffness: needed(scene, stiffness).value, argnums=1))(FILTERED, 14e3)
    # The derivative is the reciprocal of that of K_max in the damping there.
    there = FILTERED.replace(damping=direct.value).sensitivities().per["damping"]
    assert float(slope) == pytest.approx(1.0 / there, rel=1e-9)


def test_delay_and_period_may_be_traced(x64):
    for path in ("delay", "period"):
        slope = jax.grad(lambda value, path=path: FILTERED.replace(**{path: value}).max_stiffness().stiffness)(1e-3)
        assert float(slope) == pytest.approx(FILTERED.sensitivities().per[path], rel=1e-12)
    # A traced delay may have any integer part.
    jitted = jax.jit(lambda delay: FILTERED.replace(delay=delay).max_stiffness().stiffness)
    for delay in (0.0, 0.4e-3, 3.6e-3):
        expected = FILTERED.replace(delay=delay).max_stiffness().stiffness
        assert float(jitted(delay)) == pytest.approx(expected, rel=1e-14)


PRICED = ("damping", "velocity.cutoff")


def test_an_optimizer_compiles_one_program(x64):
    """Trade K_max for the prices of damping and cutoff in 200 steps; count the compilations after the first one."""
    compilations = []

    def listen(event, *_, **__):
        if event == "/jax/core/compile/backend_compile_duration":
            compilations.append(event)

    @jax.jit
    def step(scene):
        def loss(scene):
            price = 0.03 * scene.device.damping + 0.001 * scene.velocity.cutoff
            return price - jnp.log(scene.max_stiffness().stiffness)

        value, slopes = jax.value_and_grad(loss)(scene)
        # Steps in the logarithms of both numbers.
        numbers, slopes = scene.parameters(), slopes.parameters()
        changed = {path: numbers[path] * jnp.exp(-0.1 * numbers[path] * slopes[path]) for path in PRICED}
        return scene.replace(**changed), value

    scene, values = jax.tree.map(jnp.asarray, FILTERED), []
    scene, value = step(scene)
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        for _ in range(199):
            scene, value = step(scene)
            values.append(value)
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert compilations == []
    assert values[-1] < values[0]
    assert np.all(np.isfinite(np.array(values)))


def test_scan_over_scenes(x64):
    many = jax.tree.map(lambda x: x * jnp.linspace(1.0, 1.2, 3), FILTERED)
    _, found = jax.lax.scan(lambda carry, scene: (carry, scene.max_stiffness().stiffness), 0.0, many)
    np.testing.assert_array_equal(found, jax.vmap(NUMBERS["stiffness"])(many))


@pytest.mark.parametrize("name", ["poles", "stable_stiffness", "recommend", "simulate", "state_space", "islands"])
@pytest.mark.parametrize("scene", [FILTERED, RIGID], ids=["filtered", "rigid"])
def test_other_questions_refuse_traced_scenes(name, scene):
    with pytest.raises(zwidth.ZwidthError, match=r"traced"):
        jax.jit(lambda scene: getattr(scene, name)())(scene)


@pytest.mark.parametrize("function", [zwidth.assess, zwidth.limits_of, zwidth.diagnose, zwidth.to_control])
def test_other_functions_refuse_traced_scenes(function):
    with pytest.raises(InputError, match=r"traced by JAX"):
        jax.jit(function)(RIGID)


def test_float32_values_are_those_of_direct_calls():
    single = jax.tree.map(lambda x: float(np.float32(x)), FILTERED)
    with jax.enable_x64(False):
        inside = jax.jit(NUMBERS["stiffness"])(single)
    assert inside.dtype == np.float32
    assert float(inside) == pytest.approx(single.max_stiffness().stiffness, rel=1e-6)
