"""Allowed errors of computed values: one tolerance per quantity and precision, each with its reason.

A tolerance may be loosened only with a documented cause. "Condition" is the effect of a relative change of
every input by one rounding error on the exact result, below which no algorithm can be accurate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

EPS64 = 2.0**-52
EPS32 = 2.0**-23


@dataclass(frozen=True)
class Tolerance:
    """The largest allowed error in each precision, and the reason why it is not smaller."""

    float64: float
    reason: str
    # NaN: the quantity is not available in float32, because it is computed outside of JAX only.
    float32: float = math.nan


def rounding_errors(count: float, reason: str) -> Tolerance:
    """Return a tolerance of ``count`` rounding errors in both precisions."""
    return Tolerance(count * EPS64, reason, count * EPS32)


PHI = rounding_errors(4, "Relative. One exponential, one Horner sum of positive terms, one product.")
PHI_SLOPE = rounding_errors(16, "Relative. Autodiff adds two or three rounded products, which cancel by up to half.")
PHI_CURVATURE = rounding_errors(24, "Relative. As PHI_SLOPE, with four or five rounded products.")

PLANT = rounding_errors(4, "Relative, where e^-delta does not underflow. Sums of positive terms: no cancellation.")
TRANSFER = rounding_errors(8, "Relative. As PHI, plus the products with T^2/m.")
COEFFICIENT = rounding_errors(4, "Relative to the sum of the magnitudes of its terms, which may cancel for some walls.")

BOUNDARY = rounding_errors(8, "In units of the condition: measured below 4 over 10,000 points up to d = 500.")
BOUNDARY_LIMIT = rounding_errors(4, "Relative, at omega -> 0 and at pi, where the value is a short formula of delta.")
BOUNDARY_SLOPE = Tolerance(
    1e-12, "Relative to the gradient's norm: autodiff of the closed form divides by its norm twice.", 1e-4
)
BOUNDARY_POINT = Tolerance(
    1e-12,
    "Relative to |alpha| + |beta| or the wall's condition if larger: Newton's method converges to within 16 "
    "rounding errors of the residual. Near the ridge the line of constant alpha is nearly tangent to the curve, which "
    "squares the condition.",
)

POLE = Tolerance(1e-12, "Relative, for simple poles: Newton's last step in the factored form, times its condition.")
DOUBLE_POLE = Tolerance(
    1e-7, "Relative. An error of eps in P changes a double pole by its square root, 1.5e-8, times a constant."
)
REBUILT = Tolerance(
    1e-11, "Relative to the largest coefficient of prod (1 + |z_i| z): expanding 13 factors adds their errors."
)
LABEL_BAND = Tolerance(
    1e-13,
    "|rho - 1| below which labels from poles are not compared: 500 rounding errors, more than the condition of a "
    "simple pole on the unit circle at degree 10.",
)

PASSIVITY = Tolerance(
    1e-12,
    "Relative to |alpha| (d + 1) + |beta| + delta, the size of the terms: golden section has the square root of the "
    "rounding error.",
)
PASSIVE_SLOPE = Tolerance(1e-7, "Golden bracket of 12 rounds narrows beta to 2 * 8^-12; the optimum is a corner.")
PASSIVE_SLOPE_LP = Tolerance(
    1e-6, "The linear program has 20,000 frequencies; between two of them its bound is too large by the step squared."
)

RESPONSE = Tolerance(
    1e-11, "Relative to the largest sample: rounding errors of 200 periods accumulate in both implementations."
)

AREA_GRID = Tolerance(
    0.01, "Relative: a grid of 200 x 200 cells counts each cell on the boundary as inside or outside."
)

PEER = Tolerance(
    1e-10,
    "Relative to the largest coefficient: scipy's expm of [[A, B], [0, 0]] and control's transfer-function algebra "
    "multiply matrices whose entries differ by up to 1e6.",
)
NORMALIZED = rounding_errors(4, "Relative: two or three rounded products and quotients.")

RIDGE = Tolerance(2e-15, "Relative, ten rounding errors: at a maximum an error of omega enters squared.", 4e-6)
RIDGE_BETA = Tolerance(4e-15, "Relative to |alpha| + |beta|: beta is a difference of terms of that size.", 1e-5)
RIDGE_OMEGA = Tolerance(
    4e-15,
    "Relative, times 1 + 1/(pi - omega): near the corner delta determines cos^2(omega/2) up to a rounding error.",
    1e-5,
)
RIDGE_SLOPE = Tolerance(1e-12, "Relative; for derivatives with cancellation, see RIDGE_SLOPE_FLOOR.", 1e-4)
RIDGE_SLOPE_FLOOR = Tolerance(
    1e-15,
    "Relative to |alpha| + |beta| divided by the unit of the variable: terms of that size are rounded and subtracted.",
)
RIDGE_CURVATURE = Tolerance(
    1e-11, "Relative, in addition to RIDGE_CURVATURE_FLOOR: implicit derivatives divide by alpha'' once."
)
RIDGE_CURVATURE_FLOOR = rounding_errors(
    24,
    "Relative to |alpha| + |beta| divided by the units of both variables: about 20 terms of that size are added. At"
    " delta = 1e6 the largest error was 22.6.",
)
LIMIT_SLOPE = rounding_errors(8, "Relative: the same method as RIDGE, on a plant of three numbers.")

JUDGE = Tolerance(
    1e-9,
    "Relative to the largest value. Integration with 1e-12 per step over some hundred steps, with growing rounding "
    "errors.",
)

LEAST_DAMPING = Tolerance(
    1e-9, "Relative: a generalized eigenvalue of forms with condition (periods)^2, and the condition's own 1e-13."
)

GROWTH_SIMULATED = Tolerance(
    1e-6,
    "Relative, of the growth per period: share of other poles (1e-10 of the response), divided by the angle of the "
    "dominant pole between samples. Measured below 3e-8 over 28,000 walls.",
)
SIMULATED_LINEAR = Tolerance(
    1e-11,
    "Relative to the largest position: 60 periods by two matrix exponentials, with rates up to 100 per period.",
)
ENERGY_KEPT = Tolerance(
    1e-12, "Relative to the largest energy term: rounding errors of hundreds of periods; measured below 4e-14."
)
FRICTION_TRUTH = Tolerance(
    1e-13, "Relative: the instant of a stop, after some tens of periods, is found up to its last bit."
)
SIMULATED_AGAIN = Tolerance(
    1e-12, "Relative to the largest position: the same simulation in a batch, where sums are rounded in another order."
)

CONTOUR = Tolerance(
    0.01, "Of the spectral radius: interpolated linearly between the points of a grid of some dozens per side."
)
EDGE_RADIUS = Tolerance(
    1e-7, "Of the spectral radius minus 1: at double poles, as at a corner, half of the digits are rounding errors."
)

FIT_EXACT = Tolerance(
    1e-9,
    "Relative: a device fitted to exact walls or an exact log. The condition of the fit, up to 1e4, times the "
    "rounding errors of the data; measured below 4e-13 over 500 devices for walls, 2e-11 for logs.",
)
FIT_AGAIN = Tolerance(
    1e-6, "Relative: another least-squares solver stops at a vanishing difference quotient of its derivatives."
)
