"""What can be set on the page, the numbers and the parts of a scene; and the view as text that reproduces it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

from zwidth.parts.device import Device
from zwidth.parts.paths import PARTS, find_parts, spell_part, spell_scene
from zwidth.parts.timing import Timing
from zwidth.parts.velocity import BackwardDifference, Butterworth, LowPass, WindowedDifference
from zwidth.parts.wall import VirtualWall
from zwidth.runs.record import CONFIG_FILE, RUN_FILE, Record
from zwidth.scenes.scene import Scene
from zwidth.scenes.stiffest import choose_damping
from zwidth.studies.document import load_config
from zwidth.words.errors import InputError
from zwidth.words.quantities import OF_PARTS, PARAMETERS, Parameter

# Beyond so many, the poles cannot follow a drag.
_MOST_POLES = 80
# Of a number that the page sends, in its units.
_LARGEST = 1e100
_SCRIPT = """\
import matplotlib.pyplot as plt
import zwidth

{notes}scene = {scene}
verdict = zwidth.assess(scene)
print("stable" if verdict.stable else "UNSTABLE", f"spectral radius {{verdict.spectral_radius:.6f}}")
print(f"K_max = {{scene.max_stiffness().stiffness:.6g}} {unit}")

for outline in scene.stable_region():
    plt.fill(outline.stiffness, outline.virtual_damping, fill=False)
plt.plot(scene.wall.stiffness, scene.wall.virtual_damping, "o")
plt.xlabel("{x}")
plt.ylabel("{y}")
plt.show()
"""


class Slider(NamedTuple):
    """One number of the page: its label, the unit shown, how many of these are one SI unit, and the slider's range."""

    label: str
    unit: str
    per_si: float
    low: float
    high: float
    whole: bool = False


def _make_slider(parameter: Parameter) -> Slider:
    unit, per_si = _SHOWN.get(parameter.unit, (parameter.unit.removeprefix("1"), 1.0))
    low, high = parameter.slider or (0.0, 0.0)
    label = f"{parameter.words} {parameter.symbol.lstrip(chr(92))}"
    return Slider(label, unit, per_si, low * per_si, high * per_si, parameter.whole)


# The units of the page, and how many of them are one SI unit.
_SHOWN = {"kg": ("g", 1e3), "s": ("ms", 1e3)}
_DEVICE, _WALL = ("mass", "damping", "period", "delay", "delta", "d"), ("stiffness", "virtual_damping", "alpha", "beta")
# By the path in a scene. A range that begins at 0 is cubic on the page, one above logarithmic.
SLIDERS = {name: _make_slider(PARAMETERS[name]) for name in (*_DEVICE, *_WALL, *OF_PARTS) if PARAMETERS[name].slider}
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
    **{name: {form: form for form in ("none", *part.usual)} for name, part in PARTS.items()},
}
CHOICES["coupling"] |= {"motor": "tip, sensor at the motor", "tip": "tip, sensor at the tip"}


_SMALL_DEVICE = Scene(Device(0.1, 10.0), Timing(1e-3, 1e-3), VirtualWall(10e3, 40.0))


