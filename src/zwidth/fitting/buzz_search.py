"""The device that walls at the onset of buzzing ask for: rigid, or with an amplifier's lag, a resonance, or both.

Each kind by least squares from many starts.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from zwidth.fitting.buzzing import Followed, Onsets
from zwidth.scenes.scene import Scene

# Another device is as good where the sum of squares in units of the noise rises by less.
AS_GOOD = 5.99
# Relative noise that no record is better than, for telling exact points from equal ones.
EXACT = 1e-12
# An edge of the stable set lies between walls so much softer and stiffer.
_BESIDE = 1e-6
# Orders of lags and numbers of modes that are tried, the fewest unknowns first.
_KINDS = ((1, 0), (2, 0), (0, 1), (1, 1))
# Few walls: what further numbers explain of noise more often than this is no evidence of them.
_CHANCE = 0.003
# Residuals that are rounding alone.
_ROUNDING = 1e-9
# The dampings b T/m that are started from where nothing buzzes slowly, how many of the dips, and every which damping
# beside parts.
_DELTAS = np.geomspace(1e-4, 30.0, 45)
_STARTS, _EVERY = 6, 4
# Beyond this condition number some direction is not seen at all.
_BLIND = 1e6
# Tolerances of a first look and of the end, and the evaluations they may take.
_NEARLY, _ARRIVED, _MOST_STEPS = 1e-4, 1e-12, (100, 40)
_NAMES = ("mass", "damping", "delay")


class Candidate(NamedTuple):
    """A local best fit: theta, its sum of squares, residuals, what is held at 0, and whether all walls were found."""

    theta: np.ndarray
    squares: float
    residuals: np.ndarray
    held: tuple[str, ...]
    found: bool


def weigh(slopes: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Derivatives of all residuals, a row each, in units of their noise."""
    return (slopes * weights[:, None]).reshape(-1, slopes.shape[-1])


def is_blind(slopes: np.ndarray) -> bool:
    """Whether they do not tell all numbers apart."""
    sizes = np.linalg.norm(slopes, axis=0)
    return not np.all(sizes > 0) or bool(np.linalg.cond(slopes / sizes) > _BLIND)


def look_around(onsets: Onsets, weights: np.ndarray) -> list[tuple[Candidate, np.ndarray]]:
    """Where a first look from each start leads, the best first, and the start."""
    # Half a turn over the delay, and some more for noise.
    longest = 1.2 * np.pi / float(onsets.w.max())
    parts = onsets.lag + onsets.modes > 0
    if parts:
        starts = onsets.starts_beside(_DELTAS[::_EVERY], longest, _STARTS)
    else:
        starts = onsets.starts(_dampings(onsets), longest, _STARTS)
    near = [(_solve(onsets, weights, start, (), _NEARLY), start) for start in starts]
    return [each for each in sorted(near, key=lambda each: each[0].squares) if not parts or each[0].found]


def find_candidates(onsets: Onsets, weights: np.ndarray, near: Candidate, start: np.ndarray) -> list[Candidate]:
    """The local best fit there. Where damping or delay would be negative, those from the start with it held at 0."""
    if near.found:
        free = _solve(onsets, weights, near.theta, ())
        if min(free.theta[1:3]) >= 0:
            return [free]
    ends = (_solve(onsets, weights, start, held) for held in ((1,), (2,), (1, 2)))
    return [end for end in ends if min(end.theta[1:3]) >= 0]


def _dampings(onsets: Onsets) -> np.ndarray:
    """Places to look for a damping at: a wall of B = 0 buzzes near w^2 = delta/(d + 1/2), however slowly."""
    ratio = _DELTAS[1] / _DELTAS[0]
    more = np.ceil(np.log(_DELTAS[0] / (0.1 * float(onsets.w.min()) ** 2)) / np.log(ratio))
    return np.concatenate([[0.0], _DELTAS[0] * ratio ** np.arange(-more, 0.0), _DELTAS])


def _solve(
    onsets: Onsets, weights: np.ndarray, start: np.ndarray, held: tuple[int, ...], tolerance: float = _ARRIVED
) -> Candidate:
    from scipy.optimize import least_squares

    free = [k for k in range(onsets.unknowns) if k not in held]
    theta = start.copy()
    theta[list(held)] = 0.0

    @lru_cache(maxsize=1)  # The solver asks for values and slopes apart.
    @np.errstate(all="ignore")
    def evaluate(values: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray, Followed | None, np.ndarray]:
        at = theta.copy()
        at[free] = values
        walls, ratios, good = None, 0.0, np.zeros(onsets.w.shape, bool)
        if onsets.is_possible(at):
            walls = onsets.follow(at)
            ratios = np.stack([np.log(walls.kappa / onsets.kappa), np.log(walls.w / onsets.w)], -1)
            good = walls.found & np.all(np.isfinite(ratios), -1)
        # Where no such wall is found, as wrong as can be, and flat.
        return at, np.where(good[:, None], ratios, 10.0) * weights, walls, good

    @np.errstate(all="ignore")
    def differentiate(values: np.ndarray) -> np.ndarray:
        _, _, walls, good = evaluate(tuple(values))
        slopes = walls.slopes() if walls else np.zeros((*good.shape, 2, onsets.unknowns))
        return weigh(np.where(good[:, None, None] & np.isfinite(slopes), slopes, 0.0), weights)[:, free]

    found = least_squares(
        lambda x: evaluate(tuple(x))[1].ravel(),
        theta[free],
        differentiate,  # pyright: ignore[reportArgumentType]  (a function or a name)
        method="lm",
        x_scale="jac",
        xtol=tolerance,
        ftol=tolerance,
        gtol=tolerance,
        max_nfev=_MOST_STEPS[tolerance == _NEARLY],
    )
    at, residuals, _, good = evaluate(tuple(found.x))
    names = tuple(_NAMES[k] for k in held)
    return Candidate(at, float((residuals**2).sum()), -residuals, names, bool(good.all()))


