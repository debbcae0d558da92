"""A device from walls at the onset of buzzing: which stiffness, which damping, and the frequency that was heard."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from zwidth.fitting.buzz_search import (
    AS_GOOD,
    EXACT,
    Candidate,
    FittedKind,
    choose_device,
    find_edges,
    is_blind,
    weigh,
)
from zwidth.fitting.buzzing import Onsets
from zwidth.fitting.device_estimate import differentiate, find_stiffest, name_numbers
from zwidth.fitting.device_fit import BEYOND, MASS_OPEN, VAGUE, DeviceFit, FurtherExperiment, RivalDevice, doubt_period
from zwidth.fitting.words import spell_rival
from zwidth.parts.checks import check_number, find_kind, read_texts
from zwidth.parts.velocity import BackwardDifference, Velocity
from zwidth.words.errors import InputError
from zwidth.words.formatting import plain, with_unit
from zwidth.words.status import Status
from zwidth.words.unit_system import SYSTEMS, UnitSystem

# Worse by chance of 1e-4, or than this share where the noise is unknown, the points contradict each other.
_CHANCE, _ROUGH = 1e-4, 0.1
_ANGLES = 240
# Dampings closer than this are one experiment.
_SAME = 1e-6


class BuzzPoint(NamedTuple):
    """A wall at the onset of buzzing.

    Args:
        stiffness: K in N/m, raised at this damping until the wall buzzes.
        virtual_damping: B in N s/m.
        frequency: heard or measured, in Hz.
    """

    stiffness: float
    virtual_damping: float
    frequency: float


def fit_buzz(
    points: Iterable[Any],
    *,
    period: Any,
    velocity: Velocity | None = None,
    noise: float | tuple[float, float] | None = None,
    rotary: bool | None = None,
) -> DeviceFit:
    """Find mass, damping and delay from walls at the onset of buzzing, and a lag or a resonance where they ask for it.

    On ``z = e^(j 2 pi f T)`` each wall gives two real equations, ``K + B F(z)/T = (m/T^2) q(z)`` with ``q = -1/G``, the
    closed form of `zwidth.boundary`. Two walls of different damping determine m, b and t_d of a rigid mass; more are
    least squares of the relative deviations of K and f, with B exact. Where a rigid mass leaves more than noise, an
    amplifier's lag (first or second order), a resonance, or a first-order lag and a resonance are tried, as far as the
    walls are more than the unknowns: each number more has to explain what Schwarz's criterion asks for, and what chance
    explains in one of 300 cases.

    Args:
        points: walls, each (K in N/m, B in N s/m, f in Hz) or a `zwidth.BuzzPoint`; K > 0, 0 < f < 1/(2 T). At least
            two dampings. Texts with units, as "0.4 N m/rad", are allowed.
        period: T in s.
        velocity: how the velocity was estimated; the backward difference by default.
        noise: relative standard deviation of K and f, one number or one for each. Left out, it is taken to be equal
            for both and is estimated from the residuals, which two or three walls hardly determine; a wall given twice
            to the last digit then counts once.
        rotary: True if K is in N m/rad and B in N m s/rad. By default, the units of the points decide; numbers without
            units are those of a linear device.

    Returns:
        DeviceFit: the interval of K_max reaches down to what buzzed at the largest B where K_max has more; ``status``:
        UNDECIDED where another device fits as well (those are ``rivals``), NO_BOUNDARY where the walls do not lie on
        the edge of its stable set or contradict each other; K_max is NaN then, see `zwidth.DeviceFit`.

    Raises:
        InputError: a number is impossible, or an experiment is missing, which the message names.

    Numerics:
        Levenberg and Marquardt (SciPy's: three unknowns, nothing to compile) from the dips over damping and delay;
        exact walls give the device back to about 1e-12. Errors are linear in the noise, those of K_max in its
        logarithm. With 2 % of K and f and four walls of 800 random rigid devices, 10 % of the fits were UNDECIDED, 4 %
        refused, and 5 of them found a part; of the others, the intervals of m, b, t_d and K_max held the true value on
        94.8, 94.5, 94.6 and 95.5 %. Of 200 others with a lag, a resonance or both, most of five walls, 11 % were
        doubted; of the rest the interval of K_max held it on 96.6 %, and every safe wall was stable. Looking for parts
        takes a few seconds.

    References:
        Hulin, Preusche, Hirzinger 2006, section V (the boundary). Boggs, Rogers 1990 (errors in both coordinates).
        Schwarz 1978, Annals of Statistics 6, 461-464 (further numbers).

    Example:
        >>> import zwidth
        >>> heard = [(6.85e3, 0, 40.1), (15.9e3, 18.7, 68.6), (19.7e3, 37.4, 89.1)]
        >>> fit = zwidth.fit_buzz(heard, period="1 ms", noise=0.02)
        >>> print(f"{fit.mass * 1e3:.0f} g")
        100 g
    """
    from scipy.special import chdtri

    period = check_number("period", period)
    if isinstance(points, Iterable) and not isinstance(points, str | dict):
        points = list(points)
        implied = find_kind(
            {f"points[{k}]": list(each) for k, each in enumerate(points) if isinstance(each, list | tuple)}
        )
        if None not in (implied, rotary) and implied != rotary:
            raise InputError(f"rotary: got {rotary}, but points have the units of another kind; omit rotary")
        rotary = implied or rotary
    system = SYSTEMS[bool(rotary)]
    velocity = BackwardDifference() if velocity is None else velocity
    if not isinstance(velocity, Velocity):
        raise InputError(f"velocity: got {velocity!r}; give an estimate, as zwidth.LowPass(cutoff=100)")
    share = _read_noise(noise)
    table, doubts = _read_points(points, period, share is None, system)
    kappa, rub, w = (table * [period**2, period, 2 * np.pi * period]).T
    onsets = Onsets(kappa, rub, w, velocity, period, system=system)
    weights = 1.0 / np.array(share or (1.0, 1.0))
    chosen, others = choose_device(onsets, weights, share is not None)
    onsets, best, equals, _ = chosen
    scale = chosen.scale
    against = None
    if share and best.squares > chdtri(chosen.freedom, _CHANCE):
        far = plain(np.sqrt(best.squares / chosen.freedom), 2)
        against = (
            f"the walls contradict each other: they are {far} times as far from this device as their noise explains; "
            "look for friction, a compliance or a hand that holds it"
        )
    elif not share and scale > _ROUGH**2:
        against = (
            f"the walls contradict each other: no device comes closer to them than {plain(100 * np.sqrt(scale), 2)} %; "
            "check K, B, f and the period, look for friction, a compliance or a hand that holds it, or give the noise "
            "if they were measured so roughly"
        )
    elif not equals:
        against = "the walls do not lie on the edge of this device's stable set: they began to buzz before or later"
    status = Status.NO_BOUNDARY if against else Status.OK
    slopes = weigh(onsets.follow(best.theta).slopes(), weights)
    _refuse_blind(slopes, best.theta, table, bool(equals))
    information = slopes.T @ slopes / scale
    scene = chosen.scene(best.theta)
    by_theta = differentiate(lambda theta: onsets.normalize(theta).to_numbers(period), best.theta)
    stiffest, slope = find_stiffest(scene)
    covariance = by_theta @ np.linalg.inv(information) @ by_theta.T
    rivals: list[tuple[FittedKind, np.ndarray]] = []
    apart = [best.theta]
    for other in equals[1:] if status == Status.OK else ():
        # Not along the flat floor of the same valley.
        if all((away := other.theta - one) @ information @ away > AS_GOOD for one in apart):
            apart.append(other.theta)
            rivals.append((chosen, other.theta))
    error = float(np.sqrt(slope @ covariance @ slope))
    for kind in others if status == Status.OK else ():
        # Devices of other kinds whose K_max is the same say nothing else of walls.
        if abs(float(kind.scene(kind.best.theta).max_stiffness().stiffness) - stiffest) > error:
            rivals.append((kind, kind.best.theta))
    told = tuple(_describe_rival(*rival) for rival in rivals)
    if rivals:
        status = Status.UNDECIDED
        doubts.append(
            f"another device fits equally well: {spell_rival(told[0], system)}; add the experiment named next"
        )
    if against:
        doubts.append(against)
    else:
        if covariance[0, 0] > (VAGUE * scene.device.mass) ** 2:
            doubts.append(MASS_OPEN)
        if best.squares > EXACT:
            doubts += [
                f"the {name} is 0 at best: a negative one would fit better"
                for name in best.held
                if name != "delay" or _delay_beyond(slopes, best) < -BEYOND * np.sqrt(scale)
            ]
    further = _further(chosen, stiffest, information, slope @ by_theta, weights**2 / scale, rivals)
    stiffness, damping, _ = table[np.argmax(table[:, 1])].tolist()
    fit = DeviceFit(
        nominal=scene,
        covariance=covariance,
        noise=share or (float(np.sqrt(scale)), float(np.sqrt(scale))),
        residuals=best.residuals / np.sqrt(scale),
        doubts=(*doubts, *doubt_period(period)),
        status=int(status),
        freedom=None if share else chosen.freedom,
        rivals=told,
        damping_tried=damping,
        stiffness_tried=stiffness,
    )
    if further is None or status == Status.NO_BOUNDARY:
        return fit
    after = further.error_afterwards if fit.stiffness_max > 0 else np.nan
    return replace(fit, next=further._replace(error_afterwards=after))


def _read_points(
    points: Iterable[Any], period: float, copies_count_once: bool, system: UnitSystem
) -> tuple[np.ndarray, list[str]]:
    """The walls as an array, and doubts; an impossible one is refused, and so are walls that cannot tell a device."""
    if not isinstance(points, Iterable) or isinstance(points, str | dict):
        raise InputError(f"points: got {points!r}; give walls, each (K in N/m, B in N s/m, f in Hz)")
    rows, units = [], (system["N/m"], system["N s/m"], "Hz")
    for k, point in enumerate(points):
        try:
            row = [float(read_texts(f"points[{k}]", *each)) for each in zip(point, units, strict=True)]
        except (TypeError, ValueError):
            row = []
        if len(row) != 3 or not np.all(np.isfinite(row)):
            raise InputError(
                f"points[{k}]: got {point!r}; give K in {units[0]}, B in {units[1]} and f in Hz, as (6e3, 0, 37.6)"
            )
        if not row[0] > 0:
            raise InputError(f"points[{k}].stiffness: got {row[0]:g} {units[0]}; it must be greater than 0 to buzz")
        if not 0 < row[2] < 0.5 / period:
            raise InputError(
                f"points[{k}].frequency: got {row[2]:g} Hz; it must be greater than 0 and less than half the sampling "
                f"rate, {plain(0.5 / period)} Hz: check the frequency, or the period"
            )
        rows.append(row)
    if not rows:
        raise InputError("points: got none; raise K at B = 0 until the wall buzzes, and again at another B")
    doubts = []
    if copies_count_once and len(kept := list(dict.fromkeys(map(tuple, rows)))) < len(rows):
        doubts.append(
            f"{len(rows) - len(kept)} of the walls repeat others to the last digit and count once; give the noise if "
            "they were measured again"
        )
        rows = kept
    table = np.array(rows)
    # A force over a velocity: the dampings that matter are of this size.
    unit = table[0, 0] / (2 * np.pi * table[0, 2])
    if np.ptp(table[:, 1]) <= _SAME * max(unit, np.abs(table[:, 1]).max()):
        count = (
            "one wall gives two equations for" if len(table) == 1 else f"{len(table)} walls of one damping cannot tell"
        )
        raise InputError(
            f"points: {count} the three unknowns m, b and t_d; what is missing is a wall of another damping: raise K "
            f"at B = {with_unit(table[0, 1] + 0.4 * unit, units[1], 2)}, say, until it buzzes"
        )
    return table, doubts


def _read_noise(noise: Any) -> tuple[float, float] | None:
    if noise is None:
        return None
    try:
        pair = np.broadcast_to(np.asarray(noise, float), (2,))
    except ValueError:
        pair = np.zeros(2)
    if not np.all((pair > 0) & (pair < 1)):
        raise InputError(f"noise: got {noise!r}; give the relative noise of K and f, as 0.02, or (0.03, 0.01)")
    return float(pair[0]), float(pair[1])


def _describe_rival(kind: FittedKind, theta: np.ndarray) -> RivalDevice:
    scene = kind.scene(theta)
    parts = {name: scene.parameters()[name] for name in name_numbers(scene)[3:]}
    stiffness = float(scene.max_stiffness().stiffness)
    return RivalDevice(scene.mass, scene.damping, scene.timing.delay, stiffness, parts or None)


def _delay_beyond(slopes: np.ndarray, best: Candidate) -> float:
    """Where the delay of the least squares would lie that is held at 0, in standard errors of walls of noise 1."""
    inverse = np.linalg.pinv(slopes)[2]
    return float(inverse @ best.residuals.ravel() / np.linalg.norm(inverse))


def _refuse_blind(slopes: np.ndarray, theta: np.ndarray, table: np.ndarray, on_edge: bool) -> None:
    if is_blind(slopes):
        dampings = ", ".join(f"{value:g}" for value in np.unique(table[:, 1]))
        if not on_edge:
            raise InputError(
                "points: no device has these walls on the edge of its stable set; check K, B, f and the period, and at "
                "each B raise K from far below until the wall begins to buzz"
            )
        raise InputError(
            f"points: walls of B = {dampings} N s/m cannot tell m, b and t_d apart"
            + (f", the mass hardly counts beside the damping (b T/m = {plain(theta[1], 2)})" if theta[1] > 3 else "")
            + "; what is missing is a wall of a damping farther away"
        )


def _further(
    chosen: FittedKind,
    stiffest: float,
    information: np.ndarray,
    wanted: np.ndarray,
    precision: np.ndarray,
    rivals: list[tuple[FittedKind, np.ndarray]],
) -> FurtherExperiment | None:
    """The wall of the device's own boundary, B >= 0, after which K_max is known best."""
    # Where a device of another kind may be there, the wall at which the two differ most.
    onsets, theta = chosen.onsets, chosen.best.theta
    scene, period = chosen.scene(theta), onsets.period
    w = np.linspace(0.0, np.pi, _ANGLES + 2)[1:-1]
    # Slow loops have all of their boundary at low frequencies.
    w = np.concatenate([np.geomspace(1e-4, w[0], 60)[:-1], w])
    stiffness, damping = scene.boundary(w / period)
    # Softer walls than a tenth of the stiffest are outside of what anybody measures well.
    real = (damping >= 0) & (stiffness > 0.1 * stiffest)
    real[real] = find_edges(scene, stiffness[real], damping[real])
    if not real.any():
        return None
    stiffness, damping, w = stiffness[real], damping[real], w[real]
    walls = replace(onsets, kappa=stiffness * period**2, rub=damping * period, w=w)
    rows = walls.follow(theta).slopes()
    more = np.einsum("nki,k,nkj->nij", rows, precision, rows)
    after = np.linalg.solve(information + more, wanted[:, None])[..., 0] @ wanted
    best = int(np.argmin(after))
    for kind, other in rivals[:1]:
        if kind is not chosen:
            there = replace(kind.onsets, kappa=walls.kappa, rub=walls.rub, w=walls.w).follow(other)
            # Where the other one has no stiffness there is nothing to compare with.
            seen = there.found & (there.kappa > 0)
            away = np.log(np.where(seen, [there.kappa / walls.kappa, there.w / walls.w], 1.0)) ** 2
            best = int(np.argmax(precision @ away))
    return FurtherExperiment(
        float(damping[best]),
        float(stiffness[best]),
        float(w[best] / (2 * np.pi * period)),
        float(np.sqrt(max(after[best], 0.0))),
    )
