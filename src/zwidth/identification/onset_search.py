"""Search for the rigid device whose stability boundary contains the measured walls, by least squares.

The residuals are the relative errors of the stiffness K and the frequency f of each wall at its measured damping B
(`zwidth.identification.onset_model`), divided by the standard deviation of their noise. The unknowns are
``theta = (ln m, delta, d)``: the mass m, the damping delta = b T/m and the delay d in sampling periods T. SciPy's
Levenberg-Marquardt method starts from the local minima of a cost on a grid; if the minimum has a negative damping or
delay, this parameter is fixed at 0.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from zwidth.analysis.scene import Scene
from zwidth.identification.onset_model import Onsets, PredictedWalls

# Largest difference between the sums of squares of two devices that count as equally good fits, in noise variances: the
# 95 % quantile of chi-square with two degrees of freedom.
AS_GOOD = 5.99
EXACT = 1e-12  # lower limit of the estimated relative noise, to avoid division by 0 if the walls are exact
BOUNDARY_STEP = 1e-6  # relative change of K, up and down, with which a wall is tested for the stability boundary
DELTAS = np.geomspace(1e-4, 30.0, 45)  # initial values of delta; lower ones are added for low frequencies
STARTS = 6  # largest number of initial values of theta from which the minimization starts
MAX_CONDITION = 1e6  # condition number of the derivatives above which theta is not identifiable
NEARLY = 1e-4  # relative tolerance of the first minimization from each initial value
CONVERGED = 1e-12  # relative tolerance of the final minimization
MAX_EVALUATIONS = (100, 40)  # largest number of function evaluations: of the final minimization, and of the first one
NAMES = ("mass", "damping", "delay")


class Candidate(NamedTuple):
    """A local minimum of the weighted sum of squared residuals, with the theta at which it is reached."""

    theta: np.ndarray  # parameters (ln m, delta, d) at the minimum
    squares: float
    residuals: np.ndarray  # weighted residuals of K and f, shape (walls, 2)
    fixed: tuple[str, ...]  # names of the parameters that were fixed at 0
    is_complete: bool  # True if an onset of instability was computed at each measured B


def weight_derivatives(derivatives: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Multiply the derivatives of ln K and ln w, shape (walls, 2, 3), by the weights of the residuals.

    Returns:
        An array with one row per residual and one column per parameter of theta.
    """
    return (derivatives * weights[:, None]).reshape(-1, derivatives.shape[-1])


def is_rank_deficient(derivatives: np.ndarray) -> bool:
    """Return whether a matrix of derivatives is rank-deficient, so that the parameters are not identifiable."""
    sizes = np.linalg.norm(derivatives, axis=0)
    return not np.all(sizes > 0) or bool(np.linalg.cond(derivatives / sizes) > MAX_CONDITION)


def _list_dampings(onsets: Onsets) -> np.ndarray:
    """Return the grid of initial values of delta: `DELTAS`, extended downward if a measured frequency is low."""
    # Extend the grid down to values of delta at which the lowest measured frequency w can occur: at B = 0 a device
    # becomes unstable near w^2 = delta/(d + 1/2).
    ratio = DELTAS[1] / DELTAS[0]
    more = np.ceil(np.log(DELTAS[0] / (0.1 * float(onsets.w.min()) ** 2)) / np.log(ratio))
    return np.concatenate([[0.0], DELTAS[0] * ratio ** np.arange(-more, 0.0), DELTAS])


