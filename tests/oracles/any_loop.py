"""Any linear scene by another way than the library's: absolute coordinates, a dense exponential, every delay a state.

Nothing here shares a formula with `zwidth.loops.linear`: bodies are described by masses, dampers and springs, filters
by their difference equations, the loop by one matrix whose eigenvalues are the poles. `ball_parts` does the same in
arithmetic that bounds its own error, for labels where float64 cannot tell.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import flint
import numpy as np
import scipy.linalg
import scipy.signal

import zwidth


def _masses_and_links(scene: Any) -> tuple[list[list[float]], list[tuple[float, float]]]:
    """Mass, damping and spring to ground of every body; spring and damper between neighbors."""
    bodies, links = [[scene.device.mass, scene.device.damping, 0.0]], []
    tip, hand = scene.device.coupling, scene.operator
    if tip is not None:
        bodies.append([tip.mass, 0.0, 0.0])
        links.append((tip.stiffness, tip.damping))
    if hand is not None and hand.coupling_stiffness is None:
        held = bodies[-1]
        bodies[-1] = [a + b for a, b in zip(held, (hand.mass, hand.damping, hand.stiffness), strict=True)]
    elif hand is not None:
        bodies.append([hand.mass, hand.damping, hand.stiffness])
        links.append((hand.coupling_stiffness, hand.coupling_damping))
    return bodies, links


def _rates(scene: Any, number: Any = float) -> tuple[list[list[Any]], int, np.ndarray]:
    """A and B of ``x' = A x + B u`` as one table ``[[A, B], [0, 0]]``; the size of A; what the sensor sees, as a row.

    The state: positions and velocities of the bodies, position and velocity of each mode, the actuator's force and,
    where it is of second order, its rate.
    """
    if isinstance(scene.device, zwidth.LinearDevice):
        return _companion(scene.device, number)
    bodies, links = _masses_and_links(scene)
    n, modes, lag = len(bodies), scene.device.modes, scene.device.actuator
    size = 2 * n + 2 * len(modes) + (lag.order if lag else 0)
    table = [[number(0)] * (size + 1) for _ in range(size + 1)]
    for k, (mass, damping, stiffness) in enumerate(bodies):
        table[k][n + k] = number(1)
        table[n + k][k] -= number(stiffness) / number(mass)
        table[n + k][n + k] -= number(damping) / number(mass)
    for k, pair in enumerate(links):
        for place, value in zip((0, n), pair, strict=True):
            for at, other in ((k, k + 1), (k + 1, k)):
                share = number(value) / number(bodies[at][0])
                table[n + at][place + at] -= share
                table[n + at][place + other] += share
    tip = scene.device.coupling
    seen = np.zeros(size)
    seen[int(tip is not None and tip.sensor == "tip")] = 1.0
    acts = size if lag is None else size - lag.order
    table[n][acts] = 1 / number(bodies[0][0])
    turn = 2 * (flint.arb.pi() if number is _ball else np.pi)
    for k, mode in enumerate(modes):
        at, w = 2 * (n + k), turn * number(mode.frequency)
        table[at][at + 1] = number(1)
        table[at + 1][at], table[at + 1][at + 1] = -w * w, -2 * number(mode.damping_ratio) * w
        table[at + 1][acts] = 1 / number(mode.mass)
        seen[at] = 1.0
    if lag is not None:
        w = 1 / number(lag.time_constant) if lag.cutoff is None else turn * number(lag.cutoff)
        if lag.order == 1:
            table[acts][acts], table[acts][size] = -w, w
        else:
            table[acts][acts + 1] = number(1)
            table[acts + 1][acts], table[acts + 1][acts + 1] = -w * w, -2 * number(lag.damping_ratio) * w
            table[acts + 1][size] = w * w
    return table, size, seen


def continuous(scene: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A, B and the sensor row of the device in continuous time, in SI units."""
    table, size, seen = _rates(scene)
    rate = np.array(table)
    return rate[:size, :size], rate[:size, size], seen


