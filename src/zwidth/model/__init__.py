"""Models of the parts of a haptic loop: device, actuator, modes, operator, timing, velocity estimate, wall and others.

The module of a part states its equations, units and sources. The constructor of a part checks its values.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules={"devices"})
