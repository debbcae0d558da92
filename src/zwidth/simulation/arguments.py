"""Arguments of `zwidth.simulate`: conversion to SI units, checks, and broadcasting to the batch."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from zwidth.arrays.evaluate import as_float64, join_shapes
from zwidth.arrays.threads import count_processors
from zwidth.parts.checks import read_texts
from zwidth.parts.linear_device import LinearDevice
from zwidth.parts.measured import MeasuredDevice
from zwidth.parts.wall import resolve_wall
from zwidth.simulation.batch import GROUP, name_bodies
from zwidth.simulation.parameters import Settings, TracedLaw
from zwidth.words.errors import InputError, ResourceError, describe_choice
from zwidth.words.quantities import ANY, FIELDS, NOT_NEGATIVE, OF_MOTIONS
from zwidth.words.unit_system import LINEAR, UnitSystem
from zwidth.words.xp import compute_concretely, is_traced

RECORDED_BYTES = 2 * 14 * 8  # per recorded instant: about 14 numbers, twice because of the conversion to SI units
JITTER_BYTES = 20 * 8  # per instant of the running simulations
DRAWN_BYTES = 4 * 8  # per period of the running simulations, for noise and for external forces
MOST_BYTES = 4 << 30  # per call of `simulate`

STARTS = ("start_position", "start_velocity")
ARGUMENTS = {
    name: (FIELDS[name].unit, ANY if FIELDS[name].allowed == ANY else NOT_NEGATIVE)
    for name in ("stiffness", "virtual_damping", *OF_MOTIONS)
} | {"jitter": ("s", NOT_NEGATIVE)}
"""Unit and range of each numeric argument of `simulate`."""
LIMITS = ("max_force", "max_rate")  # may be infinite: the motor then has no such limit


def list_scenes(scenes: Any) -> tuple[list[Any], np.ndarray]:
    """Return the distinct scenes, and the index of the scene of each batch entry."""
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
    """Return the unit system of the scenes; raise `InputError` if they have two."""
    if len(systems := {scene.device.unit_system for scene in scenes}) > 1:
        raise InputError("scenes: got both rotary and linear devices; simulate one kind per call")
    return systems.pop() if systems else LINEAR


def spread_starts(scenes: list[Any], given: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments with initial values of every body; bodies without their own start with the device."""
    bodies = dict.fromkeys(["position", *(name for scene in scenes for name in name_bodies(scene))])
    for name in STARTS:
        start = given.pop(name)
        start = dict(start) if isinstance(start, Mapping) else {"position": start}
        for body in start.keys() - bodies.keys():
            raise InputError(f"{name}: {describe_choice(body, tuple(bodies))}")
        of_device = start.get("position", 0.0)
        given |= {f"{name}.{body}": start.get(body, of_device) for body in bodies}
    return given


def convert_hand(scenes: list[Any], which: np.ndarray, hand: Any, push: Any, periods: int) -> Any:
    """Return the mean external force on the device per period, including the force of the moving hand."""
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
        pushes = spring * 0.5 * (places[..., 1:] + places[..., :-1]) + damper * np.diff(places)
    return pushes if push is None else pushes + as_float64("push_history", push)


def _read_history(name: str, values: Any, length: int, unit: str) -> np.ndarray:
    """Return values over time, one per period along the last axis."""
    history = as_float64(name, read_texts(name, values, unit))
    if not history.ndim or history.shape[-1] != length:
        raise InputError(f"{name}: got an array of shape {history.shape}; its last axis needs {length} values")
    if history.ndim == 1 and not np.isfinite(history).all():
        raise InputError(f"{name}: got a value that is not finite; fill the gaps")
    return history


