"""Read the arguments of `zwidth.simulate`: convert them to SI units, check them, and broadcast them to the batch.

A *scene* (`zwidth.Scene`) is a device with its timing, velocity estimate and, optionally, wall. A *batch* is an array
of simulations; the array ``which`` contains the index of the scene of each simulation. A *force law* is a function of
the user that replaces the spring and the damper of the wall. A *history* has one value per sampling period (a recorded
hand position one per sample) along its last axis. The *bodies* are the device ("position"), the mass after a coupling
("tip_position") and a grasping hand ("hand_position").
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from zwidth.core.errors import InputError, ResourceError, describe_choice
from zwidth.core.xp import compute_concretely, is_traced
from zwidth.model.checks import check_integer, check_span, read_texts
from zwidth.model.linear_device import LinearDevice
from zwidth.model.measured_device import MeasuredDevice
from zwidth.model.velocity import FOAW
from zwidth.model.wall import resolve_wall
from zwidth.numerics.evaluate import as_float64, join_shapes
from zwidth.numerics.threads import count_processors
from zwidth.simulation.batch import GROUP, name_bodies
from zwidth.simulation.parameters import Settings, TracedLaw
from zwidth.units.quantities import ANY, FIELDS, NOT_NEGATIVE, OF_MOTIONS
from zwidth.units.unit_system import LINEAR, UnitSystem

# Estimated memory of one call of `simulate`, in bytes. The estimate includes JITTER_BYTES and DRAWN_BYTES only for the
# simulations that run at the same time.
RECORDED_BYTES = 2 * 14 * 8  # memory per recorded instant: 14 float64 values, twice for the conversion to SI units
JITTER_BYTES = 20 * 8  # memory per instant for the durations between jittered samples
DRAWN_BYTES = 4 * 8  # memory per period for noise, and again for external forces
MOST_BYTES = 4 << 30  # largest estimate that is accepted: 4 GiB

DEFAULT_PERIODS = 1000  # default number of simulated periods
MAX_PERIODS = 10**9  # largest number of simulated periods; memory limits recorded simulations to fewer
STARTS = ("start_position", "start_velocity")  # arguments with one initial value per body
ARGUMENTS = {
    name: (FIELDS[name].unit, ANY if FIELDS[name].allowed == ANY else NOT_NEGATIVE)
    for name in ("stiffness", "virtual_damping", *OF_MOTIONS)
} | {"jitter": ("s", NOT_NEGATIVE)}
"""Unit and range of each numeric argument of `simulate`."""
LIMITS = ("max_force", "max_rate")  # limits of the motor; the only arguments that may be infinite (no limit)


def list_scenes(scenes: Any) -> tuple[list[Any], np.ndarray]:
    """Return the distinct scenes as a list, and an array with the index of the scene of each simulation."""
    listed = isinstance(scenes, Iterable) and not isinstance(scenes, np.ndarray)
    array = np.array(list(scenes) if listed else scenes, object)
    numbers: dict[int, int] = {}
    which = np.empty(array.shape, int)
    for index, scene in np.ndenumerate(array):
        if not (hasattr(scene, "device") and hasattr(scene, "timing")):
            raise InputError(f"scenes: got {scene!r}; use a zwidth.Scene or a list of scenes")
        if isinstance(scene.device, MeasuredDevice):
            raise InputError(
                "scenes: got a measured response, which has no model to simulate; fit one to a log (zwidth.fit_log)"
            )
        if scene.traced_path is not None:
            raise InputError("scenes: got values traced by JAX; call simulate outside of jit, vmap and grad")
        which[index] = numbers.setdefault(id(scene), len(numbers))
    return [array.flat[np.flatnonzero(which.ravel() == k)[0]] for k in range(len(numbers))], which


def find_system(scenes: list[Any]) -> UnitSystem:
    """Return the unit system of the scenes, linear or rotary; raise `InputError` if they have different ones."""
    if len(systems := {scene.device.unit_system for scene in scenes}) > 1:
        raise InputError("scenes: got both rotary and linear devices; simulate one kind per call")
    return systems.pop() if systems else LINEAR


def count_periods(scenes: list[Any], periods: Any, duration: Any) -> int:
    """Return the number of sampling periods of a simulation, from ``periods`` or ``duration``; 1000 by default."""
    if duration is None:
        return check_integer("periods", DEFAULT_PERIODS if periods is None else periods, 1, MAX_PERIODS)
    if periods is not None:
        raise InputError(f"duration: got {duration!r} together with periods = {periods!r}; pass only one of them")
    span = check_span("duration", duration)
    counts = {round(span.periods(float(scene.timing.period))) for scene in scenes} or {1}
    if len(counts) > 1:
        raise InputError(f"duration: got {duration!r} with scenes of different sampling periods; pass periods instead")
    if not 1 <= (count := counts.pop()) <= MAX_PERIODS:
        raise InputError(f"duration: got {duration!r}, i.e. {count:g} periods; it must be 1 to {MAX_PERIODS} periods")
    return count


def spread_starts(scenes: list[Any], given: dict[str, Any]) -> dict[str, Any]:
    """Return all arguments by name, with one ``start_position`` and one ``start_velocity`` per body.

    An example of a new argument is "start_position.tip_position". A body for which the user specifies no initial value
    has that of the device. A tool has such an argument only if the user specifies its initial value.
    """
    bodies = dict.fromkeys(["position", *(name for scene in scenes for name in name_bodies(scene))])
    tool = ["tool_position"] * any(scene.tool is not None for scene in scenes)
    for name in STARTS:
        start = given.pop(name)
        start = dict(start) if isinstance(start, Mapping) else {"position": start}
        for body in start.keys() - {*bodies, *tool}:
            raise InputError(f"{name}: {describe_choice(body, (*bodies, *tool))}")
        of_device = start.get("position", 0.0)
        given |= {f"{name}.{body}": start.get(body, of_device) for body in bodies}
        given |= {f"{name}.{body}": start[body] for body in tool if body in start}
    return given


def convert_hand(scenes: list[Any], which: np.ndarray, hand: Any, external_force: Any, periods: int) -> Any:
    """Return the external force on the device in N, averaged over each period, plus the force of a moving hand.

    Args:
        scenes: distinct scenes, each with a rigid operator.
        which: index of the scene of each simulation.
        hand: recorded positions of the hand, the far end of the operator's spring and damper, (..., periods + 1).
    """
    places = _read_history("hand_history", hand, periods + 1, find_system(scenes)["m"])
    for scene in scenes:
        if scene.operator is None or not scene.operator.rigid or scene.device.coupling is not None:
            raise InputError(
                "hand_history: got a scene without a rigid operator; use operator=zwidth.Operator(stiffness=..., "
                "damping=...), on a device without coupling"
            )
    units = [(each.operator.stiffness, each.operator.damping / each.timing.period) for each in scenes]
    spring, damper = np.moveaxis(np.array(units, float)[which], -1, 0)[..., None]
    with np.errstate(all="ignore"):
        forces = spring * 0.5 * (places[..., 1:] + places[..., :-1]) + damper * np.diff(places)
    return forces if external_force is None else forces + as_float64("external_force_history", external_force)


def _read_history(name: str, values: Any, length: int, unit: str) -> np.ndarray:
    """Return a history as a float64 array in SI units; raise `InputError` unless its last axis has the given length."""
    history = as_float64(name, read_texts(name, values, unit))
    if not history.ndim or history.shape[-1] != length:
        raise InputError(f"{name}: got an array of shape {history.shape}; its last axis needs {length} values")
    if history.ndim == 1 and not np.isfinite(history).all():
        raise InputError(f"{name}: got a value that is not finite; fill the gaps")
    return history


def trace_law(force: Any, stiffness: Any, virtual_damping: Any) -> TracedLaw:
    """Return a force law of the user together with the program that JAX traces from it.

    Raises:
        InputError: stiffness or damping is also specified, JAX cannot trace the law, or the law keeps values between
            calls.
    """
    if stiffness is not None or virtual_damping is not None:
        raise InputError("force: got a law and a stiffness or damping; include the wall in the law, or remove one")
    # Import JAX inside this function, because importing zwidth must not load JAX.
    import jax

    name, traces = getattr(force, "__name__", repr(force)), []
    memory = InputError(
        f"force: the law {name} keeps values between calls; it is compiled once, so use only position, velocity, time "
        "and constants"
    )
    with compute_concretely(), jax.numpy_rank_promotion("allow"):
        try:
            hash(force)
            # Trace the law twice, because a law that stores values between calls then yields another program the second
            # time, or fails.
            for _ in range(2):
                # Wrap the law in a new function for each trace, because JAX would reuse the cached trace of the same
                # function.
                trace = jax.jit(lambda *args: force(*args)).trace(*[jax.ShapeDtypeStruct((2,), float)] * 3)
                traces.append((trace.lower().as_text(), len(trace.jaxpr.in_avals), trace.out_info))
        except Exception as error:
            if traces or isinstance(error, jax.errors.UnexpectedTracerError):
                raise memory from error
            words = str(error).partition("\n")[0][:200]
            raise InputError(
                f"force: JAX cannot trace {name}: {words}; write a function of position, velocity and time with "
                "jax.numpy, jnp.where in place of if"
            ) from error
    program, inputs, result = traces[0]
    # Reject a law whose program has more than three inputs, because JAX adds an input for each value that the law has
    # stored during an earlier trace.
    if traces[1] != traces[0] or inputs != 3:
        raise memory
    kind = getattr(result, "dtype", np.dtype(object)).kind
    if getattr(result, "shape", None) not in ((), (2,)) or kind not in "if":
        raise InputError(f"force: the law returns {result} for two simulations; return one force in N for each")
    return TracedLaw(force, program)


def read_arguments(
    scenes: list[Any], which: np.ndarray, given: dict[str, Any], seed: Any, history: Any, periods: int
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Return the arguments of all simulations in SI units, checked and broadcast to the batch.

    Args:
        scenes: distinct scenes.
        which: index of the scene of each simulation, in the shape of the argument ``scenes`` of `simulate`.
        given: numeric arguments by name.
        seed: seeds of noise and jitter.
        history: external force per period, (..., periods), or None.
        periods: number of sampling periods.

    Returns:
        Arguments by name in SI units, one row per simulation and 0 in place of invalid values; the scene indices,
        broadcast to the batch shape; and a mask of the simulations whose arguments are all valid, one row each.
    """
    if given["static"] is None:
        given = {**given, "static": given["coulomb"]}
    system = find_system(scenes)
    walls = [resolve_wall(scene.wall, given["stiffness"], given["virtual_damping"], system) for scene in scenes]
    if given["stiffness"] is None:
        pairs = np.array(walls, float).reshape(-1, 2)[which]
        given = {**given, "stiffness": pairs[..., 0], "virtual_damping": pairs[..., 1]}
    elif given["virtual_damping"] is None:
        given = {**given, "virtual_damping": 0.0}
    arrays = {
        name: as_float64(_spell(name), read_texts(_spell(name), value, system[_unit(name)]))
        for name, value in given.items()
    }
    seeds, forces = _read_seeds(seed), None
    shapes = {"scenes": which.shape, **{_spell(name): array.shape for name, array in arrays.items()}}
    shapes["seed"] = seeds.shape
    if history is not None:
        forces = _read_history("external_force_history", history, periods, system["N"])
        shapes["external_force_history without its last axis"] = forces.shape[:-1]
    shape = join_shapes((name, part) for name, part in shapes.items() if part or name == "scenes")
    if not math.prod(shape):
        raise InputError(f"scenes: got a batch of shape {shape}; use at least one simulation")
    which = np.broadcast_to(which, shape)
    clock = np.array([float(scene.timing.period) for scene in scenes])
    good = np.ones(shape, bool)
    for name, array in arrays.items():
        usable, allowed = _check(name, array, arrays, clock[which] if array.ndim else clock.min())
        if array.ndim == 0 and not np.all(usable):
            raise InputError(f"{_spell(name)}: got {float(array):g} {system[_unit(name)]}; {allowed}")
        good &= usable
    numbers: dict[str, Any] = {
        name: np.where(good, np.broadcast_to(array, shape), 0.0).reshape(-1) for name, array in arrays.items()
    }
    numbers["seed"] = np.broadcast_to(seeds, shape).reshape(-1)
    if forces is not None:
        finite = np.isfinite(forces)
        good &= np.broadcast_to(finite.all(-1), shape)
        filled = np.where(finite, forces, 0.0)
        numbers["external_force_history"] = np.broadcast_to(filled, (*shape, periods)).reshape(-1, periods)
    return numbers, which, good.reshape(-1)


