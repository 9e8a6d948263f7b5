"""What a road map answers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Nearest:
    """The place on a road nearest to a position: metres along it, and from it; (...,) each."""

    distance: Floats
    offset_m: Floats


@dataclass(frozen=True)
class SectionLikelihood:
    """Log-likelihood (m,) of a section whose last sample lies at each `distance` (m,), m."""

    distance: Floats
    log_likelihood: Floats


@dataclass(frozen=True)
class Match:
    """Where a section was measured.

    Attributes
    ----------
    distance : of its last sample, m; NaN where the method tells none.
    latitude, longitude : of that, degrees.
    log_likelihood : there; that of the most likely place where the method tells none.
    ratio : of the greatest likelihood to the next far from it.
    peak : share of the greatest in the sum of all likelihoods.
    """

    distance: float
    latitude: float
    longitude: float
    log_likelihood: float
    ratio: float
    peak: float


@dataclass(frozen=True)
class Feature:
    """A stretch that stands out: distances, m, axis (0 forward, 1 right, 2 down), height, nT."""

    start: float
    end: float
    peak: float
    axis: int
    amplitude: float
