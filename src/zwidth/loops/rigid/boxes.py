"""Whether every wall of a box of walls and devices is stable, proved by the one text of the verdict in affine forms.

The text is that of `loops.rigid.crossover`; the numbers are those of `arrays.balls`. NumPy's sine, cosine and arcsine
are trusted to 2^-45.
"""

from __future__ import annotations

import numpy as np

from zwidth.arrays.balls import UNIT, Form, chord
from zwidth.arrays.xp import horner
from zwidth.loops.rigid.certified_filter import functions
from zwidth.loops.rigid.crossover import Lag, first_zero, long_verdict, short_verdict
from zwidth.loops.rigid.device import DeviceTerms

# Of the phi-functions, slightly negative arguments included.
_PHI_ERROR = 100.0 * UNIT
_ARCSINE_ERROR = 2.0**-45


def _phi_forms(x: Form) -> tuple[Form, Form, Form]:
    """c, phi2 and psi: integrals of e^(-x t) over weights, so that all derivatives fall in size with x."""
    low, high = x.lower(), x.upper()
    # The series behind them are right for slightly negative arguments too, which a box round 0 has.
    low = np.where(low > -1.0, low, np.nan)
    first, last = ((at.c, at.phi2, at.psi) for at in map(functions, (low, high)))
    size = np.maximum(low, 1e-3)
    at_low = first[2]
    bends = (first[0], np.minimum(0.25 * at_low, 2.0 / size**3), np.minimum(at_low, 6.0 / size**4))
    forms = [
        chord(x, ends, bend * (1.0 + _PHI_ERROR), _PHI_ERROR)
        for ends, bend in zip(zip(first, last, strict=True), bends, strict=True)
    ]
    return forms[0], forms[1], forms[2]


def plant(delta: Form, f: Form) -> DeviceTerms:
    """The devices of boxes, in the form of `loops.rigid.device.held_plant`."""
    t = 1.0 - f
    x_t, x_f = delta * t, delta * f
    (e_t, phi2_t, psi_t), (_, phi2_f, psi_f), (c, phi2, psi) = _phi_forms(x_t), _phi_forms(x_f), _phi_forms(delta)
    p1_t, p1_f, p1 = phi2_t + psi_t, phi2_f + psi_f, phi2 + psi
    a1 = t * t * psi_t + t * f * (e_t + p1_t) * p1_f + f * f * phi2_f
    a2, a0 = t * t * phi2_t, e_t * (f * f * psi_f)
    return DeviceTerms(delta, None, f, c, delta * p1, p1, phi2, psi, p1_t, psi_t, a2, a1, a0, a2 - a1 + a0, None)


def enclose_zero(cubic: tuple[Form, Form, Form, Form]) -> tuple[Form, np.ndarray]:
    """The crossover as a form: first order by the implicit function, proved by the signs of H on both sides of it."""
    _, h1, h2, h3 = mids = tuple(h.mid for h in cubic)
    u = first_zero(mids)
    slope = h1 + u * (2.0 * h2 + 3.0 * u * h3)
    lin = -(cubic[0].lin + u * (cubic[1].lin + u * (cubic[2].lin + u * cubic[3].lin))) / slope
    form = Form(u, lin, np.zeros_like(u))
    left = horner(form, cubic)
    reach = 2.0 * (np.abs(left.mid) + left.spread) / np.abs(slope) + 8.0 * UNIT * u
    before, behind = (horner(Form(u + side, lin, 4.0 * UNIT * u), cubic) for side in (-reach, reach))
    found = (before > 0) & (behind < 0) & (form.mid - form.spread - reach > 0)
    return Form(u, lin, reach + 8.0 * UNIT * u), found


def take_lag(u: Form, whole: np.ndarray) -> Lag:
    """Cosine and sine of ``(n + 1/2) w``: w(u) by its chord, concave for u < 1; then to first order, |sin|'' <= 1."""
    low, high = u.lower(), u.upper()
    good = (low > 0) & (high < 1.0)
    low, high = np.where(good, low, 0.5), np.where(good, high, 0.5)
    turns = whole + 0.5
    ends = 2.0 * turns * np.arcsin(np.sqrt(0.5 * low)), 2.0 * turns * np.arcsin(np.sqrt(0.5 * high))
    square = low * (2.0 - low)
    angle = chord(u, ends, -turns * (1.0 - low) / (square * np.sqrt(square)), _ARCSINE_ERROR)
    spread = angle.spread
    within = good & (angle.mid + spread < np.pi * (1.0 - 1e-15))
    beyond = good & ((angle.mid - spread) * (whole + 1.0) > np.pi * turns * (1.0 + 1e-15))
    sine, cosine = np.sin(angle.mid), np.cos(angle.mid)
    left = angle.rad + 0.5 * spread * spread + 2.0**-45
    turned = Form(cosine, -sine * angle.lin, left)
    return Lag(turned, Form(sine, cosine * angle.lin, left), (1.0 - turned) * 0.5, within, beyond)


def stable_everywhere(alpha: Form, beta: Form, delta: Form, d: Form) -> np.ndarray:
    """Whether every wall of each box is proved stable; a delay that crosses a whole number is taken on both sides."""
    low, high = d.lower(), d.upper()
    first = np.maximum(np.floor(low), 0.0)
    stable = (alpha > 0) & (beta + delta > 0) & (high <= first + 2.0)
    with np.errstate(all="ignore"):
        stable &= _stable_behind(alpha, beta, delta, d, first)
        crosses = np.flatnonzero(stable & (high >= first + 1.0))
        if crosses.size:
            parts = [Form(x.mid[crosses], x.lin[:, crosses], x.rad[crosses]) for x in (alpha, beta, delta, d)]
            stable[crosses] &= _stable_behind(parts[0], parts[1], parts[2], parts[3], first[crosses] + 1.0)
    return stable


def _stable_behind(alpha: Form, beta: Form, delta: Form, d: Form, whole: np.ndarray) -> np.ndarray:
    """The verdict with n = ``whole``; f may leave [0, 1], where only its part inside has a meaning."""
    here = plant(delta, d - whole)
    short = whole == 0
    stable = np.zeros(whole.shape, bool)
    if short.any():
        stable = short & short_verdict(alpha, beta, here).stable
    if not short.all():
        stable |= ~short & long_verdict(alpha, beta, whole, here, enclose_zero, take_lag).stable
    return stable
