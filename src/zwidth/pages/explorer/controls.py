"""What can be set on the page: the numbers and the parts of a scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

from zwidth.parts.coupling import Coupling
from zwidth.parts.device import Device
from zwidth.parts.operator import Operator
from zwidth.parts.timing import Timing
from zwidth.parts.velocity import BackwardDifference, Butterworth, LowPass, WindowedDifference
from zwidth.parts.wall import VirtualWall
from zwidth.runs.record import CONFIG_FILE, RUN_FILE, Record
from zwidth.scenes.scene import Scene
from zwidth.scenes.stiffest import choose_damping
from zwidth.studies.document import load_config
from zwidth.words.errors import InputError

# Beyond so many, the poles cannot follow a drag.
_MOST_POLES = 80
# Of a number that the page sends, in its units.
_LARGEST = 1e100


class Slider(NamedTuple):
    """One number of the page: its label, the unit shown, how many of these are one SI unit, and the slider's range."""

    label: str
    unit: str
    per_si: float
    low: float
    high: float
    whole: bool = False


# By the path in a scene. A range that begins at 0 is cubic on the page, one above logarithmic.
SLIDERS = {
    "mass": Slider("mass m", "g", 1e3, 1.0, 10e3),
    "damping": Slider("physical damping b", "N s/m", 1.0, 0.0, 100.0),
    "period": Slider("period T", "ms", 1e3, 0.05, 20.0),
    "delay": Slider("delay t_d", "ms", 1e3, 0.0, 20.0),
    "delta": Slider("normalized damping delta", "", 1.0, 0.0, 5.0),
    "d": Slider("delay d", "periods", 1.0, 0.0, 10.0),
    "stiffness": Slider("wall stiffness K", "N/m", 1.0, 0.0, 50e3),
    "virtual_damping": Slider("wall damping B", "N s/m", 1.0, -20.0, 100.0),
    "alpha": Slider("wall stiffness alpha", "", 1.0, 0.0, 1.0),
    "beta": Slider("wall damping beta", "", 1.0, -0.5, 1.5),
    "velocity.samples": Slider("window n", "periods", 1.0, 1.0, 50.0, True),
    "velocity.cutoff": Slider("cut-off", "Hz", 1.0, 1.0, 5e3),
    "velocity.time_constant": Slider("time constant", "ms", 1e3, 0.02, 200.0),
    "velocity.order": Slider("order", "", 1.0, 1.0, 8.0, True),
    "operator.mass": Slider("hand: mass", "g", 1e3, 0.0, 2e3),
    "operator.damping": Slider("hand: damping", "N s/m", 1.0, 0.0, 50.0),
    "operator.stiffness": Slider("hand: stiffness", "N/m", 1.0, 0.0, 1e3),
    "operator.coupling_stiffness": Slider("grasp: stiffness", "N/m", 1.0, 10.0, 100e3),
    "operator.coupling_damping": Slider("grasp: damping", "N s/m", 1.0, 0.0, 50.0),
    "coupling.mass": Slider("tip: mass", "g", 1e3, 1.0, 1e3),
    "coupling.stiffness": Slider("tip: spring", "N/m", 1.0, 100.0, 1e6),
    "coupling.damping": Slider("tip: damper", "N s/m", 1.0, 0.0, 50.0),
}
# With m = 1 and T = 1 these are the scene's own numbers.
_NORMALIZED = {"delta": "damping", "d": "delay", "alpha": "stiffness", "beta": "virtual_damping"}
CHOICES = {
    "mode": {"physical": "physical", "normalized": "normalized"},
    "velocity": {
        "BackwardDifference": "backward difference",
        "WindowedDifference": "window of n",
        "LowPass": "low-pass",
        "Butterworth": "Butterworth",
        "VelocityFilter": "coefficients, as given",
    },
    "operator": {"none": "none", "rigid": "rigid", "grasp": "grasp"},
    "coupling": {"none": "none", "motor": "tip, sensor at the motor", "tip": "tip, sensor at the tip"},
}


def _small_device() -> Scene:
    return Scene(Device(0.1, 10.0), Timing(1e-3, 1e-3), VirtualWall(10e3, 40.0))


