"""Every route to a result about a scene's walls; `properties/test_one_answer` compares the results."""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import any_loop
import control
import jax
import numpy as np
from click.testing import CliRunner

import zwidth
from zwidth.cli import cli
from zwidth.core.status import Status
from zwidth.simulation.result import MotionKind
from zwidth.stability.linear.passivity import find_unsupported_reason

BAND = 1e-8  # relative distance from the boundary within which routes may disagree
SAME = 1e-9  # relative difference of K_max: by Newton's method, and as the highest point of an edge
WEDGE = 1e-4  # relative distance from K_max within which its line must end; step below the tip of a wedge
SAME_SLOPE = 1e-6  # relative difference of derivatives: implicit by JAX, and on the host
ROUGH = 1e-13  # error of eigenvalues: softer walls are left to the other routes
ROUGH_DOUBLE = 2e-8  # error of eigenvalues at nearly double poles
ALIKE = 1e-12  # relative difference of values that two routes merely pass on
LONGEST = 30_000  # periods; slower responses show no growth within them


class Comparison(NamedTuple):
    """One quantity, the result of each route, and the allowed relative difference (None for verdicts)."""

    name: str
    results: dict[str, Any]
    tolerance: float | None = None


class Wall(NamedTuple):
    """A wall in N/m and N s/m, on a scene without a wall."""

    scene: zwidth.Scene
    stiffness: float
    virtual_damping: float


def draw_scene(random: np.random.Generator) -> zwidth.Scene:
    """Return a scene of any kind; every fifth has a parameter at or near zero."""
    kind = str(random.choice(any_loop.KINDS)) if random.random() < 0.8 else "device"
    scene = any_loop.random_scene(kind, random)
    if random.random() < 0.15:
        # Long windows and light links have islands.
        scene = scene.replace(velocity=zwidth.WindowedDifference(int(random.integers(15, 34))))
    if random.random() < 0.8:
        return scene
    paths = [path for path in scene.parameters() if path.endswith(("damping", "operator.mass", "operator.stiffness"))]
    paths = [path for path in paths if path != "virtual_damping"]
    if "operator.coupling_damping" in paths or "coupling.damping" in paths or paths:
        path = str(random.choice(paths))
        tiny = float(random.choice([0.0, 1e-12, 1e-6])) * float(scene.parameters()[path] or 1.0)
        try:
            return scene.replace(**{path: tiny})
        except zwidth.InputError:
            # Some parameters must be positive.
            return scene
    return scene


def draw_wall(scene: zwidth.Scene, random: np.random.Generator) -> Wall:
    """Return a wall inside of, outside of, or near the end of a stable interval."""
    damping = scene.units.virtual_damping * 10 ** random.uniform(-3, 0) * random.choice([1.0, 1.0, 0.0, -0.1])
    ends = scene.stable_stiffness(damping).reshape(-1)
    ends = ends[np.isfinite(ends) & (ends > 0)]
    high = ends.max() if ends.size else float(scene.units.stiffness)
    stiffness = high * random.choice([random.uniform(0, 1.3), 10 ** random.uniform(-6, 0)])
    if random.random() < 0.2 and ends.size:
        stiffness = random.choice(ends) * (1 + random.choice([-1, 1]) * 10 ** random.uniform(-7, -2))
    return Wall(scene, float(stiffness), float(damping))


def draw_high_wall(scene: zwidth.Scene, random: np.random.Generator) -> Wall:
    """Return a wall near the maximum stiffness."""
    top = scene.max_stiffness()
    if top.status != Status.OK:
        return draw_wall(scene, random)
    size = abs(float(top.virtual_damping)) + scene.units.virtual_damping * 10 ** random.uniform(-3, -1)
    damping = float(top.virtual_damping) + size * random.choice([0.0, random.uniform(-1, 1)])
    return Wall(scene, float(top.stiffness) * random.uniform(0, 1.3), float(damping))


