"""Draw results of identification: a fitted device with its stability boundary, and a measured frequency response.

A device is fitted either to *logs*, recorded motions, or to *onsets of instability*, walls at which the operator
observed the beginning of a limit cycle. Tables call such walls "onset", and the wall that is recommended for use
"set". Columns of tables are named as in the CSV files of fit studies. K and B are the stiffness and the virtual damping
of a wall, G the measured response from force to position, L the open loop with a wall.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection

from zwidth.plotting import style
from zwidth.plotting.stable_set import MARKS, mark_wall, name_axes
from zwidth.plotting.table import SI_COLUMNS, Table, curves, draws_tables, select
from zwidth.units.formatting import round_conservatively

_MAX_SAMPLES = 4000  # largest number of samples drawn per panel; longer logs are thinned evenly
_TEXT: dict[str, Any] = {"textcoords": "offset points", "fontsize": 8, "zorder": 6}  # properties of texts at walls
_DOT: dict[str, Any] = {"linestyle": "", "marker": ".", "markersize": 2.0, "rasterized": True}  # dots of residuals
_LOW = "stiffness_low_N_per_m"  # name of the column with the lower end of the 95 % band of the boundary
_HIGH = "stiffness_high_N_per_m"  # name of the column with the upper end of the 95 % band of the boundary
# Color of the boundary, color of its band, and line style, for the first and for the second fit.
_FITS = ((style.BLUE, style.SKY, style.SOLID), (style.GREEN, style.GREEN, style.DASHED))
_ROWS = ("position", "residuals", "autocorrelation", "walls")  # names of the panels on the left, from top to bottom


@draws_tables
def draw_device_fit(
    boundary: Table,
    walls: Table,
    axes: style.AnyAxes | None = None,
    *,
    motion: Table | None = None,
    correlation: Table | None = None,
    step: float = 0.0,
) -> np.ndarray:
    """Draw a fitted device: measured motion, residuals, their autocorrelation, and the stable walls.

    The last panel shows the stability boundary with its 95 % band, the stiffest wall, the recommended wall, and the
    onsets of instability. For a fit to a log, the panels before it show the measured and the modeled position, the
    residuals, and their autocorrelation with the 95 % band of white noise. For a fit to onsets, one panel shows their
    deviations from the fit, in standard deviations of their noise.

    Args:
        boundary: Columns virtual_damping and stiffness with its lower and upper end, of one or several fits, given by
            the column ``fitted_to``.
        walls: Columns fitted_to, kind ("stiffest", "set" for the recommended wall, or "onset" of instability),
            stiffness, its error, virtual_damping, frequency; for onsets also stiffness_residual and frequency_residual.
        axes: Existing Axes, one per panel.
        motion: Columns log, time, position, modeled and residual of the logs.
        correlation: Columns lag, autocorrelation and band of the logs.
        step: Encoder step, drawn with the residuals; 0 for none.
    """
    names = [*(_ROWS[:3] if motion is not None and correlation is not None else ())]
    names += ["walls"] if "onset" in np.asarray(walls["kind"]) else []
    panels = dict(zip([*names, "boundary"], _make_panels(axes, len(names)), strict=False))
    if motion is not None and correlation is not None:
        _draw_motion(panels, motion, step)
        if "autocorrelation" in panels:
            _draw_correlation(panels["autocorrelation"], correlation)
    if "walls" in panels:
        _draw_onsets(panels["walls"], walls)
    if "boundary" in panels:
        _draw_boundary(panels["boundary"], boundary, walls)
    for ax, name in zip(panels.values(), "abcde", strict=False):
        ax.set_title(f"({name})" + (f" {ax.get_title('left')}" if ax.get_title("left") else ""))
    return np.array(list(panels.values()), dtype=object)


def _make_panels(axes: style.AnyAxes | None, rows: int) -> Any:
    """Return the given Axes, or those of a new figure: ``rows`` panels on the left and one panel on the right."""
    if axes is not None:
        return np.asarray(axes, dtype=object).ravel()[: rows + 1]
    figure, _ = style.new_figure(8.8, max(3.6, 1.55 * rows + 0.7))
    figure.clear()
    shape: Any = [[str(row), "right"] for row in range(rows)] or [["right"]]
    axes_by_name = figure.subplot_mosaic(shape, width_ratios=(1.0, 1.05) if rows else (1.0,))
    return [*(axes_by_name[str(row)] for row in range(rows)), axes_by_name["right"]]


def _draw_motion(panels: dict[str, Axes], motion: Table, step: float) -> None:
    """Draw measured and modeled position, and the residuals, of the first log.

    Args:
        panels: Axes by name; "position" and "residuals" are optional.
        motion: Columns log, time, position, modeled and residual.
        step: Encoder step, drawn with the residuals; 0 for none.
    """
    logs = np.asarray(motion["log"])
    first = select(motion, log=logs[0])
    thin = slice(None, None, max(1, -(-logs[logs == logs[0]].size // _MAX_SAMPLES)))
    time, place, model, rest = (first[name] for name in ("time_s", "position_m", "modeled_m", "residual_m"))
    clock, second = style.si_unit(time[-1] - time[0], "s")
    time = (time - time[0]) * clock
    if "position" in panels:
        ax = panels["position"]
        factor, length = style.si_unit(np.ptp(place), "m")
        ax.plot(time[thin], place[thin] * factor, color=style.GRAY, linewidth=2.4, alpha=0.55, label="measured")
        ax.plot(time[thin], model[thin] * factor, color=style.VERMILION, linewidth=0.9, label="modeled")
        ax.set(ylabel=f"{'angle' if style.units().rotary else 'position'}  in {length}", xlim=(0.0, time[-1]))
        ax.tick_params(labelbottom="residuals" not in panels)
        _put_above(ax)
        count = np.unique(logs).size
        ax.set_title(f"the first of {count} logs" if count > 1 else "")
    if "residuals" in panels:
        ax = panels["residuals"]
        factor, length = style.si_unit(rest, "m")
        ax.plot(time[thin], rest[thin] * factor, color=style.BLUE, label="residual", **_DOT)
        ax.axhline(0.0, color=style.GRAY, linewidth=0.6)
        for end in (-0.5 * step, 0.5 * step) if step else ():
            ax.axhline(
                end * factor, color=style.BLACK, linestyle=style.DASHED, linewidth=0.8, label="half an encoder step"
            )
        ax.set(xlabel=f"time  in {second}", ylabel=f"measured minus\nmodeled  in {length}", xlim=(0.0, time[-1]))
        if step:
            _put_above(ax, [style.line("half an encoder step", style.DASHED, 0.8, style.BLACK)])
            far = factor * max(0.62 * step, float(np.nanmax(np.abs(rest))))
            ax.set_ylim(*style.span(-far, far, 0.12))


def _draw_correlation(ax: Axes, correlation: Table) -> None:
    """Draw the autocorrelation of the residuals over the lag, with the 95 % band of white noise."""
    lag, band = (np.asarray(correlation[name]) for name in ("lag_s", "band"))
    factor, second = style.si_unit(lag, "s")
    values = np.asarray(correlation["autocorrelation"])
    far = lag[-1] * factor * 1.02
    ax.axhspan(-band[0], band[0], color=style.GRAY, alpha=0.22, linewidth=0.0, label="95 % band of white noise")
    ax.vlines(lag * factor, 0.0, values, color=style.BLUE, linewidth=1.1, label="autocorrelation")
    ax.axhline(0.0, color=style.GRAY, linewidth=0.6)
    largest = max(0.2, 1.25 * float(np.nanmax(np.abs(values), initial=0.0)))
    ax.set(xlabel=f"lag  in {second}", ylabel="autocorrelation\nof residuals", xlim=(0.0, far))
    ax.set_ylim(-largest, largest)
    _put_above(ax)


def _put_above(ax: Axes, handles: Any = None) -> None:
    """Add a legend in one row above a panel, to the right of its title; by default it lists all labeled lines."""
    entries = handles or ax.get_legend_handles_labels()[0]
    place = {"loc": "lower right", "bbox_to_anchor": (1.0, 0.97), "borderaxespad": 0.0}
    ax.legend(handles=entries, ncols=len(entries), columnspacing=1.2, **place)


def _draw_onsets(ax: Axes, walls: Table) -> None:
    """Draw the deviations of the onsets of instability from the fit, in standard deviations of their noise."""
    onsets = select(walls, kind="onset")
    factor, unit = style.si_unit(onsets[SI_COLUMNS[1]], "N s/m")
    for name, marker, color in (("stiffness", "o", style.VERMILION), ("frequency", "s", style.BLUE)):
        values = np.asarray(onsets[f"{name}_residual"])
        ax.plot(onsets[SI_COLUMNS[1]] * factor, values, marker, color=color, markersize=4.5, label=name, zorder=3)
    ax.axhspan(-1.96, 1.96, color=style.GRAY, alpha=0.22, linewidth=0.0, label="95 %")
    ax.axhline(0.0, color=style.GRAY, linewidth=0.6)
    far = max(3.0, *(1.2 * float(np.nanmax(np.abs(onsets[f"{name}_residual"]))) for name in ("stiffness", "frequency")))
    ax.set(ylim=(-far, far), xlabel=f"virtual damping  $B$  in {unit}", ylabel="onset minus fit,\nstandardized")
    ax.margins(x=0.1)
    _put_above(ax)


def _draw_boundary(ax: Axes, boundary: Table, walls: Table) -> None:
    """Draw the stability boundary of each fit in the plane of K and B, with its 95 % band and marked walls."""
    every, high, dampings = np.asarray(walls[SI_COLUMNS[0]]), np.asarray(boundary[_HIGH]), boundary[SI_COLUMNS[1]]
    to_spring, spring = style.si_unit(every, "N/m")
    to_damper, damper = style.si_unit(dampings, "N s/m")
    handles, colors = [], {}
    for fit, (color, shade, dash) in zip(curves(boundary, "fitted_to"), _FITS, strict=False):
        columns, source = vars(fit), style.literal(fit.fitted_to)
        colors[fit.fitted_to] = color
        K, low, up = (columns[name] * to_spring for name in (SI_COLUMNS[0], _LOW, _HIGH))
        B = columns[SI_COLUMNS[1]] * to_damper
        ax.fill_betweenx(B, low, up, color=shade, alpha=0.4, linewidth=0.0, zorder=2, label=f"band, {source}")
        # Draw the part of the boundary with K > 0 and one more point at each end, so that the curve reaches the line K
        # = 0.
        ends = np.flatnonzero(K > 0)
        shown = slice(max(int(ends[0]) - 1, 0), int(ends[-1]) + 2) if ends.size else slice(0)
        ax.fill_betweenx(B[shown], 0.0, K[shown], color=shade, alpha=0.08, linewidth=0.0, zorder=1)
        ax.plot(K[shown], B[shown], color=color, linestyle=dash, label=f"boundary, {source}", zorder=3)
        handles.append(style.line(f"boundary with its 95 % band, {source}", dash, color=color))
    # Mark the walls of two fits in the colors of their boundaries, to distinguish them; those of a single fit in black.
    colors = colors if len(colors) > 1 else dict.fromkeys(colors, style.BLACK)
    handles += _mark_walls(ax, walls, colors, (to_spring, spring), (to_damper, damper))
    ax.set_xlim(0.0, 1.15 * max(float(np.nanmax(high, initial=0.0)), float(np.nanmax(every))) * to_spring)
    # Extend the axis of B upwards by the height of the legend, so that the legend covers no wall.
    highest = float(np.max(dampings)) * to_damper
    ax.set_ylim(-0.05 * highest, (0.98 + 0.045 * len(handles)) * highest)
    name_axes(ax, spring, damper)
    ax.legend(handles=handles, loc="upper right")


def _mark_walls(
    ax: Axes, walls: Table, colors: dict[str, str], stiffness: tuple[float, str], damping: tuple[float, str]
) -> list[Any]:
    """Mark the stiffest walls, the recommended walls and the onsets of instability; return legend entries.

    Args:
        ax: Axes of the boundary.
        walls: Table of walls, with the columns that `draw_device_fit` describes.
        colors: Color of each fit.
        stiffness: Factor from N/m to the unit of the stiffness axis, and this unit.
        damping: Factor from N s/m to the unit of the damping axis, and this unit.
    """
    handles, kinds = [], {}
    for kind in ("stiffest", "set", "onset"):
        selected = select(walls, kind=kind)
        K, B = selected[SI_COLUMNS[0]] * stiffness[0], selected[SI_COLUMNS[1]] * damping[0]
        kinds[kind] = selected, K, B
    for kind, mark, words in (
        ("stiffest", "stiffest", "stiffest stable wall"),
        ("set", "recommended", "recommended wall"),
    ):
        selected, *values = kinds[kind]
        for fit, K, B in zip(selected["fitted_to"], *values, strict=True):
            color = colors.get(fit, style.BLACK)
            mark_wall(ax, (K, B), kind, kind=mark, color=color)
            # Round K down, because the wall with the printed K must be stable, too.
            numbers = f"$K = {round_conservatively(K, 'below'):.4g}$ {stiffness[1]}, $B = {B:.4g}$ {damping[1]}"
            handles.append(style.line(f"{words}: {numbers}", "", color=color, **MARKS[mark]))
    if not kinds["set"][1].size:
        handles.append(style.line("no wall recommended", ""))
    selected, K, B = kinds["onset"]
    if K.size:
        look = {"color": style.VERMILION, "markersize": 5.0, "marker": "X"}
        reach = 1.96 * selected["stiffness_error_N_per_m"] * stiffness[0]
        ax.errorbar(K, B, xerr=reach, linestyle="", zorder=5, capsize=2.0, label="onset", **look)
        middle = float(np.max(kinds["stiffest"][2]))
        for x, y, frequency in zip(K, B, selected["frequency_Hz"], strict=True):
            # Write the frequency of an onset outside of the shaded region of stable walls: below the onset in the lower
            # half of the region, above it in the upper half.
            place = (11, -10) if y < middle else (11, 5)
            ax.annotate(f"{frequency:.3g} Hz", (x, y), xytext=place, color=style.VERMILION, **_TEXT)
        handles.append(style.line("onset of instability, with frequency", "", **look))
    return handles


_REQUIRED_COLUMNS = ("frequency_Hz", "real_m_per_N", "imag_m_per_N")  # columns of every measured response
_OPTIONAL_COLUMNS = ("deviation_m_per_N", "open_loop_real", "open_loop_imag")  # columns for the band and a wall
_REACH = 1.6  # half the width of the panel of the open loop, which is centered at -1


@draws_tables
def draw_response(table: Table, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw a measured frequency response G with its uncertainty band; for a wall, also the open loop L around -1.

    The band consists of discs around the points of G, which become discs around the points of L. A stable wall remains
    stable for every response in the band if no disc around L contains -1.

    Args:
        table: Columns frequency_Hz, real_m_per_N, imag_m_per_N; optionally deviation_m_per_N, the radius of the band,
            and open_loop_real and open_loop_imag for a wall.
        axes: Existing Axes for the magnitude; or for magnitude and phase; or for both and the open loop.
    """
    columns: Any = {
        name: np.asarray(table[name], float) for name in (*_REQUIRED_COLUMNS, *_OPTIONAL_COLUMNS) if name in table
    }
    f, G = columns["frequency_Hz"], columns["real_m_per_N"] + 1j * columns["imag_m_per_N"]
    radius, size = columns.get("deviation_m_per_N", np.zeros(f.size)), np.abs(G)
    with_loop = "open_loop_real" in columns
    panels = style.panels(axes, 2 + with_loop, style.WIDTH, 2.7, columns=2 + with_loop)
    # Draw the phase only where the band excludes G = 0, because otherwise every phase is possible.
    clear = radius < size
    band: Any = {"color": style.SKY, "alpha": 0.5, "linewidth": 0}
    least = 0.3 * float(size.min())
    panels[0].fill_between(f, np.maximum(size - radius, 0.1 * least), size + radius, label="band", **band)
    panels[0].plot(f, size, color=style.BLUE, label="measured")
    panels[0].set(
        yscale="log",
        ylabel=f"response  $|G|$  in {style.units()['m/N']}",
        ylim=(least, 3.0 * float((size + radius).max())),
    )
    panels[0].legend(loc="lower left", fontsize=7)
    if len(panels) > 1:
        phase = np.degrees(np.unwrap(np.angle(G[clear])))
        spread = np.degrees(np.arcsin(radius[clear] / size[clear]))
        phase -= 360.0 * np.round((phase[:1] + 120.0) / 360.0)
        panels[1].fill_between(f[clear], phase - spread, phase + spread, **band)
        panels[1].plot(f[clear], phase, color=style.BLUE)
        panels[1].set_ylabel("phase in degrees")
    for ax in panels[:2]:
        ax.set(xscale="log", xlim=(f[0], f[-1]), xlabel="frequency  $f$  in Hz")
    if with_loop and len(panels) > 2:
        _draw_loop(panels[2], columns["open_loop_real"] + 1j * columns["open_loop_imag"], radius / size)
    return panels


def _draw_loop(ax: Any, L: np.ndarray, share: np.ndarray) -> None:
    """Draw the open loop L, the uncertainty disc around each of its points, and the point -1.

    ``share`` is the radius of each disc relative to |L|, equal to the radius of the band of G relative to |G|.
    """
    near = np.abs(1.0 + L) < 2.0 * _REACH
    wide = 2.0 * (share * np.abs(L))[near]
    look: Any = {"units": "xy", "offset_transform": ax.transData, "color": style.SKY, "alpha": 0.3, "linewidth": 0}
    x, y = np.real(L), np.imag(L)
    ax.add_collection(EllipseCollection(wide, wide, 0.0 * wide, offsets=np.column_stack([x, y])[near], **look))
    ax.plot(x, y, color=style.BLUE, label="open loop $L$")
    ax.plot(-1.0, 0.0, "x", color=style.VERMILION, label="$-1$")
    ax.set(xlim=(-1.0 - _REACH, -1.0 + _REACH), ylim=(-_REACH, _REACH), aspect="equal")
    ax.set(xlabel="real part of $L$", ylabel="imaginary part of $L$")
