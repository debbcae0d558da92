"""One question, one answer: what every road to a question about a scene says, with parts and without.

A wall's stability can be asked of the scene, of its poles, of a row, a column, an outline, a margin, the command line,
a sweep, python-control and the time domain; the stiffest wall, passivity and derivatives have roads of their own. None
may contradict another, in value or in status. Where two roads differ on a wall, the certified verdict (balls of
python-flint) a little to all sides of it tells whether rounding explains it.

As a program: ``python tests/properties/test_one_answer.py COUNT SEED [SLOW]`` prints the contradictions; SLOW of them
go through the command line, a sweep, the time domain and JAX as well.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import any_loop
import jax
import numpy as np
from click.testing import CliRunner

import zwidth
from zwidth.cli import cli
from zwidth.loops.linear.passivity import has_condition
from zwidth.words.status import Status

SEED = 20
# Relative distance from the edge within which two roads may round to different sides.
BAND = 1e-8
# K_max by different roads: polished by Newton's method on one hand, the highest point of an edge on the other.
SAME = 1e-9
# Derivatives: implicit ones by JAX beside those of the host.
SAME_SLOPE = 1e-6


class Wall(NamedTuple):
    """A wall on a scene, in N/m and N s/m."""

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
    top = scene.max_stiffness()
    high = float(top.stiffness) if top.status == Status.OK else float(scene.units.stiffness)
    best = float(top.virtual_damping) if top.status == Status.OK else 0.0
    size = abs(best) + scene.units.virtual_damping * 10 ** random.uniform(-3, -1)
    damping = random.choice([best, 0.0, best + size * random.uniform(-1, 1), abs(best) * random.uniform(0, 1.5)])
    stiffness = high * random.choice([random.uniform(0, 1.3), 10 ** random.uniform(-6, 0)])
    if random.random() < 0.2:
        ends = scene.stable_stiffness(damping).reshape(-1)
        ends = ends[np.isfinite(ends) & (ends > 0)]
        if ends.size:
            stiffness = random.choice(ends) * (1 + random.choice([-1, 1]) * 10 ** random.uniform(-7, -2))
    wall = zwidth.VirtualWall(float(stiffness), float(damping))
    return Wall(scene.replace(wall=wall), float(stiffness), float(damping))


def verdicts(wall: Wall, found: Any) -> dict[str, bool | None]:
    """What each road says of the wall's stability; None where it says that it does not know."""
    scene, K, B = wall
    decided = {name: scene.decide_stability(K, B, method=name) for name in ("auto", "crossover", "companion")}
    poles = np.abs(np.asarray(scene.poles(K, B)))
    table = scene.pole_table(K, B)
    rows = scene.stable_stiffness(B).reshape(-1, 2)
    radius = float(scene.spectral_radius(K, B))
    said = {
        "is_stable": bool(scene.is_stable(K, B)),
        "is_stable of arrays": bool(scene.is_stable([K, 2 * K, K], [B, B, 0.0])[0]),
        **{f"decide_stability, {name}": _known(told) for name, told in decided.items()},
        "spectral_radius": None if np.isnan(radius) else radius < 1,
        "poles": bool(poles.max() < 1),
        "pole_table": bool(np.abs(table.z).max() < 1),
        "stable_stiffness": bool(np.any((rows[:, 0] < K) & (rows[:, 1] > K))),
        "phase_margin": None if np.isnan(found.phase_margin) else found.phase_margin > 0,
        "delay_margin": None if np.isnan(found.delay_margin) else found.delay_margin > 0,
        "assess.stable": found.stable,
        "assess.spectral_radius": None if np.isnan(found.spectral_radius) else found.spectral_radius < 1,
        "assess.decay_rate": None if np.isnan(found.decay_rate) else found.decay_rate > 0,
        "assess, stable K": any(low < K < high for low, high in found.stable_stiffness),
        "assess, stable B": any(low < B < high for low, high in found.stable_damping),
    }
    if scene.is_rigid:
        alpha, beta = (float(part) for part in scene.normalize_walls(K, B))
        said["zwidth.is_stable"] = bool(zwidth.is_stable(alpha, beta, scene.delta, scene.d))
    said["state_space"] = bool(np.abs(np.linalg.eigvals(scene.state_space(K, B).A)).max() < 1)
    return said


