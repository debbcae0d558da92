"""What each method costs and how wrong it can be: the cheapest one that honors a tolerance.

The table is measured by ``zwidth bench``. One is shipped with the package; a user's own, where there is one, comes
first. Nothing here computes a pole, and importing it imports no JAX.
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, TypeAlias

from zwidth.errors import InputError

Layout: TypeAlias = Literal["map", "scattered"]
Quantity: TypeAlias = Literal["stable", "spectral_radius"]


@dataclass(frozen=True)
class Cost:
    """One measured entry of the table.

    Attributes:
        quantity: "stable" or "spectral_radius".
        method: as in `zwidth.is_stable` and `zwidth.spectral_radius`.
        dtype: "float64" or "float32".
        layout: "map" or "scattered".
        d: delay in periods.
        first_seconds: what a first call takes longer, compilation above all.
        rate: points a second.
        error: the worst error seen, see `zwidth.bench.suite.Row`.
    """

    quantity: str
    method: str
    dtype: str
    layout: str
    d: float
    first_seconds: float
    rate: float
    error: float


@dataclass(frozen=True)
class Choice:
    """A method, and why it is the one.

    Attributes:
        method: its name.
        dtype: "float64" or "float32".
        error: the error to expect.
        seconds: estimated time for all points, compilation included.
        why: in words.
    """

    method: str
    dtype: str
    error: float
    seconds: float
    why: str


def user_table() -> Path:
    """Where `zwidth bench` puts the table of this machine."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "zwidth" / "accuracy.json"


@cache
def table(*, shipped: bool = False) -> tuple[Cost, ...]:
    """The measured costs: the user's own where there are any, unless only those shipped are asked for.

    Raises:
        InputError: the user's table cannot be read.
    """
    own = user_table()
    if not shipped and own.is_file():
        try:
            return parse(json.loads(own.read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise InputError(
                f"{own}: got a table of costs that cannot be read ({error}); delete it or run zwidth bench again"
            ) from error
    return parse(json.loads(files("zwidth").joinpath("accuracy.json").read_text(encoding="utf-8")))


def parse(document: Any) -> tuple[Cost, ...]:
    """The entries of a table as `zwidth bench` writes it."""
    return tuple(Cost(**entry) for entry in document["costs"])


def choose(
    quantity: Quantity, *, d: float, points: int, layout: Layout, accuracy: float | None, costs: Any = None
) -> Choice:
    """Pick the cheapest method whose measured error is within a tolerance.

    Args:
        quantity: what is asked for.
        d: the longest delay in periods.
        points: how many points.
        layout: "map" where alpha and beta are axes of one device.
        accuracy: for "stable" the relative distance in alpha from the boundary within which a label may be wrong, 0
            for proof; for "spectral_radius" a relative error. None for the most accurate method that is not a proof.
        costs: entries to choose from, `table` by default.

    Returns:
        Choice. Where no method was seen to honor the tolerance, the most accurate one, and ``why`` says so.

    Example:
        >>> choose("stable", d=1, points=10**6, layout="map", accuracy=0.0).method
        'certified'
    """
    if quantity == "stable" and accuracy == 0:
        return Choice("certified", "float64", 0.0, math.nan, "proof was asked for")
    offers = _offers(quantity, d, points, layout, table() if costs is None else costs)
    allowed = [offer for offer in offers if accuracy is None or offer.error <= accuracy]
    if accuracy is None or not allowed:
        best = min(offers, key=lambda offer: (offer.error, offer.seconds))
        why = "the most accurate" if accuracy is None else f"no method was seen to keep {accuracy:g}; the most accurate"
        return Choice(best.method, best.dtype, best.error, best.seconds, why)
    best = min(allowed, key=lambda offer: offer.seconds)
    others = ", ".join(
        f"{offer.method}{' float32' if offer.dtype == 'float32' else ''} {_ratio(offer, best, accuracy)}"
        for offer in sorted(offers, key=lambda offer: offer.seconds)
        if offer is not best
    )
    return Choice(best.method, best.dtype, best.error, best.seconds, f"the cheapest within {accuracy:g} ({others})")


def _ratio(offer: Choice, best: Choice, accuracy: float) -> str:
    if offer.error > accuracy:
        return f"errs by {offer.error:.0e}"
    return f"{offer.seconds / best.seconds:.2g} times the time"


def _offers(quantity: str, d: float, points: int, layout: str, costs: Any) -> list[Choice]:
    """Each method's error and time at this delay: the next measured delay above, or an extrapolation of the last."""
    offers = []
    named = {(cost.method, cost.dtype) for cost in costs if cost.quantity == quantity and cost.layout == layout}
    for method, dtype in sorted(named):
        if method == "certified":
            continue
        mine = sorted(
            (
                cost
                for cost in costs
                if (cost.quantity, cost.layout, cost.method, cost.dtype) == (quantity, layout, method, dtype)
            ),
            key=lambda cost: cost.d,
        )
        above = [cost for cost in mine if cost.d >= d]
        # Beyond what was measured, work that grows with the square of the degree.
        slower = 1.0 if above else ((d + 3.0) / (mine[-1].d + 3.0)) ** 2
        cost = above[0] if above else mine[-1]
        # An error of a near delay is an error of this one.
        error = max(entry.error for entry in mine if entry.d <= cost.d)
        offers.append(Choice(method, dtype, error, cost.first_seconds + slower * points / cost.rate, ""))
    return offers
