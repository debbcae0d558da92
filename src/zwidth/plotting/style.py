"""House style of all figures: sizes, line styles, colors, units, axis labels and file output.

All settings apply within a context; matplotlib's global settings do not change. *Panels* are the Axes of a figure. A
curve is *exact* unless its delay model is the paper's fractional power z^d. A unit system is linear or rotary.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from io import BytesIO
from pathlib import Path
from textwrap import fill
from typing import Any, NamedTuple, TypeAlias

import matplotlib
import numpy as np
from matplotlib import rc_params_from_file
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import AutoLocator, FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from zwidth.core.contexts import set_temporarily
from zwidth.core.errors import InputError
from zwidth.io.files import write_atomically
from zwidth.units.formatting import PREFIXES
from zwidth.units.quantities import PARAMETERS
from zwidth.units.unit_system import LINEAR, UnitSystem

# Palette of Okabe and Ito (2008), distinguishable with any color vision.
BLACK = "#000000"
ORANGE = "#E69F00"
SKY = "#56B4E9"
GREEN = "#009E73"
BLUE = "#0072B2"
VERMILION = "#D55E00"
PURPLE = "#CC79A7"
GRAY = "#6E6E6E"
DISTINCT = (BLUE, ORANGE, BLACK, GREEN, VERMILION, SKY, PURPLE)  # colors of curves that are not ordered by a value

# Line styles. They have the same meanings as in the figures of the paper and can be distinguished in gray prints.
SOLID = "-"
DASHED = (0, (5.0, 2.2))
DASH_DOTTED = (0, (6.0, 1.8, 1.2, 1.8))
DOTTED = (0, (1.2, 1.6))
STYLES = (SOLID, DASHED, DASH_DOTTED, DOTTED, (0, (11.0, 2.5)), (0, (6.0, 1.8, 1.2, 1.8, 1.2, 1.8)))
# Markers that distinguish curves if their line styles already have a meaning.
MARKERS = ("o", "s", "^", "v", "P", "X", "*")

# Spelling of units in labels, for those units whose spelling in datasets (UDUNITS) differs.
_WRITTEN = {"1": "", "degree": "degrees", "g cm^2": "g cm$^2$"}

# Line properties for curves over an integer parameter: points without lines between them.
POINTS: dict[str, Any] = {"linestyle": "", "marker": "o", "markersize": 3.5}

AnyAxes: TypeAlias = Axes | Sequence[Axes] | np.ndarray

WIDTH = 7.0  # width of a figure across both columns of a journal page, in inches
DECADES = 3000.0  # least ratio of the ends of an axis of stiffness for which only powers of ten have ticks
PNG_DPI = 180  # default resolution of PNG files, in dots per inch
LIGHTEST = 0.6  # position of the lightest curve color in the colormap viridis; its contrast to white is 3:1
_DENSE_TICKS = 5.0  # ratio of the ends of a logarithmic axis, below which ticks at 1, 2 and 5 are too few
_SINGLE_VALUE_RANGE = 2.0  # factor between a single value and each end of its logarithmic axis

# Metadata to omit from files, by file format, so that the same figure always has the same bytes.
_METADATA: Any = {".png": {"Software": None}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}

_RC = dict(rc_params_from_file(Path(__file__).with_name("house.mplstyle"), use_default_template=False))
Size: TypeAlias = tuple[float, float | None]
_ONE_COLUMN = 5.0  # least width of a figure with several columns of panels, in inches


class _FigureSettings(NamedTuple):
    """Settings of figures in the current context: rcParams of a style sheet, and further settings."""

    style: Mapping[Any, Any] = {}  # rcParams of a style sheet, which override the house style
    size: Size | None = None  # size of new figures in inches
    dpi: float | None = None  # resolution of saved figures
    system: UnitSystem = LINEAR  # units of axes and labels


_DEFAULTS = _FigureSettings()
_settings: ContextVar[_FigureSettings] = ContextVar("settings", default=_DEFAULTS)


@contextmanager
def house_style(system: UnitSystem | None = None) -> Iterator[None]:
    """Draw and save in the house style within the context, in the given unit system or the current one."""
    with style_sheet(system=system), matplotlib.rc_context({**_RC, **_settings.get().style}):
        yield


def units() -> UnitSystem:
    """Return the unit system of the figures drawn in the current context."""
    return _settings.get().system


@contextmanager
def style_sheet(
    file: Path | None = None, size: Size | None = None, dpi: float | None = None, system: UnitSystem | None = None
) -> Iterator[None]:
    """Change the settings of figures within the context; arguments that are None keep the current settings.

    Args:
        file: Path of a matplotlib style sheet, which overrides the house style.
        size: Width, or width and height, of new figures in inches. The size of an outer context has priority.
        dpi: Resolution of saved figures in dots per inch. The resolution of an outer context has priority.
        system: Unit system of axes and labels.

    Raises:
        InputError: The style sheet cannot be read.
    """
    outer = _settings.get()
    try:
        style = outer.style if file is None else dict(rc_params_from_file(file, use_default_template=False))
    except OSError as error:
        raise InputError(f"style: {file}: {error.strerror}; name a style sheet of matplotlib") from error
    with set_temporarily(
        _settings, _FigureSettings(style, outer.size or size, outer.dpi or dpi, system or outer.system)
    ):
        yield


def new_figure(width: float, height: float, rows: int = 1, columns: int = 1, **keywords: Any) -> tuple[Figure, Any]:
    """Return a new figure, which pyplot does not manage, and a 2-D array of its Axes.

    Args:
        width: Width in inches, unless the current context sets a size (`style_sheet`).
        height: Height in inches, unless the current context sets a size.
        rows: Number of rows of panels.
        columns: Number of columns of panels. In a narrow figure, all panels are arranged in one column.
        keywords: Arguments of `matplotlib.figure.Figure.subplots`.
    """
    engine = ConstrainedLayoutEngine(w_pad=0.06, h_pad=0.06, wspace=0.04, hspace=0.05)
    across, up = _settings.get().size or (width, height)
    if up is None:
        narrow = across < _ONE_COLUMN and columns > 1 and not {"width_ratios", "height_ratios"} & set(keywords)
        rows, columns, height = (rows * columns, 1, height * columns) if narrow else (rows, columns, height)
        # Scale the height by at least 0.9 in a narrower figure, because the height of labels does not change.
        up = height * min(1.0, max(across * (2.0 if narrow else 1.0) / width, 0.9))
    figure = Figure(figsize=(across, up), layout=engine)
    return figure, figure.subplots(rows, columns, squeeze=False, **keywords)


def panels(given: AnyAxes | None, count: int, width: float, height: float, columns: int = 1, **keywords: Any) -> Any:
    """Return a 1-D array of the Axes to draw into: the given ones, or those of a new figure.

    Args:
        given: Existing Axes; the first ``count`` of them are returned. None for a new figure.
        count: Number of panels.
        width: Width of a new figure in inches.
        height: Height of a new figure in inches.
        columns: Number of columns of panels in a new figure.
        keywords: Arguments of `matplotlib.figure.Figure.subplots`.
    """
    if given is not None:
        return np.asarray(given, dtype=object).ravel()[:count]
    _, axes = new_figure(width, height, -(-count // columns), columns, **keywords)
    for spare in axes.flat[count:]:
        spare.remove()
    for lowest in axes.flat[max(0, count - columns) : count]:
        # Show the tick labels of the lowest panel in each column, even if the column ends above the last row.
        lowest.tick_params(labelbottom=True)
    return axes.ravel()[:count]


def label_quantity(name: str) -> str:
    """Return the axis label of a normalized quantity (its name, such as "delta") in the current unit system."""
    if name != "alpha_max":
        return PARAMETERS[name].label_in(units())
    return rf"maximum stable stiffness  $\alpha_{{\max}} = K_{{\max}}T^2\!/{'J' if units().rotary else 'm'}$"


def write_unit(unit: str) -> str:
    """Return the spelling of a unit in labels and legends; "" for the unit 1."""
    return _WRITTEN.get(unit, unit)


def letter(axes: np.ndarray) -> None:
    """Set the titles of panels to (a), (b), (c); leave a single panel without title."""
    for ax, title in zip(axes if len(axes) > 1 else (), "abc", strict=False):
        ax.set_title(f"({title})")


def literal(text: Any) -> str:
    """Escape a text of the user so that matplotlib shows it literally, also in legends."""
    text = "".join(sign if sign.isprintable() or sign == "\n" else " " for sign in str(text)).replace("$", r"\$")
    # Prefix a zero-width space to a leading underscore, because legends omit labels that begin with one.
    return f"\u200b{text}" if text.startswith("_") else text


def label_axes(axes: np.ndarray, x: str, y: str, *, once: bool) -> None:
    """Label the x and y axes of each panel; with ``once``, label several panels together, by the figure's labels."""
    if once and len(axes) > 1:
        axes[0].figure.supxlabel(x, fontsize=9.0)
        axes[0].figure.supylabel(y, fontsize=9.0)
        return
    for ax in axes:
        ax.set(xlabel=x, ylabel=y)