def trace_law(force: Any, stiffness: Any, virtual_damping: Any) -> TracedLaw:
    """Return the traced law; raise `InputError` if a wall is also given or the law has memory or cannot be traced."""
    if stiffness is not None or virtual_damping is not None:
        raise InputError("force: got a law and a stiffness or damping; include the wall in the law, or remove one")
    # Import JAX only here, because importing zwidth must not load it.
    import jax

    name, traces = getattr(force, "__name__", repr(force)), []
    memory = InputError(
        f"force: the law {name} keeps values between calls; it is compiled once, so use only position, velocity, time "
        "and constants"
    )
    with compute_concretely(), jax.numpy_rank_promotion("allow"):
        try:
            hash(force)
            # Trace twice, because a law with memory yields another program or an error in the second trace.
            for _ in range(2):
                # Wrap the law in a new function, because JAX would reuse constants cached for a known function.
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
    # A value kept from an earlier trace appears as an additional input.
    if traces[1] != traces[0] or inputs != 3:
        raise memory
    kind = getattr(result, "dtype", np.dtype(object)).kind
    if getattr(result, "shape", None) not in ((), (2,)) or kind not in "if":
        raise InputError(f"force: the law returns {result} for two simulations; return one force in N for each")
    return TracedLaw(force, program)


def read_arguments(
    scenes: list[Any], which: np.ndarray, given: dict[str, Any], seed: Any, history: Any, periods: int
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Return numbers by name, one per simulation; scene indices in the batch shape; and a mask of valid simulations."""
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
    seeds, pushes = _read_seeds(seed), None
    shapes = {"scenes": which.shape, **{_spell(name): array.shape for name, array in arrays.items()}}
    shapes["seed"] = seeds.shape
    if history is not None:
        pushes = _read_history("push_history", history, periods, system["N"])
        shapes["push_history without its last axis"] = pushes.shape[:-1]
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
    if pushes is not None:
        finite = np.isfinite(pushes)
        good &= np.broadcast_to(finite.all(-1), shape)
        filled = np.where(finite, pushes, 0.0)
        numbers["push_history"] = np.broadcast_to(filled, (*shape, periods)).reshape(-1, periods)
    return numbers, which, good.reshape(-1)


def refuse_bodies(scenes: list[Any], which: np.ndarray, numbers: dict[str, np.ndarray]) -> None:
    """Raise `InputError` for friction or initial values of a linear system, whose bodies are unknown."""
    system = np.array([isinstance(scene.device, LinearDevice) for scene in scenes])[which.ravel()]
    for name in ("static", *(name for name in numbers if name.startswith(STARTS))):
        if np.any((numbers[name] != 0) & system):
            field = "coulomb, static" if name == "static" else _spell(name)
            raise InputError(
                f"{field}: a linear system has no known bodies and starts at rest at 0; use push or push_history, or a "
                "zwidth.Device"
            )


def check_memory(numbers: dict[str, np.ndarray], settings: Settings) -> None:
    """Raise `ResourceError` if the simulations need too much memory."""
    count, instants = numbers["seed"].size, settings.periods * settings.substeps
    together = min(count, GROUP * count_processors())
    kept = count * instants * RECORDED_BYTES if settings.record else 0
    jitter = together * instants * JITTER_BYTES if np.any(numbers["jitter"] > 0) else 0
    drawn = (
        together * settings.periods * DRAWN_BYTES * (bool(np.any(numbers["noise"] > 0)) + ("push_history" in numbers))
    )
    if kept + jitter + drawn > MOST_BYTES:
        remedy = f"use {'record=False' if kept else 'fewer periods'}, or fewer simulations per call"
        raise ResourceError(
            f"{count} simulations of {instants} instants need {(kept + jitter + drawn) / 2**30:.1f} GiB, more than "
            f"{MOST_BYTES >> 30} GiB; {remedy}"
        )


def _unit(name: str) -> str:
    """Return the unit of an argument, also if its name includes a body."""
    return ARGUMENTS[name.partition(".")[0]][0]


def _spell(name: str) -> str:
    """Return the name of an argument as the user writes it: the initial value of the device names all bodies."""
    return name.removesuffix(".position")


def _check(name: str, array: np.ndarray, arrays: dict[str, np.ndarray], period: Any) -> tuple[Any, str]:
    """Return a mask of the usable values of an argument, and the allowed range in words."""
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
