"""Study "published": all numbers printed in the paper compared with computed ones.

A printed number agrees if the computed one is within half a unit of its last digit. In addition, the study computes
more precise values of numbers that the paper gives roughly or not at all ("sharpened"). Symbols of the paper: alpha,
beta, delta and d are normalized stiffness, virtual damping, physical damping and delay; g is the limit of
alpha_max/delta for strong damping; phi1, phi2, psi and c are the coefficients of the sampled mass (docs/theory/model).
P(z) is the characteristic polynomial. The corner at z = -1 is the end of the boundary curve, at omega = pi.

References:
    Hulin, Preusche, Hirzinger 2006, Stability Boundary for Haptic Rendering: Influence of Physical Damping.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from decimal import Decimal
from typing import Any, Literal

import numpy as np

from zwidth.analysis.scene import Scene
from zwidth.config.scenes import AnyScene
from zwidth.config.study import register
from zwidth.model.device import Device
from zwidth.model.timing import Timing
from zwidth.model.velocity import WindowedDifference
from zwidth.numerics.root_finding import bisect
from zwidth.stability.rigid.boundary import boundary
from zwidth.stability.rigid.normalization import normalize
from zwidth.stability.rigid.ridge import alpha_max, stiffness_slope
from zwidth.studies.outcome import ComputedStudy, Outcome
from zwidth.studies.paper_figures import limit_slope, maximize_alpha
from zwidth.units.formatting import with_unit

SOURCE = "Hulin, Preusche, Hirzinger: Stability Boundary for Haptic Rendering: Influence of Physical Damping, 2006"

# Parameters of the example in section VIII of the paper
MASS = 0.1  # kg; mass of the device
PERIOD = 1e-3  # s; sampling period
DELAY_FACTOR = 1  # sampling periods; delay d
DAMPINGS = (0.0, 10.0, 100.0)  # N s/m; physical dampings of the three devices
STIFFNESS_FRACTION = 0.75  # stiffness of the walls as a fraction of alpha_max
MASSIE_SALISBURY = 3.5e3  # N/m; maximum stiffness of the PHANToM, which section VIII cites from Massie and Salisbury
SLOPE_DELAYS = (0.0, 1.0, 2.0, 4.0)  # sampling periods; delays d of Fig. 5, and the integer ones of Fig. 10
FIG10_DELAYS = (0.0, 0.125, 0.25, 0.5, 1.0, 2.0, 4.0)  # sampling periods; delays d of Fig. 10
LINEAR_WITHIN = 0.1  # largest relative difference between d alpha_max/d delta and its limit g that counts as linear
FILTER_LAG = 0.05  # s; lag of the velocity filter, cited in section VIII
_LINE_APPEARS = "delta above which the line appears for d = 0"
_LINEAR_FROM = (
    f"delta above which alpha_max is linear: derivative within {100 * LINEAR_WITHIN:g} % of g, all curves of Fig. 10"
)


@dataclass(frozen=True)
class Comparison:
    """A number printed in the paper, and its computed value; None if the paper cites the number from another paper."""

    quantity: str  # description of the number
    where: str  # equation or section of the paper
    printed: str  # number with the digits that the paper prints
    computed: float | None
    note: str = ""  # note on a cited number

    @property
    def agrees(self) -> bool | None:
        """True if both numbers agree within half a unit of the last printed digit; None for a cited number."""
        if self.computed is None:
            return None
        if not np.isfinite(self.computed):
            return False
        printed = Decimal(self.printed)
        return abs(Decimal(self.computed) - printed) <= Decimal(5).scaleb(int(printed.as_tuple().exponent) - 1)


@dataclass(frozen=True)
class Sharpened:
    """A computed value of a number that the paper gives roughly or not at all, and the method of its computation."""

    quantity: str  # description of the number
    where: str  # equation or remark of the paper, with its rough value
    computed: float
    how: str  # method of the computation


def published_numbers() -> list[Comparison]:
    """Return a comparison for each number printed in the paper, except for its inputs.

    Inputs are the parameters of the example in section VIII and those of the figures.
    """
    deltas = [float(normalize(mass=MASS, damping=damping, period=PERIOD).delta) for damping in DAMPINGS]
    ridge = [_maximize_alpha(delta, DELAY_FACTOR) for delta in deltas]
    columns = (
        ("delta", ("0", "0.1", "1"), deltas),
        ("0.75 alpha_max", ("0.108", "0.149", "0.656"), [STIFFNESS_FRACTION * alpha for alpha, _ in ridge]),
        ("beta at alpha_max", ("0.425", "0.416", "0.388"), [beta for _, beta in ridge]),
    )
    undamped, damped = (STIFFNESS_FRACTION * _maximize_alpha(delta, DELAY_FACTOR)[0] for delta in (0.0, 1.0))
    over_practice = undamped * MASS / PERIOD**2 / MASSIE_SALISBURY
    return [
        # The next two numbers are K_max T^2/m without physical damping, which remark 4 of the paper prints.
        Comparison("alpha_max(delta = 0, d = 0)", "eq. (24)", "0.6863", _maximize_alpha(0.0, 0)[0]),
        Comparison("alpha_max(delta = 0, d = 1)", "eq. (25)", "0.1445", _maximize_alpha(0.0, 1)[0]),
        *(
            Comparison(f"{name}, b = {damping:g} N s/m", "section VIII", text, computed)
            for name, printed, values in columns
            for damping, text, computed in zip(DAMPINGS, printed, values, strict=True)
        ),
        Comparison("stiffness for b = 100 N s/m over that for b = 0", "section VIII", "6", damped / undamped),
        Comparison("stiffness for b = 0 over 3.5 kN/m", "section VIII", "3", over_practice),
        Comparison(_LINE_APPEARS, "section V, remark 3", "2.3", line_appears()),
        Comparison(_LINEAR_FROM, "section VII", "6", linear_from()),
        Comparison("K_max of a PHANToM in kN/m", "section VIII", "3.5", None, "cited from [11]"),
        Comparison("lag of its velocity filter in ms", "section VIII", "50", None, f"cited from [12]; {_with_lag()}"),
    ]


def _with_lag() -> str:
    """Return a text with K_max and its B without and with `FILTER_LAG`, for the undamped device of section VIII."""
    scene = Scene(Device(MASS), Timing(period=PERIOD, delay=DELAY_FACTOR * PERIOD))
    # Use a window of 2 FILTER_LAG/T differences, because the mean of n differences lags by n/2 sampling periods T.
    walls = [scene, scene.replace(velocity=WindowedDifference(round(2 * FILTER_LAG / PERIOD)))]
    before, after = (wall.max_stiffness() for wall in walls)
    return (
        f"for b = 0 it reduces K_max from {with_unit(before.stiffness, 'N/m')} to "
        f"{with_unit(after.stiffness, 'N/m')}, and B at K_max from {with_unit(before.virtual_damping, 'N s/m')} to "
        f"{with_unit(after.virtual_damping, 'N s/m')}"
    )


def _maximize_alpha(delta: float, d: float) -> tuple[float, float]:
    """Return the maximum stable alpha of a rigid device, and the beta of this wall."""
    point = alpha_max(delta, d)
    return float(point.alpha), float(point.beta)


def line_appears() -> float:
    """Compute the delta above which, for d = 0, walls with a real pole at z = -1 bound the stable set."""
    # Import scipy.optimize here, because it loads slowly and no other study needs it.
    from scipy.optimize import root_scalar

    # In the plane of alpha and beta, the walls with a real pole at z = -1 form a straight line. It starts at the
    # corner, where the boundary curve ends with two poles at z = -1. The line therefore bounds the stable set (alpha >
    # 0) above the delta at which the alpha of the corner becomes positive. Set the tolerances of the search for this
    # delta to a few rounding errors, because the page of results prints 15 digits.
    exact: dict[str, Any] = {"bracket": (1.0, 6.0), "method": "brentq", "xtol": 1e-15, "rtol": 1e-15}
    return float(root_scalar(lambda delta: float(boundary(np.pi, delta, 0).alpha), **exact).root)


def linear_from() -> float:
    """Compute the delta above which d alpha_max/d delta is within 10 % of its limit g for every curve of Fig. 10.

    Fractional delays are modeled as fractional powers of z, as in the paper.
    """
    limit = np.array([limit_slope(d) for d in FIG10_DELAYS])

    def excess(delta: np.ndarray) -> np.ndarray:
        """Return the largest relative difference of d alpha_max/d delta from g on all curves, minus the tolerance."""
        step = 0.008  # step of delta in fourth-order central differences, whose errors move the root by 2e-10
        deltas = np.asarray(delta)[..., None] + step * np.array([-2.0, -1.0, 1.0, 2.0])
        values = np.array([maximize_alpha(deltas, d)[0] for d in FIG10_DELAYS])
        derivatives = values @ np.array([1.0, -8.0, 8.0, -1.0]) / (12.0 * step)
        return np.abs(derivatives.T / limit - 1.0).max(axis=-1) - LINEAR_WITHIN

    grid = np.linspace(0.1, 50.0, 1000)
    last = np.flatnonzero(excess(grid) > 0)[-1]
    return float(bisect(lambda delta: excess(delta) > 0, grid[last], grid[last + 1]))


def corner_takes_over() -> float:
    """Compute the delta above which, for d = 0, the stiffest stable wall is in the corner at z = -1."""
    # For d = 0 the boundary curve is a function of beta,
    # ``alpha = (1 - c + beta (phi2 + c psi) - beta^2 psi phi1)/(psi (1 + phi2 beta))``. Its maximum reaches the
    # corner, where the curve ends, at the delta for which ``d alpha/d beta = 0`` in the corner.
    # Use extended precision if the machine has it, because rounding errors of float64 affect the last two digits.
    return float(bisect(lambda delta: _slope_at_corner(delta) < 0, np.longdouble(2.5), np.longdouble(6.0)))


def _slope_at_corner(delta: np.longdouble) -> np.longdouble:
    """Return the numerator of d alpha/d beta at the corner for d = 0, where P(-1) = P'(-1) = 0 determines beta."""
    c = np.exp(-delta)
    # Compute the quotients without series for small delta, because delta >= 2.5 and no digits cancel.
    p1 = -np.expm1(-delta) / delta
    p2 = (1 - p1) / delta
    psi = p1 - p2
    gap = p2 - psi
    beta = (1 + c) / gap * (1 - 2 * (1 + 1 / (1 + c) - p2 / gap))
    numerator = (1 - c) + beta * (p2 + c * psi) - beta**2 * psi * p1
    denominator = psi * (1 + p2 * beta)
    return ((p2 + c * psi) - 2 * beta * psi * p1) * denominator - numerator * psi * p2


