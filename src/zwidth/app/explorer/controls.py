"""Controls of the explorer page: sliders and choices of a scene, and texts that reproduce the scene.

The explorer (`zwidth explore`) is a browser page with sliders for the parameters of a scene, and choices for its parts
(estimates, further feedback, actuator, coupling, hand). `Controls` converts the values that the page shows, in its
units, to a `zwidth.Scene` and back. A normalized scene has m = 1 and T = 1, so that K is alpha, B is beta, b is delta
and the delay is d. `to_link`, `to_yaml` and `to_python` write the scene as an address, a configuration and a script.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import partial
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import parse_qsl, urlencode

from zwidth.analysis.optimization import choose_damping
from zwidth.analysis.scene import Scene
from zwidth.app.printing import get_unit
from zwidth.config.devices import ResponseSection
from zwidth.config.reader import read_mapping, write_yaml
from zwidth.config.scenes import NormalizedScene
from zwidth.core.errors import InputError
from zwidth.model.device import Device
from zwidth.model.feedback import IntegralFeedback
from zwidth.model.linear_device import LinearDevice
from zwidth.model.parameter_paths import PARTS, WITH_KIND, find_parts, spell_part, spell_scene
from zwidth.model.position import ExponentialFilter, Pll, has_velocity
from zwidth.model.timing import Timing
from zwidth.model.velocity import BackwardDifference, Butterworth, LowPass, WindowedDifference
from zwidth.model.wall import VirtualWall
from zwidth.studies.document import Config, load_config
from zwidth.units.parsing import format_exactly
from zwidth.units.quantities import OF_PARTS, PARAMETERS, Parameter
from zwidth.units.unit_system import LINEAR, ROTARY, UnitSystem

_MOST_POLES = 80  # largest number of poles; more poles take too long to follow a dragged slider
_LARGEST = 1e100  # largest magnitude of a number from the page, in units of the page
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
    """Slider of one parameter: label, unit, number of these units per SI unit, and range."""

    label: str
    unit: str
    per_si: float
    low: float
    high: float
    whole: bool = False


def _make_slider(parameter: Parameter, system: UnitSystem) -> Slider:
    """Return the slider of a parameter for linear or rotary devices."""
    unit, per_si = _SHOWN.get(parameter.unit, (parameter.unit.removeprefix("1"), 1.0))
    low, high = parameter.slider or (0.0, 0.0)
    if system.rotary and parameter.unit in _ROTARY_UNITS:
        # Keep the parameters of the wall in SI units, because the chart on which walls are set has SI units.
        unit, per_si = (ROTARY[parameter.unit], 1.0) if parameter.name in _WALL else _ROTARY_UNITS[parameter.unit]
        low, high = low * _SMALLER[parameter.unit], high * _SMALLER[parameter.unit]
    name = f"{parameter.words_in(system)} {parameter.symbol_in(system).lstrip(chr(92))}"
    return Slider(name, unit, per_si, low * per_si, high * per_si, parameter.whole)


# Units of the page that differ from SI units, each with the number of these units per SI unit.
_SHOWN = {"kg": ("g", 1e3), "s": ("ms", 1e3), "1/s": ("rad/s", 1.0)}
# Unit of a rotary device on the page and the number of these units per SI unit, for each SI unit of linear devices.
_ROTARY_UNITS = {"kg": ("g cm^2", 1e7), "N s/m": ("mN m s/rad", 1e3), "N/m": ("N m/rad", 1.0)}
_ROTARY_UNITS |= {"N/(m s)": ("N m/(rad s)", 1.0)}
# Typical ratio of a rotary to a linear parameter in SI units, for a mass at a radius of about 3 cm; by the SI unit of
# linear devices.
_SMALLER = {"kg": 1e-3, "N s/m": 1e-3, "N/m": 1e-3, "N/(m s)": 1e-3}
_BARE = ("device", "timing", "wall")  # parts whose parameters have no prefix in a path
_DEVICE = ("mass", "damping", "period", "delay", "delta", "d")
_WALL = ("stiffness", "virtual_damping", "alpha", "beta")
# Parameters with a slider, by path in a scene. On the page, ranges that start at 0 have a cubic scale, all others a
# logarithmic one.
_WITH_SLIDER = [name for name in (*_DEVICE, *_WALL, *OF_PARTS) if PARAMETERS[name].slider]
SLIDERS = {name: _make_slider(PARAMETERS[name], LINEAR) for name in _WITH_SLIDER}
ROTARY_SLIDERS = {name: _make_slider(PARAMETERS[name], ROTARY) for name in _WITH_SLIDER}
# Parameters of a scene with m = 1 and T = 1, by the normalized parameter whose value they have.
_NORMALIZED = {"delta": "damping", "d": "delay", "alpha": "stiffness", "beta": "virtual_damping"}
_AS_GIVEN = "coefficients, as given"  # text on the page for parts that only a configuration file can define
CHOICES = {
    "mode": {"physical": "physical", "normalized": "normalized"},
    "motion": {"linear": "linear", "rotary": "rotary"},
    "velocity": {
        "BackwardDifference": "backward difference",
        "WindowedDifference": "window of n",
        "LowPass": "low-pass",
        "Butterworth": "Butterworth",
        "VelocityFilter": _AS_GIVEN,
    },
    "position": {
        "none": "none",
        "ExponentialFilter": "exponential filter",
        "LowPass": "low-pass",
        "Butterworth": "Butterworth",
        "Pll": "phase-locked loop (PLL)",
        "PositionFilter": _AS_GIVEN,
        "Observer": _AS_GIVEN,
    },
    "feedback": {"none": "none", "IntegralFeedback": "integral gain", "Feedback": _AS_GIVEN},
    **{name: {form: form for form in ("none", *part.usual)} for name, part in PARTS.items()},
}
CHOICES["coupling"] |= {"motor": "tip, sensor at the motor", "tip": "tip, sensor at the tip"}


_SMALL_DEVICE = Scene(Device(0.1, 10.0), Timing(1e-3, 1e-3), VirtualWall(10e3, 40.0))
_SMALL_ROTARY = Scene(Device(1e-4, 0.01, rotary=True), Timing(1e-3, 1e-3), VirtualWall(10.0, 0.04))


@dataclass(frozen=True)
class Controls:
    """Scene of the page with its wall; a normalized scene has m = 1 and T = 1, so that K is alpha and B is beta."""

    scene: Scene = _SMALL_DEVICE
    normalized: bool = False
    # Mass in kg, period in s and kind (True if rotary) of the scene before its normalization, from which a normalized
    # scene is converted back to SI units.
    scale: tuple[float, float, bool] = (0.1, 1e-3, False)

    @property
    def wall(self) -> tuple[float, float]:
        return float(self.scene.wall.stiffness), float(self.scene.wall.virtual_damping)

    @property
    def rotary(self) -> bool:
        """True if the device is rotary."""
        return bool(self.scene.device.rotary)

    @property
    def sliders(self) -> dict[str, Slider]:
        """The sliders of all parameters of this kind of device (linear or rotary); keys such as "coupling.mass"."""
        return ROTARY_SLIDERS if self.rotary else SLIDERS

    def shown(self) -> dict[str, Any]:
        """Return the values of all sliders and choices by name, in the units of the page."""
        scene, values = self.scene, self.scene.parameters()
        if self.normalized:
            return {"mode": "normalized"} | {name: values[path] for name, path in _NORMALIZED.items()}
        forms = {name: _find_form(part) for name, part in find_parts(scene).items() if name in PARTS}
        numbers = {name: value * self.sliders[name].per_si for name, value in values.items() if name in SLIDERS}
        for part, form in forms.items():
            # Hide the sliders of parameters that have no effect with this preset of the part, for example the damper
            # parallel to a spring if the part has no spring.
            idle = {f"{part}.{item.name}" for item in fields(PARTS[part]) if item.name not in PARTS[part].usual[form]}
            numbers = {name: value for name, value in numbers.items() if name not in idle}
        choices = {"mode": "physical", "motion": "rotary" if self.rotary else "linear"}
        choices |= {"velocity": type(scene.velocity).__name__}
        choices |= {name: _name_class(getattr(scene, name)) for name in WITH_KIND}
        if isinstance(scene.device, LinearDevice):
            # Omit the choices of hand, coupling and actuator, because a linear system already contains these parts.
            return numbers | choices
        return numbers | choices | {name: forms.get(name, "none") for name in PARTS}

    def change(self, shown: Mapping[str, Any]) -> Controls:
        """Return the controls after changes of the values ``shown``, in the units of the page, by name."""
        new = self
        for name, value in shown.items():
            if name in CHOICES:
                if not isinstance(value, str) or value not in CHOICES[name]:
                    raise InputError(f"{name}: got {str(value)[:40]!r}; choose one of {', '.join(CHOICES[name])}")
                if value != new.shown().get(name):
                    change = {"motion": new._change_motion, "mode": new._convert}.get(
                        name, partial(new._choose_part, name, value)
                    )
                    new = change()
                continue
            if name not in new.shown():
                # Reject the change, because the page has no slider with this name: a choice has just hidden it, or it
                # never existed.
                raise InputError(f"{str(name)[:40]!r}: the page has no such parameter now")
            if isinstance(value, bool) or not isinstance(value, int | float) or not -_LARGEST <= value <= _LARGEST:
                raise InputError(f"{new.sliders[name].label}: got {str(value)[:40]!r}; a finite number is needed")
            slider = new.sliders[name]
            _check_range(name, slider, value)
            number = round(value) if slider.whole else _round(float(value) / slider.per_si, 15)
            new = replace(new, scene=new.scene.replace(**{_NORMALIZED.get(name, name): number}))
        return new.check()

    def check(self) -> Controls:
        """Return the controls unchanged; raise `InputError` if the page cannot show their poles or stable walls."""
        # Build the loop, because this also checks combinations of parts, such as a cutoff above the Nyquist frequency.
        order = self.scene.loop.roots.order
        if order > _MOST_POLES:
            raise InputError(
                f"delay: the loop has {order} poles, but the page allows {_MOST_POLES}; "
                "shorten the delay or the window, or use zwidth check"
            )
        if self.scene.tool is not None:
            _ = self.scene.loop.stable_set  # raises `InputError` if the stiffness of stable couplings has no limit
        return self

    def _refuse_change(self, name: str) -> None:
        """Raise `InputError` if the device is a linear system, which has no separate parts to change."""
        if isinstance(self.scene.device, LinearDevice):
            raise InputError(f"{name}: not available, because the device is a linear system that contains all parts")

    def _change_motion(self) -> Controls:
        """Return the controls with a default device of the other kind, linear or rotary; rate and delay are kept."""
        self._refuse_change("motion")
        other = _SMALL_DEVICE if self.rotary else _SMALL_ROTARY
        return Controls(replace(other, timing=self.scene.timing))

    def _choose_part(self, name: str, kind: str) -> Controls:
        """Return the controls after choosing a preset of a part, or a class of the velocity estimate."""
        scene = self.scene
        if name in PARTS:
            self._refuse_change(name)
            return replace(
                self, scene=scene.replace(**{name: None if kind == "none" else self._make_usual(name, kind)})
            )
        cutoff, gain = min(100.0, 0.1 / scene.timing.period), 1e3 * (_SMALLER["N/(m s)"] if self.rotary else 1.0)
        usual = {
            "velocity": (BackwardDifference(), WindowedDifference(5), LowPass(cutoff=cutoff), Butterworth(cutoff)),
            "position": (None, ExponentialFilter(0.5), LowPass(cutoff=cutoff), Butterworth(cutoff), Pll(2.0 * cutoff)),
            "feedback": (None, IntegralFeedback(gain)),
        }
        parts = {_name_class(part): part for part in usual[name]}
        if kind not in parts:
            raise InputError(f"{name}: coefficients can only be set in a configuration file; choose another kind")
        changes = {name: parts[kind]}
        if has_velocity(changes.get("position")):
            # Reset the velocity estimate to its default, because a phase-locked loop also estimates the velocity.
            changes["velocity"] = BackwardDifference()
        return replace(self, scene=scene.replace(**changes))

    def _make_usual(self, name: str, kind: str) -> Any:
        """Return a part with the values of one of its presets, converted to typical values of this kind of device."""
        given = dict(PARTS[name].usual[kind])
        for key, value in given.items():
            unit = get_unit(f"{name}.{key}")
            given[key] = _round(value * _SMALLER[unit], 12) if self.rotary and unit in _SMALLER else value
        return PARTS[name](**given)

    def _convert(self) -> Controls:
        """Return the controls converted to normalized or to SI units; normalization keeps only the rigid device."""
        self._refuse_change("mode")
        scene, (mass, period, rotary) = self.scene, self.scale
        if not self.normalized:
            numbers = (_round(float(number), 12) for number in scene.normalized)
            return replace(normalized_controls(*numbers), scale=(float(scene.mass), scene.timing.period, self.rotary))
        rate, (stiffness, damping) = mass / period, self.wall
        numbers = stiffness * rate / period, damping * rate, scene.damping * rate, float(scene.d) * period
        *wall, device_damping, delay = (_round(float(number), 12) for number in numbers)
        return Controls(Scene(Device(mass, device_damping, rotary=rotary), Timing(period, delay), VirtualWall(*wall)))


def _check_range(name: str, slider: Slider, value: float) -> None:
    """Raise `InputError`, in the unit of the slider, if a value lies outside the allowed range."""
    allowed, by = PARAMETERS[name].allowed, slider.per_si
    if not allowed.holds(float(value) / by):
        ends = allowed._replace(low=allowed.low * by, high=allowed.high * by)
        unit = f" {slider.unit}" if slider.unit else ""
        raise InputError(f"{slider.label}: got {value:g}{unit}; it must be {ends}{unit}")


def _name_class(part: Any) -> str:
    """Return the name of the class of an estimate or of further feedback, such as "LowPass"; "none" for None."""
    return "none" if part is None else type(part).__name__


def _round(value: float, digits: int) -> float:
    """Return a value rounded to significant digits, which removes rounding errors of unit conversions."""
    return float(f"{value:.{digits}g}")


def _find_form(part: Any) -> str:
    """Return the name of the preset that agrees with a part in all fields that are not floats."""

    def shape(part: Any) -> dict[str, Any]:
        values = {item.name: getattr(part, item.name) for item in fields(part)}
        return {name: value for name, value in values.items() if not isinstance(value, float)}

    return next(form for form, given in part.usual.items() if shape(type(part)(**given)) == shape(part))


def normalized_controls(alpha: float, beta: float, delta: float, d: float) -> Controls:
    """Return the controls of a scene with m = 1 and T = 1 and the given normalized parameters."""
    scene = Scene(Device(1.0, float(delta)), Timing(1.0, float(d)), VirtualWall(float(alpha), float(beta)))
    return Controls(scene, normalized=True)


def read_controls(path: Path | None) -> Controls:
    """Return the controls for the scene of a configuration; without a path, those of a default device."""
    if path is None:
        return Controls()
    given: Any = load_config(path).scene
    if given is None:
        raise InputError(f"{path}: scene: missing; the page shows the scene of a configuration, add one")
    return _show_scene(given, path)


def _in_seconds(scene: Scene) -> Scene:
    """Return the scene with its delay converted to seconds, because the slider uses seconds."""
    return scene.replace(delay=float(scene.timing.delay)) if scene.timing.in_periods else scene


def _show_scene(given: Any, origin: Any) -> Controls:
    """Return the controls for the scene of a configuration; the default wall has half the maximum stiffness."""
    device = getattr(given, "device", None)
    if device is not None and (isinstance(device, ResponseSection) or getattr(device, "sampled", None)):
        raise InputError(
            f"{origin}: scene.device: the page needs a model for all rates, not a response or a sampled system; "
            "use zwidth check or zwidth run"
        )
    bare = isinstance(given, NormalizedScene)
    controls = normalized_controls(0, 0, given.delta, given.d) if bare else Controls(_in_seconds(given.to_scene()))
    wall = (given.wall.alpha, given.wall.beta) if given.wall and controls.normalized else controls.wall
    if given.wall is None:
        best = controls.scene.max_stiffness()
        half = _round(0.5 * float(best.stiffness), 4)
        wall = (half, _round(choose_damping(controls.scene, best, half), 4)) if isfinite(half) else (0.0, 0.0)
    return replace(controls, scene=replace(controls.scene, wall=VirtualWall(*wall))).check()


def to_link(controls: Controls) -> str:
    """Return the scene as the fragment of an address, ``mass=100+g&damping=...``, which any explorer opens."""
    section = _spell_section(controls).items()
    texts = {
        name: value if isinstance(value, str) else json.dumps(value, separators=(",", ":")) for name, value in section
    }
    return urlencode(texts, safe="/{}[]:,")


def read_link(link: str) -> Controls:
    """Return the controls for the fragment of an address, as written by `to_link`."""
    try:
        section = {name: _read_value(text) for name, text in parse_qsl(link, strict_parsing=True, max_num_fields=99)}
    except (ValueError, RecursionError):
        raise InputError("address: the text after # is not a scene; remove it, or copy the complete address") from None
    walls = {"kind": "boundary", "name": "stable_walls"}
    document = {"version": 1, "name": "explored", "scene": section, "studies": [walls]}
    return _show_scene(read_mapping(document, Config).scene, "address")


def _read_value(text: str) -> Any:
    """Return the value of a text in JSON; return texts that are not JSON unchanged."""
    with suppress(json.JSONDecodeError):
        return json.loads(text)
    return text


def _spell_section(controls: Controls) -> dict[str, Any]:
    """Return the section ``scene`` of a configuration as a dict, with units in all quantities."""
    if controls.normalized:
        return {name: value for name, value in controls.shown().items() if name != "mode"}
    return _add_units(spell_scene(controls.scene), controls.scene.unit_system)


def _add_units(value: Any, system: UnitSystem, path: str = "") -> Any:
    """Return a section of a configuration with each quantity as a text with its unit, derived from its path."""
    if isinstance(value, dict):
        return {name: _add_units(part, system, f"{path}.{name}".lstrip(".")) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_add_units(part, system, f"{path}.{k}") for k, part in enumerate(value)]
    unit = system[get_unit(path)]
    return format_exactly(value, unit) if unit else value


def to_yaml(controls: Controls) -> str:
    """Return a configuration with the scene and studies of its stable walls and, if rigid, its step response."""
    scene = controls.scene
    studies: list[dict[str, Any]] = [{"kind": "boundary", "name": "stable_walls"}]
    if not scene.nonrigid_parts:
        studies[0] |= {"passivity": True} if scene.operator is None else {}
        studies.append({"kind": "step", "name": "response"})
    return write_yaml({"version": 1, "name": "explored", "scene": _spell_section(controls), "studies": studies})


def to_python(controls: Controls) -> str:
    """Return a script that builds the scene, checks its wall and draws the stable walls."""
    system = controls.scene.unit_system
    units = None if controls.normalized else system
    parts = spell_part(controls.scene).items()
    given = {name: _spell(part, "" if name in _BARE else name, units) for name, part in parts}
    notes, unit, damper = "", system["N/m"], system["N s/m"]
    x, y = f"stiffness K in {unit}", f"virtual damping B in {damper}"
    if controls.normalized:
        notes, unit = "# Normalized: with m = 1 and T = 1, K is alpha and B is beta.\n", "(alpha)"
        x, y = "normalized stiffness alpha", "normalized damping beta"
    text = "".join(f"    {name}={part},\n" for name, part in given.items())
    return _SCRIPT.format(scene=f"zwidth.Scene(\n{text})", notes=notes, unit=unit, x=x, y=y)


def _spell(value: Any, path: str, system: UnitSystem | None) -> str:
    """Return the Python expression of a part or a number; numbers have units if a unit system is given."""
    if isinstance(value, LinearDevice):
        return f"zwidth.{value!r}"
    if hasattr(value, "__dataclass_fields__"):
        given = spell_part(value).items()
        words = (f"{name}={_spell(item, f'{path}.{name}'.lstrip('.'), system)}" for name, item in given)
        return f"zwidth.{type(value).__name__}({', '.join(words)})"
    if isinstance(value, tuple) and any(hasattr(item, "__dataclass_fields__") for item in value):
        return f"[{', '.join(_spell(item, f'{path}.{k}', system) for k, item in enumerate(value))}]"
    unit = get_unit(path)
    return json.dumps(format_exactly(value, system[unit])) if system and unit else repr(value)  # pyright: ignore