class FittedKind(NamedTuple):
    """A kind of device at its best, and all devices of it that fit as well.

    None are equal where no device has the walls on the edge of its stable set.
    """

    onsets: Onsets
    best: Candidate
    equals: list[Candidate]
    known_noise: bool

    @property
    def scale(self) -> float:
        """The variance of the walls in units of the weights."""
        return 1.0 if self.known_noise else max(self.best.squares / self.freedom, EXACT**2)

    @property
    def equations(self) -> int:
        """How many equations there are."""
        return 2 * self.onsets.w.size

    @property
    def freedom(self) -> int:
        """How many of them are left."""
        return self.equations - self.onsets.unknowns

    @property
    def misfit(self) -> float:
        """-2 times its logarithmic likelihood."""
        if not self.equals:
            return np.inf
        squares = self.best.squares
        return squares if self.known_noise else self.equations * np.log(max(squares, self.equations * EXACT**2))

    @property
    def cost(self) -> float:
        """By Schwarz's criterion."""
        return self.misfit + self.onsets.unknowns * np.log(self.equations)

    def price(self, more: int) -> float:
        """What so many further numbers have to explain: Schwarz's price, or more where chance explains that much."""
        from scipy.special import chdtri, fdtri

        left = self.freedom - more
        ratio = 1.0 + more / left * float(fdtri(more, left, 1.0 - _CHANCE))
        chance = float(chdtri(more, _CHANCE)) if self.known_noise else self.equations * np.log(ratio)
        return max(more * np.log(self.equations), chance)

    def scene(self, theta: np.ndarray) -> Scene:
        """The loop of one of its devices."""
        return self.onsets.normalize(theta).to_scene(self.onsets.period, self.onsets.velocity, self.onsets.system)


def choose_device(onsets: Onsets, weights: np.ndarray, known_noise: bool) -> tuple[FittedKind, list[FittedKind]]:
    """The likeliest kind of device, and others that are about as likely where it is no rigid one."""
    # Parts are looked for where they could explain more than chance does.
    rigid = chosen = _try(onsets, weights, known_noise)
    tried = [rigid]
    for lag, modes in _KINDS:
        richer = replace(onsets, lag=lag, modes=modes)
        more = richer.unknowns - chosen.onsets.unknowns
        if chosen.freedom <= more:
            continue
        price = chosen.price(more)
        # No device leaves less than this.
        least = 0.0 if known_noise else chosen.equations * np.log(chosen.equations * _ROUNDING**2)
        if chosen.misfit - least <= price:
            continue
        tried.append(_try(richer, weights, known_noise))
        if chosen.misfit - tried[-1].misfit > price:
            chosen = tried[-1]
    others = [kind for kind in tried if kind is not chosen and kind.cost < chosen.cost + AS_GOOD]
    return chosen, [] if chosen is rigid else others


def _try(onsets: Onsets, weights: np.ndarray, known_noise: bool) -> FittedKind:
    """The best device of a kind, and all that fit as well."""
    nothing = Candidate(np.zeros(onsets.unknowns), np.inf, np.full((onsets.w.size, 2), np.nan), (), False)
    kind, found = FittedKind(onsets, nothing, [], known_noise), []
    # Parts are found where the walls tell their numbers; of a rigid device it is said which wall is missing.
    parts = onsets.lag + onsets.modes > 0
    for near, start in look_around(onsets, weights):
        if near.found and any(np.allclose(near.theta, other.theta, 1e-2, 1e-2) for other in found):
            continue
        for fit in find_candidates(onsets, weights, near, start):
            found.append(fit)
            if not (fit.found and fit.squares < kind.best.squares + AS_GOOD * kind.scale and _at_edge(kind, fit)):
                continue
            if not (parts and is_blind(weigh(onsets.follow(fit.theta).slopes(), weights))):
                kind.equals.append(fit)
                kind.equals.sort(key=lambda each: each.squares)
                kind = kind._replace(best=kind.equals[0])
    as_good = [fit for fit in kind.equals if fit.squares - kind.best.squares < AS_GOOD * kind.scale]
    best = (as_good or sorted(found, key=lambda fit: (not fit.found, fit.squares)) or [nothing])[0]
    return kind._replace(best=best, equals=as_good)


@np.errstate(all="ignore")  # Of parts that no device has, zeros overflow.
def _at_edge(kind: FittedKind, fit: Candidate) -> bool:
    """Whether the fitted walls are where stability ends as K rises: other lobes hold walls that buzzed long before."""
    onsets = kind.onsets
    kappa, period = onsets.follow(fit.theta).kappa, onsets.period
    if not np.all(kappa > 0):
        return False
    return bool(np.all(find_edges(kind.scene(fit.theta), kappa / period**2, onsets.rub / period)))


def find_edges(scene: Scene, stiffness: np.ndarray, virtual_damping: np.ndarray) -> np.ndarray:
    """Which walls are stable a little softer, and not a little stiffer."""
    softer = scene.is_stable(stiffness * (1 - _BESIDE), virtual_damping)
    return softer & ~scene.is_stable(stiffness * (1 + _BESIDE), virtual_damping)