def legend(
    axes: np.ndarray | Sequence[Axes], handles: Sequence[Any], *, outside: bool, loc: Any = "best", **keywords: Any
) -> None:
    """Add a legend, unless it would be empty.

    Args:
        axes: The panels.
        handles: Legend entries.
        outside: Place the legend above the panels, in as many columns as fit, instead of in the first panel.
        loc: Position of a legend in the first panel, as in matplotlib.
        keywords: Arguments of `matplotlib.figure.Figure.legend` for a legend above the panels; ``ncols`` is the largest
            number of columns.
    """
    if not handles:
        return
    if not outside:
        # Always pass ``loc``, even "best": if it is not passed, matplotlib warns when the search for the best place is
        # slow.
        axes[0].legend(handles=handles, loc=loc)
        return
    figure, columns = figure_of(axes), keywords.pop("ncols", 1)
    keywords = {"loc": "outside upper center"} | keywords | {"handles": handles}
    drawn = figure.legend(ncols=columns, **keywords)
    while (share := drawn.get_window_extent().width / figure.bbox.width) > 1.0 and columns > 1:
        columns -= 1
        drawn.remove()
        drawn = figure.legend(ncols=columns, **keywords)
    longest = max((len(text.get_text()) for text in drawn.get_texts()), default=0)
    for text in drawn.get_texts() if share > 1.0 else ():
        plain = text.get_text().replace(r"\$", "\0")
        if "$" not in plain:
            text.set_text(literal(fill(plain.replace("\0", "$"), max(int(0.9 * longest / share), 12))))


