"""Simulation in SI units: check the arguments, simulate scenes of equal structure together, assemble the result."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, Literal

import numpy as np

from zwidth.arrays.evaluate import as_float64, compute_concretely, join_shapes
from zwidth.arrays.threads import processors
from zwidth.parts.checks import check_whole, read_texts
from zwidth.parts.linear_device import LinearDevice
from zwidth.parts.measured import MeasuredDevice
from zwidth.parts.wall import resolve_wall
from zwidth.simulation.batch import GROUP, find_structure, name_bodies, run_scenes
from zwidth.simulation.parameters import Law, Settings, TracedLaw
from zwidth.simulation.result import OF_MOTION, Motion, MotionKind
from zwidth.words.errors import InputError, ResourceError, check_choice, describe_choice
from zwidth.words.quantities import ANY, FIELDS, NOT_NEGATIVE, OF_MOTIONS
from zwidth.words.rotation import in_own_units
from zwidth.words.status import Status
from zwidth.words.types import ArrayLike
from zwidth.words.xp import is_traced

Contact = Literal["bilateral", "unilateral", "push_only"]
CONTACTS: tuple[Contact, ...] = ("bilateral", "unilateral", "push_only")

RECORDED_BYTES = 2 * 14 * 8  # per recorded instant, including its conversion to SI units
JITTER_BYTES = 20 * 8  # per instant of the running simulations
DRAWN_BYTES = 4 * 8  # per period of the running simulations, for noise and for external forces
MOST_BYTES = 4 << 30  # per call of `simulate`

STARTS = ("start_position", "start_velocity")
ARGUMENTS = {
    name: (FIELDS[name].unit, ANY if FIELDS[name].allowed == ANY else NOT_NEGATIVE)
    for name in ("stiffness", "virtual_damping", *OF_MOTIONS)
} | {"jitter": ("s", NOT_NEGATIVE)}
"""Unit and range of each numeric argument of `simulate`."""
LIMITS = ("max_force", "max_rate")  # infinite if the motor has no limit


@in_own_units
def simulate(
    scenes: Any,
    stiffness: ArrayLike | None = None,
    virtual_damping: ArrayLike | None = None,
    *,
    force: Law | None = None,
    periods: int = 1000,
    substeps: int = 1,
    start_position: ArrayLike | Mapping[str, ArrayLike] = 0.0,
    start_velocity: ArrayLike | Mapping[str, ArrayLike] = 0.0,
    push: ArrayLike = 0.0,
    push_history: ArrayLike | None = None,
    hand_history: ArrayLike | None = None,
    contact: Contact = "bilateral",
    resolution: ArrayLike = 0.0,
    noise: ArrayLike = 0.0,
    coulomb: ArrayLike = 0.0,
    static: ArrayLike | None = None,
    max_force: ArrayLike = np.inf,
    max_rate: ArrayLike = np.inf,
    jitter: ArrayLike = 0.0,
    seed: Any = 0,
    tail: int | None = None,
    record: bool = True,
) -> Motion:
    """Simulate devices on virtual walls, with contact, encoder, friction, motor limits and jitter.

    The device is propagated exactly between samples. The wall occupies positive positions and applies the force
    ``-(K x_k + B v_k)``, with the measured position and the estimated velocity at sample k. Without friction, encoder,
    limits and contact this is the linear loop whose stability `zwidth.Scene.is_stable` decides; the simulation is
    independent of that decision.

    Args:
        scenes: a `zwidth.Scene`, or a list or array of scenes. Its shape and the shapes of the numbers below broadcast
            to the batch shape. Numbers may be strings with a unit, "2 N". A `zwidth.LinearDevice` starts at rest at 0,
            has no friction, and its energies are NaN.
        stiffness: K in N/m.
        virtual_damping: B in N s/m. If both are left out, each scene uses its own wall.
        force: force law in place of the wall's spring and damper: a function of the measured position (m), the
            estimated velocity (m/s) and the time of the sample (s, without jitter), arrays with one value per
            simulation. It returns the force on the device in N and is written with `jax.numpy`. The law is compiled
            once, so it must not keep values between calls and must use ``jnp.where`` in place of ``if``. Its force is
            sampled, held and delayed like that of a wall.
        periods: number of sampling periods, >= 1.
        substeps: recorded instants per period, >= 1.
        start_position: in m; one value for all bodies, or a mapping by their names in `Motion`, as ``{"position": 0,
            "hand_position": 1e-3}``; other bodies start with the device.
        start_velocity: in m/s, likewise. Before the start, the measured positions lie on the line of this velocity.
        push: constant external force on the device, in N; a `LinearDevice` feels it at the input of the command.
        push_history: external force in N, constant over each period, (..., periods); added to ``push``.
        hand_history: recorded position in m of the far end of the spring and damper of a rigid `zwidth.Operator`,
            (..., periods + 1), linear between samples; its force is averaged over each period.
        contact: "bilateral": the wall acts on both sides of its surface at 0; "unilateral": only at measured positions
            > 0; "push_only": unilateral, and it never pulls.
        resolution: step of the encoder in m, to which measured positions are rounded; 0 for an ideal sensor.
        noise: standard deviation of the measured position before rounding, in m.
        coulomb: Coulomb friction on the device while it slips, in N.
        static: static friction (breakaway force) in N, at least ``coulomb``; equal to ``coulomb`` if left out.
        max_force: largest force of the motor, in N.
        max_rate: largest rate of change of the command, in N/s.
        jitter: largest random delay of a sample, in s, less than one period.
        seed: integer >= 0, one for all or one per simulation; equal seeds give equal noise and jitter.
        tail: number of periods at the end from which amplitude, frequency, trend and outcome are computed; a quarter
            of ``periods`` if left out.
        record: also return the motion over time.

    Returns:
        Motion: arrays over time and statistics of each motion, see `zwidth.Motion`.

    Raises:
        InputError: a number is not usable; friction with a pole of more than 64 rad per period; JAX cannot trace the
            law, or the law keeps values between calls.
        ResourceError: the recorded or random numbers need more than 4 GiB.

    Numerics:
        Float64. Matrix exponentials over the intervals of constant force; friction events to the last bit
        (docs/theory/simulation.md). JAX compiles for half a second to two seconds for each structure of bodies and
        nonlinear parts; `zwidth.use_compilation_cache` stores the result for later processes. Run times:
        docs/simulation.md.

    References:
        Hulin, Preusche, Hirzinger 2006, section II (the loop).
        Abbott, Okamura 2005, IEEE Trans. Robotics 21(5):952-964 (encoder and friction).

    Example:
        >>> import zwidth
        >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(period=1e-3, delay=1e-3))
        >>> hit = zwidth.simulate(scene, 10e3, 40, start_position=-1e-4, start_velocity=0.1, contact="unilateral")
        >>> print(f"{hit.penetration * 1e3:.2f} mm, left {hit.bounces} times")
        0.21 mm, left 1 times
    """
    given = {name: value for name, value in locals().items() if name in ARGUMENTS}
    check_choice("contact", contact, CONTACTS)
    periods = check_whole("periods", periods, 1, 10**9)
    substeps = check_whole("substeps", substeps, 1, 10_000)
    tail = max(periods // 4, 1) if tail is None else check_whole("tail", tail, 1, periods)
    settings = Settings(periods, substeps, tail, contact, record)
    known, which = _list_scenes(scenes)
    if force is not None:
        settings = settings._replace(law=_trace_law(force, stiffness, virtual_damping))
        given |= {"stiffness": 0.0, "virtual_damping": 0.0}
    if hand_history is not None:
        push_history = _convert_hand(known, which, hand_history, push_history, periods)
    numbers, which, good = _read(known, which, _spread_starts(known, given), seed, push_history, periods)
    for name in ("static", *(name for name in numbers if name.startswith(STARTS))):
        _refuse_bodies(known, which, name, numbers[name])
    _check_memory(numbers, settings)
    shape, which = which.shape, which.ravel()
    found: dict[str, np.ndarray] = {}
    groups: dict[tuple[Any, ...], list[int]] = {}
    for index, scene in enumerate(known):
        groups.setdefault(find_structure(scene), []).append(index)
    for members in groups.values():
        own = np.flatnonzero(np.isin(which, members))
        rows = {name: column[own] for name, column in numbers.items()}
        part = run_scenes([known[k] for k in members], np.searchsorted(members, which[own]), rows, settings)
        for name, column in part.items():
            if name not in found:
                found[name] = np.full((which.size, *column.shape[1:]), _missing(column.dtype), column.dtype)
            found[name][own] = column
    for column in found.values():
        # Discard the motions that were simulated with a replaced bad number.
        column[~good] = _missing(column.dtype)
    found["status"][~good] = Status.INVALID_INPUT
    found["outcome"][~good] = MotionKind.INVALID
    if record:
        found["time"] = _build_time(known, which, np.arange(periods * substeps) / substeps, found.get("time"))
    shaped = {
        name: column if name == "time" and column.ndim == 1 else column.reshape((*shape, *column.shape[1:]))[()]
        for name, column in found.items()
    }
    return Motion(**(dict.fromkeys(("time", *OF_MOTION)) | shaped))


def _refuse_bodies(known: list[Any], which: np.ndarray, name: str, values: np.ndarray) -> None:
    """Raise `InputError` for friction or initial values of a linear system, whose bodies are unknown."""
    whole = np.array([isinstance(scene.device, LinearDevice) for scene in known])
    if np.any((values != 0) & whole[which.ravel()]):
        field = "coulomb, static" if name == "static" else _spell(name)
        raise InputError(
            f"{field}: a linear system has no known bodies and starts at rest at 0; use push or push_history, or a "
            "zwidth.Device"
        )


def _trace_law(force: Any, stiffness: Any, virtual_damping: Any) -> TracedLaw:
    """Return the traced law; raise `InputError` if a wall is also given or the law has memory or cannot be traced."""
    if stiffness is not None or virtual_damping is not None:
        raise InputError("force: got a law and a stiffness or damping; include the wall in the law, or remove one")
    # Import JAX only here, because importing zwidth must not load it.
    import jax

    name = getattr(force, "__name__", repr(force))
    programs, result = [], None
    with compute_concretely(), jax.numpy_rank_promotion("allow"):
        try:
            hash(force)
            # Trace twice, because a law with memory yields another program or an error in the second trace.
            for _ in range(2):
                # Wrap the law in a new function, because JAX would reuse constants cached for a known function.
                fresh = jax.jit(lambda position, velocity, time: force(position, velocity, time))
                trace = fresh.trace(*[jax.ShapeDtypeStruct((2,), float)] * 3)
                # A value kept from an earlier trace appears as an additional input.
                if len(trace.jaxpr.in_avals) != 3:
                    raise _refuse_memory(name)
                result = trace.out_info
                programs.append(trace.lower().as_text())
        except InputError:
            raise
        except Exception as error:
            if programs or isinstance(error, jax.errors.UnexpectedTracerError):
                raise _refuse_memory(name) from error
            words = str(error).partition("\n")[0][:200]
            raise InputError(
                f"force: JAX cannot trace {name}: {words}; write a function of position, velocity and time with "
                "jax.numpy, jnp.where in place of if"
            ) from error
    if programs[0] != programs[1]:
        raise _refuse_memory(name)
    kind = getattr(result, "dtype", np.dtype(object)).kind
    if getattr(result, "shape", None) not in ((), (2,)) or kind not in "if":
        raise InputError(f"force: the law returns {result} for two simulations; return one force in N for each")
    return TracedLaw(force, programs[0])


def _refuse_memory(name: str) -> InputError:
    """Return the error for a force law that depends on earlier calls."""
    return InputError(
        f"force: the law {name} keeps values between calls; it is compiled once, so use only position, velocity, time "
        "and constants"
    )


def _spread_starts(known: list[Any], given: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments with one initial value per body."""
    bodies = dict.fromkeys(["position", *(name for scene in known for name in name_bodies(scene))])
    for name in STARTS:
        start = given.pop(name)
        start = dict(start) if isinstance(start, Mapping) else {"position": start}
        for body in start.keys() - bodies.keys():
            raise InputError(f"{name}: {describe_choice(body, tuple(bodies))}")
        own = start.get("position", 0.0)
        given |= {f"{name}.{body}": start.get(body, own) for body in bodies}
    return given


