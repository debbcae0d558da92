"""Simulations in SI units: arguments to lanes, lanes to results."""

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
from zwidth.simulation.batch import TOGETHER, name_bodies, run_batch, structure
from zwidth.simulation.lanes import Course, Law, TracedLaw
from zwidth.simulation.result import OF_MOTION, Motion, MotionKind
from zwidth.words.errors import InputError, ResourceError, check_choice, describe_choice
from zwidth.words.quantities import ANY, FIELDS, NOT_NEGATIVE, OF_MOTIONS
from zwidth.words.showing import with_units
from zwidth.words.status import Status
from zwidth.words.types import ArrayLike
from zwidth.words.unit_system import LINEAR, UnitSystem
from zwidth.words.xp import is_traced

Contact = Literal["bilateral", "unilateral", "push_only"]
CONTACTS: tuple[Contact, ...] = ("bilateral", "unilateral", "push_only")

# Bytes for what is kept of an instant while it is turned to SI units, for what jitter, noise and a push take, and the
# most of all.
_RECORDED, _JITTERED, _DRAWN, _MOST_BYTES = 2 * 14 * 8, 20 * 8, 4 * 8, 4 << 30


_STARTS = ("start_position", "start_velocity")
_ARGUMENTS = {
    name: (FIELDS[name].unit, ANY if FIELDS[name].allowed == ANY else NOT_NEGATIVE)
    for name in ("stiffness", "virtual_damping", *OF_MOTIONS)
}
_ARGUMENTS["jitter"] = "s", NOT_NEGATIVE
# Infinite where there is no limit.
_LIMITS = ("max_force", "max_rate")


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
    """Simulate devices on virtual walls in time, exact between samples, with what the linear theory leaves out.

    The wall's surface is at 0 and the wall is where positions are positive; its force on the device is
    ``-(K x_k + B v_k)``, of the position that is read and the velocity that is estimated at sample k. Without friction,
    rounding, limits and contact that is the linear loop whose stability `zwidth.Scene.is_stable` decides; nothing of
    that decision is used here.

    Args:
        scenes: a `zwidth.Scene`, or a list or array of them. Its shape and those of the numbers below broadcast, as the
            shape of the batch. Numbers may be texts with a unit, "2 N". A `zwidth.LinearDevice` starts at rest at 0,
            has no friction, and no energy that is known (NaN).
        stiffness: K in N/m.
        virtual_damping: B in N s/m. Neither means each scene's own wall, as for `zwidth.Scene.is_stable`.
        force: a law in place of the wall's spring and damper: a function of the measured position (m), the estimated
            velocity (m/s) and the time of the sample (s; without jitter), arrays of one value a simulation, written
            with `jax.numpy`, that returns the force on the device in N. The law is compiled once, so it
            must not keep values between calls and must use ``jnp.where`` in place of ``if``. Its force is sampled, held
            and delayed like that of a wall. The outcome is UNCLEAR or DIVERGED, because no certificate exists for a
            law.
        periods: how many sampling periods, >= 1.
        substeps: instants recorded in each period, >= 1.
        start_position: in m; of all bodies, or by their names in `Motion`, as ``{"position": 0, "hand_position":
            1e-3}``; a body that is not named starts with the device.
        start_velocity: in m/s, likewise, by the same names; the measured past lies on the line of the sensed body.
        push: constant force of the hand on the device, in N; on a `LinearDevice` it acts where the command does.
        push_history: force of the hand in N, held over each period, (..., periods); added to ``push``.
        hand_history: recorded position in m of the place that the spring and damper of a rigid `zwidth.Operator` end
            at, (..., periods + 1), linear between samples; its force is held at its mean over each period.
        contact: "bilateral", the wall acts on both sides of its surface; "unilateral", where the measured position is
            > 0; "push_only", there and never pulling.
        resolution: of the encoder, in m; positions are rounded to it. 0 for none.
        noise: standard deviation of the measured position before it is rounded, in m.
        coulomb: dry friction on the device while it slips, in N.
        static: dry friction that holds it, in N, at least ``coulomb``, which it is where left out.
        max_force: the most that the motor gives, in N.
        max_rate: the fastest that the command changes, in N/s.
        jitter: samples are late by random times between 0 and this, in s, below one period.
        seed: whole number, >= 0, one or one for each simulation; equal seeds draw equal noise.
        tail: how many periods at the end amplitude, frequency and outcome are taken from; a quarter where left out.
        record: whether to keep the motion over time; what is said of it is there in any case.

    Returns:
        Motion: arrays over time and figures of the whole, see `zwidth.Motion`.

    Raises:
        InputError: a number is not usable; friction on a link that rings hundreds of times a period; JAX cannot trace
            the law, or the law keeps values between calls.
        ResourceError: what is recorded or drawn takes more than 4 GiB.

    Numerics:
        Float64. Matrix exponentials over the constant parts of a period; with friction the instants of stopping and
        starting to the last bit (docs/theory/simulation.md). JAX compiles for half a second to two for each combination
        of bodies and nonlinear parts; `zwidth.use_compilation_cache` keeps that for later processes. What each then
        costs stands in docs/simulation.md.

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
    given = {name: value for name, value in locals().items() if name in _ARGUMENTS}
    check_choice("contact", contact, CONTACTS)
    periods = check_whole("periods", periods, 1, 10**9)
    substeps = check_whole("substeps", substeps, 1, 10_000)
    tail = max(periods // 4, 1) if tail is None else check_whole("tail", tail, 1, periods)
    course = Course(periods, substeps, tail, contact, record)
    known, which = _list_scenes(scenes)
    system = known[0].unit_system if known else LINEAR
    if force is not None:
        course = course._replace(law=_trace_law(force, stiffness, virtual_damping))
        given |= {"stiffness": 0.0, "virtual_damping": 0.0}
    if hand_history is not None:
        push_history = _push_by_hand(known, which, hand_history, push_history, periods, system)
    numbers, which, good = _read(known, which, _spread_starts(known, given), seed, push_history, periods, system)
    for name in ("static", *(name for name in numbers if name.startswith(_STARTS))):
        _refuse_bodies(known, which, name, numbers[name])
    _check_memory(numbers, course)
    shape, which = which.shape, which.ravel()
    found: dict[str, np.ndarray] = {}
    groups: dict[tuple[Any, ...], list[int]] = {}
    for place, scene in enumerate(known):
        groups.setdefault(structure(scene), []).append(place)
    for places in groups.values():
        own = np.flatnonzero(np.isin(which, places))
        rows = {name: column[own] for name, column in numbers.items()}
        part = run_batch([known[k] for k in places], np.searchsorted(places, which[own]), rows, course)
        for name, column in part.items():
            if name not in found:
                found[name] = np.full((which.size, *column.shape[1:]), _missing(column.dtype), column.dtype)
            found[name][own] = column
    for column in found.values():
        # What was put in place of a bad number is no one's motion.
        column[~good] = _missing(column.dtype)
    found["status"][~good] = Status.INVALID_INPUT
    found["outcome"][~good] = MotionKind.INVALID
    if record:
        found["time"] = _lay_time(known, which, np.arange(periods * substeps) / substeps, found.get("time"))
    shaped = {
        name: column if name == "time" and column.ndim == 1 else column.reshape((*shape, *column.shape[1:]))[()]
        for name, column in found.items()
    }
    return with_units(Motion(**(dict.fromkeys(("time", *OF_MOTION)) | shaped)), system)


def _refuse_bodies(known: list[Any], which: np.ndarray, name: str, values: np.ndarray) -> None:
    """Refuse what a linear system has no body for: to slip, or to start from another place than its rest."""
    whole = np.array([isinstance(scene.device, LinearDevice) for scene in known])
    if np.any((values != 0) & whole[which.ravel()]):
        field, what = _spell(name), "a start names the state of all bodies"
        if name == "static":
            field, what = "coulomb, static", "friction acts on a body"
        remedy = "move it by push or push_history, or simulate a zwidth.Device"
        raise InputError(f"{field}: {what}, and of a linear system none is known; it starts at rest at 0: {remedy}")


def _trace_law(force: Any, stiffness: Any, virtual_damping: Any) -> TracedLaw:
    """Return the traced law; raise `InputError` if a wall is also given or the law has memory or cannot be traced."""
    if stiffness is not None or virtual_damping is not None:
        raise InputError("force: got a law and a stiffness or damping; write both into the law, or leave it out")
    # What JAX is needed for begins here.
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
                f"force: JAX cannot trace {name}: {words}; a function of position, velocity and time is needed, "
                "written with jax.numpy, jnp.where in place of if"
            ) from error
    if programs[0] != programs[1]:
        raise _refuse_memory(name)
    kind = getattr(result, "dtype", np.dtype(object)).kind
    if getattr(result, "shape", None) not in ((), (2,)) or kind not in "if":
        raise InputError(f"force: the law returns {result} for two simulations; one force in N for each is needed")
    return TracedLaw(force, programs[0])


def _refuse_memory(name: str) -> InputError:
    """Return the error for a force law that depends on earlier calls."""
    return InputError(
        f"force: the law {name} keeps values between calls; it is compiled once, so use only position, velocity, time "
        "and constants"
    )


def _spread_starts(known: list[Any], given: dict[str, Any]) -> dict[str, Any]:
    """The arguments with a start of each body, by name, in place of one of all."""
    bodies = dict.fromkeys(["position", *(name for scene in known for name in name_bodies(scene))])
    for name in _STARTS:
        start = given.pop(name)
        start = dict(start) if isinstance(start, Mapping) else {"position": start}
        for body in start.keys() - bodies.keys():
            raise InputError(f"{name}: {describe_choice(body, tuple(bodies))}")
        own = start.get("position", 0.0)
        given |= {f"{name}.{body}": start.get(body, own) for body in bodies}
    return given


def _push_by_hand(known: list[Any], which: np.ndarray, hand: Any, push: Any, periods: int, system: UnitSystem) -> Any:
    """The pushes of operators whose springs and dampers end at a moving place, each held at its mean over a period."""
    places = as_float64("hand_history", read_texts("hand_history", hand, system["m"]))
    if places.ndim == 1 and not np.isfinite(places).all():
        raise InputError("hand_history: got a position that is not finite; fill the gaps")
    if not places.ndim or places.shape[-1] != periods + 1:
        raise InputError(
            f"hand_history: got an array of shape {places.shape}; its last axis holds a position at the beginning of "
            f"each of {periods} periods and one at the end, {periods + 1}"
        )
    for scene in known:
        if scene.operator is None or not scene.operator.rigid or scene.device.coupling is not None:
            raise InputError(
                "hand_history: it moves the end of the spring and damper of an operator who holds the device rigidly; "
                "give operator=zwidth.Operator(stiffness=..., damping=...), on a device without coupling"
            )
    units = [
        (float(each.operator.stiffness), float(each.operator.damping) / float(each.timing.period)) for each in known
    ]
    spring, damper = np.moveaxis(np.array(units)[which], -1, 0)[..., None]
    with np.errstate(all="ignore"):
        pushes = spring * 0.5 * (places[..., 1:] + places[..., :-1]) + damper * np.diff(places)
    return pushes if push is None else pushes + as_float64("push_history", push)


def _check_memory(numbers: dict[str, np.ndarray], course: Course) -> None:
    """Refuse what the memory of a machine may not hold."""
    count, instants = numbers["seed"].size, course.periods * course.substeps
    together = min(count, TOGETHER * processors())
    kept = count * instants * _RECORDED if course.record else 0
    jitter = together * instants * _JITTERED if np.any(numbers["jitter"] > 0) else 0
    drawn = together * course.periods * _DRAWN * (bool(np.any(numbers["noise"] > 0)) + ("push_history" in numbers))
    if kept + jitter + drawn > _MOST_BYTES:
        remedy = "use record=False, or fewer at a time" if kept else "use fewer periods, or fewer at a time"
        raise ResourceError(
            f"{count} simulations of {instants} instants take {(kept + jitter + drawn) / 2**30:.1f} GiB, more than "
            f"{_MOST_BYTES >> 30} GiB{' to record' if kept else ', for jitter, noise and pushes'}; {remedy}"
        )


def _lay_time(known: list[Any], which: np.ndarray, steps: np.ndarray, drawn: np.ndarray | None) -> np.ndarray:
    """The instants: of one axis where all share them, else of every simulation; those that jitter drew as they are."""
    clock = np.array([float(scene.timing.period) for scene in known])
    if drawn is None and len(set(clock.tolist())) == 1:
        return steps * clock[0]
    even = steps * clock[which][:, None]
    return even if drawn is None else np.where(np.isnan(drawn), even, drawn)


def _missing(dtype: np.dtype) -> Any:
    return np.nan if dtype.kind == "f" else 0


def _list_scenes(scenes: Any) -> tuple[list[Any], np.ndarray]:
    """The scenes that are different objects, and which of them each place of the batch has."""
    listed = isinstance(scenes, Iterable) and not isinstance(scenes, np.ndarray)
    array = np.array(list(scenes) if listed else scenes, object)
    known: dict[int, int] = {}
    which = np.empty(array.shape, int)
    for place, scene in np.ndenumerate(array):
        if not (hasattr(scene, "device") and hasattr(scene, "timing")):
            raise InputError(f"scenes: got {scene!r}; a zwidth.Scene or a list of them is needed")
        if isinstance(scene.device, MeasuredDevice):
            raise InputError("scenes: a measured response is no model to simulate; fit one to a log (zwidth.fit_log)")
        if scene.traced_path is not None:
            raise InputError("scenes: got one of values that JAX traces; simulate outside of jit, vmap and grad")
        which[place] = known.setdefault(id(scene), len(known))
    distinct: list[Any] = [array.flat[np.flatnonzero(which.ravel() == k)[0]] for k in range(len(known))]
    if len({scene.unit_system for scene in distinct}) > 1:
        raise InputError("scenes: got both rotary and linear devices; simulate one kind per call")
    return distinct, which


def _read(
    known: list[Any],
    which: np.ndarray,
    given: dict[str, Any],
    seed: Any,
    history: Any,
    periods: int,
    system: UnitSystem,
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """The numbers of all simulations by name, the scene of each in the batch's shape, and which have usable ones."""
    if given["static"] is None:
        given = {**given, "static": given["coulomb"]}
    walls = [resolve_wall(scene.wall, given["stiffness"], given["virtual_damping"], system) for scene in known]
    if given["stiffness"] is None:
        own = np.array(walls, float).reshape(-1, 2)[which]
        given = {**given, "stiffness": own[..., 0], "virtual_damping": own[..., 1]}
    elif given["virtual_damping"] is None:
        given = {**given, "virtual_damping": 0.0}
    units = {name: system[_ARGUMENTS[name.partition(".")[0]][0]] for name in given}
    arrays = {
        name: as_float64(_spell(name), read_texts(_spell(name), value, units[name])) for name, value in given.items()
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
                f"push_history: got an array of shape {pushes.shape}; its last axis holds one force for each of "
                f"{periods} periods"
            )
        shapes["push_history without its last axis"] = pushes.shape[:-1]
    shape = join_shapes((name, part) for name, part in shapes.items() if part or name == "scenes")
    if not math.prod(shape):
        raise InputError(f"scenes: got a batch of shape {shape}; one simulation at least is needed")
    which = np.broadcast_to(which, shape)
    clock = np.array([float(scene.timing.period) for scene in known])
    good = np.ones(shape, bool)
    for name, array in arrays.items():
        usable, allowed = _check(name, array, arrays, clock[which] if array.ndim else clock.min())
        if array.ndim == 0 and not np.all(usable):
            raise InputError(f"{_spell(name)}: got {float(array):g} {units[name]}; {allowed}")
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


