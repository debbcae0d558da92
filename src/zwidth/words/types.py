"""What arrays are in annotations, with the meaning of their axes in jaxtyping's notation.

``*points`` are the axes of the walls or devices, however many; ``#`` lets an axis be 1 or absent where others have it;
a name that begins with ``_`` may differ from one argument to the next.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Complex, Float, Inexact, Integer, Num
else:
    # Loading jaxtyping takes time, and nothing is checked while the program runs; tests/project/test_types.py does.
    Complex = Float = Inexact = Integer = Num = Annotated

# Of any shape. NumPy's arrays and numbers, JAX's and traced ones are all accepted and told apart at run time.
Array: TypeAlias = Any
# What a caller gives, plain numbers and lists as well: it broadcasts with the other arguments.
ArrayLike: TypeAlias = Num[Any, "*#points"]
# One real number a point: what kernels take, all arguments of one shape.
Reals: TypeAlias = Float[Array, "*points"]
# How many, one whole number a point.
Counts: TypeAlias = Integer[Array, "*points"]
# Of a polynomial, highest power first.
Coefficients: TypeAlias = Inexact[Array, "*points coefficients"]
# Zeros or poles, in no particular order; those that a caller gives; and those of a kernel that goes over the poles.
Roots: TypeAlias = Complex[Array, "*points roots"]
RootsLike: TypeAlias = Num[Any, "*#points _roots"]
RootsFirst: TypeAlias = Complex[Array, "roots *points"]
# The distance within which each root is.
Radii: TypeAlias = Float[Array, "*points roots"]
RadiiFirst: TypeAlias = Float[Array, "roots *points"]
# Companion matrices.
Matrices: TypeAlias = Inexact[Array, "*points roots roots"]
# Along a curve, and along time.
Vertices: TypeAlias = Float[np.ndarray, "vertices"]
Samples: TypeAlias = Float[np.ndarray, "samples"]
