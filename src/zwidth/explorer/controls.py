"""What can be set on the page, and the scene that it means."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import isfinite, pi
from pathlib import Path
from typing import Any, Literal, NamedTuple

from zwidth.errors import InputError
from zwidth.parts.coupling import Coupling
from zwidth.parts.device import Device
from zwidth.parts.operator import Operator
from zwidth.parts.timing import Timing
from zwidth.parts.velocity import BackwardDifference, Butterworth, LowPass, WindowedDifference
from zwidth.parts.wall import VirtualWall
from zwidth.runs.record import CONFIG_FILE, RUN_FILE, Record
from zwidth.scene import Scene
from zwidth.studies.document import load_config

# Delay and window together: beyond, the poles are too many to follow a drag.
MOST_PERIODS = 64.0


class Slider(NamedTuple):
    """One number of the page: its label, the unit shown, how many of these are one SI unit, and the slider's range."""

    label: str
    unit: str
    per_si: float
    low: float
    high: float
    shown_if: str  # the choices under which it is there: "operator=grasp"
    whole: bool = False


# A range that begins at 0 or below is linear or cubic on the page, any other logarithmic.
SLIDERS = {
    "mass": Slider("mass m", "g", 1e3, 1.0, 10e3, "mode=physical"),
    "damping": Slider("physical damping b", "N s/m", 1.0, 0.0, 100.0, "mode=physical"),
    "period": Slider("period T", "ms", 1e3, 0.05, 20.0, "mode=physical"),
    "delay": Slider("delay t_d", "ms", 1e3, 0.0, 20.0, "mode=physical"),
    "delta": Slider("normalized damping delta", "", 1.0, 0.0, 5.0, "mode=normalized"),
    "d": Slider("delay d", "periods", 1.0, 0.0, 10.0, "mode=normalized"),
    "stiffness": Slider("wall stiffness K", "N/m", 1.0, 0.0, 50e3, "mode=physical"),
    "virtual_damping": Slider("wall damping B", "N s/m", 1.0, -20.0, 100.0, "mode=physical"),
    "alpha": Slider("wall stiffness alpha", "", 1.0, 0.0, 1.0, "mode=normalized"),
    "beta": Slider("wall damping beta", "", 1.0, -0.5, 1.5, "mode=normalized"),
    "samples": Slider("window n", "periods", 1.0, 1.0, 50.0, "velocity=windowed_difference", True),
    "cutoff": Slider("cut-off", "Hz", 1.0, 1.0, 5e3, "velocity=low_pass|butterworth"),
    "order": Slider("order", "", 1.0, 1.0, 8.0, "velocity=low_pass|butterworth", True),
    "hand_mass": Slider("hand: mass", "g", 1e3, 0.0, 2e3, "operator=rigid|grasp"),
    "hand_damping": Slider("hand: damping", "N s/m", 1.0, 0.0, 50.0, "operator=rigid|grasp"),
    "hand_stiffness": Slider("hand: stiffness", "N/m", 1.0, 0.0, 1e3, "operator=rigid|grasp"),
    "grasp_stiffness": Slider("grasp: stiffness", "N/m", 1.0, 10.0, 100e3, "operator=grasp"),
    "grasp_damping": Slider("grasp: damping", "N s/m", 1.0, 0.0, 50.0, "operator=grasp"),
    "tip_mass": Slider("tip: mass", "g", 1e3, 1.0, 1e3, "coupling=motor|tip"),
    "tip_stiffness": Slider("tip: spring", "N/m", 1.0, 100.0, 1e6, "coupling=motor|tip"),
    "tip_damping": Slider("tip: damper", "N s/m", 1.0, 0.0, 50.0, "coupling=motor|tip"),
}
CHOICES = {
    "mode": {"physical": "physical", "normalized": "normalized"},
    "velocity": {
        "backward_difference": "backward difference",
        "windowed_difference": "window of n",
        "low_pass": "low-pass",
        "butterworth": "Butterworth",
    },
    "operator": {"none": "none", "rigid": "rigid", "grasp": "grasp"},
    "coupling": {"none": "none", "motor": "tip, sensor at the motor", "tip": "tip, sensor at the tip"},
}