def refuse_unsupported(scenes: list[Any], contact: str, law: TracedLaw | None) -> None:
    """Raise `InputError` if a scene has a tool that the contact, the force law or the velocity estimate excludes."""
    for scene in scenes:
        if scene.tool is None:
            continue
        adapts = isinstance(scene.velocity, FOAW)
        if adapts and (scene.position is not None or scene.feedback is not None):
            name = "feedback" if scene.position is None else "position"
            raise InputError(
                f"{name}: got {name} and a tool with FOAW, which is not linear; use another velocity estimate"
            )
        if contact != "bilateral":
            raise InputError(
                f"contact: got {contact!r}, but a coupling to a tool has no surface; use contact='bilateral'"
            )
        nonlinear = "force" if law is not None else "velocity" if adapts else ""
        if nonlinear and scene.tool.integrator == "implicit":
            raise InputError(
                f"{nonlinear}: got a nonlinear function, but the implicit Euler method needs a linear coupling; use "
                "tool.integrator='semi-implicit'"
            )


def refuse_bodies(scenes: list[Any], which: np.ndarray, numbers: dict[str, np.ndarray]) -> None:
    """Raise `InputError` if friction or initial values are specified for a `LinearDevice`, whose bodies are unknown."""
    system = np.array([isinstance(scene.device, LinearDevice) for scene in scenes])[which.ravel()]
    starts = (name for name in numbers if name.startswith(STARTS) and not name.endswith(".tool_position"))
    for name in ("static", *starts):
        if np.any((numbers[name] != 0) & system):
            field = "coulomb, static" if name == "static" else _spell(name)
            raise InputError(
                f"{field}: a linear system has no known bodies and starts at rest at 0; use external_force or "
                "external_force_history, or a zwidth.Device"
            )


