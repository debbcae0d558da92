"""Monte Carlo estimate of the share of devices on which a wall is stable, for parameters with tolerances.

`simulate_tolerances` draws the parameters of many devices at random within their tolerances, and decides on each device
whether the wall of a scene is stable. All combinations of parameters within the tolerances form a box, whose vertices
hardly ever occur in practice; if the wall must nevertheless be stable on every device of the box, use
`zwidth.robust_wall`.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from zwidth.analysis.base import wrap_function
from zwidth.analysis.scene import Scene
from zwidth.analysis.walls import allows_negative
from zwidth.core.errors import InputError, check_choice, describe_choice
from zwidth.model.checks import check_integer
from zwidth.units.display import compact_repr
from zwidth.units.parsing import read_share
from zwidth.units.quantities import WALL

CONFIDENCE = 0.95  # confidence level of the interval of a share
MAX_SAMPLES = 1_000_000  # largest number of drawn devices; bounds the memory


class Tolerance(NamedTuple):
    """Random distribution of a parameter around its nominal value.

    A uniform distribution extends from ``(1 - share)`` to ``(1 + share)`` times the nominal value; a normal
    distribution has a standard deviation of ``share`` times the nominal value.
    """

    share: float | str  # relative tolerance, a number or a string such as "5%"
    distribution: Literal["uniform", "normal"] = "uniform"


@compact_repr(
    ("samples", "stable", "stable_low", "stable_high", "reliability", "stiffness", "stiffness_max"), stiffness_max="N/m"
)
@dataclass(frozen=True)
class ToleranceEstimate:
    """Estimated share of the devices within tolerances on which a wall is stable, and limits of the stiffness."""

    samples: int  # number of drawn devices
    stable: float  # share of drawn devices on which the wall of the scene is stable
    stable_low: float  # lower end of the 95 % confidence interval of the share of all devices
    stable_high: float  # upper end of that interval
    reliability: float  # share of devices to which the next two fields apply
    stiffness: float  # in N/m: upper end of K at which that share of devices is stable, at the wall's damping B
    stiffness_max: float  # the same if each device has its best B
    drawn: dict[str, np.ndarray]  # drawn values by parameter
    labels: np.ndarray  # stability of the wall on each device, bool


@wrap_function
def simulate_tolerances(
    scene: Scene, tolerances: dict[str, Any], *, samples: int = 10_000, seed: int = 0, reliability: float = 0.99
) -> ToleranceEstimate:
    """Draw devices within tolerances, and decide the stability of the wall of a scene on each of them.

    The parameters are drawn independently; parameters without a tolerance are exact. A delay given in periods keeps its
    number of periods.

    Args:
        scene: nominal device, timing, other parts, and the wall.
        tolerances: a `Tolerance`, or its share, per dotted path of ``scene.parameters()``; e.g. ``{"mass": 0.1}`` or
            ``{"mass": "10%"}``.
        samples: number of drawn devices, up to 1,000,000. A rigid scene takes some microseconds per device, any other
            scene about a millisecond.
        seed: seed of the random numbers; equal seeds draw equal devices.
        reliability: share of devices on which the returned stiffnesses must be stable, between 0 and 1.

    Returns:
        ToleranceEstimate.

    Raises:
        InputError: unknown parameter, a share not between 0 and 1 (normal: up to 1/3), or a parameter that is 0, for
            which a relative tolerance has no effect.

    References:
        Clopper and Pearson 1934, Biometrika 26, 404-413 (confidence interval of a share).

    Example:
        >>> import zwidth
        >>> wall = zwidth.VirtualWall("17 kN/m", "40 N s/m")
        >>> scene = zwidth.Scene(zwidth.Device("100 g", 10), zwidth.Timing("1 ms", "1 ms"), wall)
        >>> estimate = zwidth.simulate_tolerances(scene, {"mass": 0.2, "damping": 0.3})
        >>> print(f"stable on {100 * estimate.stable:.0f} %; 99 %: up to {estimate.stiffness / 1e3:.1f} kN/m")
        stable on 91 %; 99 %: up to 15.6 kN/m
    """
    count = check_integer("samples", samples, 1, MAX_SAMPLES)
    if not 0 < reliability < 1:
        raise InputError(f"reliability: got {reliability!r}; pass a share between 0 and 1, such as 0.99")
    drawn = _draw(scene, tolerances, count, check_integer("seed", seed, 0, 2**63 - 1))
    wall, variants = scene.wall, scene.loop.vary(drawn)
    labels = variants.labels(wall.stiffness, wall.virtual_damping)
    limits = variants.find_stiffness_limits(np.array([wall.virtual_damping]))[:, 0]
    stable = int(np.count_nonzero(labels))
    low, high = _compute_confidence_interval(stable, count)
    return ToleranceEstimate(
        count,
        stable / count,
        low,
        high,
        reliability,
        compute_stiffness_quantile(limits, reliability),
        compute_stiffness_quantile(variants.stiffest(allows_negative(scene, None))[0], reliability),
        drawn,
        labels,
    )


def _draw(scene: Scene, tolerances: dict[str, Any], count: int, seed: int) -> dict[str, np.ndarray]:
    """Draw ``count`` random values of each parameter with a tolerance, and return them as arrays by dotted path.

    Raises `InputError` for an invalid tolerance.
    """
    parameters = scene.parameters()
    nominal = {name: value for name, value in parameters.items() if isinstance(value, float) and name not in WALL}
    generator = np.random.default_rng(seed)
    drawn = {}
    for name, tolerance in tolerances.items():
        if name not in nominal:
            raise InputError(f"tolerances: {describe_choice(name, tuple(nominal))}")
        share, distribution = tolerance if isinstance(tolerance, Tolerance) else Tolerance(tolerance)
        if isinstance(share, str):
            with suppress(ValueError):
                share = read_share(share)
        check_choice(f"tolerances: {name}", distribution, ("uniform", "normal"))
        most = 1 / 3 if distribution == "normal" else 1.0
        if isinstance(share, bool | str) or not np.isreal(share) or not 0 < share < most:
            raise InputError(f"tolerances: {name}: got {share!r}; pass a share between 0 and {most:.3g}, such as 0.1")
        if nominal[name] == 0:
            raise InputError(f"tolerances: {name} is 0, so a relative tolerance has no effect; set a value, or omit it")
        drawn[name] = nominal[name] * _draw_factors(generator, float(share), distribution, count)
    if scene.timing.in_periods and {"delay", "period"} <= drawn.keys():
        drawn["delay"] = drawn["delay"] * (drawn["period"] / nominal["period"])
    return drawn


def _draw_factors(generator: np.random.Generator, share: float, distribution: str, count: int) -> np.ndarray:
    """Draw random positive factors by which the nominal value of a parameter is multiplied.

    Args:
        generator: generator of random numbers.
        share: half-width of a uniform distribution around 1, or standard deviation of a normal one.
        distribution: "uniform" or "normal".
        count: number of factors.
    """
    if distribution == "uniform":
        return generator.uniform(1.0 - share, 1.0 + share, count)
    factors = generator.normal(1.0, share, count)
    while np.any(bad := factors <= 0):
        # Draw a factor again if it is not positive, because parameters must be positive. This is rare: such factors are
        # at least three standard deviations below 1.
        factors[bad] = generator.normal(1.0, share, np.count_nonzero(bad))
    return factors


def compute_stiffness_quantile(limits: np.ndarray, share: float) -> float:
    """Return the largest stiffness at which walls are stable on at least a given share of the devices.

    The result is 0 if on too few devices any wall is stable.

    Args:
        limits: largest stiffness of a stable wall on each device; NaN if no wall is stable on it.
        share: required share of devices, between 0 and 1.
    """
    ordered = np.sort(np.where(np.isnan(limits), 0.0, limits))
    # Add 1e-9 before rounding down, because rounding errors make a product such as (1 - 0.9) 10 slightly less than 1.
    return float(ordered[int(np.floor((1.0 - share) * ordered.size + 1e-9))])


def _compute_confidence_interval(stable: int, count: int) -> tuple[float, float]:
    """Return a confidence interval for the share of all devices on which the wall is stable, from a random sample.

    The interval is that of Clopper and Pearson (1934) with the level `CONFIDENCE`. Its ends are quantiles of beta
    distributions.

    Args:
        stable: number of drawn devices on which the wall is stable.
        count: number of drawn devices.

    Returns:
        Lower and upper end of the interval, between 0 and 1.
    """
    from scipy.special import betaincinv

    rest = (1.0 - CONFIDENCE) / 2.0
    low = betaincinv(stable, count - stable + 1, rest) if stable else 0.0
    high = betaincinv(stable + 1, count - stable, 1.0 - rest) if stable < count else 1.0
    return float(low), float(high)