def flow(a: np.ndarray, b: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the transition matrix over a time, and the state after a unit force from rest."""
    size = len(b)
    block = np.zeros((size + 1, size + 1))
    block[:size, :size], block[:size, size] = a * time, b * time
    block = scipy.linalg.expm(block)
    return block[:size, :size], block[:size, size]


def _companion(device: Any, number: Any) -> tuple[list[list[Any]], int, np.ndarray]:
    """The same of a linear device that is not sampled, by its coefficients in a unit of time of about its own."""
    bottom, top = (
        [value / device.system.denominator[0] for value in part]
        for part in (device.system.denominator, device.system.numerator)
    )
    size = len(bottom) - 1
    table = [[number(0)] * (size + 1) for _ in range(size + 1)]

    def exact(value: Any) -> Any:
        return number(flint.fmpq(value.numerator, value.denominator)) if number is _ball else float(value)

    for k in range(size - 1):
        table[k][k + 1] = number(1)
    table[size - 1] = [*(-exact(value) for value in bottom[:0:-1]), number(1)]
    seen = np.array([exact(value) for value in top[::-1]] + [number(0)] * (size - len(top)), object)
    return table, size, seen if number is _ball else seen.astype(float)


def velocity_polynomials(scene: Any) -> tuple[np.ndarray, np.ndarray]:
    """Numerator and denominator of the velocity estimate in m and s, highest power first, of one length."""
    velocity, period = scene.velocity, scene.timing.period
    period = getattr(velocity, "coded_period", None) or period
    top, bottom = np.array([1.0, -1.0]) / period, np.array([1.0, 0.0])
    if isinstance(velocity, zwidth.VelocityFilter):
        top, bottom = np.array(velocity.numerator), np.array(velocity.denominator)
    elif isinstance(velocity, zwidth.WindowedDifference):
        top, bottom = np.zeros(velocity.samples + 1), np.zeros(velocity.samples + 1)
        top[[0, -1]] = 1.0 / (velocity.samples * period), -1.0 / (velocity.samples * period)
        bottom[0] = 1.0
    elif isinstance(velocity, zwidth.LowPass):
        tau = velocity.time_constant or 1.0 / (2.0 * np.pi * velocity.cutoff)
        p = np.exp(-period / tau)
        for _ in range(velocity.order):
            top, bottom = np.convolve(top, [-np.expm1(-period / tau), 0.0]), np.convolve(bottom, [1.0, -p])
    elif isinstance(velocity, zwidth.Butterworth):
        designed: Any = scipy.signal.butter(velocity.order, 2.0 * velocity.cutoff * period)
        top, bottom = np.convolve(designed[0], top), np.convolve(designed[1], bottom)
    return np.concatenate([np.zeros(bottom.size - top.size), top]), bottom


def _sample(scene: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the transition over a period, the effects of the newer and the older force, and the sensor row."""
    a, b, seen = continuous(scene)
    period, fraction = scene.timing.period, scene.d - scene.whole_delay
    rest, newer = flow(a, b, (1.0 - fraction) * period)
    return flow(a, b, period)[0], newer, rest @ flow(a, b, fraction * period)[1], seen


def closed_loop_matrix(scene: Any, stiffness: float, virtual_damping: float) -> np.ndarray:
    """One period of the closed loop; state: positions, velocities, filter, then the forces on their way."""
    step, newer, older, seen = _sample(scene)
    size, late = len(step), scene.whole_delay
    fraction = scene.d - late
    top, bottom = velocity_polynomials(scene)
    top, bottom = top / bottom[0], bottom / bottom[0]
    order = bottom.size - 1
    queue = late + (1 if fraction else 0)
    total = size + order + queue
    force = np.zeros(total)
    force[:size] = -(stiffness + virtual_damping * top[0]) * seen
    force[size : size + order] = -virtual_damping * (top[1:] - top[0] * bottom[1:])

    def sample(age: int) -> np.ndarray:
        """The force computed so many samples ago, as a row of the state."""
        return force if age == 0 else np.eye(total)[size + order + age - 1]

    matrix = np.zeros((total, total))
    matrix[:size, :size] = step
    matrix[:size] += np.outer(newer, sample(late))
    if fraction:
        matrix[:size] += np.outer(older, sample(late + 1))
    if order:
        matrix[size, size : size + order] = -bottom[1:]
        matrix[size + 1 : size + order, size : size + order - 1] = np.eye(order - 1)
        matrix[size, :size] += seen
    for age in range(queue):
        matrix[size + order + age] = sample(age)
    return matrix


def spectral_radius(scene: Any, stiffness: float, virtual_damping: float) -> float:
    """The largest magnitude of a pole."""
    return float(np.abs(np.linalg.eigvals(closed_loop_matrix(scene, stiffness, virtual_damping))).max())


def _ball(value: Any) -> flint.arb:
    return flint.arb(value)


def _ball_filter(scene: Any) -> tuple[flint.acb_poly, flint.acb_poly]:
    """The velocity estimate in balls, lowest power first as flint keeps them."""
    velocity, period = scene.velocity, _ball(scene.timing.period)
    if isinstance(velocity, zwidth.VelocityFilter):
        parts = [flint.acb_poly([_ball(c) for c in p[::-1]]) for p in (velocity.numerator, velocity.denominator)]
        return parts[0], parts[1]
    coded = getattr(velocity, "coded_period", None)
    period = period if coded is None else _ball(coded)
    z = flint.acb_poly([0, 1])
    if isinstance(velocity, zwidth.WindowedDifference):
        power = z**velocity.samples
        return (power - 1) * (1 / (period * velocity.samples)), power
    top, bottom = (z - 1) * (1 / period), z
    if isinstance(velocity, zwidth.LowPass):
        rate = 1 / _ball(velocity.time_constant) if velocity.time_constant else 2 * flint.arb.pi() * velocity.cutoff
        p = (-period * rate).exp()
        for _ in range(velocity.order):
            top, bottom = top * z * (1 - p), bottom * (z - p)
    if isinstance(velocity, zwidth.Butterworth):
        warped = (flint.arb.pi() * _ball(velocity.cutoff) * period).tan()
        for k in range(velocity.order):
            angle = flint.arb.pi() * (2 * k + 1 + velocity.order) / (2 * velocity.order)
            s = warped * flint.acb(angle.cos(), angle.sin())
            # s/(bilinear - s) with the bilinear (z - 1)/(z + 1).
            top, bottom = top * (z + 1) * (-s), bottom * ((z - 1) - (z + 1) * s)
    return top, bottom


def ball_parts(scene: Any) -> tuple[flint.acb_poly, flint.acb_poly, flint.acb_poly]:
    """``P = D + K N1 + B N2`` in SI units, in the precision of `flint.ctx`."""
    table, size, sees = _rates(scene, _ball)
    late = scene.whole_delay
    fraction = _ball(scene.d) - late
    rate = flint.arb_mat(table) * _ball(scene.timing.period)
    step, rest, first = (_top((rate * part).exp(), size) for part in (_ball(1), 1 - fraction, fraction))
    own = step[0].charpoly()

    def answer(push: flint.arb_mat) -> flint.arb_poly:
        """``C adj(z - step) push`` as the change of the determinant."""
        seen = flint.arb_mat(size, size, [push[i, 0] * sees[j] for i in range(size) for j in range(size)])
        return (step[0] - seen).charpoly() - own

    z = flint.acb_poly([0, 1])
    top, bottom = _ball_filter(scene)
    if scene.d == late:
        device, moved = z**late * flint.acb_poly(own), flint.acb_poly(answer(rest[1]))
    else:
        older = flint.acb_poly(answer(rest[0] * first[1]))
        device, moved = z ** (late + 1) * flint.acb_poly(own), z * flint.acb_poly(answer(rest[1])) + older
    return device * bottom, moved * bottom, moved * top


def _top(block: flint.arb_mat, size: int) -> tuple[flint.arb_mat, flint.arb_mat]:
    a = flint.arb_mat(size, size, [block[i, j] for i in range(size) for j in range(size)])
    return a, flint.arb_mat(size, 1, [block[i, size] for i in range(size)])


def count_outside(scene: Any, stiffness: float, virtual_damping: float, digits: int = 60) -> int | None:
    """Poles outside the unit circle, proved by disjoint balls; None where one ball meets the circle."""
    before = flint.ctx.dps
    try:
        flint.ctx.dps = digits
        device, spring, damper = ball_parts(scene)
        polynomial = device + spring * _ball(stiffness) + damper * _ball(virtual_damping)
        outside = 0
        for root in nonzero(polynomial).roots(tol=10.0 ** (-digits // 2)):
            size = abs(root)
            if size > 1:
                outside += 1
            elif not size < 1:
                return None
        return outside
    except ValueError:
        return None
    finally:
        flint.ctx.dps = before


def proved_poles(
    scene: Any, stiffness: float, virtual_damping: float, found: np.ndarray, digits: int = 90
) -> tuple[np.ndarray, np.ndarray]:
    """Poles less 1 from balls, and how much each found one misses ``P = 0``, in units of the sizes of its terms.

    The second is the backward error: a loop whose D, K and B are moved by that share of themselves has this pole.
    """
    before = flint.ctx.dps
    try:
        flint.ctx.dps = digits
        device, spring, damper = ball_parts(scene)
        terms = device, spring * _ball(stiffness), damper * _ball(virtual_damping)
        roots = nonzero(terms[0] + terms[1] + terms[2]).roots(tol=10.0 ** (-digits // 2))
        missed = []
        for zeta in found.tolist():
            z = 1 + flint.acb(zeta.real, zeta.imag)
            values = [term(z) for term in terms]
            size = abs(values[0]) + abs(values[1]) + abs(values[2])
            missed.append(float((abs(values[0] + values[1] + values[2]) / size).mid()))
        return np.array([_number(root - 1) for root in roots]), np.array(missed)
    finally:
        flint.ctx.dps = before


def proved_zeros(scene: Any, digits: int = 90) -> np.ndarray:
    """Zeros less 1 of the device's answer, behind the backward difference."""
    before = flint.ctx.dps
    try:
        flint.ctx.dps = digits
        return np.array([_number(root - 1) for root in nonzero(ball_parts(scene)[1]).roots(tol=10.0 ** (-digits // 2))])
    finally:
        flint.ctx.dps = before


def _number(ball: flint.acb) -> complex:
    return complex(float(ball.real.mid()), float(ball.imag.mid()))


def nonzero(polynomial: flint.acb_poly) -> flint.acb_poly:
    """Without its roots at 0, which lie inside: exact ones, and those of modes gone within a sample."""
    parts = polynomial.coeffs()
    largest = max(abs(part).abs_upper() for part in parts)
    while parts and abs(parts[0]) < largest * flint.arb(10) ** -40:
        parts = parts[1:]
    return flint.acb_poly(parts)


def scene_of(parts: dict[str, Any]) -> zwidth.Scene:
    """A scene from plain numbers, as reference files hold them: each part by its name, the velocity with its kind."""
    device = dict(parts["device"])
    if coupling := device.pop("coupling", None):
        device["coupling"] = zwidth.Coupling(**coupling)
    velocity = dict(parts.get("velocity", {"kind": "BackwardDifference"}))
    estimate = getattr(zwidth, velocity.pop("kind"))(**velocity)
    hand = zwidth.Operator(**parts["operator"]) if parts.get("operator") else None
    return zwidth.Scene(zwidth.Device(**device), zwidth.Timing(**parts["timing"]), velocity=estimate, operator=hand)


def random_scene(kind: str, generator: np.random.Generator) -> zwidth.Scene:
    """One random scene of a kind of `KINDS`: filters, hands, couplings soft and stiff, whole delays and not."""
    draw = generator.uniform
    mass, period = 10 ** draw(-1.5, 0.5), 10 ** draw(-4, -2.5)
    coupling = hand = None
    velocity: Any = zwidth.BackwardDifference()
    if kind in ("tip", "motor", "all"):
        sensor = kind if kind != "all" else str(generator.choice(["tip", "motor"]))
        stiffness = mass / period**2 * 10 ** draw(-3, 0.5)
        damping = float(generator.choice([0.0, mass / period * 10 ** draw(-3, -0.5)]))
        coupling = zwidth.Coupling(mass * 10 ** draw(-1, 0.5), stiffness, damping, sensor)  # type: ignore[arg-type]
    if kind in ("hand", "soft hand", "all"):
        hand_mass, damping, stiffness = mass * 10 ** draw(-1, 1), 10 ** draw(-1, 1), 10 ** draw(1, 3)
        soft = kind == "soft hand" or (kind == "all" and draw() < 0.5)
        behind = {"coupling_stiffness": 10 ** draw(2, 4), "coupling_damping": 10 ** draw(-1, 1)} if soft else {}
        hand = zwidth.Operator(hand_mass, damping, stiffness, **behind)
    if kind in ("filter", "all"):
        cutoff = 10 ** draw(-2.5, -0.4) / period
        velocity = (
            zwidth.BackwardDifference(),
            zwidth.WindowedDifference(int(generator.integers(2, 15))),
            zwidth.LowPass(cutoff=cutoff),
            zwidth.LowPass(time_constant=period * 10 ** draw(-0.5, 1.5), order=2),
            zwidth.Butterworth(max(cutoff, 0.02 / period), int(generator.integers(1, 5))),
            zwidth.VelocityFilter(np.convolve([1.0, -1.0], [1.0, 0.3]) / period / 1.3, [1.0, -0.2, 0.0]),
        )[generator.integers(0, 6)]
    device = zwidth.Device(mass, float(generator.choice([0.0, 10 ** draw(-1, 1.5)])), coupling)
    if kind == "driven":
        rate = 10 ** draw(-2, 1) / period
        lag = zwidth.Actuator(rate) if draw() < 0.5 else zwidth.Actuator(rate, order=2, damping_ratio=10 ** draw(-1, 0))
        modes = [
            zwidth.Mode(10 ** draw(-2.5, -0.1) / period, 10 ** draw(-3, -0.7), mass * 10 ** draw(0, 2) * sign)
            for sign in generator.choice([1.0, 1.0, -1.0], generator.integers(0, 3))
        ]
        device = replace(device, modes=modes, actuator=lag if draw() < 0.6 or not modes else None)
    whole, odd = int(generator.integers(0, 12)), float(draw(0, 8))
    periods = float(generator.choice([0, 1, whole, odd, 0.3, np.nextafter(3, 0)]))
    return zwidth.Scene(device, zwidth.Timing(period, periods * period), velocity=velocity, operator=hand)


KINDS = ("device", "filter", "tip", "motor", "hand", "soft hand", "all", "driven")


def row_ends(scene: Any, virtual_damping: float, angles: int = 4000) -> tuple[np.ndarray, float]:
    """Every stiffness that puts a pole on the unit circle at a damping, by a dense scan of angles; and their scale.

    The response of the device comes from its matrix, solved at every angle: no roots, no nodes of the library.
    """
    own, newer, older, seen = _sample(scene)
    size, late = len(own), scene.whole_delay
    fraction = scene.d - late
    top, bottom = velocity_polynomials(scene)

    def needed(w: np.ndarray) -> Any:
        """``-1/G - B F``: the stiffness, where it is real."""
        z = np.exp(1j * w)
        push = newer[None, :] + older[None, :] / z[:, None] if fraction else np.broadcast_to(newer, (w.size, size))
        moved = np.linalg.solve(z[:, None, None] * np.eye(size) - own, push[..., None])[..., 0] @ seen
        return -(z**late) / moved - virtual_damping * np.polyval(top, z) / np.polyval(bottom, z)

    grid = np.unique(np.concatenate([np.geomspace(1e-6, 0.3, angles // 2), np.linspace(1e-3, np.pi - 1e-9, angles)]))
    value = needed(grid)
    k = np.flatnonzero(np.sign(value.imag[:-1]) * np.sign(value.imag[1:]) < 0)
    low, high, sign = grid[k], grid[k + 1], np.sign(value.imag[k])
    for _ in range(60 if k.size else 0):
        middle = 0.5 * (low + high)
        same = np.sign(needed(middle).imag) == sign
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    at_ends = np.array([1e-9, np.pi])
    found: Any = np.concatenate([needed(0.5 * (low + high)), needed(at_ends)])
    return found.real, float(np.median(np.abs(value)))


def proved_column(scene: Any, stiffness: float, digits: int = 60) -> np.ndarray | None:
    """The stable intervals of the damping at a stiffness, shape (n, 2), in balls; None where poles cannot be counted.

    ``Im((D + K N1) conj N2) = 0`` on the circle is a polynomial in ``1 - cos w``: all its roots, without a curve or a
    node, then poles counted between the dampings that they stand for.
    """
    before = flint.ctx.dps
    try:
        flint.ctx.dps = digits
        device, spring, damper = ball_parts(scene)
        fixed, moved = device + spring * _ball(stiffness), damper
        count = max(fixed.length(), moved.length())
        # Pairs of a filter's zeros at z = -1 are real factors on the circle: as multiple roots they would hide others.
        pairs = scene.velocity.order // 2 if isinstance(scene.velocity, zwidth.Butterworth) else 0
        turned = divmod(moved, flint.acb_poly([1, 2, 1]) ** pairs)[0] * flint.acb_poly([0] * pairs + [1])
        a, b = ([part[k].real for k in range(count)] for part in (fixed, turned))
        x = flint.arb_poly([0, 1])
        sines, total = [flint.arb_poly([1]), 2 * (1 - x)], flint.arb_poly([0])
        for k in range(1, count):
            while len(sines) < k:
                sines.append(2 * (1 - x) * sines[-1] - sines[-2])
            total += sum((a[j + k] * b[j] - a[j] * b[j + k] for j in range(count - k)), _ball(0)) * sines[k - 1]
        # Both ends may be rounding of 0.
        parts = total.coeffs()
        least = max(abs(part).abs_upper() for part in parts) * flint.arb(10) ** (12 - digits)
        kept = [k for k, part in enumerate(parts) if not abs(part) < least]
        roots = flint.acb_poly(parts[kept[0] : kept[-1] + 1]).roots(tol=10.0 ** (-digits // 2)) if len(kept) > 1 else []
        real = [r.real for r in roots if abs(r.imag) < flint.arb(10) ** (-digits // 3) * abs(r)]
        angles = [flint.acb(1 - y, (y * (2 - y)).sqrt()) for y in real if y > 0 and y < 2] + [
            flint.acb(1),
            flint.acb(-1),
        ]
        size = sum((abs(moved[k]) for k in range(count)), _ball(0))
        known = [z for z in angles if not abs(moved(z)) < size * flint.arb(10) ** (-digits // 4)]
        met = np.array(sorted(float(-(fixed(z) / moved(z)).real.mid()) for z in known))
    except ValueError:
        return None
    finally:
        flint.ctx.dps = before
    reach = np.ptp(met) + np.abs(met).max() + 1e-300
    ends = np.concatenate([[-np.inf], met, [np.inf]])
    between = 0.5 * (np.concatenate([[met[0] - reach], met]) + np.concatenate([met, [met[-1] + reach]]))
    outside = [count_outside(scene, stiffness, damping, digits) for damping in between.tolist()]
    if None in outside:
        return None
    stable = np.array(outside) == 0
    return np.stack([ends[:-1][stable], ends[1:][stable]], -1)