def _convert_hand(known: list[Any], which: np.ndarray, hand: Any, push: Any, periods: int) -> Any:
    """Return the external force of operators with a moving far end, averaged over each period."""
    places = as_float64("hand_history", read_texts("hand_history", hand, "m"))
    if places.ndim == 1 and not np.isfinite(places).all():
        raise InputError("hand_history: got a position that is not finite; fill the gaps")
    if not places.ndim or places.shape[-1] != periods + 1:
        raise InputError(
            f"hand_history: got an array of shape {places.shape}; its last axis needs {periods + 1} positions, one per "
            "period and one at the end"
        )
    for scene in known:
        if scene.operator is None or not scene.operator.rigid or scene.device.coupling is not None:
            raise InputError(
                "hand_history: got a scene without a rigid operator; use operator=zwidth.Operator(stiffness=..., "
                "damping=...), on a device without coupling"
            )
    units = [
        (float(each.operator.stiffness), float(each.operator.damping) / float(each.timing.period)) for each in known
    ]
    spring, damper = np.moveaxis(np.array(units)[which], -1, 0)[..., None]
    with np.errstate(all="ignore"):
        pushes = spring * 0.5 * (places[..., 1:] + places[..., :-1]) + damper * np.diff(places)
    return pushes if push is None else pushes + as_float64("push_history", push)


