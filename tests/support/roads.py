"""Every road to a question about a scene's walls, and what it answers: `properties.test_one_answer` compares them."""

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

# Relative distance from the edge within which two roads may round to different sides.
BAND = 1e-8
# K_max by different roads: polished by Newton's method on one hand, the highest point of an edge on the other.
SAME = 1e-9
# Within which share of K_max a row that leads up to it ends, and how far below the tip of a wedge is asked.
WEDGE = 1e-4
# Derivatives: implicit ones by JAX beside those of the host.
SAME_SLOPE = 1e-6
# How far off eigenvalues of a matrix may be: walls too soft for it are left to the other roads.
ROUGH = 1e-13
# Where two poles are almost one.
ROUGH_DOUBLE = 2e-8
# Numbers that two roads pass on alike.
ALIKE = 1e-12
# Slower motions tell no growth within so many periods.
LONGEST = 30_000


class Question(NamedTuple):
    """One question, what each road answers, and within which share numbers are alike; verdicts have none."""

    name: str
    answers: dict[str, Any]
    within: float | None = None


class Wall(NamedTuple):
    """A wall on a scene that has none of its own, in N/m and N s/m."""

    scene: zwidth.Scene
    stiffness: float
    virtual_damping: float


def draw_scene(random: np.random.Generator) -> zwidth.Scene:
    """A scene of any kind; a part in five has a number at zero or next to it."""
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
            # Some numbers must be positive.
            return scene
    return scene


def draw_wall(scene: zwidth.Scene, random: np.random.Generator) -> Wall:
    """A wall inside, outside or next to an end of a row."""
    damping = scene.units.virtual_damping * 10 ** random.uniform(-3, 0) * random.choice([1.0, 1.0, 0.0, -0.1])
    ends = scene.stable_stiffness(damping).reshape(-1)
    ends = ends[np.isfinite(ends) & (ends > 0)]
    high = ends.max() if ends.size else float(scene.units.stiffness)
    stiffness = high * random.choice([random.uniform(0, 1.3), 10 ** random.uniform(-6, 0)])
    if random.random() < 0.2 and ends.size:
        stiffness = random.choice(ends) * (1 + random.choice([-1, 1]) * 10 ** random.uniform(-7, -2))
    return Wall(scene, float(stiffness), float(damping))


def draw_high_wall(scene: zwidth.Scene, random: np.random.Generator) -> Wall:
    """A wall around the stiffest stable one."""
    top = scene.max_stiffness()
    if top.status != Status.OK:
        return draw_wall(scene, random)
    size = abs(float(top.virtual_damping)) + scene.units.virtual_damping * 10 ** random.uniform(-3, -1)
    damping = float(top.virtual_damping) + size * random.choice([0.0, random.uniform(-1, 1)])
    return Wall(scene, float(top.stiffness) * random.uniform(0, 1.3), float(damping))


def verdicts(wall: Wall) -> dict[str, bool | None]:
    """What each road says of the wall's stability; None where it says that it does not know."""
    scene, K, B = wall
    decided = {name: scene.decide_stability(K, B, method=name) for name in ("auto", "crossover", "companion")}
    poles = np.abs(np.asarray(scene.poles(K, B)))
    rows = scene.stable_stiffness(B).reshape(-1, 2)
    radius = float(scene.spectral_radius(K, B))
    said = {
        "is_stable": bool(scene.is_stable(K, B)),
        "is_stable of arrays": bool(scene.is_stable([K, 2 * K, K], [B, B, 0.0])[0]),
        **{f"decide_stability, {name}": _known(told) for name, told in decided.items()},
        "spectral_radius": None if np.isnan(radius) else radius < 1,
        "poles": _inside(poles, ROUGH if scene.nonrigid_parts else ROUGH_DOUBLE),
        "stable_stiffness": bool(np.any((rows[:, 0] < K) & (rows[:, 1] > K))),
        "state_space": _inside(np.linalg.eigvals(scene.state_space(K, B).A)),
        "to_control": _inside(control.poles(zwidth.to_control(scene, K, B))),
    }
    if not scene.nonrigid_parts:
        alpha, beta = (float(part) for part in scene.normalize_walls(K, B))
        said["zwidth.is_stable"] = bool(zwidth.is_stable(alpha, beta, scene.delta, scene.d))
    return said


def _inside(eigenvalues: np.ndarray, rough: float = ROUGH) -> bool | None:
    """Whether all lie in the unit circle; None where the rounding of eigenvalues decides."""
    beyond = float(np.abs(eigenvalues).max()) - 1
    return None if abs(beyond) < rough else beyond < 0


