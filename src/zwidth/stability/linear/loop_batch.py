"""Evaluate the plant G and velocity estimate F of many loops at angles w on the unit circle, in NumPy or JAX.

Each loop is evaluated at its own *nodes*, a list of angles w; ``q = -1/G`` is the critical controller. All loops of a
batch have the same *form*: orders, integer delay and window of the velocity estimate. The last axis of every array is
that of the loops, the first axis that of coefficients, roots or angles. Roots are stored as *offsets* 1 - z, and
polynomials by their coefficients in ``zeta = z - 1`` (`stability.linear.roots`). On a line of walls, k(w) is the
function whose zeros are the angles of poles on the unit circle (`stability.linear.batch_lines`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import namespace, tree_map
from zwidth.model.circle_functions import CirclePoints, Jet, circle_points, distances_inside
from zwidth.model.estimate import Estimate

# Nodes, as angles w in rad. They are geometrically spaced towards w = 0 and w = pi, equidistant between these ranges,
# and condensed near zeros of G and poles of F that are close to the unit circle, where q or F changes fast.
SPLIT = 0.3  # width of the two ranges with geometric spacing
FIRST_NODE = 1e-3  # first node, relative to the distance of the nearest root from z = 1
LAST_NODE = 1e-4  # scale of pi - w of the last node, as in `stability.linear.curve.place_nodes`
LOW_RATIO, HIGH_RATIO = 0.2, 0.25  # steps in log w near 0, and in log(pi - w) near pi
STEP, PHASE_STEP = 0.08, 0.4  # in rad between these ranges: largest step of w, and of the phases of powers of z
BUCKET = 32  # the numbers of nodes in the ranges are multiples of this, so that many loops have arrays of equal shape
# A zero of G or pole of F has additional nodes if its distance from the unit circle is below this fraction of its angle
# (of 1 rad for larger angles).
NEAR_CIRCLE = 0.25
CLUSTER_NODES = 31  # number of additional nodes near one root
CLUSTER_REACH = 0.15  # largest distance of these additional nodes from the angle of the root, in rad
CLOSEST = 1e-7  # distance from the unit circle, in rad, below which the spacing of these nodes decreases no further
# A step between two nodes counts as resolved if the sum of step/distance over all zeros of G and poles of F is below
# this limit. The limit is below 2, the ratio for a root in the middle of the step.
RESOLUTION = 1.9
INSIDE = 1e-10  # a pole inside the unit circle by less than this, relative to |1 - z|, counts as on the circle


class Form(NamedTuple):
    """The structure that all loops of a batch share."""

    lag: int  # power of 1/z in G: the integer delay plus 1
    window: int  # window of the velocity estimate F in samples; 0 without a window
    estimate_lag: int  # power of 1/z in F

    @property
    def phase_rate(self) -> float:
        """Upper bound of the derivative in w of the phases of all powers of z in q and F."""
        return self.lag + self.window + abs(self.estimate_lag) + 1.0


class LoopBatch(NamedTuple):
    """Loops without their walls: ``G = numerator/(denominator z^lag)``, polynomials in z - 1, lowest power first."""

    numerator: Array  # shape (coefficients, loops)
    denominator: Array
    gain: Array  # gain of F, shape (loops,)
    zeros: Array  # offsets 1 - z of the zeros of F, shape (zeros, loops)
    poles: Array  # offsets 1 - z of the poles of F
    plant_zeros: Array  # offsets 1 - z of the zeros of G
    plant_poles: Array  # offsets 1 - z of the poles of G; poles at z = 1 come first
    integrators: Array  # number of poles of G at z = 1

    def take(self, index: Array) -> LoopBatch:
        """Return the loops with the given indices."""
        return LoopBatch(*(leaf[..., index] for leaf in self))


class Values(NamedTuple):
    """The critical controller q, the velocity estimate F, and their derivatives in w, at angles w."""

    q: Array
    q_slope: Array
    f: Array
    f_slope: Array


def evaluate(form: Form, loop: LoopBatch, w: Array) -> Values:
    """Return q = -1/G, F, and their derivatives in w, at angles w of shape (..., loops)."""
    xp, points = namespace(w), circle_points(w)
    top, top_slope = _horner(loop.numerator, points.z_minus_1)
    bottom, bottom_slope = _horner(loop.denominator, points.z_minus_1)
    power = xp.where(w >= np.pi, (-1.0) ** form.lag + 0j, xp.exp(1j * form.lag * w))
    ratio = bottom / top
    slope = -power * (1j * points.z * (bottom_slope - ratio * top_slope) / top + 1j * form.lag * ratio)
    f = Estimate(form.window, loop.gain, form.estimate_lag).jet(points)
    for offset in loop.zeros:
        f = f.times(_subtract_root(points, offset))
    for offset in loop.poles:
        f = f.over(_subtract_root(points, offset))
    return Values(-power * ratio, slope, f.value, f.slope)


def _subtract_root(points: CirclePoints, offset: Array) -> Jet:
    """Return z - root and its derivative in w, from the offset 1 - root, without cancellation near z = 1 and z = -1."""
    xp = namespace(points.w)
    value, left = points.z_minus_1 + offset, offset.real > 1.0
    if xp is not np or left.any():
        # For roots near z = -1 compute z - root from z + 1, which is accurate near z = -1 (V16).
        value = xp.where(left, points.z_plus_1 + (offset - 2.0), value)
    return Jet(value, 1j * points.z)


def _horner(coefficients: Array, x: Array) -> tuple[Array, Array]:
    """Return the values of a polynomial and of its derivative at x, from coefficients in order of ascending powers."""
    value, slope = coefficients[-1] + 0.0 * x, 0.0 * x
    for coefficient in coefficients[-2::-1]:
        value, slope = value * x + coefficient, slope * x + value
    return value, slope


class Sizes(NamedTuple):
    """Numbers of nodes of a loop, which determine the shapes of all arrays."""

    low: int  # nodes near w = 0
    high: int  # nodes near w = pi
    clusters: int  # zeros of G and poles of F that have additional nodes
    density: int = 1  # factor by which all numbers of nodes are multiplied


def count_nodes(form: Form, loop: LoopBatch) -> np.ndarray:
    """Return the `Sizes` of each loop of a NumPy batch, shape (3, loops).

    Loops of equal sizes can be computed together. Neither the sizes of a loop nor its results depend on the other
    loops.
    """
    first, last = _find_ends(form, loop)
    counts = np.log(SPLIT / np.stack([first, last])) / np.array([[LOW_RATIO], [HIGH_RATIO]])
    return np.concatenate([BUCKET * np.ceil(counts / BUCKET), _find_near(loop)[2].sum(0)[None]]).astype(int)


def _find_ends(form: Form, loop: LoopBatch) -> tuple[Array, Array]:
    """Return the angle of the first node, and pi minus the angle of the last node."""
    xp = namespace(loop.gain)
    roots = xp.concatenate([loop.plant_zeros, loop.plant_poles, loop.zeros, loop.poles])
    ends = []
    for offset in (0.0, 2.0):
        distance = xp.abs(roots - offset)
        nearest = xp.min(xp.where(distance > 1e-13, distance, np.inf), 0)
        ends.append(xp.minimum(nearest, 1.0 / form.phase_rate))
    return FIRST_NODE * ends[0], LAST_NODE * ends[1] ** (2.0 / 3.0)


def _find_near(loop: LoopBatch) -> tuple[Array, Array, Array]:
    """Return angle, distance from the unit circle, and a flag for each zero of G and pole of F.

    The flag is True for roots in the upper half-plane that are so close to the unit circle that they need more nodes.
    """
    xp = namespace(loop.gain)
    roots = xp.concatenate([loop.plant_zeros, loop.poles])
    angle, distance = xp.angle(1.0 - roots), xp.abs(distances_inside(roots))
    near = (angle > 1e-9) & (angle < np.pi - 1e-9) & (distance < NEAR_CIRCLE * xp.minimum(angle, 1.0))
    return angle, distance, near


def place_nodes(form: Form, loop: LoopBatch, sizes: Sizes) -> Array:
    """Return the angles of the nodes, ascending, shape (nodes, loops)."""
    xp = namespace(loop.gain)
    first, last = _find_ends(form, loop)
    counts = sizes.density * sizes.low, sizes.density * sizes.high
    low, high = (xp.asarray(np.linspace(0.0, 1.0, count)[:, None]) for count in counts)
    inner = sizes.density * int(np.ceil((np.pi - 2.0 * SPLIT) / min(STEP, PHASE_STEP / form.phase_rate))) + 1
    middle = xp.asarray(np.linspace(SPLIT, np.pi - SPLIT, inner)[1:-1, None])
    parts = [first * (SPLIT / first) ** low, middle + 0.0 * first, np.pi - SPLIT * (last / SPLIT) ** high]
    if not sizes.clusters:
        return xp.concatenate(parts)
    angle, distance, near = _find_near(loop)
    order = xp.argsort(xp.where(near, distance, np.inf), 0)[: sizes.clusters]
    cluster = xp.asarray(np.linspace(-1.0, 1.0, sizes.density * CLUSTER_NODES)[:, None])
    for row in order:
        radius, center = (xp.take_along_axis(part, row[None], 0)[0] for part in (distance, angle))
        radius = xp.maximum(radius, CLOSEST)
        offset = radius * xp.sinh(xp.arcsinh(CLUSTER_REACH / radius) * cluster)
        parts.append(xp.clip(center + offset, first, np.pi - last))
    return xp.sort(xp.concatenate(parts), 0)


class Sampled(NamedTuple):
    """Loops with values of q and F at their nodes, from which k(w) of any line of walls can be computed (V23)."""

    form: Form
    loop: LoopBatch
    w: Array
    parts: tuple[Array, Array, Array]  # Im q, Im(q conj F), Im F
    slopes: tuple[Array, Array, Array]  # derivatives in w of the three ``parts``
    levels: tuple[Array, Array]  # Re(q conj F)/|F|^2 and Re F/|F|^2: the first minus alpha times the second is beta
    ends: Values  # q and F at z = -1
    resolved: Array  # for each loop: True if the nodes resolve q and F

    def take(self, index: Array) -> Sampled:
        """Return the values of a selection of loops, given the indices of these loops."""
        return Sampled(self.form, *tree_map(lambda part: part[..., index], tuple(self[1:])))

    def count_start(self, k_first: Array) -> Array:
        """Return the number of poles outside the unit circle for the softest walls of a ray, from k at the first node.

        A ray is a line of walls that starts at K = B = 0.
        """
        # For K = B = 0, one or two poles are at z = 1, and all other poles are inside the unit circle. For the softest
        # walls of the ray, the poles near z = 1 are outside if k > 0 at small angles, and inside otherwise (V23).
        xp = namespace(k_first)
        return xp.where(k_first < 0, 0.0, self.loop.integrators)


def sample(form: Form, loop: LoopBatch, sizes: Sizes) -> Sampled:
    """Evaluate q and F of loops at their nodes."""
    xp, w = namespace(loop.gain), place_nodes(form, loop, sizes)
    values = evaluate(form, loop, w)
    parts, slopes = split_values(values)
    size = values.f.real**2 + values.f.imag**2
    levels = (values.q.real * values.f.real + values.q.imag * values.f.imag) / size, values.f.real / size
    points = circle_points(w)
    crowding = form.phase_rate + 0.0 * w
    for root in (*loop.plant_zeros, *loop.poles):
        crowding = crowding + 1.0 / xp.abs(points.z_minus_1 + root)
    crowding = xp.maximum(crowding[1:], crowding[:-1]) * (w[1:] - w[:-1])
    decaying = distances_inside(loop.plant_poles) > INSIDE * xp.abs(loop.plant_poles)
    decaying = decaying | (xp.arange(loop.plant_poles.shape[0])[:, None] < loop.integrators)
    resolved = xp.all(crowding < RESOLUTION, 0) & xp.all(decaying, 0) & (loop.integrators <= 2)
    # Mark loops with a negative static gain as not resolved, because a wall with K > 0 then may have a pole at z = 1,
    # which the pole counts along lines do not include.
    resolved = resolved & (loop.numerator[0] * loop.denominator[0] >= 0)
    ends = evaluate(form, loop, np.pi + 0.0 * loop.gain)
    return Sampled(form, loop, w, parts, slopes, levels, ends, resolved)


def split_values(values: Values) -> tuple[tuple[Array, Array, Array], tuple[Array, Array, Array]]:
    """Return Im q, Im(q conj F) and Im F, and their derivatives in w, for q = -1/G and the velocity estimate F."""
    q, q_slope, f, f_slope = values
    cross = q.imag * f.real - q.real * f.imag
    cross_slope = q_slope.imag * f.real - q_slope.real * f.imag + q.imag * f_slope.real - q.real * f_slope.imag
    return (q.imag + 0.0, cross, f.imag + 0.0), (q_slope.imag + 0.0, cross_slope, f_slope.imag + 0.0)
