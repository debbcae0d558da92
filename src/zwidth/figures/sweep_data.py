"""What the figures of sweeps draw: plain records, made from a store."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from zwidth.quantities import Look


@dataclass(frozen=True)
class Scale:
    """An axis, or a quantity that is drawn by color.

    Attributes:
        name: as in the store.
        symbol: in mathtext, without dollar signs; empty where it has none.
        label: words, symbol and unit.
        unit: of ``values``; empty for a normalized number.
        values: along an axis, ascending or not, shape (N,); empty for a quantity.
        logarithmic: whether an axis is spaced so.
    """

    name: str
    symbol: str
    label: str
    unit: str = ""
    values: np.ndarray = field(default_factory=lambda: np.empty(0))
    logarithmic: bool = False

    def at(self, index: int) -> str:
        """One value of an axis with symbol and unit, for titles and legends."""
        unit = rf"\,\mathrm{{{self.unit.replace(' ', '~')}}}" if self.unit else ""
        return rf"${self.symbol} = {self.values[index]:.4g}{unit}$"


@dataclass(frozen=True)
class Panel:
    """One panel.

    Attributes:
        title: where in the sweep it lies.
        fields: variables by name; for a plane of shape (y, x), for curves of shape (curves, x). NaN, and for truth
            values -1, where a point was not computed.
        peak: the stiffest stable wall in the plane, (x, y).
    """

    title: str
    fields: dict[str, np.ndarray]
    peak: tuple[float, float] | None = None


@dataclass(frozen=True)
class PlaneData:
    """Panels over two parameters, all with the same axes."""

    x: Scale
    y: Scale
    panels: tuple[Panel, ...]
    columns: int


@dataclass(frozen=True)
class CurvesData:
    """Panels of curves over one parameter, one curve a value of another one; ``names`` says which, in their order."""

    x: Scale
    names: tuple[str, ...]
    panels: tuple[Panel, ...]
    columns: int


@dataclass(frozen=True)
class Quantity:
    """What is drawn of the fields.

    Attributes:
        name: of the field.
        label: words, symbol and unit.
        look: how its values become colors.
        center: where a diverging quantity changes sides: the edge of what is stable or passive.
        below: whether the good side lies below the center.
    """

    name: str
    label: str
    look: Look
    center: float = 0.0
    below: bool = False
