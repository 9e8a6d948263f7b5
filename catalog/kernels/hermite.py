"""Hermite interpolation in height between levels, as weights of the levels' derivatives.

Quintic: value, first and second derivative are met at both levels, so the interpolant and its
vertical gradient are continuous across levels. See de Boor, A Practical Guide to Splines,
chapter I (osculatory interpolation); the weights are Hermite's for degree five.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LEVEL_TOLERANCE_M = 1e-6
"""A height this near a level is on it."""

_LOWER = np.array(
    [
        [1, 0, 0, -10, 15, -6],
        [0, 1, 0, -6, 8, -3],
        [0, 0, 0.5, -1.5, 1.5, -0.5],
    ]
)
_UPPER = np.array(
    [
        [0, 0, 0, 10, -15, 6],
        [0, 0, 0, -4, 7, -3],
        [0, 0, 0, 0.5, -1, 0.5],
    ]
)
_BASIS = np.stack([_LOWER, _UPPER])
"""[level, order of derivative, power of t]."""

_SLOPES = polynomial.polyder(_BASIS, axis=2)


@dataclass(frozen=True)
class Bracket:
    """The levels around heights, and what each contributes.

    Attributes
    ----------
    level : (n,) index of the lower level.
    value, slope : (2, n, 3) weights of the lower and upper level's value, first and second
        vertical derivative in the interpolant and in its derivative per metre.
    uses : (2, n) whether the lower and upper level contribute.
    linear : (2, n) weights of linear interpolation, for what has no derivatives.
    above, below : (n,) whether the height is beyond the levels, where the interpolant goes
        on linearly.
    """

    level: NDArray[np.intp]
    value: Floats
    slope: Floats
    uses: NDArray[np.bool_]
    linear: Floats
    above: NDArray[np.bool_]
    below: NDArray[np.bool_]


def bracket(levels: Floats, heights: Floats) -> Bracket:
    """Weights of `levels` (ascending, metres) at `heights` (n,) above the same surface."""
    near = np.clip(np.searchsorted(levels, heights + LEVEL_TOLERANCE_M, "right") - 1, 0, None)
    gain = heights - levels[near]
    # The sum above is rounded: what it lifts to a level is on that level, not below the lowest.
    on_level = (np.abs(gain) <= LEVEL_TOLERANCE_M) | ((gain < 0.0) & (near > 0))
    gain = np.where(on_level, 0.0, gain)
    last = len(levels) - 1
    below, above = gain < 0.0, (near == last) & (gain > 0.0)
    between = (gain > 0.0) & ~above
    spacing = np.append(np.diff(levels), 1.0)[near]
    t = np.where(between, gain / spacing, 0.0)
    powers = np.vander(t, 6, increasing=True)
    scale = np.vander(spacing, 3, increasing=True)
    value = (powers @ _BASIS.swapaxes(1, 2)) * scale
    slope = (powers[:, :5] @ _SLOPES.swapaxes(1, 2)) * scale / spacing[:, None]
    # On a level only that level counts, and beyond them the outermost, as a straight line.
    alone = ~between
    value[:, alone], slope[:, alone] = 0.0, 0.0
    value[0, alone, 0] = slope[0, alone, 1] = 1.0
    value[0, alone, 1] = gain[alone]
    uses = np.stack([np.ones_like(between), between])
    return Bracket(near, value, slope, uses, np.stack([1.0 - t, t]), above, below)