def _known(told: Any) -> bool | None:
    return bool(told.stable) if int(told.status) in (Status.OK, Status.ON_BOUNDARY) else None


def near_the_edge(wall: Wall) -> bool:
    """Whether the proved verdict changes, or is open, within rounding of the wall."""
    scene, K, B = wall
    size = abs(B) + scene.units.virtual_damping * 1e-6
    walls = [(K * (1 + a), B + b * size) for a in (-BAND, 0, BAND) for b in (-BAND, 0, BAND)]
    told = scene.decide_stability(*np.array(walls).T, method="certified")
    return bool(np.any(np.asarray(told.stable) != told.stable[0]) or np.any(~np.isin(told.status, (Status.OK,))))


def differing(values: dict[str, Any]) -> str:
    """The roads and their answers, where two that know differ."""
    known = {road: value for road, value in values.items() if value is not None}
    return "" if len(set(known.values())) < 2 else str(known)


def spread(values: dict[str, Any], within: float) -> str:
    """The roads and their numbers, where they differ by more than rounding, or only some know."""
    numbers = np.array([np.nan if value is None else float(value) for value in values.values()])
    if np.isnan(numbers).all():
        return ""
    if np.isnan(numbers).any() or np.ptp(numbers) > within * np.abs(numbers).max():
        return str(values)
    return ""


def contradictions(wall: Wall) -> Iterator[tuple[str, str]]:
    """The questions to which two roads give different answers."""
    scene, K, B = wall
    found = zwidth.assess(scene)
    text = differing(verdicts(wall, found))
    if text and not near_the_edge(wall):
        proved = scene.decide_stability(K, B, method="certified")
        yield "stable", f"{text}, proved {bool(proved.stable)}"
    top = scene.max_stiffness()
    known = top.status == Status.OK
    tops = {"max_stiffness": top.stiffness, "assess": found.stiffness_max}
    if scene.is_rigid:
        tops["alpha_max"] = zwidth.alpha_max(scene.delta, scene.d).alpha * scene.units.stiffness
    if known and (text := spread(tops, SAME)):
        yield "K_max", text
    if known and not scene.is_stable(top.stiffness * (1 - 1e-7), top.virtual_damping) and found.ridge_kind == "smooth":
        # A smooth top is inside for any softer wall of its damping only on a row that is one interval.
        yield "the stiffest wall stands on stable ones", f"{top}"
    if has_condition(scene.device):
        margin = float(scene.passivity_margin(K, B))
        if text := differing(
            {"is_passive": bool(scene.is_passive(K, B)), "margin": margin > 0, "assess": found.passive}
        ):
            yield "passive", text
        if text := spread({"scene": margin, "assess": found.passivity_margin}, 1e-12):
            yield "passivity margin", text


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
    outputs = ["stable", "spectral_radius", "stiffness_max", *(["passive"] if has_condition(device) else [])]
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