def _known(told: Any) -> bool | None:
    return bool(told.stable) if int(told.status) in (Status.OK, Status.ON_BOUNDARY) else None


def near_the_edge(wall: Wall) -> bool:
    """Whether the proved verdict changes, or is open, within rounding of the wall."""
    scene, K, B = wall
    size = abs(B) + scene.units.virtual_damping * 1e-6
    walls = [(K * (1 + a), B + b * size) for a in (-BAND, 0, BAND) for b in (-BAND, 0, BAND)]
    told = scene.decide_stability(*np.array(walls).T, method="certified")
    return bool(np.any(np.asarray(told.stable) != told.stable[0]) or np.any(~np.isin(told.status, (Status.OK,))))


def quick_questions(wall: Wall) -> Iterator[Question]:
    """Those that are answered in some hundredths of a second."""
    scene, K, B = wall
    yield Question("stable", verdicts(wall))
    if not find_unsupported_reason(**vars(scene.device)):
        margin = float(scene.passivity_margin(K, B))
        yield Question("passive", {"is_passive": bool(scene.is_passive(K, B)), "margin": margin > 0})


def highest_questions(wall: Wall) -> Iterator[Question]:
    """Those about the stiffest wall of the device."""
    scene = wall.scene
    top = scene.max_stiffness()
    tops = {"max_stiffness": top.stiffness}
    if not scene.nonrigid_parts:
        tops["alpha_max"] = zwidth.alpha_max(scene.delta, scene.d).alpha * scene.units.stiffness
    yield Question("K_max", tops, SAME)
    if top.status == Status.OK:
        starts, ends = scene.stable_stiffness(top.virtual_damping).reshape(-1, 2).T / top.stiffness
        reached = ends[(np.abs(ends - 1) <= WEDGE) & (ends - starts > WEDGE)] * top.stiffness
        if reached.size:
            yield Question("K_max ends its row", {"max_stiffness": top.stiffness, "stable_stiffness": reached[0]}, SAME)
            wall = Wall(scene, top.stiffness * (1 - 1e-7), top.virtual_damping)
            # K_max of some uN/m is known to the rounding of B.
            below = bool(scene.is_stable(*wall[1:])) or (None if near_the_edge(wall) else False)
            yield Question("stable below K_max", {"max_stiffness": True, "is_stable": below})
        else:
            # It may be the tip of a wedge that leans: its own row hardly meets it, the columns below it do.
            edges = scene.stable_damping(top.stiffness * (1 - WEDGE))
            near = edges.size and np.abs(edges / top.virtual_damping - 1).min() <= math.sqrt(WEDGE)
            yield Question("K_max is a tip", {"max_stiffness": True, "stable_damping": bool(near)})


def assessed_questions(wall: Wall) -> Iterator[Question]:
    """Those to which `assess` and ``zwidth check`` have all answers together."""
    scene, K, B = wall
    found = zwidth.assess(scene.replace(wall=zwidth.VirtualWall(K, B)))
    top, stands = scene.max_stiffness(), scene.margins(K, B)
    options = options_of(scene)
    said = None
    if options is not None:
        said = ask_command("check", *options, f"--stiffness={K!r}", f"--virtual-damping={B!r}")
    yield Question(
        "stable",
        {
            "is_stable": bool(scene.is_stable(K, B)),
            "margins, phase": None if np.isnan(stands.phase_margin) else bool(stands.phase_margin > 0),
            "margins, delay": None if np.isnan(stands.delay_margin) else bool(stands.delay_margin > 0),
            "assess.stable": found.stable,
            "assess.spectral_radius": None if np.isnan(found.spectral_radius) else found.spectral_radius < 1,
            "assess.decay_rate": None if np.isnan(found.decay_rate) else found.decay_rate > 0,
            "assess, stable K": any(low < K < high for low, high in found.stable_stiffness),
            "assess, stable B": any(low < B < high for low, high in found.stable_damping),
            "check": said and said["stable"],
        },
    )
    tops = {"max_stiffness": top.stiffness, "assess": found.stiffness_max}
    yield Question("K_max", tops | ({"check": said["stiffness_max"]} if said else {}), SAME)
    for name in ("gain_margin", "phase_margin", "modulus_margin", "delay_margin"):
        values = {"scene": float(getattr(stands, name)), "assess": float(getattr(found, name))}
        # JSON has no infinity.
        if said and math.isfinite(values["assess"]):
            values["check"] = said[name]
        yield Question(name, values, ALIKE)
    if not find_unsupported_reason(**vars(scene.device)):
        yield Question(
            "passive",
            {"scene": bool(scene.is_passive(K, B)), "assess": found.passive, "check": said and said["passive"]},
        )
        margins = {"scene": float(scene.passivity_margin(K, B)), "assess": found.passivity_margin}
        yield Question("passivity margin", margins, ALIKE)


