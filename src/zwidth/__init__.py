"""Stability of haptic virtual walls: boundaries, the stiffest stable wall, passivity, and sweeps of them.

Names are loaded on first use, so that `import zwidth` and the command line's help need no JAX.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from zwidth.assessment import Assessment as Assessment
    from zwidth.assessment import assess as assess
    from zwidth.design.area import stable_area as stable_area
    from zwidth.design.damping import DampingChoice as DampingChoice
    from zwidth.design.damping import FastestWall as FastestWall
    from zwidth.design.damping import fastest_damping as fastest_damping
    from zwidth.design.damping import fastest_wall as fastest_wall
    from zwidth.design.damping import most_robust_damping as most_robust_damping
    from zwidth.design.margin import modulus_margin as modulus_margin
    from zwidth.design.passive import passive_area as passive_area
    from zwidth.design.requirements import Requirement as Requirement
    from zwidth.design.requirements import allowed_delay as allowed_delay
    from zwidth.design.requirements import required_damping as required_damping
    from zwidth.design.requirements import required_mass as required_mass
    from zwidth.design.requirements import required_period as required_period
    from zwidth.design.robust import Interval as Interval
    from zwidth.design.robust import RobustStiffness as RobustStiffness
    from zwidth.design.robust import RobustWall as RobustWall
    from zwidth.design.robust import robust_max_stiffness as robust_max_stiffness
    from zwidth.design.robust import robust_wall as robust_wall
    from zwidth.design.stiffness import Sensitivities as Sensitivities
    from zwidth.design.stiffness import max_stiffness as max_stiffness
    from zwidth.design.stiffness import sensitivities as sensitivities
    from zwidth.errors import ConfigError as ConfigError
    from zwidth.errors import InputError as InputError
    from zwidth.errors import PrecisionWarning as PrecisionWarning
    from zwidth.errors import StoreExistsError as StoreExistsError
    from zwidth.errors import TracedDelayError as TracedDelayError
    from zwidth.errors import ZwidthError as ZwidthError
    from zwidth.kernel_cache import use_compilation_cache as use_compilation_cache
    from zwidth.loop import char_poly as char_poly
    from zwidth.response import StepResponse as StepResponse
    from zwidth.response import step_response as step_response
    from zwidth.runs import run as run
    from zwidth.scene import Device as Device
    from zwidth.scene import Scene as Scene
    from zwidth.scene import Timing as Timing
    from zwidth.scene import VirtualWall as VirtualWall
    from zwidth.scene import denormalize as denormalize
    from zwidth.scene import normalize as normalize
    from zwidth.stability.boundary import BoundaryPoint as BoundaryPoint
    from zwidth.stability.boundary import boundary as boundary
    from zwidth.stability.boundary import boundary_point as boundary_point
    from zwidth.stability.counting import count_poles as count_poles
    from zwidth.stability.decay import decay_rate as decay_rate
    from zwidth.stability.labels import is_stable as is_stable
    from zwidth.stability.labels import stability_of as stability_of
    from zwidth.stability.margins import Margins as Margins
    from zwidth.stability.margins import margins as margins
    from zwidth.stability.passivity import is_passive as is_passive
    from zwidth.stability.passivity import passivity_margin as passivity_margin
    from zwidth.stability.poles import poles as poles
    from zwidth.stability.radii import spectral_radius as spectral_radius
    from zwidth.stability.region import StableRegion as StableRegion
    from zwidth.stability.region import stable_region as stable_region
    from zwidth.stability.ridge import RidgeKind as RidgeKind
    from zwidth.stability.ridge import RidgePoint as RidgePoint
    from zwidth.stability.ridge import alpha_max as alpha_max
    from zwidth.stability.slope import stiffness_slope as stiffness_slope
    from zwidth.status import Status as Status
    from zwidth.studies.document import load_config as load_config
    from zwidth.sweep.store import open_dataset as open_dataset

# public name -> the module that defines it
_HOME = {
    "Assessment": "zwidth.assessment",
    "assess": "zwidth.assessment",
    "passive_area": "zwidth.design.passive",
    "stable_area": "zwidth.design.area",
    "DampingChoice": "zwidth.design.damping",
    "FastestWall": "zwidth.design.damping",
    "fastest_damping": "zwidth.design.damping",
    "fastest_wall": "zwidth.design.damping",
    "modulus_margin": "zwidth.design.margin",
    "most_robust_damping": "zwidth.design.damping",
    "Requirement": "zwidth.design.requirements",
    "allowed_delay": "zwidth.design.requirements",
    "required_damping": "zwidth.design.requirements",
    "required_mass": "zwidth.design.requirements",
    "required_period": "zwidth.design.requirements",
    "Interval": "zwidth.design.robust",
    "RobustStiffness": "zwidth.design.robust",
    "RobustWall": "zwidth.design.robust",
    "robust_max_stiffness": "zwidth.design.robust",
    "robust_wall": "zwidth.design.robust",
    "Sensitivities": "zwidth.design.stiffness",
    "max_stiffness": "zwidth.design.stiffness",
    "sensitivities": "zwidth.design.stiffness",
    "ConfigError": "zwidth.errors",
    "InputError": "zwidth.errors",
    "PrecisionWarning": "zwidth.errors",
    "StoreExistsError": "zwidth.errors",
    "TracedDelayError": "zwidth.errors",
    "ZwidthError": "zwidth.errors",
    "use_compilation_cache": "zwidth.kernel_cache",
    "char_poly": "zwidth.loop",
    "StepResponse": "zwidth.response",
    "step_response": "zwidth.response",
    "Device": "zwidth.scene",
    "Scene": "zwidth.scene",
    "Timing": "zwidth.scene",
    "VirtualWall": "zwidth.scene",
    "denormalize": "zwidth.scene",
    "normalize": "zwidth.scene",
    "BoundaryPoint": "zwidth.stability.boundary",
    "boundary": "zwidth.stability.boundary",
    "boundary_point": "zwidth.stability.boundary",
    "count_poles": "zwidth.stability.counting",
    "is_stable": "zwidth.stability.labels",
    "spectral_radius": "zwidth.stability.radii",
    "decay_rate": "zwidth.stability.decay",
    "stability_of": "zwidth.stability.labels",
    "Margins": "zwidth.stability.margins",
    "margins": "zwidth.stability.margins",
    "is_passive": "zwidth.stability.passivity",
    "passivity_margin": "zwidth.stability.passivity",
    "poles": "zwidth.stability.poles",
    "StableRegion": "zwidth.stability.region",
    "stable_region": "zwidth.stability.region",
    "RidgeKind": "zwidth.stability.ridge",
    "RidgePoint": "zwidth.stability.ridge",
    "alpha_max": "zwidth.stability.ridge",
    "stiffness_slope": "zwidth.stability.slope",
    "Status": "zwidth.status",
    "load_config": "zwidth.studies.document",
    "open_dataset": "zwidth.sweep.store",
    "run": "zwidth.runs",
}

__all__ = [
    "Assessment",
    "BoundaryPoint",
    "ConfigError",
    "DampingChoice",
    "Device",
    "FastestWall",
    "InputError",
    "Interval",
    "Margins",
    "PrecisionWarning",
    "Requirement",
    "RidgeKind",
    "RidgePoint",
    "RobustStiffness",
    "RobustWall",
    "Scene",
    "Sensitivities",
    "StableRegion",
    "Status",
    "StepResponse",
    "StoreExistsError",
    "Timing",
    "TracedDelayError",
    "VirtualWall",
    "ZwidthError",
    "__version__",
    "allowed_delay",
    "alpha_max",
    "assess",
    "boundary",
    "boundary_point",
    "char_poly",
    "count_poles",
    "decay_rate",
    "denormalize",
    "fastest_damping",
    "fastest_wall",
    "is_passive",
    "is_stable",
    "load_config",
    "margins",
    "max_stiffness",
    "modulus_margin",
    "most_robust_damping",
    "normalize",
    "open_dataset",
    "passive_area",
    "passivity_margin",
    "poles",
    "required_damping",
    "required_mass",
    "required_period",
    "robust_max_stiffness",
    "robust_wall",
    "run",
    "sensitivities",
    "spectral_radius",
    "stability_of",
    "stable_area",
    "stable_region",
    "step_response",
    "stiffness_slope",
    "use_compilation_cache",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'zwidth' has no attribute {name!r}")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
