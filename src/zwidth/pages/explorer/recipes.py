"""The view as text that reproduces it: a configuration for `zwidth run`, and a Python script."""

from __future__ import annotations

import json
from typing import Any

from zwidth.pages.explorer.controls import Controls
from zwidth.parts.paths import spell_part, spell_scene

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
    """A configuration: the scene, its stable walls and, of a rigid device, the passive ones and the response."""
    scene = controls.scene
    studies: list[dict[str, Any]] = [{"kind": "boundary", "name": "stable_walls"}]
    if not scene.parts_beyond:
        studies[0] |= {"passivity": True} if scene.operator is None else {}
        studies.append({"kind": "step", "name": "response"})
    # JSON is YAML of one line.
    lines = ["version: 1", "name: explored", "scene:"]
    lines += [f"  {name}: {json.dumps(value)}" for name, value in _section(controls).items()]
    return "\n".join([*lines, "studies:", *(f"  - {json.dumps(study)}" for study in studies)]) + "\n"


def _section(controls: Controls) -> dict[str, Any]:
    """The scene as a configuration spells it."""
    if controls.normalized:
        return {name: value for name, value in controls.shown().items() if name != "mode"}
    return spell_scene(controls.scene)


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
