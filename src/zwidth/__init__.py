"""Stability of haptic virtual walls: boundaries, the stiffest stable wall, passivity, and sweeps of them.

Names are loaded on first use, so that `import zwidth` and the command line's help need no JAX.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from zwidth.errors import ConfigError as ConfigError
    from zwidth.errors import InputError as InputError
    from zwidth.errors import StoreExistsError as StoreExistsError
    from zwidth.errors import ZwidthError as ZwidthError
    from zwidth.loop import char_poly as char_poly
    from zwidth.scene import Device as Device
    from zwidth.scene import Scene as Scene
    from zwidth.scene import Timing as Timing
    from zwidth.scene import VirtualWall as VirtualWall
    from zwidth.scene import denormalize as denormalize
    from zwidth.scene import normalize as normalize
    from zwidth.stability.poles import poles as poles
    from zwidth.stability.ridge import alpha_max as alpha_max
    from zwidth.status import Status as Status

# public name -> the module that defines it
_HOME = {
    "ConfigError": "zwidth.errors",
    "InputError": "zwidth.errors",
    "StoreExistsError": "zwidth.errors",
    "ZwidthError": "zwidth.errors",
    "Device": "zwidth.scene",
    "Scene": "zwidth.scene",
    "Timing": "zwidth.scene",
    "VirtualWall": "zwidth.scene",
    "denormalize": "zwidth.scene",
    "normalize": "zwidth.scene",
    "Status": "zwidth.status",
    "char_poly": "zwidth.loop",
    "poles": "zwidth.stability.poles",
    "alpha_max": "zwidth.stability.ridge",
}

__all__ = ["__version__", *_HOME]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'zwidth' has no attribute {name!r}")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
