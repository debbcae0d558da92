"""Discretize many devices of one structure at once: compute the sampled plant G of each loop.

A *chain* (`model.mechanism`) is the model ``x' = A x + B u`` of a device, with one value per loop of each parameter,
along the last axis. With ``zeta = z - 1`` and ``Psi = e^A - 1``, the poles of G are eigenvalues of Psi, and the zeros
of G are eigenvalues of a similar matrix. Numerator and denominator of G are polynomials in zeta, lowest power first.
They are expanded from these roots, because roots in the left half-plane of zeta yield sums of positive terms. The
result is checked: the critical controller ``q = -1/G`` from the polynomials must agree with q from the matrices. The
loops form a batch (`stability.linear.loop_batch`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import namespace
from zwidth.model.circle_functions import circle_points
from zwidth.model.linear_plant import System
from zwidth.model.mechanism import AnyChain, Chain, build_chain, is_zero
from zwidth.model.parameter_paths import Parts, fill_parameters
from zwidth.numerics.threads import run_in_threads
from zwidth.plant.rigid_mass import discretize_mass, factor_numerator
from zwidth.plant.sampled_states import SampledStates, integrate_chain
from zwidth.stability.linear.batch_lines import pad_index
from zwidth.stability.linear.loop_batch import Form, LoopBatch, Sizes, count_nodes, evaluate

# Angles in rad per sample at which q = -1/G from polynomials and q from matrices are compared, and the largest relative
# difference that is accepted.
TEST_ANGLES = (1e-2, 1e-1, 0.5, 2.0)
RESPONSE_TOLERANCE = 1e-10
LARGEST_RATE = 1e6  # largest entry of A, in (rad per period)^2, of devices that are evaluated in batches


class _SampledBatch(NamedTuple):
    """The sampled plant G of each loop, with the fields of `LoopBatch`."""

    numerator: Array
    denominator: Array
    plant_zeros: Array
    plant_poles: Array
    integrators: Array


class DeviceBatch(NamedTuple):
    """Loops of one structure, and their discretized devices in state space."""

    form: Form
    loop: LoopBatch
    states: SampledStates | None  # the first axis is that of the loops; None for rigid devices


def build_loops(chain: AnyChain, size: int) -> DeviceBatch:
    """Return the loops of a chain whose parameters are numbers or arrays of shape (size,), one value per loop."""
    f, fraction = chain.estimate, chain.d - chain.n_delay
    form, states, A = Form(chain.n_delay + 1, f.window, f.lag), None, np.zeros((size, 1, 1))
    if isinstance(chain, Chain) and chain.rigid:
        plant = _discretize_rigid(chain.bodies[0].damping, fraction, size)
    else:
        A, B = _stack_states(chain, size)
        states = _sample(A, B, chain)
        plant = _factor(chain, states)
    roots = (part[:, None] if np.ndim(part) < 2 else part for part in (f.zeros, f.poles))
    xp = namespace(plant.numerator, f.gain)
    estimate = [xp.broadcast_to(xp.asarray(f.gain), (size,)), *(xp.broadcast_to(r, (r.shape[0], size)) for r in roots)]
    loop = LoopBatch._make([*plant[:2], *estimate, *plant[2:]])
    if states is not None:
        # Set the gain of a loop to NaN, so that all its results are NaN, if its polynomials have large rounding errors,
        # or if its device is so fast that a scene with this device may be rejected as invalid.
        exact = xp.all(xp.stack([compare_responses(form, loop, states, w) for w in TEST_ANGLES]), 0)
        slow = xp.max(xp.abs(A), (1, 2)) < LARGEST_RATE
        loop = loop._replace(gain=xp.where(exact & slow, loop.gain, np.nan))
    return DeviceBatch(form, loop, states)


def compare_responses(form: Form, loop: LoopBatch, states: SampledStates, w: Any) -> Array:
    """Return whether q = -1/G from the polynomials agrees with q from the matrices at angles w, per loop."""
    xp = namespace(loop.gain)
    w = w + 0.0 * loop.numerator[0]
    points = circle_points(xp.where(xp.isfinite(w), w, 0.5))
    return xp.abs(evaluate(form, loop, points.w).q / states.controller(points) - 1.0) < RESPONSE_TOLERANCE


def _discretize_rigid(damping: Any, fraction: Any, size: int) -> _SampledBatch:
    """Return the sampled plant G of rigid masses in closed form."""
    xp = namespace(damping, fraction)
    delta = xp.broadcast_to(xp.asarray(damping), (size,)) + 0.0
    plant = discretize_mass(delta, xp.broadcast_to(xp.asarray(fraction), (size,)) + 0.0)
    h, q = factor_numerator(plant)
    one = xp.ones_like(delta)
    return _SampledBatch(
        xp.stack([plant.a2 + plant.a1 + plant.a0, 2.0 * plant.a2 + plant.a1, plant.a2]),
        xp.stack([0.0 * one, plant.em, one]),
        xp.stack([one + h / plant.a2, one + q]) + 0j,
        xp.stack([0.0 * one, plant.em]) + 0j,
        xp.where(delta > 0, 1.0, 2.0),
    )


def _stack_states(chain: AnyChain, size: int) -> tuple[Array, Array]:
    """Return the state matrices, shape (size, n, n), and input vectors, shape (size, n), of a chain."""
    if not isinstance(chain, System):
        A, B, _ = chain.realize()
        xp = namespace(A)
        A, B = (
            xp.broadcast_to(part[..., None] if part.ndim == axes else part, (*part.shape[:axes], size))
            for part, axes in ((A, 2), (B, 1))
        )
        return xp.moveaxis(A, -1, 0) + 0.0, xp.moveaxis(B, -1, 0) + 0.0
    # Realize the linear system in units of 1 s and 1 kg, then convert the matrices to the units of each loop.
    A, B, _ = System(chain.device, 1.0, 1.0, chain.d, chain.n_delay, chain.estimate).realize()
    xp = namespace(chain.period, chain.mass)
    period = xp.broadcast_to(xp.asarray(chain.period), (size,))[:, None]
    return A * period[..., None], B * (chain.mass / period)


def _sample(A: Array, B: Array, chain: AnyChain) -> SampledStates:
    """Discretize devices in state space; for integer delays ``late`` is ``full``, which adds a zero of G at z = 0."""
    fraction = chain.d - chain.n_delay
    psi, full = integrate_chain(chain, A, B, 1.0)
    late = full if is_zero(fraction) else integrate_chain(chain, A, B, 1.0 - fraction)[1]
    return SampledStates(psi, full, late, chain.n_delay)


def _factor(chain: AnyChain, states: SampledStates) -> _SampledBatch:
    """Return the sampled plants G of discretized devices as polynomials, with their zeros and poles."""
    psi, late = states.psi, states.late
    xp = namespace(psi)
    zeros = -xp.linalg.eigvals(_realize_zeros(states)).T + 0j
    offsets, integrators = _find_poles(chain, psi)
    return _SampledBatch(late[:, 0] * _expand(zeros), _expand(offsets), zeros, offsets, integrators)


def _realize_zeros(states: SampledStates) -> Array:
    """Return matrices whose eigenvalues are the zeros of G in ``zeta = z - 1``.

    At a zero of G, a state x and a force u exist with ``(zeta - Psi) x = (zeta late + full) u`` and the position 0. The
    position is the first entry of x. Let y be ``x - late u`` without its first entry; then (y, u) is an eigenvector.
    """
    xp = namespace(states.psi)
    psi, full, late, _ = states
    inner, row = psi[:, 1:, 1:], psi[:, :1, 1:]
    column = inner @ late[:, 1:, None] + full[:, 1:, None]
    last = xp.concatenate([row, row @ late[:, 1:, None] + full[:, :1, None]], -1) / -late[:, :1, None]
    matrix = xp.concatenate([xp.concatenate([inner, column], -1), last], -2)
    return xp.where(xp.isfinite(matrix), matrix, 0.0)


def _expand(offsets: Array) -> Array:
    """Return the coefficients of ``prod(zeta + offset)``, lowest power first."""
    xp = namespace(offsets)
    one, zero = xp.ones_like(offsets[:1]), xp.zeros_like(offsets[:1])
    product = one
    for offset in offsets:
        product = xp.concatenate([zero, product]) + offset * xp.concatenate([product, zero])
    return product.real


def _find_poles(chain: AnyChain, psi: Array) -> tuple[Array, Array]:
    """Return the offsets 1 - z of all poles of G, and the number of poles at z = 1, which come first."""
    xp, size = namespace(psi), psi.shape[0]
    if isinstance(chain, System):
        device = chain.device
        poles = device.poles[np.argsort(np.abs(device.poles))][:, None]
        offsets = xp.broadcast_to(-xp.expm1(poles * xp.asarray(chain.period)), (poles.size, size))
        return offsets, xp.full((size,), float(np.sum(poles == 0)))
    offsets = -xp.linalg.eigvals(xp.where(xp.isfinite(psi), psi, 0.0)).T + 0j
    if not all(is_zero(body.stiffness) for body in chain.bodies):
        return offsets, xp.zeros(size)
    # One pole is at z = 1, and a second one if no damper connects the device to ground.
    offsets = xp.take_along_axis(offsets, xp.argsort(xp.abs(offsets), 0), 0)
    damping = sum(body.damping for body in chain.bodies) + xp.zeros(size)
    count = xp.where(damping > 0, 1.0, 2.0)
    return xp.where(xp.arange(offsets.shape[0])[:, None] < count, 0.0, offsets), count


BLOCK_SIZE = 1 << 9  # loops per call; their arrays fit in the cache
LONGEST_DELAY = 24  # in periods; longer delays need so many evaluations that a batch saves little time


def map_loops(
    scene: Parts, values: dict[str, np.ndarray], d: np.ndarray, function: Callable[..., tuple[np.ndarray, ...]]
) -> list[np.ndarray]:
    """Apply a function to the loops of many scenes of one structure, in blocks of loops that have equally many nodes.

    The results for a scene are bit for bit the same, whatever the other scenes are.

    Args:
        scene: one scene of this structure; parameters that are not in ``values`` have its values in all scenes.
        values: varied parameters by dotted path, arrays of shape (scenes,).
        d: delays in periods, at most `LONGEST_DELAY`, shape (scenes,) with at least one scene.
        function: function of five arguments (form, loops, `Sizes`, discretized devices, indices of the scenes) that
            returns arrays whose last axis is that of the loops.

    Returns:
        The arrays of the function for all scenes.
    """
    whole, tasks = np.floor(d), []
    for n in np.unique(whole).astype(int).tolist():
        index = pad_index(np.flatnonzero(whole == n))
        filled = fill_parameters(scene, {path: column[index] for path, column in values.items()})
        fraction = d[index] if np.any(d[index] != n) else np.float64(n)
        batch = build_loops(build_chain(filled, (fraction, n)), index.size)
        sizes, group = np.unique(count_nodes(batch.form, batch.loop), axis=1, return_inverse=True)
        for k, column in enumerate(sizes.T.tolist()):
            members = np.flatnonzero(group.reshape(-1) == k)
            tasks += [
                (batch, Sizes(*column), index, members[start : start + BLOCK_SIZE])
                for start in range(0, members.size, BLOCK_SIZE)
            ]

    def run(task: tuple[DeviceBatch, Sizes, np.ndarray, np.ndarray]) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        batch, sizes, index, members = task
        padded = pad_index(members)
        states = batch.states
        if states is not None:
            states = SampledStates(states.psi[padded], states.full[padded], states.late[padded], states.n_delay)
        with np.errstate(all="ignore"):
            results = function(batch.form, batch.loop.take(padded), sizes, states, index[padded])
        return index[members], tuple(part[..., : members.size] for part in results)

    whole_results: list[np.ndarray] = []
    for index, results in run_in_threads(run, tasks):
        whole_results = whole_results or [np.zeros((*part.shape[:-1], d.size), part.dtype) for part in results]
        for to, part in zip(whole_results, results, strict=True):
            to[..., index] = part
    return whole_results
