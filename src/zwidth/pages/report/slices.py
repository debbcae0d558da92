"""Slices of stored maps for a page: few enough numbers to travel in it, drawn where it is read."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from zwidth.figures.grid import choose_axes
from zwidth.figures.style import pick_evenly
from zwidth.words.quantities import OUTPUTS, VARIABLES

if TYPE_CHECKING:
    import xarray

_GRAY = "not finite, or not known"
# Of each axis of a slice, of each other axis, and numbers a map in all: half a megabyte.
_ALONG, _OTHERS, _MOST = 120, 9, 120_000


def find_slices(data: xarray.Dataset) -> Iterator[str]:
    """The maps of a store, as HTML."""
    # A store lists its variables in any order.
    for name in (name for name in OUTPUTS if name in data and name != "kind"):
        axes = choose_axes(data, name)
        if len(axes) == 2 and "device" not in axes:
            yield _draw(data[name], name, *axes)


def _draw(values: xarray.DataArray, name: str, x: str, y: str) -> str:
    output = OUTPUTS[name]
    others = [str(dim) for dim in values.dims if dim not in (x, y)]
    along = min(_ALONG, int(np.sqrt(_MOST / max(1, np.prod([min(values.sizes[dim], _OTHERS) for dim in others])))))
    most = {dim: along if dim in (x, y) else _OTHERS for dim in map(str, values.dims)}
    thin = values.isel({dim: pick_evenly(values.sizes[dim], count) for dim, count in most.items()})
    thin = thin.transpose(*others, y, x).load()
    numbers = thin.values.astype(np.float32)
    finite = numbers[np.isfinite(numbers)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    steep = output.look in ("logarithmic", "steep") and low > 0
    content = {
        "name": name,
        "unit": _unit(thin),
        "truth": output.dtype == "bool",
        "scale": "log" if steep else "linear",
        "low": low,
        "high": min(high, 1e4 * low) if steep else high,
        "x": _axis(thin, x),
        "y": _axis(thin, y),
        "others": [_axis(thin, dim) for dim in others],
        "values": base64.b64encode(np.where(np.isfinite(numbers), numbers, np.nan).astype("<f4").tobytes()).decode(),
    }
    words = f"{output.long_name}, over {_words(x)} (across) and {_words(y)} (up)"
    sliders = "".join(
        f'<label>{escape(_words(dim))}: <span></span><input type="range" min="0" max="{thin.sizes[dim] - 1}" value="0">'
        "</label>"
        for dim in others
    )
    ends = (
        f"not {name}, {name}"
        if output.dtype == "bool"
        else f"{low:.4g} to {content['high']:.4g} {_unit(thin)}".rstrip()
    )
    thinned = "" if thin.size == values.size else f" Shown are {thin.size:,} of {values.size:,} values."
    return (
        f'<div class="slices"><h3>{escape(name)}</h3><p class="soft">{escape(words)}. '
        f"Dark to bright: {ends}; gray: {_GRAY}.{thinned} "
        "Point, or focus the map and use the arrow keys, to read a value.</p>"
        f'{sliders}<canvas tabindex="0" role="img" aria-label="{escape(words)}"></canvas><output aria-live="polite">'
        f'</output><script type="application/json">{_embed(content)}</script></div>'
    )


def _axis(values: xarray.DataArray, dim: str) -> dict[str, Any]:
    along = values[dim]
    labels = along.dtype.kind not in "biuf"
    steps = [str(label) for label in along.values] if labels else np.asarray(along.values, float).tolist()
    return {"name": _words(dim), "unit": "" if labels else _unit(along), "values": steps}


def _unit(values: xarray.DataArray) -> str:
    unit = str(values.attrs.get("units", ""))
    return "" if unit == "1" else unit


def _words(dim: str) -> str:
    return VARIABLES[dim].words if dim in VARIABLES else dim


def _embed(content: dict[str, Any]) -> str:
    """JSON that ends no script element."""
    return json.dumps(content, separators=(",", ":")).replace("<", "\\u003c")