def sharpened_numbers() -> list[Sharpened]:
    """Return more precise values of numbers that the paper gives roughly or not at all, each with its method."""
    alpha, beta = _maximize_alpha(0.0, 0)
    slopes = np.asarray(stiffness_slope(np.array(SLOPE_DELAYS)))
    return [
        Sharpened(
            "delta above which the line z = -1 bounds the stable region, d = 0",
            "remark 3: 'delta > 2.3'",
            line_appears(),
            "root of alpha at the curve's end, omega = pi",
        ),
        Sharpened(
            "delta above which alpha_max is the corner at z = -1, d = 0",
            "not in the paper",
            corner_takes_over(),
            "root of d alpha/d beta at the curve's end, omega = pi",
        ),
        Sharpened("alpha_max(delta = 0, d = 0)", "eq. (24): 0.6863", alpha, "exactly 12 - 8 sqrt(2)"),
        Sharpened("beta at alpha_max(delta = 0, d = 0)", "not in the paper", beta, "exactly 2 sqrt(2) - 2"),
        *(
            Sharpened(f"slope g, d = {d:g}", "eq. (22), no number", float(slope), "limit of alpha_max/delta")
            for d, slope in zip(SLOPE_DELAYS, slopes, strict=True)
        ),
    ]


def as_json(printed: list[Comparison], sharpened: list[Sharpened]) -> str:
    """Return the printed and the sharpened numbers, and the inputs of the paper, as the text of a JSON file."""
    given = {"where": "section VIII", "mass_kg": MASS, "period_s": PERIOD, "d": DELAY_FACTOR}
    content = {
        "source": SOURCE,
        "all_agree": all(row.agrees is not False for row in printed),
        "given": {**given, "damping_N_s_per_m": list(DAMPINGS), "stiffness_fraction": STIFFNESS_FRACTION},
        "published": [{**asdict(row), "agrees": row.agrees} for row in printed],
        "sharpened": [asdict(row) for row in sharpened],
    }
    return json.dumps(content, indent=2) + "\n"


