"""Least-squares search of the rigid device whose stability boundary contains the measured walls."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from zwidth.fitting.buzzing import Followed, Onsets
from zwidth.scenes.scene import Scene

AS_GOOD = 5.99  # devices fit equally well if their sums of squares differ by less, in noise variances
EXACT = 1e-12  # lower limit of the estimated relative noise, below that of any measurement; for exact walls
BESIDE = 1e-6  # relative change of K on both sides of the boundary at which stability is checked
DELTAS = np.geomspace(1e-4, 30.0, 45)  # initial values of b T/m; lower ones are added for low frequencies
STARTS = 6  # largest number of initial values
BLIND = 1e6  # condition number above which the parameters are not identifiable
NEARLY = 1e-4  # relative tolerance of the first search from an initial value
CONVERGED = 1e-12  # relative tolerance of the final search
MOST_STEPS = (100, 40)  # largest number of function evaluations of a final and of a first search
NAMES = ("mass", "damping", "delay")


class Candidate(NamedTuple):
    """A local minimum of the weighted sum of squares."""

    theta: np.ndarray  # (ln m, delta, d)
    squares: float
    residuals: np.ndarray  # weighted, shape (walls, 2)
    held: tuple[str, ...]  # names of the parameters fixed at 0
    found: bool  # the device has a wall for each measured one


def weigh(slopes: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the derivatives of all residuals, one row each, in units of their noise."""
    return (slopes * weights[:, None]).reshape(-1, slopes.shape[-1])


def is_blind(slopes: np.ndarray) -> bool:
    """Return whether the sensitivity matrix is rank-deficient (parameters not identifiable)."""
    sizes = np.linalg.norm(slopes, axis=0)
    return not np.all(sizes > 0) or bool(np.linalg.cond(slopes / sizes) > BLIND)


def _list_dampings(onsets: Onsets) -> np.ndarray:
    """Return initial values of delta, including low ones for low frequencies."""
    # At B = 0 the onset is near w^2 = delta/(d + 1/2).
    ratio = DELTAS[1] / DELTAS[0]
    more = np.ceil(np.log(DELTAS[0] / (0.1 * float(onsets.w.min()) ** 2)) / np.log(ratio))
    return np.concatenate([[0.0], DELTAS[0] * ratio ** np.arange(-more, 0.0), DELTAS])


def _solve(
    onsets: Onsets, weights: np.ndarray, start: np.ndarray, held: tuple[int, ...], tolerance: float = CONVERGED
) -> Candidate:
    """Return the local minimum near an initial value, with the parameters at the indices ``held`` fixed at 0."""
    from scipy.optimize import least_squares

    free = [k for k in range(3) if k not in held]
    theta = start.copy()
    theta[list(held)] = 0.0

    @lru_cache(maxsize=1)  # The solver requests values and derivatives separately.
    @np.errstate(all="ignore")
    def evaluate(values: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray, Followed, np.ndarray]:
        at = theta.copy()
        at[free] = values
        walls = onsets.follow(at)
        ratios = np.stack([np.log(walls.kappa / onsets.kappa), np.log(walls.w / onsets.w)], -1)
        good = walls.found & np.all(np.isfinite(ratios), -1)
        # Assign a large constant residual to a measured wall for which the device has none.
        return at, np.where(good[:, None], ratios, 10.0) * weights, walls, good

    @np.errstate(all="ignore")
    def differentiate(values: np.ndarray) -> np.ndarray:
        _, _, walls, good = evaluate(tuple(values))
        slopes = walls.slopes()
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
        max_nfev=MOST_STEPS[tolerance == NEARLY],
    )
    at, residuals, _, good = evaluate(tuple(found.x))
    names = tuple(NAMES[k] for k in held)
    return Candidate(at, float((residuals**2).sum()), -residuals, names, bool(good.all()))


def _refine(onsets: Onsets, weights: np.ndarray, near: Candidate, start: np.ndarray) -> list[Candidate]:
    """Return the local minimum; if its damping or delay is negative, the minima with one or both fixed at 0."""
    if near.found:
        free = _solve(onsets, weights, near.theta, ())
        if min(free.theta[1:3]) >= 0:
            return [free]
    ends = (_solve(onsets, weights, start, held) for held in ((1,), (2,), (1, 2)))
    return [end for end in ends if min(end.theta[1:3]) >= 0]


class RigidFit(NamedTuple):
    """The best rigid device, and all that fit equally well: none if no device has the walls on its boundary."""

    onsets: Onsets
    best: Candidate
    equals: list[Candidate]
    known_noise: bool

    @property
    def scale(self) -> float:
        """Noise variance of the weighted residuals: 1 if the noise is given; otherwise estimated."""
        return 1.0 if self.known_noise else max(self.best.squares / self.freedom, EXACT**2)

    @property
    def freedom(self) -> int:
        """Degrees of freedom: equations minus unknowns."""
        return 2 * self.onsets.w.size - 3

    def scene(self, theta: np.ndarray) -> Scene:
        """Return the loop of a device theta."""
        return self.onsets.normalize(theta).to_scene(self.onsets.period, self.onsets.velocity, self.onsets.system)


def find_device(onsets: Onsets, weights: np.ndarray, known_noise: bool) -> RigidFit:
    """Return the best rigid device, and all others that fit equally well."""
    # In a stable loop the delay changes the phase by at most pi; add 20 % for noise.
    longest = 1.2 * np.pi / float(onsets.w.max())
    starts = onsets.starts(_list_dampings(onsets), longest, STARTS)
    near = sorted(((_solve(onsets, weights, start, (), NEARLY), start) for start in starts), key=lambda x: x[0].squares)
    nothing = Candidate(np.zeros(3), np.inf, np.full((onsets.w.size, 2), np.nan), (), False)
    fit, found = RigidFit(onsets, nothing, [], known_noise), []
    for first, start in near:
        if first.found and any(np.allclose(first.theta, other.theta, 1e-2, 1e-2) for other in found):
            continue
        for each in _refine(onsets, weights, first, start):
            found.append(each)
            if each.found and each.squares < fit.best.squares + AS_GOOD * fit.scale and _is_onset(fit, each):
                fit.equals.append(each)
                fit.equals.sort(key=lambda one: one.squares)
                fit = fit._replace(best=fit.equals[0])
    as_good = [each for each in fit.equals if each.squares - fit.best.squares < AS_GOOD * fit.scale]
    best = (as_good or sorted(found, key=lambda one: (not one.found, one.squares)) or [nothing])[0]
    return fit._replace(best=best, equals=as_good)


@np.errstate(all="ignore")
def _is_onset(fit: RigidFit, each: Candidate) -> bool:
    """Return whether stability ends at the fitted walls; the boundary curve also runs through the unstable region."""
    onsets = fit.onsets
    kappa, period = onsets.follow(each.theta).kappa, onsets.period
    if not np.all(kappa > 0):
        return False
    return bool(np.all(are_on_boundary(fit.scene(each.theta), kappa / period**2, onsets.rub / period)))


def are_on_boundary(scene: Scene, stiffness: np.ndarray, virtual_damping: np.ndarray) -> np.ndarray:
    """Return a mask of the walls that are stable if slightly softer and unstable if slightly stiffer."""
    softer = scene.is_stable(stiffness * (1 - BESIDE), virtual_damping)
    return softer & ~scene.is_stable(stiffness * (1 + BESIDE), virtual_damping)