class _PlainLocator(LogLocator):
    """Locator of a logarithmic axis that chooses other ticks if fewer than two of the usual ones are visible."""

    def tick_values(self, vmin: float, vmax: float) -> Any:
        """Return the ticks of an axis from ``vmin`` to ``vmax``."""
        ticks = np.asarray(super().tick_values(vmin, vmax))
        low, high = sorted((vmin, vmax))
        if low <= 0 or np.count_nonzero((low <= ticks) & (ticks <= high)) > 1:
            return ticks
        # Use powers of ten on axes longer than a decade: with 2 and 5 times powers of ten, matplotlib would place no
        # ticks on axes of very many decades. Use linear ticks on shorter axes.
        wide = LogLocator() if high > 10.0 * low else AutoLocator()
        return wide.tick_values(low, high)


def use_logarithmic(ax: Axes, which: str, values: Any, wide: float = 100.0) -> None:
    """Make an axis logarithmic, with tick labels such as 0.1 and 50 instead of powers of ten.

    Args:
        ax: Axes to change.
        which: Axis, "x" or "y".
        values: Values along the axis, which determine its ticks; only finite positive values count.
        wide: Least ratio of the largest to the smallest value for which only powers of ten have ticks. Below this ratio
            2 and 5 times powers of ten also have ticks, and further multiples if the ratio is below `_DENSE_TICKS`.
    """
    getattr(ax, f"set_{which}scale")("log")
    axis, positive = getattr(ax, f"{which}axis"), np.asarray(values, dtype=np.float64)
    positive = positive[np.isfinite(positive) & (positive > 0)]
    if positive.size and positive.min() == positive.max():
        # Set the limits for a single value, because otherwise matplotlib shows decades around it.
        getattr(ax, f"set_{which}lim")(positive[0] / _SINGLE_VALUE_RANGE, positive[0] * _SINGLE_VALUE_RANGE)
    with_2_and_5 = not positive.size or positive.max() < wide * positive.min()
    dense = positive.size and positive.max() < _DENSE_TICKS * positive.min()
    axis.set_major_locator(
        _PlainLocator(subs=(1.0, 1.5, 2.0, 3.0, 5.0, 7.0) if dense else (1.0, 2.0, 5.0) if with_2_and_5 else (1.0,))
    )
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def use_whole(ax: Axes) -> None:
    """Place the ticks of the x axis at integers, if the axis is linear."""
    if ax.get_xscale() == "linear":
        ax.xaxis.set_major_locator(MaxNLocator("auto", integer=True))