def _spell(name: str) -> str:
    """An argument as its user wrote it: a start of the device alone stands for all bodies."""
    return name.removesuffix(".position")


def _check(name: str, array: np.ndarray, arrays: dict[str, np.ndarray], period: Any) -> tuple[Any, str]:
    """Which values of an argument are usable, and what is allowed."""
    _, rule = _ARGUMENTS[name.partition(".")[0]]
    usable = rule.holds(array) & (np.isfinite(array) | ((name in _LIMITS) & (array > 0)))
    allowed = "it must be finite" if rule == ANY else f"it must be {rule}" + ("" if name in _LIMITS else " and finite")
    if name == "static":
        return usable & (array >= arrays["coulomb"]), "it must be at least coulomb, the friction while slipping"
    if name == "jitter":
        return usable & (array < period), "it must be at least 0 and less than the period"
    return usable, allowed


def _read_seeds(seed: Any) -> np.ndarray:
    if is_traced(seed):
        raise InputError("seed: got a value that JAX traces; give whole numbers, outside of jit, vmap and grad")
    try:
        seeds = np.asarray(seed)
    except ValueError:
        seeds = np.asarray("ragged")
    if seeds.dtype.kind not in "iu" or np.any(seeds < 0):
        raise InputError(f"seed: got {seed!r}; whole numbers of at least 0 are needed")
    return seeds