def check_memory(numbers: dict[str, np.ndarray], settings: Settings) -> None:
    """Raise `ResourceError` if the simulations need more memory than `MOST_BYTES`."""
    count, instants = numbers["seed"].size, settings.periods * settings.substeps
    together = min(count, GROUP * count_processors())
    kept = count * instants * RECORDED_BYTES if settings.record else 0
    jitter = together * instants * JITTER_BYTES if np.any(numbers["jitter"] > 0) else 0
    drawn = (
        together
        * settings.periods
        * DRAWN_BYTES
        * (bool(np.any(numbers["noise"] > 0)) + ("external_force_history" in numbers))
    )
    if kept + jitter + drawn > MOST_BYTES:
        remedy = f"use {'record=False' if kept else 'fewer periods'}, or fewer simulations per call"
        raise ResourceError(
            f"{count} simulations of {instants} instants need {(kept + jitter + drawn) / 2**30:.1f} GiB, more than "
            f"{MOST_BYTES >> 30} GiB; {remedy}"
        )


def _unit(name: str) -> str:
    """Return the SI unit of an argument; its name may end with a body, as in "start_position.tip_position"."""
    return ARGUMENTS[name.partition(".")[0]][0]


def _spell(name: str) -> str:
    """Return the name of an argument as users write it, e.g. "start_position" for "start_position.position"."""
    return name.removesuffix(".position")