@dataclass(frozen=True)
class Controls:
    """The numbers and choices of the page, in SI units; the defaults are those of a small desktop device."""

    mode: Literal["physical", "normalized"] = "physical"
    mass: float = 0.1
    damping: float = 10.0
    period: float = 1e-3
    delay: float = 1e-3
    stiffness: float = 10e3
    virtual_damping: float = 40.0
    delta: float = 0.1
    d: float = 1.0
    alpha: float = 0.1
    beta: float = 0.4
    velocity: str = "backward_difference"
    samples: int = 5
    cutoff: float = 100.0
    order: int = 1
    operator: str = "none"
    hand_mass: float = 0.554
    hand_damping: float = 6.45
    hand_stiffness: float = 135.0
    grasp_stiffness: float = 1e3
    grasp_damping: float = 5.0
    coupling: str = "none"
    tip_mass: float = 0.05
    tip_stiffness: float = 20e3
    tip_damping: float = 2.0

    @property
    def normalized(self) -> bool:
        """Whether the page shows alpha, beta, delta and d."""
        return self.mode == "normalized"

    @property
    def wall(self) -> tuple[float, float]:
        """The wall in the units of the plane that is shown."""
        return (self.alpha, self.beta) if self.normalized else (self.stiffness, self.virtual_damping)

    def change(self, shown: Mapping[str, Any]) -> Controls:
        """New controls with some values as the page shows them, in its units.

        Raises:
            InputError: a name or a value is not one that the page has.
        """
        changes: dict[str, Any] = {}
        for name, value in shown.items():
            if name in CHOICES:
                if not isinstance(value, str) or value not in CHOICES[name]:
                    raise InputError(f"{name}: got {str(value)[:40]!r}; choose one of {', '.join(CHOICES[name])}")
                changes[name] = value
                continue
            if name not in SLIDERS:
                raise InputError(f"{str(name)[:40]!r}: the page has no such field; reload it")
            if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
                raise InputError(f"{SLIDERS[name].label}: got {str(value)[:40]!r}; a finite number is needed")
            changes[name] = round(value) if SLIDERS[name].whole else float(value) / SLIDERS[name].per_si
        new = replace(self, **changes)
        return new._convert() if new.mode != self.mode else new

    def _convert(self) -> Controls:
        """The same device and wall in the units that have just been chosen; normalized is rigid, without parts."""
        if self.normalized:
            bare = replace(self, mode="physical", velocity="backward_difference", operator="none", coupling="none")
            found = bare.scene().normalized
            return replace(self, **{name: float(value) for name, value in found._asdict().items()})
        rate = self.mass / self.period
        return replace(
            self,
            damping=self.delta * rate,
            delay=self.d * self.period,
            stiffness=self.alpha * rate / self.period,
            virtual_damping=self.beta * rate,
        )

    def shown(self) -> dict[str, Any]:
        """Every value as the page shows it, in its units."""
        numbers = {name: getattr(self, name) * slider.per_si for name, slider in SLIDERS.items()}
        return numbers | {name: getattr(self, name) for name in CHOICES}

    def scene(self) -> Scene:
        """The scene that they mean; a normalized one has m = 1 and T = 1, so that K is alpha and B is beta.

        Raises:
            InputError: a part refuses its numbers, or the loop has more poles than the page can follow.
        """
        wall = VirtualWall(*self.wall)
        if self.normalized:
            scene = Scene(Device(1.0, self.delta), Timing(1.0, self.d), wall)
        else:
            timing = Timing(period=self.period, delay=self.delay)
            device = Device(self.mass, self.damping, coupling=self._coupling())
            scene = Scene(device, timing, wall, velocity=self._velocity(), operator=self._operator())
        periods = float(scene.d) + (self.samples if isinstance(scene.velocity, WindowedDifference) else 0)
        if not periods <= MOST_PERIODS:
            raise InputError(
                f"delay: delay and window together are {periods:g} periods; the page follows {MOST_PERIODS:g}, "
                "zwidth check judges any wall"
            )
        # What parts refuse only together, as a cut-off beyond half the sampling rate.
        _ = scene.is_rigid or scene.loop
        return scene

    def _velocity(self) -> Any:
        if self.velocity == "windowed_difference":
            return WindowedDifference(self.samples)
        if self.velocity == "low_pass":
            return LowPass(cutoff=self.cutoff, order=self.order)
        return Butterworth(self.cutoff, self.order) if self.velocity == "butterworth" else BackwardDifference()

    def _operator(self) -> Operator | None:
        hand = (self.hand_mass, self.hand_damping, self.hand_stiffness)
        if self.operator == "grasp":
            return Operator(*hand, self.grasp_stiffness, self.grasp_damping)
        return Operator(*hand) if self.operator == "rigid" else None

    def _coupling(self) -> Coupling | None:
        if self.coupling == "none":
            return None
        return Coupling(self.tip_mass, self.tip_stiffness, self.tip_damping, sensor=self.coupling)  # pyright: ignore[reportArgumentType]