def _check_memory(numbers: dict[str, np.ndarray], settings: Settings) -> None:
    """Raise `ResourceError` if the simulations need too much memory."""
    count, instants = numbers["seed"].size, settings.periods * settings.substeps
    together = min(count, GROUP * processors())
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


def _build_time(known: list[Any], which: np.ndarray, steps: np.ndarray, drawn: np.ndarray | None) -> np.ndarray:
    """Return the instants, on one axis if all simulations share them; ``drawn``: instants with jitter, else NaN."""
    clock = np.array([float(scene.timing.period) for scene in known])
    if drawn is None and len(set(clock.tolist())) == 1:
        return steps * clock[0]
    even = steps * clock[which][:, None]
    return even if drawn is None else np.where(np.isnan(drawn), even, drawn)


def _missing(dtype: np.dtype) -> Any:
    return np.nan if dtype.kind == "f" else 0


def _list_scenes(scenes: Any) -> tuple[list[Any], np.ndarray]:
    """Return the distinct scenes, and the index of the scene of each batch entry."""
    listed = isinstance(scenes, Iterable) and not isinstance(scenes, np.ndarray)
    array = np.array(list(scenes) if listed else scenes, object)
    known: dict[int, int] = {}
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
        which[index] = known.setdefault(id(scene), len(known))
    return [array.flat[np.flatnonzero(which.ravel() == k)[0]] for k in range(len(known))], which