_AGREEMENT = {True: "yes", False: "**NO**", None: "cited"}


def _spell(row: Comparison) -> str:
    """Return the computed number of a row as text with ten digits, or the note of a cited number."""
    return row.note if row.computed is None else f"{row.computed:{'#' if row.computed else ''}.10g}"


def as_markdown(printed: list[Comparison], sharpened: list[Sharpened]) -> str:
    """Return a page in Markdown with a table of the printed numbers and a table of the sharpened ones."""
    computed = [row for row in printed if row.computed is not None]
    agreeing = sum(row.agrees is True for row in computed)
    cited = f" Cited from other papers: {len(printed) - len(computed)}." if len(computed) < len(printed) else ""
    lines = [
        "# The paper's numbers, computed",
        "",
        f"{SOURCE}.",
        "",
        f"{len(printed)} printed numbers, {len(computed)} of them results: {agreeing} of {len(computed)} agree.",
        f"A value agrees if it differs from the printed one by at most half a unit of the last printed digit.{cited}",
        "",
        "| quantity | location | printed | computed | agrees |",
        "|---|---|---|---|---|",
        *(
            f"| {row.quantity} | {row.where} | {row.printed} | {_spell(row)} | {_AGREEMENT[row.agrees]} |"
            for row in printed
        ),
        "",
        f"Given in section VIII: m = {MASS:g} kg, T = {PERIOD:g} s, d = {DELAY_FACTOR}, "
        f"b = {', '.join(f'{damping:g}' for damping in DAMPINGS)} N s/m, {100 * STIFFNESS_FRACTION:g} % of alpha_max.",
        "",
        "## More precise values",
        "",
        "| quantity | in the paper | computed | how |",
        "|---|---|---|---|",
        *(f"| {row.quantity} | {row.where} | {row.computed:.15f} | {row.how} |" for row in sharpened),
        "",
    ]
    return "\n".join(lines)


@register
class PublishedStudy(ComputedStudy):
    """The numbers that are printed in the paper, for comparison with the printed values."""

    method = "The paper's numbers, from closed forms."
    from_scene = ()

    kind: Literal["published"]

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        printed, sharpened = published_numbers(), sharpened_numbers()
        texts = {"md": as_markdown(printed, sharpened), "json": as_json(printed, sharpened)}
        disagreeing = (row for row in printed if row.agrees is False)
        notes = tuple(f"{row.quantity}: printed {row.printed}, computed {row.computed:.10g}" for row in disagreeing)
        return Outcome(documents={f"{self.name}.{ending}": text for ending, text in texts.items()}, notes=notes)
