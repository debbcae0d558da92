"""The public functions of arrays, each as one case that every test of the contract runs through."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np

import zwidth


@dataclass(frozen=True)
class Case:
    """A function of arrays with three good points and, per argument, a value that is out of range."""

    name: str
    call: Callable[..., Any]
    good: dict[str, list[float]]
    bad: dict[str, float]
    # Arguments that must stay concrete inside a transformation.
    concrete: tuple[str, ...] = ()
    # How many axes the results have beyond those of the arguments.
    extra_axes: int = 0
    # Compiling it once more takes seconds: its own tests trace it.
    heavy: bool = False
    fields: tuple[str, ...] = field(default=())

    @property
    def arguments(self) -> dict[str, np.ndarray]:
        return {name: np.array(values) for name, values in self.good.items()}

    def leaves(self, result: Any) -> dict[str, Any]:
        """The arrays of a result by name."""
        if hasattr(result, "_asdict"):
            return result._asdict()
        assert isinstance(result, np.ndarray | np.generic | jax.Array), type(result)
        return {"value": result}


WALL = {"alpha": [0.05, 0.1, 0.2], "beta": [0.3, 0.4, 0.1], "delta": [0.0, 0.1, 1.5]}
BAD_WALL = {"alpha": np.inf, "beta": np.nan, "delta": -1.0, "d": -0.5}
ONE_DELAY = {"d": [1.0, 1.0, 1.0]}
DEVICE = {"delta": [0.0, 0.1, 1.5], "d": [0.0, 1.0, 2.5]}
SI = {"mass": [0.1, 0.2, 1.0], "period": [1e-3, 1e-3, 2e-3]}


def of_walls(function, name, **options):
    return Case(name, function, {**WALL, **ONE_DELAY}, BAD_WALL, concrete=("d",), **options)


CASES = [
    Case(
        "normalize",
        zwidth.normalize,
        {**SI, "damping": [0.0, 10.0, 5.0], "delay": [0.0, 1e-3, 3e-3], "stiffness": [1e3, 5e3, 0.0]},
        {"mass": 0.0, "damping": -1.0, "delay": np.nan},
    ),
    Case("denormalize", zwidth.denormalize, {**SI, **WALL}, {"mass": -1.0, "delta": np.nan}),
    of_walls(zwidth.char_poly, "char_poly", extra_axes=1),
    of_walls(zwidth.poles, "poles", extra_axes=1),
    Case("spectral_radius", zwidth.spectral_radius, {**WALL, **ONE_DELAY}, BAD_WALL),
    Case("decay_rate", zwidth.decay_rate, {**WALL, **ONE_DELAY}, BAD_WALL),
    of_walls(zwidth.is_stable, "is_stable"),
    Case("is_passive", zwidth.is_passive, {**WALL, **ONE_DELAY}, BAD_WALL),
    Case("passivity_margin", zwidth.passivity_margin, {**WALL, **ONE_DELAY}, BAD_WALL),
    Case("margins", zwidth.margins, {**WALL, **ONE_DELAY}, BAD_WALL, heavy=True),
    Case(
        "boundary",
        zwidth.boundary,
        {"omega": [0.0, 0.5, 3.0], **DEVICE},
        {"omega": 3.5, "delta": -1e-9, "d": np.inf},
    ),
    Case(
        "boundary_point",
        lambda alpha, delta, d: zwidth.boundary_point(delta, d, alpha=alpha),
        {"alpha": [0.3, 0.1, 0.05], **DEVICE},
        {"alpha": np.nan, "delta": -1.0, "d": np.inf},
        heavy=True,
    ),
    Case("alpha_max", zwidth.alpha_max, DEVICE, {"delta": -1.0, "d": np.nan}),
    Case(
        "max_stiffness",
        zwidth.max_stiffness,
        {**SI, "damping": [0.0, 10.0, 5.0], "delay": [0.0, 1e-3, 3e-3]},
        {"mass": -1.0, "damping": -1.0, "delay": np.nan},
    ),
    Case("stiffness_slope", zwidth.stiffness_slope, {"d": [0.0, 1.0, 2.5]}, {"d": -1.0}),
]

# Public functions that take no arrays point by point: their own tests hold their contract.
OTHERS = {
    "use_compilation_cache": "a setting",
    "margins": "a tuple of margins: its own tests",
    "count_poles": "any linear loop: its own tests",
    "allowed_delay": "design questions are slow to compile: their own tests cover batches, bad entries and tracing",
    "assess": "one scene",
    "fastest_damping": "a design question",
    "fastest_wall": "a design question",
    "load_config": "a file",
    "modulus_margin": "a design question",
    "most_robust_damping": "a design question",
    "open_dataset": "a folder",
    "passive_area": "a design question",
    "required_damping": "a design question",
    "required_mass": "a design question",
    "required_period": "a design question",
    "robust_max_stiffness": "boxes of devices",
    "robust_wall": "boxes of devices",
    "run": "a configuration",
    "sensitivities": "a design question",
    "stable_area": "a design question",
    "stability_of": "is_stable with its status; tested beside the methods",
    "stable_region": "one device",
    "step_response": "one wall",
}
