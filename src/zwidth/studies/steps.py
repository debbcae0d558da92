"""The step study: responses from force to position."""

from __future__ import annotations

from functools import partial

import numpy as np

from zwidth.figures import draw_step
from zwidth.figures.data import Response, StepData
from zwidth.quantities import plain, with_unit
from zwidth.response import step_response
from zwidth.stability.ridge import alpha_max
from zwidth.studies.outcome import Outcome, stack
from zwidth.sweep.devices import AnyDevice, PhysicalDevice, normalized_wall
from zwidth.sweep.responses import StepStudy


def respond(
    device: AnyDevice, alpha: float, beta: float, *, label: str, periods: float, substeps: int, physical: bool
) -> Response:
    """The response of one device: to 1 N in SI units, or to a unit force in normalized ones."""
    raw = step_response(alpha, beta, device.delta, device.d, periods=max(1, round(periods)), substeps=substeps)
    clock = length = 1.0
    if physical:
        assert isinstance(device, PhysicalDevice), "only a device with mass and period has SI units"
        clock, length = device.period, device.period**2 / device.mass
    return Response(
        label,
        alpha,
        beta,
        device.delta,
        device.d,
        raw.time * clock,
        raw.position * length,
        raw.velocity * length / clock,
        raw.wall_force,
        raw.final_position * length,
        raw.settling_time * clock,
    )


def run_step(study: StepStudy) -> Outcome:
    """Compute and draw the responses of a study."""
    physical = all(isinstance(device, PhysicalDevice) for device in study.devices)
    responses, notes = [], []
    for number, (device, given) in enumerate(study.pairs(), start=1):
        if given is not None:
            alpha, beta = normalized_wall(device, given)
        else:
            ridge = alpha_max(device.delta, device.d)
            assert study.stiffness_fraction is not None, "a study without walls has a fraction"
            alpha, beta = study.stiffness_fraction * float(ridge.alpha), float(ridge.beta)
        label = device.label or _wall_text(device, alpha, beta) or f"device {number}"
        times = {"periods": study.periods(device), "substeps": study.substeps}
        responses.append(respond(device, alpha, beta, label=label, physical=physical, **times))
        if note := unsettled(responses[-1], physical):
            notes.append(f"{label}: {note}")
    data = StepData(tuple(responses), physical)
    return Outcome(
        table=stack(response_columns(response, physical) for response in responses),
        figures={"": partial(draw_step, data)},
        notes=tuple(notes),
    )


def unsettled(response: Response, physical: bool) -> str:
    """What to say of a response that has not settled at the end of the time shown; nothing otherwise."""
    if np.isnan(response.settling_time):
        return "no settling time: the wall is not stable, its poles nearly coincide, or the delay exceeds 500 periods"
    if response.settles_in_view:
        return ""
    after = with_unit(response.settling_time, "s", 3) if physical else f"{plain(response.settling_time)} periods"
    return f"the response settles after {after}, later than the time shown"


def _wall_text(device: AnyDevice, alpha: float, beta: float) -> str:
    """The wall in SI units, the name of a response whose device has none."""
    if not isinstance(device, PhysicalDevice):
        return ""
    wall = device.to_scene().to_si(alpha=alpha, beta=beta)
    return f"K = {with_unit(wall.stiffness, 'N/m')}, B = {with_unit(wall.virtual_damping, 'N s/m')}"


def response_columns(response: Response, physical: bool) -> dict[str, object]:
    """The columns of one response in a data file; SI columns carry their unit."""
    units = ("_s", "_m", "_m_per_s", "_N") if physical else ("", "", "", "")
    columns: dict[str, object] = {name: getattr(response, name) for name in ("label", "alpha", "beta", "delta", "d")}
    for name, unit in zip(("time", "position", "velocity", "wall_force"), units, strict=True):
        columns[name + unit] = getattr(response, name)
    return columns
