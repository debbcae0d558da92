"""Search for the rigid device whose stability boundary contains the measured walls, by least squares.

The residuals are the relative errors of K and f at the measured B (`zwidth.fitting.buzzing`), in units of their noise.
The unknowns are ``theta = (ln m, delta, d)`` with delta = b T/m and the delay d in periods. SciPy's Levenberg-Marquardt
method starts from the local minima of a cost on a grid; damping and delay that would be negative are fixed at 0.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from zwidth.fitting.buzzing import Onsets, PredictedWalls
from zwidth.scenes.scene import Scene

AS_GOOD = 5.99  # largest difference of the sums of squares, in noise variances, of devices that fit equally well
EXACT = 1e-12  # lower limit of the estimated relative noise, below that of any measurement; for exact walls
BOUNDARY_STEP = 1e-6  # relative change of K on both sides of the boundary at which stability is checked
DELTAS = np.geomspace(1e-4, 30.0, 45)  # initial values of b T/m; lower ones are added for low frequencies
STARTS = 6  # largest number of initial values
MAX_CONDITION = 1e6  # condition number above which the parameters are not identifiable
NEARLY = 1e-4  # relative tolerance of the first search from an initial value
CONVERGED = 1e-12  # relative tolerance of the final search
MAX_EVALUATIONS = (100, 40)  # largest number of function evaluations of a final and of a first search
NAMES = ("mass", "damping", "delay")


class Candidate(NamedTuple):
    """A local minimum of the weighted sum of squares."""

    theta: np.ndarray  # (ln m, delta, d)
    squares: float
    residuals: np.ndarray  # weighted, shape (walls, 2)
    fixed: tuple[str, ...]  # names of the parameters fixed at 0
    is_complete: bool  # the device has a wall for each measured one


def weight_derivatives(derivatives: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the derivatives of all residuals, one row each, in units of their noise."""
    return (derivatives * weights[:, None]).reshape(-1, derivatives.shape[-1])


def is_rank_deficient(derivatives: np.ndarray) -> bool:
    """Return whether the sensitivity matrix is rank-deficient (parameters not identifiable)."""
    sizes = np.linalg.norm(derivatives, axis=0)
    return not np.all(sizes > 0) or bool(np.linalg.cond(derivatives / sizes) > MAX_CONDITION)


def _list_dampings(onsets: Onsets) -> np.ndarray:
    """Return initial values of delta, including low ones for low frequencies."""
    # At B = 0 the onset is near w^2 = delta/(d + 1/2).
    ratio = DELTAS[1] / DELTAS[0]
    more = np.ceil(np.log(DELTAS[0] / (0.1 * float(onsets.w.min()) ** 2)) / np.log(ratio))
    return np.concatenate([[0.0], DELTAS[0] * ratio ** np.arange(-more, 0.0), DELTAS])


def _solve(
    onsets: Onsets, weights: np.ndarray, start: np.ndarray, fixed: tuple[int, ...], tolerance: float = CONVERGED
) -> Candidate:
    """Return the local minimum near an initial value, with the parameters at the indices ``fixed`` set to 0."""
    from scipy.optimize import least_squares

    free = [k for k in range(3) if k not in fixed]
    theta = start.copy()
    theta[list(fixed)] = 0.0

    @lru_cache(maxsize=1)  # The solver requests values and derivatives separately.
    @np.errstate(all="ignore")
    def evaluate(values: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray, PredictedWalls, np.ndarray]:
        trial = theta.copy()
        trial[free] = values
        walls = onsets.predict_walls(trial)
        ratios = np.stack([np.log(walls.kappa / onsets.kappa), np.log(walls.w / onsets.w)], -1)
        valid = walls.converged & np.all(np.isfinite(ratios), -1)
        # Assign a large constant residual to a measured wall for which the device has none.
        return trial, np.where(valid[:, None], ratios, 10.0) * weights, walls, valid

    @np.errstate(all="ignore")
    def differentiate(values: np.ndarray) -> np.ndarray:
        _, _, walls, valid = evaluate(tuple(values))
        derivatives = walls.differentiate()
        derivatives = np.where(valid[:, None, None] & np.isfinite(derivatives), derivatives, 0.0)
        return weight_derivatives(derivatives, weights)[:, free]

    solution = least_squares(
        lambda x: evaluate(tuple(x))[1].ravel(),
        theta[free],
        differentiate,  # pyright: ignore[reportArgumentType]  (a function or a name)
        method="lm",
        x_scale="jac",
        xtol=tolerance,
        ftol=tolerance,
        gtol=tolerance,
        max_nfev=MAX_EVALUATIONS[tolerance == NEARLY],
    )
    theta, residuals, _, valid = evaluate(tuple(solution.x))
    names = tuple(NAMES[k] for k in fixed)
    return Candidate(theta, float((residuals**2).sum()), -residuals, names, bool(valid.all()))


def _refine(onsets: Onsets, weights: np.ndarray, first: Candidate, start: np.ndarray) -> list[Candidate]:
    """Return the minimum near ``first``, or with a negative damping or delay the minima with one or both fixed at 0."""
    if first.is_complete:
        free = _solve(onsets, weights, first.theta, ())
        if min(free.theta[1:3]) >= 0:
            return [free]
    ends = (_solve(onsets, weights, start, fixed) for fixed in ((1,), (2,), (1, 2)))
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
    starts = onsets.list_starts(_list_dampings(onsets), longest, STARTS)
    first_fits = ((_solve(onsets, weights, start, (), NEARLY), start) for start in starts)
    first_fits = sorted(first_fits, key=lambda pair: pair[0].squares)
    nothing = Candidate(np.zeros(3), np.inf, np.full((onsets.w.size, 2), np.nan), (), False)
    fit, minima = RigidFit(onsets, nothing, [], known_noise), []
    for first, start in first_fits:
        if first.is_complete and any(np.allclose(first.theta, other.theta, 1e-2, 1e-2) for other in minima):
            continue
        for each in _refine(onsets, weights, first, start):
            minima.append(each)
            if each.is_complete and each.squares < fit.best.squares + AS_GOOD * fit.scale and _is_onset(fit, each):
                fit.equals.append(each)
                fit.equals.sort(key=lambda candidate: candidate.squares)
                fit = fit._replace(best=fit.equals[0])
    as_good = [each for each in fit.equals if each.squares - fit.best.squares < AS_GOOD * fit.scale]
    best = (
        as_good or sorted(minima, key=lambda candidate: (not candidate.is_complete, candidate.squares)) or [nothing]
    )[0]
    return fit._replace(best=best, equals=as_good)


@np.errstate(all="ignore")
def _is_onset(fit: RigidFit, candidate: Candidate) -> bool:
    """Return whether stability ends at the fitted walls; the boundary curve also runs through the unstable region."""
    onsets = fit.onsets
    kappa, period = onsets.predict_walls(candidate.theta).kappa, onsets.period
    if not np.all(kappa > 0):
        return False
    return bool(np.all(are_on_boundary(fit.scene(candidate.theta), kappa / period**2, onsets.scaled_damping / period)))


def are_on_boundary(scene: Scene, stiffness: np.ndarray, virtual_damping: np.ndarray) -> np.ndarray:
    """Return a mask of the walls that are stable if slightly softer and unstable if slightly stiffer."""
    softer = scene.is_stable(stiffness * (1 - BOUNDARY_STEP), virtual_damping)
    return softer & ~scene.is_stable(stiffness * (1 + BOUNDARY_STEP), virtual_damping)
