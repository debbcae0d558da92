"""Numbers for people: SI prefixes and a fixed count of significant digits."""

from __future__ import annotations

import math

_PREFIXES = {-9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G"}


def plain(value: float, digits: int = 4) -> str:
    """A number with a fixed count of significant digits, without an exponent where it stays short."""
    if not math.isfinite(value):
        return "none" if math.isnan(value) else ("infinite" if value > 0 else "-infinite")
    value = float(f"{value:.{digits - 1}e}")
    if value != 0 and not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value)))) if value else 0
    return f"{value:.{decimals}f}"


def with_unit(value: float, unit: str, digits: int = 4) -> str:
    """A quantity with an SI prefix on its unit: ``19.87 kN/m``."""
    if not math.isfinite(value) or value == 0:
        return f"{plain(value)} {unit}" if value == 0 else plain(value)
    power = min(9, max(-9, 3 * math.floor(math.log10(abs(value)) / 3)))
    # 999.96 with four digits reads 1000: the next prefix is meant.
    if abs(float(f"{value / 10**power:.{digits - 1}e}")) >= 1000 and power < 9:
        power += 3
    return f"{plain(value / 10**power, digits)} {_PREFIXES[power]}{unit}"
