"""Stability of haptic virtual walls: boundaries, maximum stiffness, passivity, margins, simulation, and sweeps.

The public names are loaded on first use, so that `import zwidth` and the help of the command line do not load JAX.
"""

import lazy_loader

__version__ = "0.1.0"

# The stub __init__.pyi lists the public names and the modules that define them.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
