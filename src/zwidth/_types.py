"""Array aliases used in annotations."""

from __future__ import annotations

from typing import Any, Literal, TypeAlias

# NumPy arrays, JAX arrays, traced values and plain numbers are all accepted and told apart at run time.
ArrayLike: TypeAlias = Any
Array: TypeAlias = Any
DelayModel: TypeAlias = Literal["held", "fractional_power"]

DELAY_MODELS: tuple[DelayModel, ...] = ("held", "fractional_power")
