"""Estimate the share of devices on which a wall is stable, from parameters drawn within their tolerances (any loop).

If the wall must be stable on every device, use `zwidth.robust_wall`, which searches the whole box of devices. The share
and its confidence interval are more useful if the vertices of the box hardly ever occur.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from zwidth.parts.checks import check_whole
from zwidth.scenes.base import of_scene
from zwidth.scenes.scene import Scene
from zwidth.words.errors import InputError, check_choice, describe_choice
from zwidth.words.quantities import WALL
from zwidth.words.showing import shown

# Of the interval in which the share of all devices lies.
_CONFIDENCE = 0.95
_MOST_SAMPLES = 1_000_000


class Tolerance(NamedTuple):
    """How far a parameter lies from its nominal value, as a share of it.

    Uniform: anywhere from ``(1 - share)`` to ``(1 + share)`` times it. Normal: ``share`` is the standard deviation.
    """

    share: float
    distribution: Literal["uniform", "normal"] = "uniform"


@shown(
    ("samples", "stable", "stable_low", "stable_high", "reliability", "stiffness", "stiffness_max"), stiffness_max="N/m"
)
@dataclass(frozen=True)
class ToleranceEstimate:
    """What `simulate_tolerances` finds; of a share the interval holds the true one with 95 % confidence."""

    samples: int
    stable: float  # the share of devices on which the wall of the scene is stable
    stable_low: float
    stable_high: float
    reliability: float  # the share for which the next two hold
    stiffness: float  # in N/m: upper end of K at which that share of devices is stable, at the wall's damping B
    stiffness_max: float  # the same where each device has the damping that suits it best; NaN for a scene with parts
    drawn: dict[str, np.ndarray]  # what was drawn, by parameter
    labels: np.ndarray  # whether each device bears the wall


@of_scene
def simulate_tolerances(
    scene: Scene, tolerances: dict[str, Any], *, samples: int = 10_000, seed: int = 0, reliability: float = 0.99
) -> ToleranceEstimate:
    """Draw devices within tolerances and judge the scene's wall on each of them.

    The parameters are independent of each other; all that is not named is exact. A delay given in periods keeps its
    number of periods.

    Args:
        scene: nominal device, timing, parts, and the wall.
        tolerances: by dotted path as in ``scene.parameters()``: a `Tolerance`, or its share, as ``{"mass": 0.1}``.
        samples: how many devices are drawn, up to 1,000,000. A rigid scene takes some microseconds a device, a scene
            with parts some 10 to 100 ms.
        seed: of the draws; equal seeds give equal devices.
        reliability: the share of devices that must bear the stiffnesses returned, between 0 and 1.

    Returns:
        ToleranceEstimate.

    Raises:
        InputError: an unknown parameter, a share that is not between 0 and 1 (normal: up to 1/3), or a parameter that
            is 0 and has no share.

    References:
        Clopper and Pearson 1934, Biometrika 26, 404-413 (the interval of a share).

    Example:
        >>> import zwidth
        >>> wall = zwidth.VirtualWall("17 kN/m", "40 N s/m")
        >>> scene = zwidth.Scene(zwidth.Device("100 g", 10), zwidth.Timing("1 ms", "1 ms"), wall)
        >>> found = zwidth.simulate_tolerances(scene, {"mass": 0.2, "damping": 0.3})
        >>> print(f"{100 * found.stable:.0f} % bear it, 99 % bear {found.stiffness / 1e3:.1f} kN/m")
        91 % bear it, 99 % bear 15.6 kN/m
    """
    count = check_whole("samples", samples, 1, _MOST_SAMPLES)
    if not 0 < reliability < 1:
        raise InputError(f"reliability: got {reliability!r}; a share between 0 and 1 is needed, as 0.99")
    drawn = _draw(scene, tolerances, count, check_whole("seed", seed, 0, 2**63 - 1))
    wall, variants = scene.wall, scene.loop.vary(drawn)
    labels = variants.labels(wall.stiffness, wall.virtual_damping)
    limits = variants.row_ends(np.array([wall.virtual_damping]))[:, 0]
    stable = int(np.count_nonzero(labels))
    low, high = _interval(stable, count)
    return ToleranceEstimate(
        count,
        stable / count,
        low,
        high,
        reliability,
        borne_by(limits, reliability),
        np.nan if variants.searched else borne_by(variants.stiffest()[0], reliability),
        drawn,
        labels,
    )


def _draw(scene: Scene, tolerances: dict[str, Any], count: int, seed: int) -> dict[str, np.ndarray]:
    own = scene.parameters()
    nominal = {name: value for name, value in own.items() if isinstance(value, float) and name not in WALL}
    generator = np.random.default_rng(seed)
    drawn = {}
    for name, given in tolerances.items():
        if name not in nominal:
            raise InputError(f"tolerances: {describe_choice(name, tuple(nominal))}")
        share, distribution = given if isinstance(given, Tolerance) else Tolerance(given)
        check_choice(f"tolerances: {name}", distribution, ("uniform", "normal"))
        most = 1 / 3 if distribution == "normal" else 1.0
        if isinstance(share, bool | str) or not np.isreal(share) or not 0 < share < most:
            raise InputError(f"tolerances: {name}: got {share!r}; a share between 0 and {most:.3g} is needed, as 0.1")
        if nominal[name] == 0:
            raise InputError(f"tolerances: {name} is 0, and so is any share of it; give it a value, or leave it out")
        drawn[name] = nominal[name] * _factors(generator, float(share), distribution, count)
    if scene.timing.in_periods and {"delay", "period"} <= drawn.keys():
        drawn["delay"] = drawn["delay"] * (drawn["period"] / nominal["period"])
    return drawn


def _factors(generator: np.random.Generator, share: float, distribution: str, count: int) -> np.ndarray:
    if distribution == "uniform":
        return generator.uniform(1.0 - share, 1.0 + share, count)
    factors = generator.normal(1.0, share, count)
    while np.any(bad := factors <= 0):
        # No mass is negative: what three standard deviations or more would make so is drawn again.
        factors[bad] = generator.normal(1.0, share, np.count_nonzero(bad))
    return factors


def borne_by(limits: np.ndarray, share: float) -> float:
    """The stiffness up to which a share of the devices is stable; 0 where too few are stable at all."""
    ordered = np.sort(np.where(np.isnan(limits), 0.0, limits))
    # The tolerance keeps 1 - 0.99 of 100 devices at one device.
    return float(ordered[int(np.floor((1.0 - share) * ordered.size + 1e-9))])


def _interval(stable: int, count: int) -> tuple[float, float]:
    """Clopper and Pearson's interval of a share."""
    from scipy.special import betaincinv

    rest = (1.0 - _CONFIDENCE) / 2.0
    low = betaincinv(stable, count - stable + 1, rest) if stable else 0.0
    high = betaincinv(stable + 1, count - stable, 1.0 - rest) if stable < count else 1.0
    return float(low), float(high)
