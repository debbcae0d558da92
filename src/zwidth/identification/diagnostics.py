"""Tabulate the data that support a fit, for plots and for files.

For a log, the tables contain the measured and fitted positions, and the residuals with their autocorrelation. For every
fit, they contain the stability boundary (the largest stable stiffness over the damping B) with its confidence band,
and the stiffest, recommended and measured walls. A table is a dictionary of columns by header.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.identification.device_estimate import compute_coverage_factor
from zwidth.identification.device_fit import DeviceFit
from zwidth.identification.fit_report import unit_of
from zwidth.identification.onset_fit import BuzzPoint
from zwidth.units.formatting import header

_DRAWS = 1000  # largest number of random devices from which the confidence band is computed
_ROWS = 121  # number of values of B from 0 to the largest stable one; a tenth more values lie above it
_BEYOND = 1.1  # largest tabulated B, relative to the largest stable one
# Largest lag at which the autocorrelation of the residuals is tabulated: the smaller of two limits.
_LAGS = 60  # first limit, in samples
_SHARE = 0.25  # second limit, relative to the number of samples of the log


def gather_evidence(fit: DeviceFit, source: str, points: Sequence[BuzzPoint] = ()) -> dict[str, dict[str, Any]]:
    """Return all tables of a fit as a dictionary by name; its plots and data files contain these tables.

    Args:
        fit: the fit.
        source: name of the log, or number of walls, for the first column of the tables of the boundary and the walls.
        points: the measured walls of a fit to walls.
    """
    tables: dict[str, dict[str, Any]] = {}
    for name, table in (("boundary", trace_boundary(fit)), ("walls", tabulate_walls(fit, points))):
        rows = next(iter(table.values())).size
        tables[name] = {"fitted_to": np.full(rows, source), **table}
    if fit.motions:
        tables |= {"motion": tabulate_motions(fit), "correlation": correlate_residuals(fit)}
    return tables


def tabulate_motions(fit: DeviceFit) -> dict[str, np.ndarray]:
    """Return a table of the measured position, the modeled position and the residual of every sample."""
    logs = [np.full(motion.time.size, k, int) for k, motion in enumerate(fit.motions, start=1)]
    names = {"force": "force", "position": "position", "modeled": "position"}
    units = {"time": "s"} | {name: unit_of(quantity, fit.unit_system) for name, quantity in names.items()}
    columns = {name: np.concatenate([getattr(motion, name) for motion in fit.motions]) for name in units}
    table = {header(name, unit): columns[name] for name, unit in units.items()}
    residual = columns["position"] - columns["modeled"]
    return {"log": np.concatenate(logs), **table, header("residual", units["position"]): residual}


def correlate_residuals(fit: DeviceFit) -> dict[str, np.ndarray]:
    """Return a table of the residual autocorrelation over the lag, averaged over all logs, with the 95 % band.

    At each lag, the autocorrelation of white noise is within the band with a probability of 95 %.
    """
    residuals = [motion.position - motion.modeled for motion in fit.motions]
    residuals = [each[np.isfinite(each)] for each in residuals]
    most = int(min(_LAGS, *(_SHARE * each.size for each in residuals)))
    lags = np.arange(1, most + 1)
    products = np.array([sum(float(each[k:] @ each[: each.size - k]) for each in residuals) for k in lags])
    size, count = sum(float(each @ each) for each in residuals), sum(each.size for each in residuals)
    return {
        header("lag", "s"): lags * fit.period,
        "autocorrelation": products / size if size > 0 else np.full(most, np.nan),
        "band": np.full(most, compute_coverage_factor(None) / np.sqrt(count)),
    }


def trace_boundary(fit: DeviceFit) -> dict[str, np.ndarray]:
    """Return a table of the largest stable stiffness on a grid of B >= 0, with its pointwise 95 % interval.

    The interval is computed from random devices drawn from the estimate; it is NaN if the records do not determine the
    device. For a device without a stable wall at some B, the largest stable stiffness is set to 0 there.
    """
    outlines = fit.nominal.stable_region()
    if not outlines:
        raise InputError("scene: no wall of the fitted device is stable; measure again")
    end = max(float(each.virtual_damping.max()) for each in outlines)
    damping = np.concatenate([np.linspace(0.0, end, _ROWS), np.linspace(end, _BEYOND * end, _ROWS // 10)[1:]])
    estimate = fit.estimates[None]
    low = high = np.full(damping.size, np.nan)
    drawn = fit.draw(min(_DRAWS, fit.nominal.loop.draws))
    if drawn is not None:
        low, high = np.quantile(_limit_rows(fit, drawn, damping), [0.025, 0.975], axis=0)
    unit = unit_of("stiffness", fit.unit_system)
    return {
        header("virtual_damping", unit_of("damping", fit.unit_system)): damping,
        header("stiffness", unit): _limit_rows(fit, estimate, damping)[0],
        header("stiffness_low", unit): low,
        header("stiffness_high", unit): high,
    }


def _limit_rows(fit: DeviceFit, devices: np.ndarray, damping: np.ndarray) -> np.ndarray:
    """Return the largest stable stiffness at given values of B for each of several devices; 0 if no wall is stable.

    Args:
        fit: the fit.
        devices: parameters of the devices, shape (devices, parameters).
        damping: values of B in N s/m.

    Returns:
        An array with one row per device and one column per value of B.
    """
    return fit.nominal.loop.vary(dict(zip(fit.parameter_names, devices.T, strict=True))).find_stiffness_limits(damping)


def tabulate_walls(fit: DeviceFit, points: Sequence[BuzzPoint] = ()) -> dict[str, np.ndarray]:
    """Return a table of the stiffest, the recommended and the measured walls, with errors, frequencies and residuals.

    The residuals of stiffness and frequency are in units of their noise.
    """
    top, recommended, missing = fit.nominal.max_stiffness(), fit.recommended, (np.nan,) * 4
    rows: list[tuple[Any, ...]] = [("stiffest", float(top.stiffness), float(top.virtual_damping), *missing)]
    rows += (
        []
        if recommended.status != Status.OK
        else [("set", recommended.stiffness, recommended.virtual_damping, *missing)]
    )
    noise = fit.noise[0] if isinstance(fit.noise, tuple) else np.nan
    for each, residual in zip(points, fit.residuals if points else (), strict=True):
        rows.append(("onset", each.stiffness, each.virtual_damping, noise * each.stiffness, each.frequency, *residual))
    kinds, *numbers = zip(*rows, strict=True)
    stiffness, damping = (unit_of(name, fit.unit_system) for name in ("stiffness", "damping"))
    heads = {"stiffness": stiffness, "virtual_damping": damping, "stiffness_error": stiffness, "frequency": "Hz"}
    names = [*(header(*head) for head in heads.items()), "stiffness_residual", "frequency_residual"]
    columns = {name: np.array(part, float) for name, part in zip(names, numbers, strict=True)}
    return {"kind": np.array(kinds), **columns}
