"""Color scales of outputs of sweeps, and the levels of their contours.

The field ``color_scale`` of an output (`units.outputs`) determines the scale: "diverging" has a favorable and an
unfavorable side of a center, such as a margin around 0; "steep" is logarithmic and grows without bound; others are
linear or logarithmic.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import matplotlib
import numpy as np
from matplotlib.colors import LogNorm, Normalize, TwoSlopeNorm
from matplotlib.ticker import LogLocator, MaxNLocator

from zwidth.units.outputs import Output

LEAST_POSITIVE = 1e-300  # smallest value shown on a logarithmic scale
_STEEP = 100.0  # ratio of last to first color value of outputs that grow without bound


class ColorScale(NamedTuple):
    """Mapping of an output's values to colors; values outside [low, high] have the color of the nearer end."""

    colormap: str  # name in matplotlib
    low: float  # value of the first color
    high: float  # value of the last color
    logarithmic: bool
    extend: Literal["neither", "min", "max", "both"]  # ends of the color bar with an arrow, beyond which values lie


def choose_scale(output: Output, finite: np.ndarray) -> ColorScale:
    """Choose the color scale of an output from its kind and its finite values, for figures and reports."""
    finite = finite[finite >= LEAST_POSITIVE] if output.logarithmic else finite
    usual = (1.0, 10.0) if output.logarithmic else (0.0, 1.0)
    least, most = (float(finite.min()), float(finite.max())) if finite.size else usual
    if output.color_scale == "diverging":
        # Make both sides of the center as wide as the favorable side, if it has values. Values beyond the ends of the
        # scale share one color.
        sides = [output.center - least, most - output.center]
        good, bad = sides if output.below else reversed(sides)
        span = max(good if good > 0 else bad, 1e-6)
        low, high = output.center - span, output.center + span
    elif output.logarithmic:
        low, high = least, min(most, _STEEP * least) if output.color_scale == "steep" else most
        high = max(high, 1.001 * low)
    else:
        low, high = least, most if most > least else least + 1.0
    beyond: Any = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}
    return ColorScale(_name_colormap(output), low, high, output.logarithmic, beyond[least < low, most > high])


def _name_colormap(output: Output) -> str:
    """Return the name of the colormap of an output in matplotlib."""
    if output.color_scale == "diverging":
        return "PuOr_r" if output.below else "PuOr"
    return "viridis_r" if output.color_scale == "steep" else "viridis"


def find_colormap(output: Output) -> Any:
    """Return matplotlib's colormap of an output."""
    return matplotlib.colormaps[_name_colormap(output)]


def make_norm(output: Output, scale: ColorScale) -> Any:
    """Return matplotlib's normalization of a color scale."""
    if output.color_scale == "diverging":
        return TwoSlopeNorm(output.center, scale.low, scale.high)
    return (LogNorm if scale.logarithmic else Normalize)(scale.low, scale.high)


def choose_levels(values: Any, output: Output, norm: Any) -> np.ndarray:
    """Choose round numbers between the smallest and the largest value of an output as the levels of its contours."""
    low, high = float(values.min()), float(values.max())
    if output.logarithmic:
        # Omit high levels of a steep output, where its contours would be crowded, unless its values have a small range.
        end = min(high, max(norm.vmax / 2.0, (low * high) ** 0.5)) if output.color_scale == "steep" else high
        levels = np.asarray(LogLocator(subs=(1.0, 2.0, 5.0)).tick_values(low, end))
        levels = levels[levels <= end]
    elif output.color_scale == "diverging":
        ends = (low, output.center) if output.below else (output.center, high)
        levels = np.asarray(MaxNLocator(6).tick_values(*ends)) if ends[0] < ends[1] else np.empty(0)
        levels = levels[levels != output.center]
        levels = levels[(levels < output.center) == output.below]
    else:
        levels = np.asarray(MaxNLocator(8).tick_values(low, high))
    return levels[(levels > low) & (levels < high)]
