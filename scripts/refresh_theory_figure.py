#!/usr/bin/env python3
"""Redraw docs/figures/one_lobe.svg, the figure of docs/theory/one-lobe.md, from the formulas on that page."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from zwidth.plotting import style

TARGET = Path(__file__).resolve().parents[1] / "docs" / "figures" / "one_lobe.svg"

# Panel (a): strong damping without delay, where the line of z = -1 bounds the stable set. Panel (b): device and delays.
STRONG = 5.0
DELTA, DELAYS = 1.0, (0.0, 0.5, 1.0, 2.0)
TURNS = {0.25: r"$\theta = \pi/4$", 0.5: r"$\pi/2$", 0.75: r"$3\pi/4$"}
POINTS = 1201


class Lobe:
    """Boundary curve of L1 up to theta = pi, and the coordinates (w, m) of S16 in its interior."""

    def __init__(self, delta: float, d: float) -> None:
        self.delta, self.n = delta, int(d)
        self.c = np.exp(-delta)
        self.m = _numerator(delta, d - int(d))
        w = np.linspace(0.0, np.pi / (self.n + 1), POINTS)[1:-1]
        self.w = w[self.theta(w) < np.pi]
        self.w_end = np.pi if len(self.w) == len(w) and self.n == 0 else float(np.interp(np.pi, self.theta(w), w))
        self.alpha, self.beta = self.wall(self.w)

    def theta(self, w):
        """Return the angle of L1, continuous in w, with the argument of M computed from its zeros."""
        a2, a1, a0 = self.m
        z, root = np.exp(1j * w), np.sqrt(a1**2 - 4 * a2 * a0)
        arg_m = -w + np.angle(z + (a1 + root) / (2 * a2)) + np.angle(z + 2 * a0 / (a1 + root))
        return (self.n + 1) * w + np.angle(z - self.c) - arg_m

    def wall(self, w, margin=0.0):
        """Return (alpha, beta) for the crossover w and the phase margin m."""
        a2, a1, a0 = self.m
        z = np.exp(1j * w)
        ratio = np.abs(z - self.c) / np.abs(a2 * z + a1 + a0 / z)
        phase = self.theta(w) + margin
        return 2 * np.tan(w / 2) * ratio * np.sin(phase), -ratio * np.cos(phase - w / 2) / np.cos(w / 2)

    def at(self, turn: float):
        """Return the point of the lobe where theta is the given fraction of pi."""
        return self.wall(np.interp(turn * np.pi, self.theta(self.w), self.w))

    def outline(self):
        """Return the boundary of the stable set from (0, -delta) to alpha = 0, along lobe and line of z = -1."""
        alpha, beta = np.append(0.0, self.alpha), np.append(-self.delta, self.beta)
        top = self.line() / 2 if self.w_end == np.pi else float(self.wall(self.w_end)[1])
        return np.append(alpha, 0.0), np.append(beta, top)

    def line(self) -> float:
        """Return alpha + 2 beta on the line of z = -1 (n = 0)."""
        a2, a1, a0 = self.m
        return -2 * (1 + self.c) / (a1 - a2 - a0)


def _numerator(delta: float, f: float) -> tuple[float, float, float]:
    """Return a2, a1, a0 of S1: integrals with density e^(-delta t), by Gauss quadrature on both sides of the kink."""
    nodes, weights = np.polynomial.legendre.leggauss(40)
    late = 1.0 - f
    total = np.zeros(3)
    for low, high in ((0.0, late), (late, 1.0)):
        t = 0.5 * (high - low) * nodes + 0.5 * (high + low)
        density = 0.5 * (high - low) * weights * np.exp(-delta * t)
        shares = (np.maximum(late - t, 0), 1 - np.abs(t - late), np.maximum(t - late, 0))
        total += [float(np.sum(density * share)) for share in shares]
    return total[0], total[1], total[2]


def main() -> None:
    """Draw both panels and write the SVG."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=TARGET, help="where the SVG goes; a PNG goes beside any other name")
    out = parser.parse_args().out
    with style.house_style():
        figure, axes = style.new_figure(style.WIDTH, 3.7, 1, 2)
        _draw_coordinates(axes[0, 0], Lobe(STRONG, 0.0))
        _draw_delays(axes[0, 1], [Lobe(DELTA, d) for d in DELAYS])
        for ax in axes.flat:
            ax.axhline(0.0, color=style.GRAY, linewidth=0.4, zorder=0.5)
            ax.set_xlabel(style.label_quantity("alpha"))
        axes[0, 0].set_ylabel(style.label_quantity("beta"))
        figure.savefig(out, metadata={"Date": None})
        if out != TARGET:
            figure.savefig(out.with_suffix(".png"), dpi=style.PNG_DPI, metadata={"Software": None})
    print(out)