def read_controls(path: Path | None) -> Controls:
    """The controls of a configuration's scene, or of the one that a run folder has recorded; the defaults of neither.

    Raises:
        InputError: there is no scene, or it has a part that the page has no sliders for.
        ConfigError: the configuration has faults.
    """
    if path is None:
        return Controls()
    if path.is_dir():
        record = Record(path)
        if CONFIG_FILE not in record.files() or not record.exists:
            raise InputError(f"{path}: no run with a recorded configuration ({RUN_FILE}, {CONFIG_FILE}); name a file")
        path = path / CONFIG_FILE
    scene: Any = load_config(path).scene
    if scene is None:
        raise InputError(f"{path}: scene: missing; the page shows the scene of a configuration, add one")
    if scene.delay_model != "held":
        raise InputError(
            f"{path}: scene.delay_model: got {scene.delay_model!r}; the page computes the model 'held' alone, "
            "zwidth run draws both"
        )
    if hasattr(scene, "delta") and not hasattr(scene, "mass"):
        given = {name: getattr(scene, name) for name in ("delta", "d", "alpha", "beta")}
        return replace(Controls(mode="normalized"), **{name: v for name, v in given.items() if v is not None})
    return controls_of(scene.to_scene(), f"{path}: scene", scene.stiffness is not None)


def controls_of(scene: Scene, where: str = "scene", has_wall: bool = True) -> Controls:
    """The controls that mean a scene.

    Raises:
        InputError: it has a part that the page has no sliders for.
    """
    device, timing, velocity, hand = scene.device, scene.timing, scene.velocity, scene.operator
    found: dict[str, Any] = {"mass": device.mass, "damping": device.damping}
    found |= {"period": timing.period, "delay": timing.delay}
    kinds = {BackwardDifference: 0, WindowedDifference: 1, LowPass: 2, Butterworth: 3}
    if type(velocity) not in kinds or velocity.coded_period is not None:  # pyright: ignore[reportAttributeAccessIssue]
        raise InputError(
            f"{where}.velocity: the page has sliders for {', '.join(CHOICES['velocity'])}, written for the loop's own "
            "period; zwidth run computes any other"
        )
    found["velocity"] = list(CHOICES["velocity"])[kinds[type(velocity)]]  # pyright: ignore[reportArgumentType]
    found |= {name: getattr(velocity, name) for name in ("samples", "cutoff", "order") if hasattr(velocity, name)}
    if isinstance(velocity, LowPass) and velocity.cutoff is None:
        found["cutoff"] = 1.0 / (2.0 * pi * velocity.time_constant)
    if hand is not None:
        found |= {"operator": "rigid" if hand.rigid else "grasp", "hand_mass": hand.mass}
        found |= {"hand_damping": hand.damping, "hand_stiffness": hand.stiffness}
        found |= {} if hand.rigid else {"grasp_stiffness": hand.coupling_stiffness}
        found |= {} if hand.rigid else {"grasp_damping": hand.coupling_damping}
    tip = device.coupling
    if tip is not None:
        found |= {"coupling": tip.sensor, "tip_mass": tip.mass, "tip_stiffness": tip.stiffness}
        found |= {"tip_damping": tip.damping}
    controls = Controls(**found)
    if has_wall:
        wall = {"stiffness": scene.wall.stiffness, "virtual_damping": scene.wall.virtual_damping}
    else:
        best = controls.scene().max_stiffness()
        # Well inside of the stable set, if there is one.
        wall = {"stiffness": 0.5 * float(best.stiffness), "virtual_damping": float(best.virtual_damping)}
        wall = wall if isfinite(wall["stiffness"]) else {"stiffness": 0.0, "virtual_damping": 0.0}
    return replace(controls, **wall)
