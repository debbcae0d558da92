"""The view as text that reproduces it: a configuration for `zwidth run`, and a Python script."""

from __future__ import annotations

import json
from dataclasses import MISSING, fields
from typing import Any

from zwidth.explorer.controls import Controls
from zwidth.scene import Scene

_KINDS = {"WindowedDifference": "windowed_difference", "LowPass": "low_pass", "Butterworth": "butterworth"}
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


def to_yaml(controls: Controls) -> str:
    """A configuration: the scene, and studies of its walls."""
    scene = controls.scene()
    study: dict[str, Any] = {"kind": "boundary", "name": "stable_walls"}
    if scene.is_rigid and scene.operator is None:
        study["passivity"] = True
    lines = ["version: 1", "name: explored", "scene:"]
    # JSON is YAML of one line.
    lines += [f"  {name}: {json.dumps(value)}" for name, value in _section(controls, scene).items()]
    studies = [study] + ([{"kind": "step", "name": "response"}] if scene.is_rigid else [])
    lines += ["studies:", *(f"  - {json.dumps(study)}" for study in studies)]
    return "\n".join(lines) + "\n"


def _section(controls: Controls, scene: Scene) -> dict[str, Any]:
    """The scene as a configuration spells it."""
    if controls.normalized:
        return {name: getattr(controls, name) for name in ("delta", "d", "alpha", "beta")}
    found: dict[str, Any] = {"mass": scene.device.mass, "damping": scene.device.damping}
    found |= {"period": scene.timing.period, "delay": scene.timing.delay}
    found |= {"stiffness": scene.wall.stiffness, "virtual_damping": scene.wall.virtual_damping}
    kind = _KINDS.get(type(scene.velocity).__name__)
    if kind is not None:
        found["velocity"] = {"kind": kind, **_given(scene.velocity)}
    parts = {"operator": scene.operator, "coupling": scene.device.coupling}
    return found | {name: _given(part) for name, part in parts.items() if part is not None}


def _given(part: Any) -> dict[str, Any]:
    """The fields of a part that differ from their defaults."""
    values = {field.name: (getattr(part, field.name), field.default) for field in fields(part)}
    return {name: value for name, (value, default) in values.items() if default is MISSING or value != default}


def to_python(controls: Controls) -> str:
    """A script that builds the scene, judges its wall and draws the stable set."""
    scene = controls.scene()
    parts = {"device": scene.device, "timing": scene.timing, "wall": scene.wall}
    parts |= _given(scene)
    text = "zwidth.Scene(\n" + "".join(f"    {name}={_spell(part)},\n" for name, part in parts.items()) + ")"
    normalized = {"notes": "# Normalized: with m = 1 and T = 1, K is alpha and B is beta.\n", "unit": "(alpha)"}
    normalized |= {"x": "normalized stiffness alpha", "y": "normalized damping beta"}
    physical = {"notes": "", "unit": "N/m", "x": "stiffness K in N/m", "y": "virtual damping B in N s/m"}
    return _SCRIPT.format(scene=text, **(normalized if controls.normalized else physical))


def _spell(part: Any) -> str:
    """A part as Python writes it."""
    if not hasattr(part, "__dataclass_fields__"):
        return repr(part)
    given = ", ".join(f"{name}={_spell(value)}" for name, value in _given(part).items())
    return f"zwidth.{type(part).__name__}({given})"