def slow_contradictions(wall: Wall) -> Iterator[tuple[str, str]]:
    """Those between the scene's answers and the roads that start a program, a run, a compiler or a simulation."""
    scene, K, B = wall
    found, top = zwidth.assess(scene), scene.max_stiffness()
    stands = scene.margins(K, B)
    for name in ("gain_margin", "phase_margin", "modulus_margin", "delay_margin"):
        pair = {"scene": float(getattr(stands, name)), "assess": float(getattr(found, name))}
        if np.isfinite(list(pair.values())).any() and (text := spread(pair, 1e-12)):
            yield name, text
    stable = {"scene": bool(scene.is_stable(K, B))}
    tops: dict[str, Any] = {"scene": float(top.stiffness)}
    shares = [limit.stiffness / limit.gain for limit in zwidth.limits_of(scene)]
    tops |= {f"limits_of, {k}": share for k, share in enumerate(shares) if not np.isnan(share)}
    passive = {"scene": bool(scene.is_passive(K, B)) if has_condition(scene.device) else None}
    options = options_of(scene)
    if options is not None:
        said = ask_command("check", *options, f"--stiffness={K!r}", f"--virtual-damping={B!r}")
        stable["check"], passive["check"], tops["check"] = said["stable"], said["passive"], said["stiffness_max"]
        said = ask_command("ridge", *options)
        tops["ridge"] = said.get("stiffness_max")
        slopes = scene.sensitivities()
        for name, entry in said.get("sensitivities", {}).items():
            value = next((entry[key] for key in entry if key in ("value", "derivative", "slope")), None)
            path = {"delay": "delay"}.get(name, name)
            if value is None or path not in slopes.per:
                continue
            if text := spread({"ridge": value, "sensitivities": float(slopes.per[path])}, 1e-9):
                yield f"slope in {name}", text
    swept = sweep_of(wall)
    stable["sweep"], tops["sweep"] = bool(swept["stable"][0]), float(swept["stiffness_max"][0])
    if "passive" in swept:
        passive["sweep"] = bool(swept["passive"][0])
    import control

    stable["to_control"] = bool(np.abs(control.poles(zwidth.to_control(scene, K, B))).max() < 1)
    rate = np.log(float(scene.spectral_radius(K, B)))
    if abs(rate) > 3e-4:
        periods = int(min(30 / abs(rate) + 50, 1e5))
        motion = scene.simulate(K, B, start_velocity=1e-3, periods=periods, record=True)
        size = np.abs(np.asarray(motion.position))
        stable["simulate"] = bool(size[-periods // 8 :].max() < size[periods // 4 : periods // 2].max())
    for question, values in (("stable", stable), ("passive", passive)):
        if (text := differing(values)) and not near_the_edge(wall):
            yield question, text
    if text := spread(tops, SAME):
        yield "K_max", text
    assert found.stable == stable["scene"] or near_the_edge(wall)
    if top.status == Status.OK:
        yield from slope_contradictions(scene)


def slope_contradictions(scene: zwidth.Scene) -> Iterator[tuple[str, str]]:
    """Sensitivities beside JAX's gradient, in the numbers that can be traced."""
    per = scene.sensitivities().per
    path = "damping" if scene.device.damping > 0 else "mass"

    def stiffness(value: Any) -> Any:
        return scene.replace(**{path: value}).max_stiffness().stiffness

    with jax.enable_x64(True):
        slope = float(jax.grad(stiffness)(float(scene.parameters()[path])))
    if text := spread({"sensitivities": float(per[path]), "jax.grad": slope}, SAME_SLOPE):
        yield f"slope in {path}", text


def found_in(count: int, seed: int, slow: int = 0) -> list[tuple[str, str, Wall]]:
    """The contradictions on so many walls, one a scene."""
    random = np.random.default_rng(seed)
    found = []
    for k in range(count):
        wall = draw_wall(draw_scene(random), random)
        told = list(contradictions(wall))
        if slow and k % max(1, count // slow) == 0:
            told += slow_contradictions(wall)
        found += [(question, text, wall) for question, text in told]
    return found


def test_every_road_gives_the_same_answer():
    assert found_in(60, SEED, slow=6) == []


if __name__ == "__main__":
    import time
    import traceback
    import warnings

    warnings.simplefilter("ignore", zwidth.PrecisionWarning)
    total, first, share = (int(text) for text in (*sys.argv[1:3], *(sys.argv[3:] or ["0"])))
    start, bad = time.process_time(), 0
    random = np.random.default_rng(first)
    for k in range(total):
        wall = draw_wall(draw_scene(random), random)
        try:
            told = list(contradictions(wall))
            if share and k % max(1, total // share) == 0:
                told += slow_contradictions(wall)
        except Exception:
            told = [("error", traceback.format_exc(limit=-4))]
        for question, text in told:
            bad += 1
            print(f"{k}: {question}: {text}\n    {wall}", flush=True)
    print(f"{total} scenes, {bad} contradictions, {time.process_time() - start:.0f} s of CPU")