def _draw_coordinates(ax: Axes, lobe: Lobe) -> None:
    """Draw the stable set with its boundary, and lines of constant crossover and of constant phase margin."""
    ax.fill(*lobe.outline(), facecolor=style.BLUE, alpha=0.09, linewidth=0.0, zorder=1)
    for share in np.arange(0.1, 0.95, 0.1):
        w = share * np.pi
        ax.plot(*lobe.wall(w, np.linspace(0.0, np.pi - lobe.theta(w), 80)), color=style.SKY, linewidth=0.7, zorder=2)
    for margin in np.radians(np.arange(15.0, 180.0, 15.0)):
        w = lobe.w[lobe.theta(lobe.w) + margin < np.pi]
        ax.plot(*lobe.wall(w, margin), color=style.SKY, linewidth=0.7, linestyle=style.DASHED, zorder=2)
    ax.plot(lobe.alpha, lobe.beta, color=style.BLUE, zorder=4)
    corner = (float(lobe.alpha[-1]), float(lobe.beta[-1]))
    top = lobe.line() / 2
    ax.plot([corner[0], 0.0], [corner[1], top], color=style.VERMILION, zorder=4)
    # Extension of the line beyond the corner, where it is not part of the boundary.
    reach = corner[0] + 1.6
    ax.plot([reach, corner[0]], [(lobe.line() - reach) / 2, corner[1]], color=style.VERMILION, linestyle=style.DOTTED)
    ax.plot(*corner, "o", color=style.BLACK, markersize=4.0, zorder=6)
    ax.annotate("corner:\ndouble pole\nat $-1$", corner, (7, 1), textcoords="offset points", fontsize=8)
    ax.plot(0.0, -lobe.delta, "o", color=style.BLACK, markersize=4.0, zorder=6, clip_on=False)
    ax.annotate(r"$\beta = -\delta$", (0.0, -lobe.delta), (3, -11), textcoords="offset points", fontsize=8)
    _mark_turns(ax, lobe, style.BLUE, {0.5: r"$\theta = \pi/2$", 0.75: r"$3\pi/4$"})
    ax.annotate(
        "line of $z = -1$",
        (0.4 * lobe.line(), 0.3 * lobe.line()),
        (5, 3),
        textcoords="offset points",
        fontsize=8,
        color=style.VERMILION,
    )
    ax.set_xlim(0.0, reach + 6.0)
    ax.set_ylim(-lobe.delta - 1.5, top + 0.7)
    handles = [
        Line2D([], [], color=style.BLUE, label="lobe"),
        Line2D([], [], color=style.SKY, linewidth=0.9, label=r"crossover $w$ = 18°, 36°, ..., 162°"),
        Line2D(
            [], [], color=style.SKY, linewidth=0.9, linestyle=style.DASHED, label=r"margin $m$ = 15°, 30°, ..., 165°"
        ),
    ]
    ax.legend(handles=handles, loc="upper right")
    ax.set_title(rf"(a)  $\delta = {lobe.delta:g}$, $d = 0$")


def _draw_delays(ax: Axes, lobes: list[Lobe]) -> None:
    """Draw the stable sets of one device for several delays, with values of theta along each lobe."""
    colors = style.ordered_colors(len(lobes))
    for lobe, d, color in zip(lobes, DELAYS, colors, strict=True):
        alpha, beta = lobe.outline()
        ax.fill(alpha, beta, facecolor=color, alpha=0.12, linewidth=0.0, zorder=1)
        ax.plot(alpha, beta, color=color, zorder=3, label=f"$d = {d:g}$")
        _mark_turns(ax, lobe, color, TURNS if d == DELAYS[0] else dict.fromkeys(TURNS, ""))
        ax.plot(alpha[-1], beta[-1], "o", color=color, markersize=4.0, zorder=5, clip_on=False)
    first = lobes[0].outline()
    ax.annotate(r"$\theta = \pi$", (0.0, first[1][-1]), (7, 2), textcoords="offset points", fontsize=8, va="bottom")
    ax.plot(0.0, -lobes[0].delta, "o", color=style.BLACK, markersize=4.0, zorder=6, clip_on=False)
    ax.annotate(r"$\beta = -\delta$", (0.0, -lobes[0].delta), (3, -20), textcoords="offset points", fontsize=8)
    ax.set_xlim(0.0, 1.16 * max(float(lobe.alpha.max()) for lobe in lobes))
    low, high = style.span(-lobes[0].delta, float(first[1][-1]), 0.14)
    ax.set_ylim(low, high)
    ax.set_title(rf"(b)  $\delta = {DELTA:g}$")
    ax.legend(loc="upper right")


def _mark_turns(ax: Axes, lobe: Lobe, color, turns: dict[float, str]) -> None:
    """Mark the points where theta is a given fraction of pi."""
    for turn, name in turns.items():
        place = lobe.at(turn)
        ax.plot(*place, "o", color=color, markersize=3.2, zorder=5)
        ax.annotate(name, place, (2, -4), textcoords="offset points", fontsize=8, va="top", color=color)


if __name__ == "__main__":
    main()