def collect_verdicts(wall: Wall) -> dict[str, bool | None]:
    """Return the verdict of each route on the wall's stability, or None if the route is undecided."""
    scene, K, B = wall
    decided = {name: scene.decide_stability(K, B, method=name) for name in ("auto", "crossover", "companion")}
    poles = np.abs(np.asarray(scene.poles(K, B)))
    rows = scene.stable_stiffness(B).reshape(-1, 2)
    radius = float(scene.spectral_radius(K, B))
    verdict_by_route = {
        "is_stable": bool(scene.is_stable(K, B)),
        "is_stable of arrays": bool(scene.is_stable([K, 2 * K, K], [B, B, 0.0])[0]),
        **{f"decide_stability, {name}": _to_verdict(decision) for name, decision in decided.items()},
        "spectral_radius": None if np.isnan(radius) else radius < 1,
        "poles": _inside(poles, ROUGH if scene.nonrigid_parts else ROUGH_DOUBLE),
        "stable_stiffness": bool(np.any((rows[:, 0] < K) & (rows[:, 1] > K))),
        "state_space": _inside(np.linalg.eigvals(scene.state_space(K, B).A)),
        "to_control": _inside(control.poles(zwidth.to_control(scene, K, B))),
    }
    if not scene.nonrigid_parts:
        alpha, beta = (float(part) for part in scene.normalize_walls(K, B))
        verdict_by_route["zwidth.is_stable"] = bool(zwidth.is_stable(alpha, beta, scene.delta, scene.d))
    return verdict_by_route


def _inside(eigenvalues: np.ndarray, rough: float = ROUGH) -> bool | None:
    """Return whether all eigenvalues are inside the unit circle, or None if within their error."""
    excess = float(np.abs(eigenvalues).max()) - 1
    return None if abs(excess) < rough else excess < 0


def _to_verdict(decision: Any) -> bool | None:
    return bool(decision.stable) if int(decision.status) in (Status.OK, Status.ON_BOUNDARY) else None


def is_near_boundary(wall: Wall) -> bool:
    """Return whether the certified verdict changes or is undecided within rounding errors of the wall."""
    scene, K, B = wall
    size = abs(B) + scene.units.virtual_damping * 1e-6
    walls = [(K * (1 + a), B + b * size) for a in (-BAND, 0, BAND) for b in (-BAND, 0, BAND)]
    decision = scene.decide_stability(*np.array(walls).T, method="certified")
    return bool(
        np.any(np.asarray(decision.stable) != decision.stable[0]) or np.any(~np.isin(decision.status, (Status.OK,)))
    )


def compare_fast(wall: Wall) -> Iterator[Comparison]:
    """Yield comparisons that take some hundredths of a second."""
    scene, K, B = wall
    yield Comparison("stable", collect_verdicts(wall))
    if not find_unsupported_reason(**vars(scene.device)):
        margin = float(scene.passivity_margin(K, B))
        yield Comparison("passive", {"is_passive": bool(scene.is_passive(K, B)), "margin": margin > 0})


def compare_maximum(wall: Wall) -> Iterator[Comparison]:
    """Yield comparisons of the maximum stiffness."""
    scene = wall.scene
    top = scene.max_stiffness()
    maxima = {"max_stiffness": top.stiffness}
    if not scene.nonrigid_parts:
        maxima["alpha_max"] = zwidth.alpha_max(scene.delta, scene.d).alpha * scene.units.stiffness
    yield Comparison("K_max", maxima, SAME)
    if top.status == Status.OK:
        starts, ends = scene.stable_stiffness(top.virtual_damping).reshape(-1, 2).T / top.stiffness
        reached = ends[(np.abs(ends - 1) <= WEDGE) & (ends - starts > WEDGE)] * top.stiffness
        if reached.size:
            yield Comparison(
                "K_max ends its row", {"max_stiffness": top.stiffness, "stable_stiffness": reached[0]}, SAME
            )
            wall = Wall(scene, top.stiffness * (1 - 1e-7), top.virtual_damping)
            # A K_max of some uN/m is accurate up to the rounding error of B.
            below = bool(scene.is_stable(*wall[1:])) or (None if is_near_boundary(wall) else False)
            yield Comparison("stable below K_max", {"max_stiffness": True, "is_stable": below})
        else:
            # The maximum may be the tip of an inclined wedge, which its own line hardly intersects; lines of constant K
            # below do.
            edges = scene.stable_damping(top.stiffness * (1 - WEDGE))
            is_tip = edges.size and np.abs(edges / top.virtual_damping - 1).min() <= math.sqrt(WEDGE)
            yield Comparison("K_max is a tip", {"max_stiffness": True, "stable_damping": bool(is_tip)})


