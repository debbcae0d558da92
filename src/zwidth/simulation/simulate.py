"""Simulate scenes in SI units: check the arguments, simulate scenes of equal structure together, collect the results.

A *scene* (`zwidth.Scene`) is a device with its timing, velocity estimate and, optionally, wall. Scenes have equal
*structure* if they can share one compiled program.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from zwidth.core.errors import check_choice
from zwidth.core.status import Status
from zwidth.core.types import ArrayLike
from zwidth.model.checks import check_integer
from zwidth.simulation.arguments import (
    ARGUMENTS,
    check_memory,
    convert_hand,
    count_periods,
    list_scenes,
    read_arguments,
    refuse_bodies,
    refuse_unsupported,
    spread_starts,
    trace_law,
)
from zwidth.simulation.batch import find_structure, run_scenes
from zwidth.simulation.parameters import Law, Settings
from zwidth.simulation.result import OF_MOTION, Motion, MotionKind
from zwidth.units.display import with_units

Contact = Literal["bilateral", "unilateral", "push_only"]
CONTACTS: tuple[Contact, ...] = ("bilateral", "unilateral", "push_only")


def simulate(
    scenes: Any,
    stiffness: ArrayLike | None = None,
    virtual_damping: ArrayLike | None = None,
    *,
    force: Law | None = None,
    periods: int | None = None,
    duration: float | str | None = None,
    substeps: int = 1,
    start_position: ArrayLike | Mapping[str, ArrayLike] = 0.0,
    start_velocity: ArrayLike | Mapping[str, ArrayLike] = 0.0,
    external_force: ArrayLike = 0.0,
    external_force_history: ArrayLike | None = None,
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
    ``-(K p_k + B v_k + r_k)`` with the position estimate p_k, the velocity estimate v_k and the force r_k of the
    further feedback at sample k. If a scene has no position estimate, p_k is the measured position. If it has no
    further feedback, r_k is 0. Without friction, encoder, limits and contact this is the linear loop whose stability
    `zwidth.Scene.is_stable` decides; the simulation is independent of that decision. At the start, both estimates are
    in steady state for the start velocity: their transients have decayed. The states of the further feedback, such as
    an integral, are 0 at the start and outside of contact.

    In a scene with a `zwidth.Tool`, the force ``f_k = K (p_k - y_k) + B v_k`` of the virtual coupling acts on the tool,
    and ``-(f_k + r_k)`` is the command of the device. Here y_k is the position of the tool, and v_k the estimated
    velocity of the device relative to the tool. The limits of the motor apply only to the command. At the start, the
    tool is at rest at the measured position of the device.

    Args:
        scenes: a `zwidth.Scene`, or a list or array of scenes. Its shape and the shapes of the numbers below broadcast
            to the batch shape. Numbers may be strings with a unit, "2 N". A `zwidth.LinearDevice` starts at rest at 0,
            has no friction, and its energies are NaN.
        stiffness: K in N/m.
        virtual_damping: B in N s/m. If both are left out, each scene uses its own wall.
        force: force law in place of the wall's spring and damper: a function of three arrays with one value per
            simulation. They contain the position p_k in m (see above), the estimated velocity in m/s, and the time of
            the sample in s, without jitter. It returns the force on the device in N and is written with `jax.numpy`.
            The law is compiled once, so it must not keep values between calls and must use ``jnp.where`` in place of
            ``if``. Its force is sampled, held and delayed like that of a wall. With a tool, the position is p_k - y_k;
            a tool that is integrated by the implicit Euler method excludes a law.
        periods: number of sampling periods, >= 1; 1000 if left out.
        duration: length of the simulation in s, or a string such as "2 s" or "500 periods", in place of ``periods``;
            rounded to an integer number of periods.
        substeps: recorded instants per period, >= 1.
        start_position: in m; one value for all bodies, or a mapping by their names in `Motion`, as ``{"position": 0,
            "hand_position": 1e-3}``; other bodies start with the device. The name of a tool is "tool_position".
        start_velocity: in m/s, likewise; the velocity of a tool is 0 unless the mapping contains its name. Before the
            start, device and tool move at their start velocities.
        external_force: constant external force on the device, in N; on a `LinearDevice` it acts where the wall acts.
        external_force_history: external force in N, constant over each period, (..., periods); added to
            ``external_force``.
        hand_history: recorded position in m of the far end of the spring and damper of a rigid `zwidth.Operator`,
            (..., periods + 1), linear between samples; its force is averaged over each period.
        contact: "bilateral": the wall acts on both sides of its surface at 0; "unilateral": only at positions p_k > 0;
            "push_only": unilateral, and it never pulls. A coupling to a tool has no surface and is always bilateral.
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
        record: return the motion over time in addition to its statistics.

    Returns:
        Motion: arrays over time and statistics of each motion, see `zwidth.Motion`.

    Raises:
        InputError: an argument is invalid; friction with a pole of more than 64 rad per period; JAX cannot trace the
            law, or the law keeps values between calls; a scene has a tool together with a contact, a law or a
            velocity estimate that does not allow a tool.
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
    substeps = check_integer("substeps", substeps, 1, 10_000)
    distinct, which = list_scenes(scenes)
    periods = count_periods(distinct, periods, duration)
    tail = max(periods // 4, 1) if tail is None else check_integer("tail", tail, 1, periods)
    settings = Settings(periods, substeps, tail, contact, record)
    if force is not None:
        settings = settings._replace(law=trace_law(force, stiffness, virtual_damping))
        given |= {"stiffness": 0.0, "virtual_damping": 0.0}
    refuse_unsupported(distinct, contact, settings.law)
    if hand_history is not None:
        external_force_history = convert_hand(distinct, which, hand_history, external_force_history, periods)
    numbers, which, good = read_arguments(
        distinct, which, spread_starts(distinct, given), seed, external_force_history, periods
    )
    refuse_bodies(distinct, which, numbers)
    check_memory(numbers, settings)
    shape, which = which.shape, which.ravel()
    results: dict[str, np.ndarray] = {}
    groups: dict[tuple[Any, ...], list[int]] = {}
    for index, scene in enumerate(distinct):
        groups.setdefault(find_structure(scene), []).append(index)
    for members in groups.values():
        indices = np.flatnonzero(np.isin(which, members))
        rows = {name: column[indices] for name, column in numbers.items()}
        part = run_scenes([distinct[k] for k in members], np.searchsorted(members, which[indices]), rows, settings)
        for name, column in part.items():
            if name not in results:
                results[name] = np.full((which.size, *column.shape[1:]), _missing(column.dtype), column.dtype)
            results[name][indices] = column
    for column in results.values():
        # Replace the results of simulations with invalid arguments, because these arguments were replaced by 0.
        column[~good] = _missing(column.dtype)
    results["status"][~good] = Status.INVALID_INPUT
    results["outcome"][~good] = MotionKind.INVALID
    if record:
        results["time"] = _build_time(distinct, which, np.arange(periods * substeps) / substeps, results.get("time"))
    shaped = {
        name: column if name == "time" and column.ndim == 1 else column.reshape((*shape, *column.shape[1:]))[()]
        for name, column in results.items()
    }
    return with_units(Motion(**(dict.fromkeys(("time", *OF_MOTION)) | shaped)), distinct[0].unit_system)


def _build_time(distinct: list[Any], which: np.ndarray, steps: np.ndarray, drawn: np.ndarray | None) -> np.ndarray:
    """Return the recorded instants in s: one array for equal sampling periods, otherwise one row per simulation.

    Args:
        distinct: distinct scenes.
        which: index of the scene of each simulation.
        steps: recorded instants in sampling periods.
        drawn: instants of the simulations with jitter in s, NaN for the others; None if no simulation has jitter.
    """
    clock = np.array([float(scene.timing.period) for scene in distinct])
    if drawn is None and len(set(clock.tolist())) == 1:
        return steps * clock[0]
    even = steps * clock[which][:, None]
    return even if drawn is None else np.where(np.isnan(drawn), even, drawn)


def _missing(dtype: np.dtype) -> Any:
    """Return the value of a missing result of the type ``dtype``: NaN, or 0 for integers and booleans."""
    return np.nan if dtype.kind == "f" else 0
