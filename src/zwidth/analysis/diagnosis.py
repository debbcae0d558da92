"""Time-domain diagnosis of a wall: the cause of a sustained oscillation and the changes that stop it.

The *linear loop* ignores encoder steps, friction and motor limits. `diagnose` decides its stability, and then simulates
the wall with these effects from several initial conditions (`zwidth.analysis.trials`). A simulated *motion* is
sustained if it neither comes to rest nor decays. K and B are the stiffness and damping of the wall.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from zwidth.analysis.base import wrap_function
from zwidth.analysis.optimization import SceneOptima
from zwidth.analysis.remedies import search_remedies
from zwidth.analysis.stabilization import Remedy, stabilize
from zwidth.analysis.trials import LONG_DELAY, Experiment, Hardware, SustainedMotion, list_starts
from zwidth.analysis.walls import read_single_wall
from zwidth.core.errors import InputError
from zwidth.model.checks import check_limit, check_number
from zwidth.model.wall import VirtualWall, resolve_wall
from zwidth.simulation.result import MotionKind
from zwidth.units.display import compact_repr
from zwidth.units.formatting import plain, to_json, with_unit
from zwidth.units.unit_system import LINEAR, UnitSystem

Cause: TypeAlias = Literal["none", "instability", "quantization", "saturation", "undecided"]

TIME_CONSTANTS = 30.0  # length of a simulation, in time constants of the linear loop
FEWEST_PERIODS = 2000  # length of the shortest simulation, in sampling periods
MOST_PERIODS = 200_000  # length of the longest simulation, in sampling periods; limits the run time
SETTLED = 2.0  # time constants that must be simulated before a motion may count as sustained
CONFIRMED = "simulated at these and larger changes: check the value that you choose with diagnose"
UNSEARCHED = f"zwidth diagnose searches for a remedy, unless the delay is longer than {LONG_DELAY:g} periods"
SMALL = 0.1  # encoder steps; a limit cycle of smaller amplitude is printed without a caution
WITHOUT_MARGINS = "these are limits of stability, without margins: for a wall to set, use recommend"
FRICTIONLESS = "without friction a finer encoder only reduces the amplitude, in proportion to its steps"


@compact_repr(
    ("cause", "amplitude", "frequency", "linearly_stable", "phase_margin", "remedies"),
    missing={"frequency": "no oscillation", "phase_margin": "no gain crossover determines it"},
    amplitude="m",
    frequency="Hz",
    phase_margin="degrees",
)
@dataclass(frozen=True)
class Diagnosis:
    """The cause of a sustained oscillation of a device on a wall, and the remedies.

    Attributes:
        cause: cause of the oscillation. "instability": the linear loop is unstable. "quantization": the steps of the
            encoder. "saturation": the limits of the motor. "none": every simulated response comes to rest.
            "undecided": the linear loop decays too slowly to simulate until rest.
        stiffness: K in N/m.
        virtual_damping: B in N s/m.
        hardware: encoder, friction and motor.
        linearly_stable: whether the linear loop, without encoder steps, friction and motor limits, is stable.
        phase_margin: phase margin of the linear loop in degrees.
        amplitude: half of the peak-to-peak position of the largest sustained motion, in m; 0 if every response comes to
            rest, infinite if one grows without bound.
        frequency: frequency of the largest sustained motion in Hz; NaN at rest. For an unstable linear loop whose
            simulation shows no frequency: frequency of the dominant pole.
        outcome: code of `zwidth.MotionKind` observed for the largest sustained motion.
        remedies: changes of one parameter, each of which stops the oscillation; empty if the search found none or if
            none is needed. None without a search: by choice, or for a limit cycle with a delay of more than 50 periods.
        unit_system: units of the device.
    """

    cause: Cause
    stiffness: float
    virtual_damping: float
    hardware: Hardware
    linearly_stable: bool
    phase_margin: float
    amplitude: float
    frequency: float
    outcome: MotionKind
    remedies: tuple[Remedy, ...] | None = ()
    unit_system: UnitSystem = LINEAR

    @property
    def word(self) -> str:
        """Diagnosis as a label in capitals, such as "LIMIT CYCLE", which commands print."""
        if self.cause in ("quantization", "saturation"):
            return "LIMIT CYCLE" if math.isfinite(self.amplitude) else "UNBOUNDED"
        return {"none": "AT REST", "instability": "UNSTABLE"}.get(self.cause, "UNDECIDED")

    @property
    def is_small(self) -> bool:
        """True for a limit cycle caused by the encoder whose amplitude is below a tenth of an encoder step."""
        return self.cause == "quantization" and self.amplitude < SMALL * self.hardware.resolution

    def explain(self) -> str:
        """Return the cause of the oscillation as a sentence, with its amplitude and frequency."""
        units = self.unit_system
        size = with_unit(self.amplitude, units["m"], 2)
        swing = f"{size} at {with_unit(self.frequency, 'Hz', 2)}" if math.isfinite(self.amplitude) else "without bound"
        margin = f", phase margin {plain(self.phase_margin, 3)} deg" if math.isfinite(self.phase_margin) else ""
        linear = (
            f"the linear loop is stable{margin}"
            if self.linearly_stable
            else "the linear loop is marginal (poles on the unit circle)"
        )
        if self.cause == "instability":
            simulated = f"reaches {swing}" if math.isfinite(self.amplitude) else "grows without bound"
            simulated = simulated if self.amplitude else "comes to rest, because friction holds small displacements"
            return f"the linear loop is unstable at {with_unit(self.frequency, 'Hz', 3)}; the simulation {simulated}"
        if self.cause == "quantization":
            step = with_unit(self.hardware.resolution, units["m"], 3)
            small = ", less than a tenth of a step" if self.is_small else ""
            return f"{swing}, caused by the encoder's steps of {step}{small}; {linear}"
        if self.cause == "saturation":
            limits = (
                [with_unit(self.hardware.max_force, units["N"], 3)] if math.isfinite(self.hardware.max_force) else []
            )
            limits += (
                [with_unit(self.hardware.max_rate, units["N/s"], 3)] if math.isfinite(self.hardware.max_rate) else []
            )
            return f"{swing}, caused by the motor's limit of {' and '.join(limits)}; {linear}"
        if self.cause == "undecided":
            return f"the linear loop decays too slowly to simulate until rest; {linear}"
        return f"no sustained oscillation; {linear}"

    def advise(self) -> str:
        """Return the changes that stop the oscillation as a sentence; "" if no change is needed."""
        if self.cause in ("none", "undecided"):
            return ""
        simulated = self.cause != "instability"
        if self.remedies is None:
            parts = [UNSEARCHED]
        elif self.remedies:
            changes = ", or ".join(remedy.spell(3 if simulated else 4) for remedy in self.remedies)
            parts = [changes, CONFIRMED if simulated else WITHOUT_MARGINS]
        else:
            parts = ["no remedy by a change of one parameter was found"]
        # Without friction a finer encoder does not stop the oscillation: no equilibrium exists between two steps of the
        # force, and the amplitude is proportional to the encoder step.
        parts += [FRICTIONLESS] if self.cause == "quantization" and not self.hardware.static else []
        return "; ".join(parts)

    def as_dict(self) -> dict[str, Any]:
        """Return a dictionary of the fields as JSON values, with None in place of NaN and infinity."""
        values = {name: getattr(self, name) for name in self.__dataclass_fields__ if name != "unit_system"}
        values |= {"hardware": self.hardware._asdict(), "outcome": self.outcome.name}
        remedies = None if self.remedies is None else [remedy._asdict() for remedy in self.remedies]
        return to_json(values | {"remedies": remedies})


@wrap_function
def diagnose(
    scene: SceneOptima,
    stiffness: float | str | None = None,
    virtual_damping: float | str | None = None,
    *,
    resolution: float | str = 0.0,
    coulomb: float | str = 0.0,
    static: float | str | None = None,
    max_force: float | str = np.inf,
    max_rate: float | str = np.inf,
    remedies: bool = True,
) -> Diagnosis:
    """Find the cause of a sustained oscillation of a device on a wall, and the changes that stop it.

    First `zwidth.Scene.is_stable` decides the stability of the linear loop. Then the wall is simulated with encoder,
    friction and motor from several initial displacements, each without external force and with the worst constant one,
    K times half an encoder step. If removing the motor limits more than halves the amplitude, the cause is saturation;
    otherwise it is quantization. To confirm a remedy of a limit cycle, the simulations are repeated at many values
    of its parameter, from the returned value to 64 times the change. The ranges of an unstable linear loop are exact.

    Args:
        scene: device, timing and parts.
        stiffness: K in N/m.
        virtual_damping: B in N s/m. If both are left out, the wall of the scene is diagnosed.
        resolution: step of the encoder in m; 0 for an ideal sensor.
        coulomb: Coulomb friction, which acts while the device moves, in N.
        static: static friction (breakaway force) in N; equal to ``coulomb`` if left out.
        max_force: largest force of the motor, in N.
        max_rate: largest rate of change of the commanded force, in N/s.
        remedies: also search for remedies, which takes most of the run time.

    Returns:
        Diagnosis: cause, amplitude, frequency and remedies. Amplitude and frequency are those of the largest simulated
        motion; from other initial conditions a larger one may exist.

    Raises:
        InputError: a value is not usable, the scene has no wall or has a tool, or its device is a measured response
            without a model.

    References:
        Abbott, Okamura 2005, IEEE Trans. Robotics 21(5):952-964 (encoder and friction).

    Example:
        >>> import zwidth
        >>> device = zwidth.Device(mass="60 g cm^2", damping="0.02 mN m s/rad")
        >>> scene = zwidth.Scene(device, zwidth.Timing(period=1e-3, delay=0.7e-3), velocity=zwidth.LowPass(cutoff=100))
        >>> diagnosis = zwidth.diagnose(scene, 0.3, 1.4e-3, resolution="0.0005 rev", coulomb="0.1 mN m", remedies=False)
        >>> diagnosis.cause
        'quantization'
    """
    if scene.tool is not None:
        raise InputError(f"tool: got {scene.tool!r}, but diagnose supports walls only; use zwidth.simulate")
    units = scene.unit_system
    K, B = read_single_wall(*map(np.asarray, resolve_wall(scene.wall, stiffness, virtual_damping, units)))
    sliding = check_number("coulomb", coulomb, units["N"])
    hardware = Hardware(
        check_number("resolution", resolution, units["m"]),
        sliding,
        sliding if static is None else check_number("static", static, units["N"]),
        check_limit("max_force", max_force, units["N"]),
        check_limit("max_rate", max_rate, units["N/s"]),
    )
    scene = scene.replace(wall=VirtualWall(K, B))
    stable, dominant, margins = bool(scene.is_stable()), _find_dominant(scene), scene.margins()
    rate = TIME_CONSTANTS / FEWEST_PERIODS if dominant.marginal else dominant.rate
    periods = int(np.clip(TIME_CONSTANTS / max(rate, 1e-9), FEWEST_PERIODS, MOST_PERIODS))
    experiment = Experiment(scene, hardware, list_starts(scene, hardware), periods, rate * periods)
    worst = experiment.measure()
    cause, frequency = _find_cause(experiment, worst, dominant), float(worst.frequency[0])
    if cause == "instability" and not math.isfinite(frequency):
        frequency = dominant.angle / (2.0 * math.pi * scene.timing.period)
    changes: list[Remedy] | None = []
    if cause == "instability":
        changes = stabilize(scene) if remedies else None
    elif cause == "quantization" or cause == "saturation":
        changes = search_remedies(experiment, cause) if remedies and scene.d <= LONG_DELAY else None
    return Diagnosis(
        cause, K, B, hardware, stable, float(margins.phase_margin), float(worst.amplitude[0]), frequency,
        MotionKind(int(worst.outcome[0])), None if changes is None else tuple(changes), units,
    )  # fmt: skip


def _find_dominant(scene: Any) -> Any:
    """Return the dominant pole of the linear closed loop with the wall of a scene."""
    return scene.loop.find_dominant(float(scene.alpha), float(scene.beta))


def _find_cause(experiment: Experiment, worst: SustainedMotion, dominant: Any) -> Cause:
    """Return the cause of the largest sustained motion as a label, such as "quantization".

    Args:
        experiment: the simulations, with the scene and its hardware.
        worst: the largest sustained motion in the simulations.
        dominant: dominant pole of the linear loop.
    """
    scene, hardware = experiment.scene, experiment.hardware
    if not dominant.marginal and not scene.is_stable():
        return "instability"
    limited = min(hardware.max_force, hardware.max_rate) < math.inf
    if not limited and hardware.resolution == 0:
        # With an ideal encoder and motor, report no sustained oscillation unless the linear loop is unstable, because
        # friction only dissipates energy.
        return "none"
    if not worst.at_rest[0] and experiment.decay < SETTLED:
        return "undecided"
    if worst.amplitude[0] == 0:
        return "none"
    if limited and hardware.resolution > 0:
        unlimited = experiment.measure(max_force=np.inf, max_rate=np.inf)
        # Attribute the motion to saturation if it is more than twice as large as the limit cycle that the encoder steps
        # alone cause, simulated without motor limits.
        limited = bool(worst.amplitude[0] > 2.0 * unlimited.amplitude[0])
    return "saturation" if limited else "quantization"
