"""Which device walls that buzzed ask for: a rigid one, or with an amplifier's lag or a resonance, or with both."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from zwidth.fitting.buzz_devices import Candidate, find_candidates, is_blind, look_around, weigh
from zwidth.fitting.buzzing import Onsets
from zwidth.scenes.scene import Scene

# Another device is as good where the sum of squares in units of the noise rises by less.
AS_GOOD = 5.99
# Relative noise that no record is better than, for telling exact points from equal ones.
EXACT = 1e-12
# An edge of the stable set lies between walls so much softer and stiffer.
_BESIDE = 1e-6
# Orders of lags and numbers of modes that are tried, the fewest unknowns first.
_KINDS = ((1, 0), (2, 0), (0, 1), (1, 1))
# Few walls: what further numbers explain of noise more often than this is no evidence of them.
_CHANCE = 0.003
# Slopes promise squares at most so many times as large as they lead to, and near an optimum no less than this share.
_HOPELESS, _STUCK = 1.2, 0.5
# Residuals that are rounding alone.
_ROUNDING = 1e-9


class FittedKind(NamedTuple):
    """A kind of device at its best: the variance in units of the weights, and all devices of it that fit as well.

    None are equal where no device has the walls on the edge of its stable set.
    """

    onsets: Onsets
    best: Candidate
    scale: float
    equals: list[Candidate]
    known_noise: bool

    @property
    def equations(self) -> int:
        """How many equations there are."""
        return 2 * self.onsets.w.size

    @property
    def freedom(self) -> int:
        """How many of them are left."""
        return self.equations - self.onsets.unknowns

    @property
    def misfit(self) -> float:
        """-2 times its logarithmic likelihood."""
        if not self.equals:
            return np.inf
        squares = self.best.squares
        return squares if self.known_noise else self.equations * np.log(max(squares, self.equations * EXACT**2))

    @property
    def cost(self) -> float:
        """By Schwarz's criterion."""
        return self.misfit + self.onsets.unknowns * np.log(self.equations)

    def price(self, more: int) -> float:
        """What so many further numbers have to explain: Schwarz's price, or more where chance explains that much."""
        from scipy.special import chdtri, fdtri

        left = self.freedom - more
        ratio = 1.0 + more / left * float(fdtri(more, left, 1.0 - _CHANCE))
        chance = float(chdtri(more, _CHANCE)) if self.known_noise else self.equations * np.log(ratio)
        return max(more * np.log(self.equations), chance)

    def scene(self, theta: np.ndarray) -> Scene:
        """The loop of one of its devices."""
        return self.onsets.normalize(theta).to_scene(self.onsets.period, self.onsets.velocity)


def choose_device(onsets: Onsets, weights: np.ndarray, known_noise: bool) -> tuple[FittedKind, list[FittedKind]]:
    """The likeliest kind of device, and others that are about as likely where it is no rigid one.

    Parts are looked for where they could explain more than chance does.
    """
    rigid = chosen = _try(onsets, weights, known_noise)
    tried = [rigid]
    for lag, modes in _KINDS:
        richer = replace(onsets, lag=lag, modes=modes)
        more = richer.unknowns - chosen.onsets.unknowns
        if chosen.freedom <= more:
            continue
        price = chosen.price(more)
        # No device leaves less than this.
        least = 0.0 if known_noise else chosen.equations * np.log(chosen.equations * _ROUNDING**2)
        if chosen.misfit - least <= price:
            continue
        tried.append(_try(richer, weights, known_noise))
        if chosen.misfit - tried[-1].misfit > price:
            chosen = tried[-1]
    others = [kind for kind in tried if kind is not chosen and kind.cost < chosen.cost + AS_GOOD]
    return chosen, [] if chosen is rigid else others


def _try(onsets: Onsets, weights: np.ndarray, known_noise: bool) -> FittedKind:
    """The best device of a kind, and all that fit as well."""
    nothing = Candidate(np.zeros(onsets.unknowns), np.inf, np.full((onsets.w.size, 2), np.nan), (), False)
    freedom = 2 * onsets.w.size - onsets.unknowns
    kind, found, scale = FittedKind(onsets, nothing, 1.0, [], known_noise), [], 1.0
    # Parts are found where the walls tell their numbers; of a rigid device it is said which wall is missing.
    parts = onsets.lag + onsets.modes > 0
    for near, start in look_around(onsets, weights):
        most = _HOPELESS * (kind.equals[0].squares + AS_GOOD * scale) if kind.equals else np.inf
        known = any(np.allclose(near.theta, other.theta, 1e-2, 1e-2) for other in found)
        # Where slopes promise much the search got stuck, and says nothing yet.
        if near.found and (known or near.ahead > max(most, _STUCK * near.squares)):
            continue
        for fit in find_candidates(onsets, weights, near, start, most if parts else np.inf):
            found.append(fit)
            if not (fit.found and fit.squares < most and _at_edge(kind, fit)):
                continue
            if not (parts and is_blind(weigh(onsets.follow(fit.theta).slopes(), weights))):
                kind.equals.append(fit)
                kind.equals.sort(key=lambda each: each.squares)
                scale = 1.0 if known_noise else max(kind.equals[0].squares / freedom, EXACT**2)
    as_good = [fit for fit in kind.equals if fit.squares - kind.equals[0].squares < AS_GOOD * scale]
    best = (as_good or sorted(found, key=lambda fit: (not fit.found, fit.squares)) or [nothing])[0]
    scale = 1.0 if known_noise else max(best.squares / freedom, EXACT**2)
    return kind._replace(best=best, scale=scale, equals=as_good)


@np.errstate(all="ignore")  # Of parts that no device has, zeros overflow.
def _at_edge(kind: FittedKind, fit: Candidate) -> bool:
    """Whether the fitted walls are where stability ends as K rises: other lobes hold walls that buzzed long before."""
    onsets = kind.onsets
    kappa, period = onsets.follow(fit.theta).kappa, onsets.period
    if not np.all(kappa > 0):
        return False
    return bool(np.all(find_edges(kind.scene(fit.theta), kappa / period**2, onsets.rub / period)))


def find_edges(scene: Scene, stiffness: np.ndarray, virtual_damping: np.ndarray) -> np.ndarray:
    """Which walls are stable a little softer, and not a little stiffer."""
    softer = scene.is_stable(stiffness * (1 - _BESIDE), virtual_damping)
    return softer & ~scene.is_stable(stiffness * (1 + _BESIDE), virtual_damping)
