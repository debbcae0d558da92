"""Array types for annotations, with names of axes in the notation of jaxtyping.

``*points`` stands for any number of axes of walls or devices. An axis with ``#`` is broadcast: it may have length 1 or
be absent. An axis whose name begins with ``_`` may have different lengths in different arguments.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Complex, Float, Inexact, Integer, Num
else:
    # Do not import jaxtyping at run time, because the import is slow and nothing checks the types then. The test
    # tests/project/test_types.py checks them.
    Complex = Float = Inexact = Integer = Num = Annotated

# Array of any shape: of NumPy or JAX, traced or not, or a number.
Array: TypeAlias = Any
# Argument of a public function, broadcast with the other arguments; numbers and lists are accepted, too.
ArrayLike: TypeAlias = Num[Any, "*#points"]
# One real number per point: an argument of a kernel, whose arguments all have the same shape.
Reals: TypeAlias = Float[Array, "*points"]
# One nonnegative integer per point, for numbers of items.
Counts: TypeAlias = Integer[Array, "*points"]
# Coefficients of a polynomial per point, highest power first.
Coefficients: TypeAlias = Inexact[Array, "*points coefficients"]
# Zeros or poles, in no particular order.
Roots: TypeAlias = Complex[Array, "*points roots"]
# Zeros or poles in an argument of a public function.
RootsLike: TypeAlias = Num[Any, "*#points _roots"]
# Zeros or poles along the first axis, for kernels that iterate over them.
RootsFirst: TypeAlias = Complex[Array, "roots *points"]
# Bound on the error of each root.
Radii: TypeAlias = Float[Array, "*points roots"]
# Bound on the error of each root, with the roots along the first axis.
RadiiFirst: TypeAlias = Float[Array, "roots *points"]
# Companion matrices.
Matrices: TypeAlias = Inexact[Array, "*points roots roots"]
# Values along a curve.
Vertices: TypeAlias = Float[np.ndarray, "vertices"]
# Values along time.
Samples: TypeAlias = Float[np.ndarray, "samples"]