@dataclass(frozen=True)
class Controls:
    """A scene with its wall; a normalized one has m = 1 and T = 1, so that K is alpha and B is beta."""

    scene: Scene = _SMALL_DEVICE
    normalized: bool = False
    scale: tuple[float, float] = (0.1, 1e-3)  # mass and period that a normalized scene takes when it gets units again

    @property
    def wall(self) -> tuple[float, float]:
        return float(self.scene.wall.stiffness), float(self.scene.wall.virtual_damping)

    def shown(self) -> dict[str, Any]:
        """Every number and choice that the scene has, as the page shows it."""
        scene, values = self.scene, self.scene.parameters()
        if self.normalized:
            return {"mode": "normalized"} | {name: values[path] for name, path in _NORMALIZED.items()}
        forms = {name: _find_form(part) for name, part in find_parts(scene).items() if name in PARTS}
        found = {name: value * SLIDERS[name].per_si for name, value in values.items() if name in SLIDERS}
        for part, form in forms.items():
            # A form has the numbers that it names: without a spring, the damper beside it does nothing.
            idle = {f"{part}.{item.name}" for item in fields(PARTS[part]) if item.name not in PARTS[part].usual[form]}
            found = {name: value for name, value in found.items() if name not in idle}
        choices = {"mode": "physical", "velocity": type(scene.velocity).__name__}
        return found | choices | {name: forms.get(name, "none") for name in PARTS}

    def change(self, shown: Mapping[str, Any]) -> Controls:
        """New controls with some values as the page shows them; what it does not have is an `InputError`."""
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
        """The same, if the page can follow so many poles."""
        # Where parts refuse only together, as a cut-off beyond half the sampling rate, the loop does.
        order = self.scene.loop.roots.order
        if order > _MOST_POLES:
            raise InputError(
                f"delay: the loop has {order} poles, by its delay and its window; the page follows "
                f"{_MOST_POLES}, zwidth check judges any wall"
            )
        return self

    def _replace_part(self, name: str, kind: str) -> Scene:
        """The scene with another part of a usual kind."""
        scene = self.scene
        cutoff = min(100.0, 0.1 / scene.timing.period)
        estimates = {
            "BackwardDifference": lambda: BackwardDifference(),
            "WindowedDifference": lambda: WindowedDifference(5),
            "LowPass": lambda: LowPass(cutoff=cutoff),
            "Butterworth": lambda: Butterworth(cutoff),
        }
        if name in PARTS:
            return scene.replace(**{name: None if kind == "none" else PARTS[name](**PARTS[name].usual[kind])})
        if kind not in estimates:
            raise InputError(f"{name}: coefficients come with a configuration alone; choose another")
        return scene.replace(velocity=estimates[kind]())

    def _convert(self) -> Controls:
        """The device and wall in the other units; normalized it is rigid, its parts are left out."""
        scene, (mass, period) = self.scene, self.scale
        if not self.normalized:
            return replace(normalized_controls(*scene.normalized), scale=(float(scene.mass), scene.timing.period))
        rate, (stiffness, damping) = mass / period, self.wall
        wall = VirtualWall(stiffness * rate / period, damping * rate)
        return Controls(Scene(Device(mass, scene.damping * rate), Timing(period, float(scene.d) * period), wall))


def _find_form(part: Any) -> str:
    """Which of its usual forms a part has: the one with the same words, and with the same numbers left out."""

    def shape(part: Any) -> dict[str, Any]:
        values = {item.name: getattr(part, item.name) for item in fields(part)}
        return {name: value for name, value in values.items() if not isinstance(value, float)}

    return next(form for form, given in part.usual.items() if shape(type(part)(**given)) == shape(part))


def normalized_controls(alpha: float, beta: float, delta: float, d: float) -> Controls:
    scene = Scene(Device(1.0, float(delta)), Timing(1.0, float(d)), VirtualWall(float(alpha), float(beta)))
    return Controls(scene, normalized=True)


def read_controls(path: Path | None) -> Controls:
    """The scene of a configuration, or of the one that a run folder has recorded; without either, a small device."""
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


def to_yaml(controls: Controls) -> str:
    """A configuration: the scene, its stable walls and, of a rigid device, the passive ones and the response."""
    scene = controls.scene
    studies: list[dict[str, Any]] = [{"kind": "boundary", "name": "stable_walls"}]
    if not scene.parts_beyond:
        studies[0] |= {"passivity": True} if scene.operator is None else {}
        studies.append({"kind": "step", "name": "response"})
    # JSON is YAML of one line.
    lines = ["version: 1", "name: explored", "scene:"]
    own = {name: value for name, value in controls.shown().items() if name != "mode"}
    section = own if controls.normalized else spell_scene(scene)
    lines += [f"  {name}: {json.dumps(value)}" for name, value in section.items()]
    return "\n".join([*lines, "studies:", *(f"  - {json.dumps(study)}" for study in studies)]) + "\n"


def to_python(controls: Controls) -> str:
    """A script that builds the scene, judges its wall and draws the stable set."""
    parts = spell_part(controls.scene)
    text = "zwidth.Scene(\n" + "".join(f"    {name}={_spell(part)},\n" for name, part in parts.items()) + ")"
    normalized = {"notes": "# Normalized: with m = 1 and T = 1, K is alpha and B is beta.\n", "unit": "(alpha)"}
    normalized |= {"x": "normalized stiffness alpha", "y": "normalized damping beta"}
    physical = {"notes": "", "unit": "N/m", "x": "stiffness K in N/m", "y": "virtual damping B in N s/m"}
    return _SCRIPT.format(scene=text, **(normalized if controls.normalized else physical))


def _spell(part: Any) -> str:
    """A part as Python writes it."""
    if not hasattr(part, "__dataclass_fields__"):
        return repr(part)
    given = ", ".join(f"{name}={_spell(value)}" for name, value in spell_part(part).items())
    return f"zwidth.{type(part).__name__}({given})"