def compare_assessment(wall: Wall) -> Iterator[Comparison]:
    """Yield comparisons with `assess` and ``zwidth check``."""
    scene, K, B = wall
    assessment = zwidth.assess(scene.replace(wall=zwidth.VirtualWall(K, B)))
    top, margins_direct = scene.max_stiffness(), scene.margins(K, B)
    options = make_options(scene)
    checked = None
    if options is not None:
        checked = run_command_json("check", *options, f"--stiffness={K!r}", f"--virtual-damping={B!r}")
    yield Comparison(
        "stable",
        {
            "is_stable": bool(scene.is_stable(K, B)),
            "margins, phase": None if np.isnan(margins_direct.phase_margin) else bool(margins_direct.phase_margin > 0),
            "margins, delay": None if np.isnan(margins_direct.delay_margin) else bool(margins_direct.delay_margin > 0),
            "assess.stable": assessment.stable,
            "assess.spectral_radius": None if np.isnan(assessment.spectral_radius) else assessment.spectral_radius < 1,
            "assess.decay_rate": None if np.isnan(assessment.decay_rate) else assessment.decay_rate > 0,
            "assess, stable K": any(low < K < high for low, high in assessment.stable_stiffness),
            "assess, stable B": any(low < B < high for low, high in assessment.stable_damping),
            "check": checked and checked["stable"],
        },
    )
    maxima = {"max_stiffness": top.stiffness, "assess": assessment.stiffness_max}
    yield Comparison("K_max", maxima | ({"check": checked["stiffness_max"]} if checked else {}), SAME)
    for name in ("gain_margin", "phase_margin", "modulus_margin", "delay_margin"):
        values = {"scene": float(getattr(margins_direct, name)), "assess": float(getattr(assessment, name))}
        # JSON has no infinity.
        if checked and math.isfinite(values["assess"]):
            values["check"] = checked[name]
        yield Comparison(name, values, ALIKE)
    if not find_unsupported_reason(**vars(scene.device)):
        yield Comparison(
            "passive",
            {
                "scene": bool(scene.is_passive(K, B)),
                "assess": assessment.passive,
                "check": checked and checked["passive"],
            },
        )
        margins = {"scene": float(scene.passivity_margin(K, B)), "assess": assessment.passivity_margin}
        yield Comparison("passivity margin", margins, ALIKE)


def make_options(scene: zwidth.Scene) -> list[str] | None:
    """Return the scene as command line options, or None if its velocity filter has none."""
    names = {
        "BackwardDifference": "backward_difference",
        "WindowedDifference": "windowed_difference",
        "LowPass": "low_pass",
        "Butterworth": "butterworth",
    }
    kind = names.get(type(scene.velocity).__name__)
    if kind is None:
        return None
    values_by_path = {"velocity.kind": kind}
    if (coupling := scene.device.coupling) is not None:
        values_by_path["coupling.sensor"] = coupling.sensor
    skipped = ("stiffness", "virtual_damping")
    values_by_path |= {path: repr(value) for path, value in scene.parameters().items() if path not in skipped}
    return [
        f"--{path.replace('.', '-').replace('_', '-')}={value}"
        for path, value in values_by_path.items()
        if value != "None"
    ]


def run_command_json(*arguments: str) -> dict[str, Any]:
    """Return the JSON output of a command."""
    result = CliRunner().invoke(cli, [*arguments, "--json"], catch_exceptions=False)
    if result.exit_code:
        return {"error": result.output}
    return json.loads(result.stdout)


