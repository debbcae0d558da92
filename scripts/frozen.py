#!/usr/bin/env python3
"""Regression check: save the results of all functions, commands and configurations, and compare two such files.

    .venv/bin/python scripts/frozen.py keep FILE.npz [PART...]     PARTS: functions scenes commands configurations
    .venv/bin/python scripts/frozen.py compare OLD.npz NEW.npz     lists the differences; exit code 1 if there are any

Inputs are random with fixed seeds. Run "keep" before and after a change on the same machine, since rounding differs
between processors. For configurations, the SHA-256 of every data file is saved, except for figures and files with
times and machine names.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
from click.testing import CliRunner

import zwidth
from zwidth.cli import cli

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests" / folder) for folder in ("support", "oracles")]
Answers = Iterator[tuple[str, np.ndarray]]

_WALLS, _SCENES = 4000, 10
# These files differ between runs.
_TIMES = ("run.json", "versions.json", "zarr.json", "zwidth.json")
_PICTURES = (".png", ".svg", ".pdf", ".html")


def flatten(name: str, value: Any) -> Answers:
    """Yield every number and text of a result with a unique name."""
    if hasattr(value, "_asdict"):
        value = value._asdict()
    elif hasattr(value, "as_dict"):
        value = value.as_dict()
    elif hasattr(value, "__dataclass_fields__"):
        value = {key: getattr(value, key) for key in value.__dataclass_fields__}
    if isinstance(value, dict):
        for key, part in value.items():
            yield from flatten(f"{name}.{key}", part)
    elif isinstance(value, list | tuple) and not all(isinstance(part, int | float) for part in value):
        for k, part in enumerate(value):
            yield from flatten(f"{name}[{k}]", part)
    elif value is None or isinstance(value, str):
        yield name, np.array(str(value))
    else:
        yield name, np.asarray(value)


def ask(name: str, function: Callable[..., Any], *arguments: Any, **options: Any) -> Answers:
    """Yield the results of a function, or the error that it raises."""
    try:
        yield from flatten(name, function(*arguments, **options))
    except (zwidth.ZwidthError, ArithmeticError) as error:
        yield f"{name}.refused", np.array(f"{type(error).__name__}: {error}")


def functions() -> Answers:
    """Yield results of all array functions for single walls, few walls (NumPy), many walls (compiled) and traced."""
    random = np.random.default_rng(1)
    delta = np.where(random.random(_WALLS) < 0.1, 0.0, 10.0 ** random.uniform(-6, 4, _WALLS))
    d = random.choice([0.0, 0.3, 1.0, 1.6, 2.0, 4.0, 8.0, 50.0, 137.5], _WALLS)
    top = zwidth.alpha_max(delta, d)
    alpha = top.alpha * 10.0 ** random.uniform(-4, 0.1, _WALLS)
    beta = -delta + (top.beta + delta) * random.uniform(-0.1, 2.0, _WALLS)
    walls = (alpha, beta, delta, d)
    names = ("is_stable", "decide_stability", "spectral_radius", "decay_rate", "margins")
    for name in (*names, "is_passive", "passivity_margin"):
        for size in (1, 60, _WALLS if name != "margins" else 500):
            yield from ask(f"{name}[{size}]", getattr(zwidth, name), *(part[:size] for part in walls))
    for method in ("companion", "schur_cohn", "certified"):
        yield from ask(f"decide_stability, {method}", zwidth.decide_stability, *(p[:200] for p in walls), method=method)
    few = [part[:60][walls[3][:60] <= 8] for part in walls]
    for name in ("char_poly", "poles"):
        for wall in zip(*(part[:12].tolist() for part in few), strict=True):
            yield from ask(f"{name}{wall}", getattr(zwidth, name), *wall)
    for name in ("alpha_max", "stable_area", "passive_area"):
        size = _WALLS if name == "alpha_max" else 40
        yield from ask(name, getattr(zwidth, name), delta[:size], d[:size])
    yield from ask("stiffness_slope", zwidth.stiffness_slope, np.unique(d))
    omega = random.uniform(0.01, 3.1, 40)
    yield from ask("boundary", zwidth.boundary, omega, delta[:40], d[:40])
    for size in (3, 40, _WALLS):
        at = delta[:size], d[:size]
        yield from ask(f"boundary_point, beta[{size}]", zwidth.boundary_point, *at, beta=beta[:size])
        for side in ("lower", "upper"):
            yield from ask(f"boundary_point, {side}[{size}]", zwidth.boundary_point, *at, alpha=alpha[:size], side=side)
    for k in range(6):
        yield from ask(f"stable_region[{k}]", zwidth.stable_region, float(delta[k]), float(d[k]))
        yield from ask(f"step_response[{k}]", zwidth.step_response, *(float(p[k]) for p in walls), periods=40)
    zeros, poles = np.array([0.3, 0.9]), np.array([0.2, 0.99, 1.0])
    yield from ask("count_poles", zwidth.count_poles, zeros, poles, alpha[:50], np.floor(d[:50]), 1.0)
    device = {"mass": 10.0 ** random.uniform(-2, 1, 30), "damping": delta[:30], "period": 1e-3}
    yield from ask("max_stiffness", zwidth.max_stiffness, **device, delay=1e-3 * d[:30])
    yield from ask("sensitivities", zwidth.sensitivities, **device, delay=1e-3 * d[:30])
    with jax.enable_x64(True):
        slopes = jax.vmap(jax.grad(lambda delta, d: zwidth.alpha_max(delta, d).alpha), (0, None))
        yield from ask("grad alpha_max", slopes, delta[:20] + 0.01, 1.0)


def scenes() -> Answers:
    """Yield results of all methods of scenes of every kind."""
    import any_loop

    random = np.random.default_rng(2)
    for kind in any_loop.KINDS:
        for k in range(_SCENES):
            scene = any_loop.random_scene(kind, random)
            name = f"{kind}[{k}]"
            top = scene.max_stiffness()
            size = float(scene.units.virtual_damping) * 0.1
            K = float(top.stiffness) if top.status == 0 else float(scene.units.stiffness) * 0.1
            stiffness = K * 10.0 ** random.uniform(-2, 0.1, 30)
            damping = random.uniform(-0.2, 1.5, 30) * (abs(float(np.nan_to_num(top.virtual_damping))) + size)
            yield from flatten(f"{name}.max_stiffness", top)
            for question in ("is_stable", "decide_stability", "spectral_radius", "poles"):
                yield from ask(f"{name}.{question}", getattr(scene, question), stiffness, damping)
            for question in ("is_passive", "passivity_margin"):
                yield from ask(f"{name}.{question}", getattr(scene, question), stiffness, damping)
            yield from ask(f"{name}.stable_stiffness", scene.stable_stiffness, damping)
            for question in ("state_space", "open_loop"):
                yield from ask(f"{name}.{question}", getattr(scene, question), stiffness[0], damping[0])
            yield from ask(f"{name}.frequency_response", scene.frequency_response, stiffness[0], damping[0], 3.0)
            if k >= 3:
                continue
            yield from ask(f"{name}.margins", scene.margins, stiffness[:2], damping[:2])
            yield from ask(f"{name}.stable_region", scene.stable_region)
            yield from ask(f"{name}.sensitivities", scene.sensitivities)
            yield from ask(f"{name}.required", scene.required, "damping", 0.8 * K)
            yield from ask(f"{name}.best_damping", scene.best_damping, 0.5 * K)
            yield from ask(f"{name}.limits_of", zwidth.limits_of, scene)
            wall = scene.replace(wall=zwidth.VirtualWall(float(stiffness[0]), float(damping[0])))
            yield from ask(f"{name}.assess", zwidth.assess, wall)
            yield from ask(f"{name}.simulate", simulate, scene, stiffness[:3], damping[:3])


def simulate(scene: zwidth.Scene, stiffness: np.ndarray, damping: np.ndarray) -> dict[str, Any]:
    """Return the amplitude, outcome and final position of a simulation."""
    motion = scene.simulate(
        stiffness, damping, start_velocity=0.1, external_force=1.0, contact="unilateral", periods=300
    )
    return {"end": motion.position[..., -1], "amplitude": motion.amplitude, "outcome": motion.outcome}


_DEVICE = ("--mass", "100 g", "--damping", "10", "--period", "1 ms", "--delay", "1 ms")
_WALL = ("--stiffness", "10 kN/m", "--virtual-damping", "40")
_PARTS = {
    "rigid": (),
    "filter": ("--velocity-cutoff", "100 Hz"),
    "window": ("--velocity-samples", "15"),
    "hand": ("--operator-mass", "500 g", "--operator-damping", "5"),
    "tip": ("--coupling-mass", "50 g", "--coupling-stiffness", "20 kN/m"),
}


def commands() -> Answers:
    """Yield the JSON and text output of every command that prints JSON."""
    for name, parts in _PARTS.items():
        yield from run_command(f"check, {name}", "check", *_DEVICE, *_WALL, *parts)
        yield from run_command(f"ridge, {name}", "ridge", *_DEVICE, *parts)
    yield from run_command("ridge, normalized", "ridge", "--delta", "0.1", "--d", "1")
    yield from run_command("devices", "devices")
    yield from run_command("fit", "fit", str(ROOT / "configs" / "fit_log.csv"))


def run_command(name: str, *arguments: str) -> Answers:
    """Yield the output of a command with and without --json."""
    told = CliRunner().invoke(cli, [*arguments, "--json"])
    yield f"{name}.exit", np.array(told.exit_code)
    if told.exit_code == 0:
        yield from flatten(name, json.loads(told.stdout))
    yield f"{name}.text", np.array(CliRunner().invoke(cli, [*arguments]).output)


def configurations() -> Answers:
    """Yield the SHA-256 of every data file that the shipped configurations write."""
    for path in sorted((ROOT / "configs").glob("*.yaml")):
        folder = Path(tempfile.mkdtemp())
        try:
            told = zwidth.run(path, out=folder / "out")
            yield f"{path.name}.ok", np.array(told.ok)
            for file in sorted((folder / "out").rglob("*")):
                if (
                    file.is_file()
                    and ".locks" not in file.parts
                    and file.name not in _TIMES
                    and file.suffix not in _PICTURES
                ):
                    digest = hashlib.sha256(file.read_bytes()).hexdigest()
                    yield f"{path.name}/{file.relative_to(folder / 'out')}", np.array(digest)
        finally:
            shutil.rmtree(folder)


PARTS = {part.__name__: part for part in (functions, scenes, commands, configurations)}


def keep(target: Path, parts: list[str]) -> None:
    """Compute all results once and save them."""
    answers = {f"{part}/{name}": value for part in parts or PARTS for name, value in PARTS[part]()}
    # Names contain slashes, which would become folders in the archive.
    values = {str(k): v for k, v in enumerate(answers.values())}
    np.savez_compressed(target, allow_pickle=False, names=np.array(list(answers)), **values)
    print(f"{len(answers)} answers in {target}")


def compare(old: Path, new: Path) -> bool:
    """Print the differences between two files; return True if there are none."""
    first, second = (read(path) for path in (old, new))
    same = True
    for name in sorted(first.keys() | second.keys()):
        if name not in first or name not in second:
            same = False
            print(f"{name}: only in {old if name in first else new}")
            continue
        a, b = first[name], second[name]
        numbers = a.dtype.kind in "fc" and b.dtype.kind in "fc"
        if a.shape == b.shape and (np.array_equal(a, b, equal_nan=True) if numbers else np.array_equal(a, b)):
            continue
        same = False
        if a.shape != b.shape or not numbers:
            print(f"{name}: {shorten(a)} became {shorten(b)}")
        else:
            away, gone = np.abs(a - b), int(np.sum(np.isnan(a) != np.isnan(b)))
            size = np.nanmax(np.abs(a), initial=1e-300)
            print(f"{name}: {np.nanmax(away, initial=0.0) / size:.2g} of the largest; NaN changes {gone}")
    print("nothing differs" if same else "answers differ")
    return same


def read(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as file:
        return {str(name): file[str(k)] for k, name in enumerate(file["names"])}


def shorten(value: np.ndarray) -> str:
    text = str(value.tolist())
    return text if len(text) < 80 else f"{text[:77]}..."


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("keep", "compare"))
    parser.add_argument("file", type=Path)
    parser.add_argument("more", nargs="*")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    if given.action == "keep":
        keep(given.file, given.more)
    elif not compare(given.file, Path(given.more[0])):
        sys.exit(1)


if __name__ == "__main__":
    main()