def label_ends(ax: Axes, curves: Sequence[Any], ends: Sequence[float], colors: dict[float, Any]) -> None:
    """Write the delay of each exact curve to the right of its end.

    Args:
        ax: Axes of the curves.
        curves: The curves, with their delay as attribute ``d``.
        ends: Vertical coordinate of the right end of each curve.
        colors: Color of each delay.
    """
    named = [k for k, curve in enumerate(curves) if is_exact(curve)]
    texts = [f"$d = {curves[k].d:g}$" for k in named]
    name_heights(ax, texts, [ends[k] for k in named], [colors[curves[k].d] for k in named])


def name_heights(ax: Axes, names: Sequence[str], ends: Sequence[float], colors: Sequence[Any]) -> None:
    """Write names to the right of a panel, moved apart vertically if they would overlap.

    Args:
        ax: Axes of the panel.
        names: Names to write.
        ends: Vertical coordinate of each name, in the units of the axis.
        colors: Color of each name.
    """
    to_scale = ax.yaxis.get_transform().transform
    low, high = to_scale(np.array(ax.get_ylim()))
    heights = (to_scale(np.array(ends, dtype=np.float64)) - low) / (high - low)
    spec = ax.get_subplotspec()
    rows = spec.get_gridspec().nrows if spec else 1
    heights_apart = spread(heights, 0.18 * rows / figure_of(ax).get_figheight())
    look: dict[str, Any] = {"xycoords": "axes fraction", "fontsize": 8, "va": "center", "annotation_clip": False}
    for name, place, color in zip(names, heights_apart, colors, strict=True):
        ax.annotate(name, (1.015, place), color=color, **look)


def line(label: str, dash: Any = SOLID, width: float | None = None, color: str = GRAY, **keywords: Any) -> Line2D:
    """Return a legend entry: a label and a line with the given line style, width in points, color and properties."""
    return Line2D([], [], color=color, linestyle=dash, linewidth=width, label=label, **keywords)


def is_exact(curve: Any) -> bool:
    """Return whether a curve is exact, that is, its delay model is not the paper's fractional power."""
    return getattr(curve, "delay_model", "held") == "held"


def delay_model_handles(curves: Sequence[Any]) -> list[Line2D]:
    """Return legend entries that explain solid and dashed lines, if some curves use the paper's fractional power."""
    both = not all(map(is_exact, curves))
    return [line("held delay (exact)"), line(r"fractional power $z^{1+d}$", DASHED)] if both else []


def figure_of(drawn: AnyAxes | Figure) -> Figure:
    """Return the figure that contains the given Axes, or the given figure itself."""
    figure = drawn if isinstance(drawn, Figure) else np.asarray(drawn, dtype=object).flat[0].get_figure(root=True)
    assert isinstance(figure, Figure), "an Axes belongs to a figure"
    return figure


def save(
    drawn: AnyAxes | Figure, stem: Path | str, formats: Sequence[str] = ("png", "svg"), dpi: float | None = None
) -> tuple[Path, ...]:
    """Write a figure to one file per format and return their paths; the same figure always has the same bytes.

    Args:
        drawn: The figure, or its Axes.
        stem: Path of the files without suffix.
        formats: File formats: "png", "svg" or "pdf".
        dpi: Resolution in dots per inch of PNG files, and of images within SVG and PDF files. Default: 180 for PNG.
    """
    figure, stem = figure_of(drawn), Path(stem)
    files = tuple(stem.with_name(f"{stem.name}.{ending}") for ending in formats)
    engine = figure.get_layout_engine()
    with house_style():
        for file in files:
            usual = PNG_DPI if file.suffix == ".png" else "figure"
            kind = {"format": file.suffix[1:], "metadata": _METADATA[file.suffix]}
            figure.savefig(drawing := BytesIO(), dpi=dpi or _settings.get().dpi or usual, **kind)
            write_atomically(file, drawing.getvalue())
            # Compute the layout only for the first format and keep it for the others, because it takes half the run
            # time.
            figure.set_layout_engine(None)
    figure.set_layout_engine(engine)
    return files


