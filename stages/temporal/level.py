"""Whether a record's level is that of the core field where its header says it was made."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.models import FieldModel, evaluate

Real = NDArray[np.float64]


@dataclass(frozen=True)
class Place:
    """Geodetic degrees and metres above mean sea level.

    That the model wants metres above the ellipsoid matters little: 100 m are 3 nT.
    """

    latitude: float
    longitude: float
    height: float


def core_vector(model: FieldModel, place: Place, date: np.datetime64) -> Real:
    """North, east, down (3,), nT."""
    at = place.latitude, place.longitude, place.height
    return evaluate(model, *at, date, allow_extrapolated=True)


def likely_mistakes(place: Place) -> dict[str, Place]:
    """Places that a header means when it is wrong in one of the usual ways."""
    latitude, longitude, height = place.latitude, place.longitude, place.height
    mistakes = {
        "the latitude's sign is wrong": Place(-latitude, longitude, height),
        "the longitude's sign is wrong": Place(latitude, -longitude, height),
        "both signs are wrong": Place(-latitude, -longitude, height),
        "the colatitude is given as latitude": Place(90.0 - latitude, longitude, height),
        "latitude and longitude are exchanged": Place(longitude, latitude, height),
    }
    return {what: p for what, p in mistakes.items() if abs(p.latitude) <= 90.0}


def explain(
    model: FieldModel, place: Place, date: np.datetime64, found: Real, tolerance: float
) -> str | None:
    """The likely mistake under which the field (3,) agrees best, if within `tolerance` nT."""
    misfits = {
        what: float(np.linalg.norm(found - core_vector(model, p, date)))
        for what, p in likely_mistakes(place).items()
    }
    best = min(misfits, key=misfits.__getitem__)
    return best if misfits[best] <= tolerance else None


def daily_medians(time: NDArray[np.datetime64], values: Real) -> tuple[NDArray[np.int64], Real]:
    """The UTC day of each sample, counted from 0, and each day's medians (rows, days)."""
    dates = time.astype("datetime64[D]")
    day = (dates - dates[0]).astype(np.int64)
    edges = np.searchsorted(day, np.arange(day[-1] + 2))
    medians = np.full((len(values), int(day[-1]) + 1), np.nan)
    for number, (begin, end) in enumerate(itertools.pairwise(edges)):
        part = values[:, begin:end]
        known = np.isfinite(part).any(axis=1)
        medians[known, number] = np.nanmedian(part[known], axis=1)
    return day, medians
