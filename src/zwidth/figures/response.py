"""A measured frequency response with its band: size and phase, and the open loop of a wall around -1."""

from __future__ import annotations

from typing import Any

import numpy as np

from zwidth.figures import style
from zwidth.figures.table import Table, draws_tables

_NEEDED = ("frequency_Hz", "real_m_per_N", "imag_m_per_N")
_KNOWN = ("deviation_m_per_N", "open_loop_real", "open_loop_imag")
# Half the width of the picture around -1.
_REACH = 1.6


@draws_tables
def draw_response(table: Table, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw a response over frequency, and, of a wall, the open loop around the point -1 that no response may reach.

    Args:
        table: columns frequency_Hz, real_m_per_N, imag_m_per_N; where they are known deviation_m_per_N, the radius of
            the band, and open_loop_real and open_loop_imag of a wall.
        axes: Axes of yours, for the size alone, for the phase as well, and for the open loop.
    """
    columns: Any = {name: np.asarray(table[name], float) for name in (*_NEEDED, *_KNOWN) if name in table}
    f, G = columns["frequency_Hz"], columns["real_m_per_N"] + 1j * columns["imag_m_per_N"]
    radius, size = columns.get("deviation_m_per_N", np.zeros(f.size)), np.abs(G)
    looped = "open_loop_real" in columns
    panels = style.panels(axes, 2 + looped, style.WIDTH, 2.7, columns=2 + looped)
    # Where the band reaches 0 there is any phase.
    clear = radius < size
    band: Any = {"color": style.SKY, "alpha": 0.5, "linewidth": 0}
    least = 0.3 * float(size.min())
    panels[0].fill_between(f, np.maximum(size - radius, 0.1 * least), size + radius, label="band", **band)
    panels[0].plot(f, size, color=style.BLUE, label="measured")
    panels[0].set(yscale="log", ylabel="response  $|G|$  in m/N", ylim=(least, 3.0 * float((size + radius).max())))
    panels[0].legend(loc="lower left", fontsize=7)
    if len(panels) > 1:
        phase = np.degrees(np.unwrap(np.angle(G[clear])))
        spread = np.degrees(np.arcsin(radius[clear] / size[clear]))
        phase -= 360.0 * np.round((phase[:1] + 120.0) / 360.0)
        panels[1].fill_between(f[clear], phase - spread, phase + spread, **band)
        panels[1].plot(f[clear], phase, color=style.BLUE)
        panels[1].set_ylabel("phase in degrees")
    for ax in panels[:2]:
        ax.set(xscale="log", xlim=(f[0], f[-1]), xlabel="frequency  $f$  in Hz")
    if looped and len(panels) > 2:
        _draw_loop(panels[2], columns["open_loop_real"] + 1j * columns["open_loop_imag"], radius / size)
    return panels


def _draw_loop(ax: Any, L: np.ndarray, share: np.ndarray) -> None:
    """The open loop, a disc around each line that the band makes of it, and -1."""
    from matplotlib.collections import EllipseCollection

    near = np.abs(1.0 + L) < 2.0 * _REACH
    wide = 2.0 * (share * np.abs(L))[near]
    look: Any = {"units": "xy", "offset_transform": ax.transData, "color": style.SKY, "alpha": 0.3, "linewidth": 0}
    x, y = np.real(L), np.imag(L)
    ax.add_collection(EllipseCollection(wide, wide, 0.0 * wide, offsets=np.column_stack([x, y])[near], **look))
    ax.plot(x, y, color=style.BLUE, label="open loop $L$")
    ax.plot(-1.0, 0.0, "x", color=style.VERMILION, label="$-1$")
    ax.set(xlim=(-1.0 - _REACH, -1.0 + _REACH), ylim=(-_REACH, _REACH), aspect="equal")
    ax.set(xlabel="real part of $L$", ylabel="imaginary part of $L$")
