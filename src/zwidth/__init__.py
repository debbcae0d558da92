"""Stability of haptic virtual walls: boundaries, the stiffest stable wall, passivity, and sweeps of them.

Names are loaded on first use, so that `import zwidth` and the command line's help need no JAX.
"""

import lazy_loader

__version__ = "0.1.0"

# The names stand in __init__.pyi.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
