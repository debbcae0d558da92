"""Figures from the store of a sweep: which of its variables are drawn, over what, and at which values of the rest."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from zwidth.errors import InputError, StoreError
from zwidth.figures import save
from zwidth.figures.curves import draw_curves, draw_outlines
from zwidth.figures.plane import draw_plane
from zwidth.figures.style import si_unit
from zwidth.figures.sweep_data import CurvesData, Panel, PlaneData, Quantity, Scale
from zwidth.quantities import NOT_COMPUTED, OUTPUTS, PARAMETERS, STATUS_OF, WALL
from zwidth.sweep.store import SUFFIX, find_stores, open_dataset

if TYPE_CHECKING:
    import xarray

FOLDER = "figures"

# As many values as one panel, or one of several, resolves; of a finer grid every n-th is drawn.
_RESOLVED, _RESOLVED_BY_MANY = 1000, 500
# A grid of more panels than this says nothing on a page: evenly spaced values stand for all.
_ACROSS = 3
_MANY_PANELS = 9
# Fewer values than this along both axes are curves rather than a surface.
_SURFACE = 6
_OUTLINES = 9

# What an axis of a plane is, rather than a choice of panels: the first two that vary.
_ORDER = ("alpha", "stiffness", "beta", "virtual_damping", "delta", "damping", "d", "delay", "rate", "period", "mass")
# The boundary by the first of these that a store has: a number gives a smoother line than a truth value.
_BOUNDARIES = (("margin", 0.0), ("spectral_radius", 1.0), ("stable", 0.5))


def draw_stores(
    path: str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    *,
    at: Mapping[str, float | str] | None = None,
    progress: Callable[[Path], None] | None = None,
) -> tuple[Path, ...]:
    """Draw the sweeps in a store, or in all stores of a folder, as PNG and SVG.

    Args:
        path: a store ``<study>.zarr`` or the folder of a run.
        out: where the figures go; ``figures`` beside the stores where left out. Figures that are there are replaced.
        at: values of parameters by name, in the units of the store, or the label of a device: the slices to draw. The
            nearest values that the sweep has are taken; of a parameter that is not given, up to three are shown.
        progress: called with every file when it is there.

    Returns:
        The files.

    Raises:
        StoreError: there is no store, or one is damaged.
        InputError: no sweep has a parameter of ``at``, or not the device.
    """
    folder = Path(os.fsdecode(path))
    stores = find_stores(folder)
    if not stores:
        raise StoreError(f"{folder}: holds no store of a sweep; name the folder of a run, or a store in it")
    beside = folder.parent if stores == [folder] else folder
    target = beside / FOLDER if out is None else Path(os.fsdecode(out))
    wanted = dict(at or {})
    views = {store: _View(open_dataset(store), wanted) for store in stores}
    unknown = [name for name in wanted if not any(name in view.data.dims for view in views.values())]
    if unknown:
        known = dict.fromkeys(str(dim) for view in views.values() for dim in view.data.dims)
        raise InputError(f"at: no sweep in {folder} varies {unknown[0]!r}; choose from {', '.join(known)}")
    target.mkdir(parents=True, exist_ok=True)
    files = []
    for store, view in views.items():
        for name, draw in view.figures():
            for file in save(draw(), target / f"{store.name.removesuffix(SUFFIX)}_{name}"):
                files.append(file)
                (progress or (lambda file: None))(file)
    return tuple(files)


class _View:
    """What is drawn of one dataset.

    Args:
        data: as `open_dataset` gives it.
        at: the slices that are wanted.
    """

    def __init__(self, data: xarray.Dataset, at: dict[str, float | str]) -> None:
        self.data = data
        self.chosen = {str(dim): _nearest(data, str(dim), at[str(dim)]) for dim in data.dims if str(dim) in at}

    def figures(self) -> Iterator[tuple[str, Callable[[], Figure]]]:
        """The name of each figure and what draws it."""
        for name in map(str, self.data.data_vars):
            if name not in OUTPUTS or name == "kind":
                continue
            if name == "passive" and "stable" in self.data:
                continue
            axes = self._axes(name)
            if not axes:
                continue
            quantity = self._quantity(name)
            few = min(self.data.sizes[axis] for axis in axes) < _SURFACE
            if len(axes) == 2 and not (OUTPUTS[name].family == "device" and few):
                yield name, lambda name=name, quantity=quantity: draw_plane(self._plane(name), quantity)
            elif OUTPUTS[name].dtype == "float64":
                yield name, lambda name=name, quantity=quantity: draw_curves(self._curves(name, quantity), quantity)
        for name, level in _BOUNDARIES:
            family = self._outlined(name)
            if family:
                yield "boundaries", lambda name=name, level=level, family=family: self._outlines(name, level, family)
                break

    def _axes(self, name: str) -> list[str]:
        """One or two parameters that a variable is drawn over."""
        dims = [dim for dim in _ORDER if dim in self.data[name].dims and self.data.sizes[dim] > 1]
        return [dim for dim in dims if dim not in self.chosen][:2]

    def _panels(self, dims: list[str]) -> tuple[list[dict[str, int]], int]:
        """Which values of the other parameters have a panel, and how many panels are beside each other."""
        free = [dim for dim in dims if dim not in self.chosen and self.data.sizes[dim] > 1]
        shown = free[-2:]
        most = _MANY_PANELS if len(shown) == 1 else _ACROSS
        values = {dim: _evenly(self.data.sizes[dim], most) for dim in shown}
        fixed = {dim: self.chosen.get(dim, 0) for dim in dims if dim not in shown}
        places = [fixed | dict(zip(shown, place, strict=True)) for place in product(*values.values())]
        columns = len(values[shown[-1]]) if len(shown) == 2 else min(_ACROSS, len(places))
        return places, 2 if len(places) == 4 and len(shown) == 1 else columns

    def _title(self, place: Mapping[str, int]) -> str:
        """The values of a panel."""
        parts = []
        for dim, index in place.items():
            if dim == "device":
                parts.insert(0, str(self.data["device"].values[index]))
            else:
                parts.append(self._scale(dim).at(index))
        return ",  ".join(parts)

    def _scale(self, name: str) -> Scale:
        """A parameter as an axis."""
        parameter = PARAMETERS[name]
        values = np.asarray(self.data[name].values, dtype=float)
        unit = str(self.data[name].attrs.get("units", "1"))
        factor, unit = _readable(values, unit)
        definition = f" = {parameter.definition}" if parameter.definition else ""
        label = f"{parameter.words}  ${parameter.symbol}{definition}$"
        steps = values[1:] / values[:-1] if values.ndim and values.size > 2 and (values > 0).all() else np.empty(0)
        spaced = bool(steps.size and np.allclose(steps, steps[0], rtol=1e-6) and not np.isclose(steps[0], 1.0))
        plain_unit = "periods" if unit == "sampling periods" else unit
        label += f"  in {unit}" if unit else ""
        return Scale(name, parameter.symbol, label, plain_unit, values * factor, spaced)

    def _quantity(self, name: str) -> Quantity:
        output = OUTPUTS[name]
        if output.look == "truth":
            return Quantity(name, name, "truth")
        unit = self._factor(name)[1]
        label = f"{output.words}  ${output.symbol}$" + (f"  in {unit}" if unit else "")
        return Quantity(name, label, output.look, output.center, output.below)

    def _factor(self, name: str) -> tuple[float, str]:
        """The unit that a variable is drawn in."""
        unit = str(self.data[name].attrs.get("units", "1"))
        if unit in ("1", "sampling periods"):
            return 1.0, "" if unit == "1" else unit
        # Two digits of the first slice are enough to choose a prefix.
        part = self.data[name].isel({dim: slice(0, 1) for dim in self.data[name].dims[:-2]}).values
        finite = np.abs(part[np.isfinite(part)])
        return si_unit(float(np.median(finite)) if finite.size else 1.0, unit)

    def _values(self, name: str, place: Mapping[str, Any], order: list[str]) -> np.ndarray:
        """A part of a variable, what was not computed marked, with the given dimensions."""
        variable = self.data[name]
        place = {dim: index for dim, index in place.items() if dim in variable.dims}
        values = variable.isel(place).transpose(*order).values
        status = self.data[STATUS_OF[OUTPUTS[name].family]].isel(place).transpose(*order).values
        if values.dtype == bool:
            return np.where(status == 0, values.astype(np.int8), np.int8(-1))
        if values.dtype == np.uint8:
            return values
        factor = self._factor(name)[0]
        return np.where(status == NOT_COMPUTED, np.nan, values * factor)

    def _plane(self, name: str) -> PlaneData:
        """Panels of a variable over two parameters."""
        x, y = self._axes(name)
        rest = [str(dim) for dim in self.data[name].dims if dim not in (x, y)]
        places, columns = self._panels(rest)
        thin = self._thin((x, y), len(places))
        names = [name]
        if name == "stable" and "passive" in self.data:
            names.append("passive")
        if OUTPUTS[name].family == "device" and "kind" in self.data:
            names.append("kind")
        if name == "stable":
            # Numbers give a smoother boundary than truth values.
            names += [each for each, _ in _BOUNDARIES[:-1] if each in self.data][:1]
        panels = []
        for place in places:
            fields = {each: self._values(each, {**place, **thin}, [y, x]) for each in names}
            if name in ("settling_time", "gain_margin", "delay_margin"):
                known = np.isfinite(fields[name]) & (fields[name] > 0)
                fields[name] = np.where(known, fields[name], np.nan)
            panels.append(Panel(self._title(place), fields, self._peak(place, x, y)))
        scales = [self._scale(dim) for dim in (x, y)]
        scales = [replace(scale, values=scale.values[thin[scale.name]]) for scale in scales]
        return PlaneData(scales[0], scales[1], tuple(panels), columns)

    def _thin(self, dims: tuple[str, str], panels: int) -> dict[str, slice]:
        """Every n-th value along both axes of a plane."""
        most = _RESOLVED if panels == 1 else _RESOLVED_BY_MANY
        return {dim: slice(None, None, -(-self.data.sizes[dim] // most)) for dim in dims}

    def _peak(self, place: Mapping[str, int], x: str, y: str) -> tuple[float, float] | None:
        """The stiffest stable wall of a panel, where the plane is one of walls."""
        pair = {("alpha", "beta"): ("alpha_max", "beta_at_max")}
        pair[("stiffness", "virtual_damping")] = ("stiffness_max", "virtual_damping_at_max")
        names = pair.get((x, y), ())
        if not names or any(name not in self.data for name in names):
            return None
        values = [float(self.data[name].isel({dim: place[dim] for dim in map(str, self.data[name].dims)}))
                  for name in names]  # fmt: skip
        at = [value * _readable(self.data[dim].values, str(self.data[dim].attrs["units"]))[0]
              for value, dim in zip(values, (x, y), strict=True)]  # fmt: skip
        inside = all(scale.values.min() <= value <= scale.values.max()
                     for value, scale in zip(at, (self._scale(x), self._scale(y)), strict=True))  # fmt: skip
        return (at[0], at[1]) if inside else None

    def _curves(self, name: str, quantity: Quantity) -> CurvesData:
        """Panels of a variable over one parameter."""
        axes = sorted(self._axes(name), key=lambda dim: -self.data.sizes[dim])
        x, several = axes[0], axes[1:]
        rest = [str(dim) for dim in self.data[name].dims if dim not in axes]
        if not several:
            several = [dim for dim in rest if dim not in self.chosen and self.data.sizes[dim] > 1][-1:]
            rest = [dim for dim in rest if dim not in several]
        places, columns = self._panels(rest)
        picked = _evenly(self.data.sizes[several[0]], _OUTLINES) if several else [0]
        names = tuple(self._title({several[0]: index}) for index in picked) if several else ("",)
        part = {several[0]: picked} if several else {}
        panels = []
        for place in places:
            values = self._values(name, {**place, **part}, [*several, x])
            panels.append(Panel(self._title(place), {name: values if several else values[None]}))
        return CurvesData(self._scale(x), names, tuple(panels), columns)

    def _outlined(self, name: str) -> list[str]:
        """The parameter whose values have a boundary each, and those of the panels; nothing where there is none."""
        if name not in self.data or len(self._axes(name)) < 2 or self._axes(name)[1] not in WALL:
            return []
        dims = [str(dim) for dim in self.data[name].dims if dim not in WALL and dim not in self.chosen]
        dims = [dim for dim in dims if self.data.sizes[dim] > 1]
        first = next((dim for dim in ("delta", "damping", *reversed(dims)) if dim in dims), "")
        return [first, *(dim for dim in dims if dim != first)] if first else []

    def _outlines(self, name: str, level: float, family: list[str]) -> Figure:
        """Boundaries of many devices in each panel."""
        x, y = self._axes(name)
        picked = _evenly(self.data.sizes[family[0]], _OUTLINES)
        rest = [str(dim) for dim in self.data[name].dims if dim not in (x, y, family[0])]
        places, columns = self._panels(rest)
        thin = self._thin((x, y), len(places))
        panels = []
        for place in places:
            values = self._values(name, {**place, **thin, family[0]: picked}, [family[0], y, x])
            panels.append(Panel(self._title(place), {name: values}))
        scales = [self._scale(dim) for dim in (x, y)]
        scales = [replace(scale, values=scale.values[thin[scale.name]]) for scale in scales]
        names = tuple(self._title({family[0]: index}) for index in picked)
        plane = PlaneData(scales[0], scales[1], tuple(panels), columns)
        return draw_outlines(plane, name, level, names, "boundaries of the stable walls")


def _readable(values: np.ndarray, unit: str) -> tuple[float, str]:
    """The factor and the unit in which the values of a parameter have few digits."""
    if unit in ("1", "sampling periods"):
        return 1.0, "" if unit == "1" else unit
    if unit == "kg":
        return (1.0, unit) if np.max(np.abs(values)) >= 1 else (1e3, "g")
    return si_unit(float(np.max(np.abs(values))), unit)


def _evenly(count: int, most: int) -> list[int]:
    """Indices of all values, or of so many that are spaced evenly."""
    return list(range(count)) if count <= most else sorted({round(place) for place in np.linspace(0, count - 1, most)})


def _nearest(data: xarray.Dataset, dim: str, value: float | str) -> int:
    """The index of the value that the sweep has and that is closest to the one wanted."""
    if dim == "device":
        labels = [str(label) for label in data["device"].values]
        if str(value) not in labels:
            raise InputError(f"at: there is no device {str(value)!r}; choose from {', '.join(labels)}")
        return labels.index(str(value))
    try:
        wanted = float(value)
    except ValueError as error:
        raise InputError(f"at: {dim}: got {value!r}; write a number in {data[dim].attrs['units']}") from error
    if not np.isfinite(wanted):
        raise InputError(f"at: {dim}: got {value!r}; write a finite number")
    return int(np.argmin(np.abs(np.asarray(data[dim].values, dtype=float) - wanted)))