@dataclass(frozen=True)
class Controls:
    """A scene with its wall; a normalized one has m = 1 and T = 1, so that K is alpha and B is beta."""

    scene: Scene = field(default_factory=_small_device)
    normalized: bool = False
    scale: tuple[float, float] = (0.1, 1e-3)  # mass and period that a normalized scene takes when it gets units again

    @property
    def wall(self) -> tuple[float, float]:
        """K and B."""
        return float(self.scene.wall.stiffness), float(self.scene.wall.virtual_damping)

    def shown(self) -> dict[str, Any]:
        """Every number and choice that the scene has, as the page shows it."""
        scene, values = self.scene, self.scene.parameters()
        if self.normalized:
            return {"mode": "normalized"} | {name: values[path] for name, path in _NORMALIZED.items()}
        hand, tip = scene.operator, scene.device.coupling
        if hand is not None and hand.rigid:
            values.pop("operator.coupling_damping", None)
        found = {name: value * SLIDERS[name].per_si for name, value in values.items() if name in SLIDERS}
        grasp = "none" if hand is None else "rigid" if hand.rigid else "grasp"
        choices = {"operator": grasp, "coupling": "none" if tip is None else tip.sensor}
        return found | {"mode": "physical", "velocity": type(scene.velocity).__name__} | choices

    def change(self, shown: Mapping[str, Any]) -> Controls:
        """New controls with some values as the page shows them.

        Raises:
            InputError: a name or a value is not one that the page has, or a part refuses it.
        """
        new = self
        for name, value in shown.items():
            if name in CHOICES:
                if not isinstance(value, str) or value not in CHOICES[name]:
                    raise InputError(f"{name}: got {str(value)[:40]!r}; choose one of {', '.join(CHOICES[name])}")
                if value != new.shown().get(name):
                    new = new._convert() if name == "mode" else replace(new, scene=new._replace_part(name, value))
                continue
            if name not in new.shown():
                # A slider that has just gone, or none that ever was.
                raise InputError(f"{str(name)[:40]!r}: the page has no such number now")
            if isinstance(value, bool) or not isinstance(value, int | float) or not -_LARGEST <= value <= _LARGEST:
                raise InputError(f"{SLIDERS[name].label}: got {str(value)[:40]!r}; a finite number is needed")
            number = round(value) if SLIDERS[name].whole else float(value) / SLIDERS[name].per_si
            new = replace(new, scene=new.scene.replace(**{_NORMALIZED.get(name, name): number}))
        return new.check()

    def check(self) -> Controls:
        """The same, if the page can follow them.

        Raises:
            InputError: the loop has too many poles.
        """
        # Where parts refuse only together, as a cut-off beyond half the sampling rate, the loop does.
        if self.scene.loop.order > _MOST_POLES:
            raise InputError(
                f"delay: the loop has {self.scene.loop.order} poles, by its delay and its window; the page follows "
                f"{_MOST_POLES}, zwidth check judges any wall"
            )
        return self

    def _replace_part(self, name: str, kind: str) -> Scene:
        """The scene with another part of a usual kind."""
        scene = self.scene
        cutoff = min(100.0, 0.1 / scene.timing.period)
        hand, tip = (0.554, 6.45, 135.0), (0.05, 20e3, 2.0)
        parts = {
            "BackwardDifference": lambda: BackwardDifference(),
            "WindowedDifference": lambda: WindowedDifference(5),
            "LowPass": lambda: LowPass(cutoff=cutoff),
            "Butterworth": lambda: Butterworth(cutoff),
            "none": lambda: None,
            "rigid": lambda: Operator(*hand),
            "grasp": lambda: Operator(*hand, 1e3, 5.0),
            "motor": lambda: Coupling(*tip),
            "tip": lambda: Coupling(*tip, sensor="tip"),
        }
        if kind not in parts:
            raise InputError(f"{name}: coefficients come with a configuration alone; choose another")
        return scene.replace(**{name: parts[kind]()})

    def _convert(self) -> Controls:
        """The device and wall in the other units; normalized it is rigid, its parts are left out."""
        scene, (mass, period) = self.scene, self.scale
        if not self.normalized:
            return replace(normalized_controls(*scene.normalized), scale=(float(scene.mass), scene.timing.period))
        rate, (stiffness, damping) = mass / period, self.wall
        wall = VirtualWall(stiffness * rate / period, damping * rate)
        return Controls(Scene(Device(mass, scene.damping * rate), Timing(period, float(scene.d) * period), wall))


def normalized_controls(alpha: float, beta: float, delta: float, d: float) -> Controls:
    """The controls of a normalized wall."""
    scene = Scene(Device(1.0, float(delta)), Timing(1.0, float(d)), VirtualWall(float(alpha), float(beta)))
    return Controls(scene, normalized=True)


def read_controls(path: Path | None) -> Controls:
    """The scene of a configuration, or of the one that a run folder has recorded; without either, a small device.

    Raises:
        InputError: there is no scene, or none that the page can show.
        ConfigError: the configuration has faults.
    """
    if path is None:
        return Controls()
    if path.is_dir():
        if CONFIG_FILE not in Record(path).files():
            raise InputError(f"{path}: no run with a recorded configuration ({RUN_FILE}, {CONFIG_FILE}); name a file")
        path = path / CONFIG_FILE
    given: Any = load_config(path).scene
    if given is None:
        raise InputError(f"{path}: scene: missing; the page shows the scene of a configuration, add one")
    if given.delay_model != "held":
        raise InputError(
            f"{path}: scene.delay_model: got {given.delay_model!r}; the page computes the model 'held' alone, "
            "zwidth run draws both"
        )
    controls = (
        Controls(given.to_scene()) if hasattr(given, "to_scene") else normalized_controls(0, 0, given.delta, given.d)
    )
    wall = (given.wall.alpha, given.wall.beta) if given.wall and controls.normalized else controls.wall
    if given.wall is None:
        # Well inside of the stable set, if there is one.
        best = controls.scene.max_stiffness()
        wall, half = (0.0, 0.0), 0.5 * float(best.stiffness)
        wall = (half, choose_damping(controls.scene, best, half)) if isfinite(half) else wall
    return replace(controls, scene=replace(controls.scene, wall=VirtualWall(*wall))).check()
