"""What a wanted stiffness needs: the stiffest wall over one parameter, with the values that are enough."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from zwidth.figures import style
from zwidth.figures.table import SI_COLUMNS, Table
from zwidth.words.formatting import header
from zwidth.words.quantities import PARAMETERS

_WORDS = {"above": "or more", "below": "or less"}


@style.house_style()
def draw_requirement(curve: Table, required: Table, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw the stiffest stable wall over a parameter, and where it reaches each wanted stiffness.

    Args:
        curve: columns parameter, value with its unit (as ``value_Hz``), stiffness_N_per_m.
        required: columns of a design study: stiffness_N_per_m, reserve, present and value with their unit, enough, and
            stable_share where tolerances are given.
        axes: an Axes of yours.
    """
    (ax,) = panels = style.panels(axes, 1, 5.6, 3.8)
    parameter = PARAMETERS[str(np.asarray(curve["parameter"])[0])]
    value_in, present_in = (header(name, parameter.unit) for name in ("value", "present"))
    values, stiffness = np.asarray(curve[value_in]), np.asarray(curve[SI_COLUMNS[0]])
    wanted = np.asarray(required[SI_COLUMNS[0]])
    targets = wanted * required["reserve"]
    factor, unit = style.si_unit(np.append(stiffness, targets), "N/m")
    known = np.concatenate([values, required[value_in], required[present_in]])
    scale, spelled = style.si_unit(np.sqrt(np.nanmax(known) * values.min()), parameter.unit)
    ax.plot(values * scale, stiffness * factor, color=style.BLACK, label="K_max", zorder=3)
    colors = style.color_by_value(targets.tolist())
    ax.set(xscale="log", yscale="log")
    _mark_present(ax, values * scale, stiffness * factor, float(required[present_in][0]) * scale)
    rows = zip(targets, required[value_in], required["enough"], strict=True)
    curve_drawn = np.stack([values * scale, stiffness * factor])
    names = [
        _mark_required(ax, curve_drawn, target * factor, value * scale, str(enough), colors[target], spelled)
        for target, value, enough in rows
    ]
    for name, scaled in (("x", values * scale), ("y", stiffness * factor)):
        style.use_logarithmic(ax, name, scaled, style.DECADES)
    ax.set(
        xlim=(values[0] * scale, values[-1] * scale),
        xlabel=f"{parameter.words}  ${parameter.symbol}$  in {spelled}",
        ylabel=f"maximum stable stiffness  $K_{{\\max}}$  in {unit}",
    )
    # Beside the panel: below its dot a value would stand on the line of the next one.
    style.name_heights(ax, names, (targets * factor).tolist(), [colors[target] for target in targets])
    handles = [style.line(words, style.DASHED, color=colors[at]) for at, words in _name_targets(required, factor, unit)]
    handles.append(style.line("as it is", "", color=style.BLACK, marker="s", markerfacecolor="white", markersize=5))
    style.legend(panels, handles, outside=axes is None, ncols=2)
    return panels


def _name_targets(required: Table, factor: float, unit: str) -> Iterator[tuple[float, str]]:
    """What each dashed line stands for: the wanted stiffness, its reserve, and the share of devices that bear it."""
    borne = "stable_share" in required
    shares = required["stable_share"] if borne else np.full(len(required["reserve"]), np.nan)
    for wanted, reserve, share in zip(required[SI_COLUMNS[0]], required["reserve"], shares, strict=True):
        words = f"{wanted * factor:.3g} {unit}" + (rf" $\times\,{reserve:g}$" if reserve != 1 else "")
        yield wanted * reserve, words + (f", borne by {100 * share:.3g} %" if np.isfinite(share) else "")


def _mark_present(ax: Axes, values: np.ndarray, stiffness: np.ndarray, present: float) -> None:
    if not values[0] <= present <= values[-1]:
        return
    height = np.exp(np.interp(np.log(present), np.log(values), np.log(stiffness)))
    look: dict[str, Any] = {"marker": "s", "markersize": 5, "markerfacecolor": "white", "color": style.BLACK}
    ax.plot([present], [height], linestyle="", label="present", zorder=5, **look)


def _mark_required(ax: Axes, curve: np.ndarray, target: float, value: float, enough: str, color: Any, unit: str) -> str:
    """Mark the wanted stiffness, and where on the curve there is enough for it; returns the value that is, in words."""
    ax.axhline(target, color=color, linewidth=0.9, linestyle=style.DASHED, zorder=2, label=f"wanted {target:g}")
    known = np.isfinite(value) and enough in _WORDS
    x, y = (np.append(part, end) for part, end in zip(curve, (value, target) if known else (np.nan,) * 2, strict=True))
    order = np.argsort(x)
    band = np.where(y[order] >= target, target, np.nan)
    ax.plot(x[order], band, color=color, linewidth=3.5, alpha=0.35, label="enough", zorder=2.5)
    if not known:
        return ""
    ax.plot([value], [target], linestyle="", marker="o", markersize=6, color=color, label="required", zorder=6)
    return f"{_round_safely(value, enough):g} {unit} {_WORDS[enough]}"


def _round_safely(value: float, enough: str) -> float:
    """Three digits, to the side on which there is enough."""
    step = 10.0 ** (np.floor(np.log10(value)) - 2)
    # A value that has three digits stays, whatever the rounding of the quotient.
    return float((np.ceil(value / step - 1e-9) if enough == "above" else np.floor(value / step + 1e-9)) * step)
