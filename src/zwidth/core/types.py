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
# One nonnegative integer per point, such as a number of poles.
Counts: TypeAlias = Integer[Array, "*points"]
# Coefficients of a polynomial per point, highest power first.
Coefficients: TypeAlias = Inexact[Array, "*points coefficients"]
# Zeros or poles of each point along the last axis, in no particular order.
Roots: TypeAlias = Complex[Array, "*points roots"]
# Zeros or poles as an argument of a public function; numbers and lists are accepted, too.
RootsLike: TypeAlias = Num[Any, "*#points _roots"]
# Zeros or poles along the first axis, for kernels that iterate over them.
RootsFirst: TypeAlias = Complex[Array, "roots *points"]
# Bound on the error of each root, with the roots along the last axis.
Radii: TypeAlias = Float[Array, "*points roots"]
# Bound on the error of each root, with the roots along the first axis.
RadiiFirst: TypeAlias = Float[Array, "roots *points"]
# One companion matrix per point, a square matrix whose eigenvalues are the roots of a polynomial.
Matrices: TypeAlias = Inexact[Array, "*points roots roots"]
# One coordinate or other value per vertex of a polygonal curve.
Vertices: TypeAlias = Float[np.ndarray, "vertices"]
# One value per sample of a signal over time.
Samples: TypeAlias = Float[np.ndarray, "samples"]
