"""Levels of survey lines, from what they measured where they cross."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import lsmr

from magtiles.stages.vehicle.crossings import Crossings

Real = NDArray[np.float64]

_ROUNDS = 20
_HUBER = 1.345
_MAD = 1.4826


@dataclass(frozen=True)
class Misfit:
    """Crossover misfits, nT: how many, their root mean square, median and robust 1 sigma."""

    count: int
    rms: float
    median: float
    robust_sigma: float


def misfit(differences: Real) -> Misfit:
    """Statistics of differences at crossings (n,); NaN are left out."""
    known = differences[np.isfinite(differences)]
    if not known.size:
        return Misfit(0, float("nan"), float("nan"), float("nan"))
    middle = float(np.median(known))
    spread = float(_MAD * np.median(np.abs(known - middle)))
    return Misfit(known.size, float(np.sqrt(np.mean(known**2))), middle, spread)


def crossover_levels(crossings: Crossings, differences: Real, lines: int) -> Real:
    """A constant for each line (lines,), nT, that fits the differences at crossings best.

    Least squares with Huber's weights, by LSMR: difference = level[first] - level[second]. Of
    lines that hang together the levels sum to zero; a line without crossings has NaN. Crossings
    of a line with itself say nothing.
    """
    use = np.isfinite(differences) & (crossings.first_line != crossings.second_line)
    first, second, wanted = (
        a[use] for a in (crossings.first_line, crossings.second_line, differences)
    )
    levels = np.full(lines, np.nan)
    if not wanted.size:
        return levels
    rows = np.tile(np.arange(wanted.size), 2)
    signs = np.repeat([1.0, -1.0], wanted.size)
    weight = np.ones(wanted.size)
    found = np.zeros(lines)
    for _ in range(_ROUNDS):
        entries = signs * np.tile(weight, 2)
        design = coo_array(
            (entries, (rows, np.concatenate([first, second]))), shape=(wanted.size, lines)
        ).tocsr()
        # From zero LSMR finds the shortest solution: the one whose levels sum to zero.
        before, found = found, lsmr(design, weight * wanted, atol=1e-12, btol=1e-12)[0]
        if np.abs(found - before).max() < 1e-6:
            break
        left = np.abs(wanted - found[first] + found[second])
        limit = max(_HUBER * _MAD * float(np.median(left)), 1e-9)
        weight = np.sqrt(np.minimum(1.0, limit / np.maximum(left, limit)))
    joined = coo_array((np.ones(wanted.size), (first, second)), shape=(lines, lines))
    groups = connected_components(joined, directed=False)[1]
    crossed = np.unique(np.concatenate([first, second]))
    for group in np.unique(groups[crossed]):
        members = crossed[groups[crossed] == group]
        levels[members] = found[members] - found[members].mean()
    return levels