def sweep_wall(wall: Wall) -> dict[str, Any]:
    """Return the results of a sweep over this wall."""
    scene, K, B = wall
    device, hand, tip = scene.device, scene.operator, scene.device.coupling
    axes = {"mass": device.mass, "damping": device.damping, "period": scene.timing.period, "delay": scene.timing.delay}
    outputs = [
        "stable",
        "spectral_radius",
        "stiffness_max",
        *([] if find_unsupported_reason(**vars(device)) else ["passive"]),
    ]
    study: dict[str, Any] = {"kind": "sweep", "name": "one", "outputs": outputs}
    study["axes"] = {**axes, "stiffness": [K, 2 * K], "virtual_damping": [B]}
    names = {"LowPass": "low_pass", "Butterworth": "butterworth", "WindowedDifference": "windowed_difference"}
    kind = names.get(type(scene.velocity).__name__, "filter")
    if not isinstance(scene.velocity, zwidth.BackwardDifference):
        fields = {name: getattr(scene.velocity, name) for name in scene.velocity.__dataclass_fields__}
        study["velocity"] = {"kind": kind, **{name: value for name, value in fields.items() if value is not None}}
    if hand is not None:
        study["operator"] = {k: v for k, v in vars(hand).items() if v is not None}
    if tip is not None:
        study["coupling"] = dict(vars(tip))
    with tempfile.TemporaryDirectory() as folder:
        result = zwidth.run({"version": 1, "name": "one", "studies": [study]}, out=Path(folder) / "out")
        assert result.ok, result
        with zwidth.open_dataset(Path(folder) / "out" / result.studies[0].files[0]) as data:
            return {str(name): np.asarray(data[name]).reshape(-1) for name in data.data_vars}


def compare_runs(wall: Wall) -> Iterator[Comparison]:
    """Yield comparisons with runs, commands and simulations."""
    scene, K, B = wall
    top = scene.max_stiffness()
    stable: dict[str, Any] = {"scene": bool(scene.is_stable(K, B))}
    maxima: dict[str, Any] = {"scene": float(top.stiffness)}
    maxima_by_limit = [limit.stiffness / limit.gain for limit in zwidth.limits_of(scene)]
    maxima |= {f"limits_of, {k}": maximum for k, maximum in enumerate(maxima_by_limit) if not np.isnan(maximum)}
    if (options := make_options(scene)) is not None:
        ridge_output = run_command_json("ridge", *options)
        maxima["ridge"] = ridge_output.get("stiffness_max")
        slopes = scene.sensitivities().per
        for name, entry in ridge_output.get("sensitivities", {}).items():
            value = next((entry[key] for key in entry if key in ("value", "derivative", "slope")), None)
            if value is not None and name in slopes:
                yield Comparison(
                    f"slope of K_max in {name}", {"ridge": value, "sensitivities": float(slopes[name])}, SAME
                )
    swept = sweep_wall(wall)
    stable["sweep"], maxima["sweep"] = bool(swept["stable"][0]), float(swept["stiffness_max"][0])
    if "passive" in swept:
        yield Comparison("passive", {"scene": bool(scene.is_passive(K, B)), "sweep": bool(swept["passive"][0])})
    radius = float(scene.spectral_radius(K, B))
    yield Comparison("spectral radius", {"scene": radius, "sweep": float(swept["spectral_radius"][0])}, SAME)
    rate = abs(np.log(radius))
    periods = int(30 / rate + 50) if rate > 0 else LONGEST
    if periods < LONGEST:
        motion = scene.simulate(K, B, start_velocity=1e-3, periods=periods, record=True)
        size = np.abs(np.asarray(motion.position))
        stable["simulate"] = bool(size[-periods // 8 :].max() < size[periods // 4 : periods // 2].max())
        label = MotionKind(int(motion.outcome))
        stable["simulate, label"] = {MotionKind.DECAYING: True, MotionKind.GROWING: False}.get(label)
    yield Comparison("stable", stable)
    yield Comparison("K_max", maxima, SAME)


def compare_gradients(wall: Wall) -> Iterator[Comparison]:
    """Yield comparisons of the sensitivities with JAX's gradient in one parameter."""
    scene = wall.scene
    if scene.max_stiffness().status != Status.OK:
        return
    path = "damping" if scene.device.damping > 0 else "mass"

    def stiffness(value: Any) -> Any:
        return scene.replace(**{path: value}).max_stiffness().stiffness

    with jax.enable_x64(True):
        slope = float(jax.grad(stiffness)(float(scene.parameters()[path])))
    yield Comparison(
        f"slope of K_max in {path}",
        {"sensitivities": float(scene.sensitivities().per[path]), "jax.grad": slope},
        SAME_SLOPE,
    )