def _solve(
    onsets: Onsets, weights: np.ndarray, start: np.ndarray, fixed: tuple[int, ...], tolerance: float = CONVERGED
) -> Candidate:
    """Minimize the weighted sum of squares from one initial value by the Levenberg-Marquardt method.

    Args:
        onsets: the measured walls.
        weights: reciprocals of the relative noise of K and f.
        start: initial theta.
        fixed: indices of the parameters in theta that are set to 0.
        tolerance: relative tolerance at which the minimization ends.
    """
    from scipy.optimize import least_squares

    free = [k for k in range(3) if k not in fixed]
    theta = start.copy()
    theta[list(fixed)] = 0.0

    @lru_cache(maxsize=1)  # Cache one evaluation, because the solver requests values and derivatives separately.
    @np.errstate(all="ignore")
    def evaluate(values: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray, PredictedWalls, np.ndarray]:
        trial = theta.copy()
        trial[free] = values
        walls = onsets.predict_walls(trial)
        ratios = np.stack([np.log(walls.kappa / onsets.kappa), np.log(walls.w / onsets.w)], -1)
        valid = walls.converged & np.all(np.isfinite(ratios), -1)
        # If the device has no onset of instability at a measured B, use a large constant as the residuals of this wall.
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
        differentiate,  # pyright: ignore[reportArgumentType]  (SciPy also accepts a function)
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
    """Repeat the search with the final tolerance, and return the minima whose damping and delay are nonnegative.

    Args:
        onsets: the measured walls.
        weights: reciprocals of the relative noise of K and f.
        first: result of the first search.
        start: initial theta of the first search.

    Returns:
        The minimum near ``first``. If its damping or delay is negative, up to three minima from ``start`` instead:
        with the damping, the delay or both fixed at 0.
    """
    if first.is_complete:
        free = _solve(onsets, weights, first.theta, ())
        if min(free.theta[1:3]) >= 0:
            return [free]
    ends = (_solve(onsets, weights, start, fixed) for fixed in ((1,), (2,), (1, 2)))
    return [end for end in ends if min(end.theta[1:3]) >= 0]


class RigidFit(NamedTuple):
    """The best rigid device, and the list ``equals`` of devices that fit equally well, including the best one.

    ``equals`` is empty if no device has all measured walls on its stability boundary.
    """

    onsets: Onsets
    best: Candidate
    equals: list[Candidate]
    known_noise: bool

    @property
    def scale(self) -> float:
        """Noise variance of the weighted residuals: 1 if the noise is given; otherwise their estimated variance."""
        return 1.0 if self.known_noise else max(self.best.squares / self.degrees_of_freedom, EXACT**2)

    @property
    def degrees_of_freedom(self) -> int:
        """Degrees of freedom of the fit: two residuals per wall minus three unknowns."""
        return 2 * self.onsets.w.size - 3

    def scene(self, theta: np.ndarray) -> Scene:
        """Return the scene of the rigid device with the parameters theta, without a wall."""
        return self.onsets.normalize(theta).to_scene(self.onsets.period, self.onsets.velocity, self.onsets.system)


def find_device(onsets: Onsets, weights: np.ndarray, known_noise: bool) -> RigidFit:
    """Fit the rigid device by least squares, and find all other devices that fit equally well.

    Args:
        onsets: the measured walls.
        weights: reciprocals of the relative noise of K and f.
        known_noise: True if the noise is given; False if it is estimated from the residuals.
    """
    # Limit the delay d so that it changes the phase d w by at most pi, as in every stable loop, plus 20 % for noise.
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
    """Return whether all fitted walls of a candidate are at the onset of instability.

    The walls of a candidate have a pole on the unit circle. That is not sufficient, because another pole may already be
    unstable.
    """
    onsets = fit.onsets
    kappa, period = onsets.predict_walls(candidate.theta).kappa, onsets.period
    if not np.all(kappa > 0):
        return False
    return bool(np.all(are_on_boundary(fit.scene(candidate.theta), kappa / period**2, onsets.scaled_damping / period)))


def are_on_boundary(scene: Scene, stiffness: np.ndarray, virtual_damping: np.ndarray) -> np.ndarray:
    """Return a mask of the walls that become stable with a slightly smaller K and unstable with a slightly larger K."""
    softer = scene.is_stable(stiffness * (1 - BOUNDARY_STEP), virtual_damping)
    return softer & ~scene.is_stable(stiffness * (1 + BOUNDARY_STEP), virtual_damping)