def options_of(scene: zwidth.Scene) -> list[str] | None:
    """The scene as options of the command line; None where it has none for the estimate."""
    names = {
        "BackwardDifference": "backward_difference",
        "WindowedDifference": "windowed_difference",
        "LowPass": "low_pass",
        "Butterworth": "butterworth",
    }
    kind = names.get(type(scene.velocity).__name__)
    if kind is None:
        return None
    given = {"velocity.kind": kind}
    if (coupling := scene.device.coupling) is not None:
        given["coupling.sensor"] = coupling.sensor
    skipped = ("stiffness", "virtual_damping")
    given |= {path: repr(value) for path, value in scene.parameters().items() if path not in skipped}
    return [f"--{path.replace('.', '-').replace('_', '-')}={value}" for path, value in given.items() if value != "None"]


def ask_command(*arguments: str) -> dict[str, Any]:
    """What a command says with --json."""
    told = CliRunner().invoke(cli, [*arguments, "--json"], catch_exceptions=False)
    if told.exit_code:
        return {"error": told.output}
    return json.loads(told.stdout)


def sweep_of(wall: Wall) -> dict[str, Any]:
    """What a sweep of this one wall holds."""
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
        told = zwidth.run({"version": 1, "name": "one", "studies": [study]}, out=Path(folder) / "out")
        assert told.ok, told
        with zwidth.open_dataset(Path(folder) / "out" / told.studies[0].files[0]) as data:
            return {str(name): np.asarray(data[name]).reshape(-1) for name in data.data_vars}


def run_questions(wall: Wall) -> Iterator[Question]:
    """Those asked of a run, a command or a simulation."""
    scene, K, B = wall
    top = scene.max_stiffness()
    stable: dict[str, Any] = {"scene": bool(scene.is_stable(K, B))}
    tops: dict[str, Any] = {"scene": float(top.stiffness)}
    shares = [limit.stiffness / limit.gain for limit in zwidth.limits_of(scene)]
    tops |= {f"limits_of, {k}": share for k, share in enumerate(shares) if not np.isnan(share)}
    if (options := options_of(scene)) is not None:
        said = ask_command("ridge", *options)
        tops["ridge"] = said.get("stiffness_max")
        slopes = scene.sensitivities().per
        for name, entry in said.get("sensitivities", {}).items():
            value = next((entry[key] for key in entry if key in ("value", "derivative", "slope")), None)
            if value is not None and name in slopes:
                yield Question(
                    f"slope of K_max in {name}", {"ridge": value, "sensitivities": float(slopes[name])}, SAME
                )
    swept = sweep_of(wall)
    stable["sweep"], tops["sweep"] = bool(swept["stable"][0]), float(swept["stiffness_max"][0])
    if "passive" in swept:
        yield Question("passive", {"scene": bool(scene.is_passive(K, B)), "sweep": bool(swept["passive"][0])})
    radius = float(scene.spectral_radius(K, B))
    yield Question("spectral radius", {"scene": radius, "sweep": float(swept["spectral_radius"][0])}, SAME)
    rate = abs(np.log(radius))
    periods = int(30 / rate + 50) if rate > 0 else LONGEST
    if periods < LONGEST:
        motion = scene.simulate(K, B, start_velocity=1e-3, periods=periods, record=True)
        size = np.abs(np.asarray(motion.position))
        stable["simulate"] = bool(size[-periods // 8 :].max() < size[periods // 4 : periods // 2].max())
        label = MotionKind(int(motion.outcome))
        stable["simulate, label"] = {MotionKind.DECAYING: True, MotionKind.GROWING: False}.get(label)
    yield Question("stable", stable)
    yield Question("K_max", tops, SAME)


def traced_questions(wall: Wall) -> Iterator[Question]:
    """The sensitivities beside JAX's gradient, in a number that can be traced."""
    scene = wall.scene
    if scene.max_stiffness().status != Status.OK:
        return
    path = "damping" if scene.device.damping > 0 else "mass"

    def stiffness(value: Any) -> Any:
        return scene.replace(**{path: value}).max_stiffness().stiffness

    with jax.enable_x64(True):
        slope = float(jax.grad(stiffness)(float(scene.parameters()[path])))
    yield Question(
        f"slope of K_max in {path}",
        {"sensitivities": float(scene.sensitivities().per[path]), "jax.grad": slope},
        SAME_SLOPE,
    )