def _read(
    known: list[Any], which: np.ndarray, given: dict[str, Any], seed: Any, history: Any, periods: int
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Return the numbers of all simulations by name, the scene index in the batch shape, and a mask of usable rows."""
    if given["static"] is None:
        given = {**given, "static": given["coulomb"]}
    walls = [resolve_wall(scene.wall, given["stiffness"], given["virtual_damping"]) for scene in known]
    if given["stiffness"] is None:
        own = np.array(walls, float).reshape(-1, 2)[which]
        given = {**given, "stiffness": own[..., 0], "virtual_damping": own[..., 1]}
    elif given["virtual_damping"] is None:
        given = {**given, "virtual_damping": 0.0}
    arrays = {
        name: as_float64(_spell(name), read_texts(_spell(name), value, _unit(name))) for name, value in given.items()
    }
    seeds, pushes = _read_seeds(seed), None
    shapes = {
        "scenes": which.shape,
        **{_spell(name): array.shape for name, array in arrays.items()},
        "seed": seeds.shape,
    }
    if history is not None:
        pushes = as_float64("push_history", history)
        if not pushes.ndim or pushes.shape[-1] != periods:
            raise InputError(
                f"push_history: got an array of shape {pushes.shape}; its last axis needs one force for each of "
                f"{periods} periods"
            )
        shapes["push_history without its last axis"] = pushes.shape[:-1]
    shape = join_shapes((name, part) for name, part in shapes.items() if part or name == "scenes")
    if not math.prod(shape):
        raise InputError(f"scenes: got a batch of shape {shape}; use at least one simulation")
    which = np.broadcast_to(which, shape)
    clock = np.array([float(scene.timing.period) for scene in known])
    good = np.ones(shape, bool)
    for name, array in arrays.items():
        usable, allowed = _check(name, array, arrays, clock[which] if array.ndim else clock.min())
        if array.ndim == 0 and not np.all(usable):
            raise InputError(f"{_spell(name)}: got {float(array):g} {_unit(name)}; {allowed}")
        good &= usable
    numbers: dict[str, Any] = {
        name: np.where(good, np.broadcast_to(array, shape), 0.0).reshape(-1) for name, array in arrays.items()
    }
    numbers["seed"] = np.broadcast_to(seeds, shape).reshape(-1)
    if pushes is not None:
        if pushes.ndim == 1 and not np.all(np.isfinite(pushes)):
            raise InputError("push_history: got a force that is not finite; fill the gaps")
        finite = np.isfinite(pushes)
        good &= np.broadcast_to(finite.all(-1), shape)
        filled = np.where(finite, pushes, 0.0)
        numbers["push_history"] = np.broadcast_to(filled, (*shape, periods)).reshape(-1, periods)
    return numbers, which, good.reshape(-1)


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
    if is_traced(seed):
        raise InputError("seed: got a value traced by JAX; use integers, outside of jit, vmap and grad")
    try:
        seeds = np.asarray(seed)
    except ValueError:
        seeds = np.asarray("ragged")
    if seeds.dtype.kind not in "iu" or np.any(seeds < 0):
        raise InputError(f"seed: got {seed!r}; use integers of at least 0")
    return seeds