def ordered_colors(count: int) -> list[Any]:
    """Return ``count`` colors for values in ascending order; colors of larger values are darker."""
    shades = np.linspace(LIGHTEST, 0.0, count) if count > 1 else np.array([0.25])
    return [matplotlib.colormaps["viridis"](shade) for shade in shades]


def color_by_value(values: Sequence[float]) -> dict[float, Any]:
    """Return a color for each distinct value; colors of larger values are darker."""
    distinct = sorted(set(values))
    return dict(zip(distinct, ordered_colors(len(distinct)), strict=True))


def look(k: int) -> dict[str, Any]:
    """Return the color and the line style of the k-th curve; those of the first six curves differ from each other."""
    return {"color": DISTINCT[k % len(DISTINCT)], "linestyle": STYLES[k % len(STYLES)]}


def pick_evenly(count: int, most: int) -> list[int]:
    """Return the indices of all of ``count`` values, or of ``most`` evenly spaced ones if there are more."""
    return list(range(count)) if count <= most else sorted({round(place) for place in np.linspace(0, count - 1, most)})


def span(low: float, high: float, margin: float = 0.05) -> tuple[float, float]:
    """Return a range of an axis: from ``low`` to ``high``, with a margin relative to this width on both sides."""
    width = (high - low) or abs(high) or 1.0
    return low - margin * width, high + margin * width


def spread(positions: Sequence[float], gap: float) -> np.ndarray:
    """Move positions to be at least ``gap`` apart, by as little as possible and without changing their order."""
    order = np.argsort(positions, kind="stable")
    steps = gap * np.arange(len(positions))
    # Solve by isotonic regression (least squares): positions that would be too close form a group around their mean.
    groups: list[list[float]] = []
    for place in np.asarray(positions, dtype=np.float64)[order] - steps:
        groups.append([place])
        while len(groups) > 1 and np.mean(groups[-2]) > np.mean(groups[-1]):
            groups[-2:] = [groups[-2] + groups[-1]]
    placed = np.empty(len(positions))
    placed[order] = [np.mean(group) for group in groups for _ in group] + steps
    return placed


def add_si_axes(ax: Axes, scale: tuple[float, float]) -> None:
    """Add axes of stiffness and virtual damping in SI units at the top and the right of an (alpha, beta) plane.

    ``scale`` contains the stiffness at alpha = 1 and the damping at beta = 1, in SI units.
    """
    ax.spines[["top", "right"]].set_visible(True)
    ends, names = (ax.get_xlim()[1], max(map(abs, ax.get_ylim()))), ("N/m", "N s/m")
    secondary_axes: Any = (
        (ax.secondary_xaxis, "top", "stiffness  $K$"),
        (ax.secondary_yaxis, "right", "virtual damping  $B$"),
    )
    for (add, side, words), si_per_unit, end, unit in zip(secondary_axes, scale, ends, names, strict=True):
        factor, unit_text = si_unit(si_per_unit * end, unit)
        both = (lambda value, by=si_per_unit * factor: value * by), (lambda value, by=si_per_unit * factor: value / by)
        add(side, functions=both).set(**{"xlabel" if side == "top" else "ylabel": f"{words}  in {unit_text}"})


def si_unit(values: Any, unit: str) -> tuple[float, str]:
    """Choose an SI prefix for values, so that the largest has one to three digits before the decimal point.

    Args:
        values: Values in ``unit``, or in the corresponding unit of a rotary device.
        unit: Unit of the values for a linear device.

    Returns:
        The factor by which the values are multiplied, and their unit with prefix in the current unit system.
    """
    unit, largest = units()[unit], float(np.nanmax(np.abs(values), initial=0.0))
    if not np.isfinite(largest) or largest <= 0 or unit == "sampling periods" or unit.startswith("1"):
        # Do not add a prefix to an inverse unit, because it would seem to belong to the unit in the denominator.
        return 1.0, unit
    if unit == "kg":
        return (1.0, unit) if largest >= 1 else (1e3, "g")
    if unit == "kg m^2":
        return 1e7, "g cm$^2$"
    power = int(np.clip(3 * np.floor(np.log10(largest) / 3), -12, 9))
    return 10.0**-power, PREFIXES[power] + unit
