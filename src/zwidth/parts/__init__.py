"""The parts of a loop, each in one file with its source, its equations and its units; values are checked where made."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules={"devices"})