def _check(name: str, array: np.ndarray, arrays: dict[str, np.ndarray], period: Any) -> tuple[Any, str]:
    """Return a mask of the valid values of an argument, and a phrase with its allowed range for messages.

    Args:
        name: name of the argument.
        array: values of the argument.
        arrays: values of all arguments, because the range of ``static`` depends on ``coulomb``.
        period: sampling period in s, the upper bound of ``jitter``.
    """
    _, rule = ARGUMENTS[name.partition(".")[0]]
    usable = rule.holds(array) & (np.isfinite(array) | ((name in LIMITS) & (array > 0)))
    allowed = "it must be finite" if rule == ANY else f"it must be {rule}" + ("" if name in LIMITS else " and finite")
    if name == "static":
        return usable & (array >= arrays["coulomb"]), "it must be at least coulomb, the friction while slipping"
    if name == "jitter":
        return usable & (array < period), "it must be at least 0 and less than the period"
    return usable, allowed


def _read_seeds(seed: Any) -> np.ndarray:
    """Return the seeds as an array of integers; raise `InputError` for other values."""
    if is_traced(seed):
        raise InputError("seed: got a value traced by JAX; use integers, outside of jit, vmap and grad")
    try:
        seeds = np.asarray(seed)
    except ValueError:
        seeds = np.asarray("ragged")
    if seeds.dtype.kind not in "iu" or np.any(seeds < 0):
        raise InputError(f"seed: got {seed!r}; use integers of at least 0")
    return seeds
