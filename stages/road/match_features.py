"""Features of a pass found among those of maps (Shockley 2012, 4.6.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from magtiles.catalog.kernels.road_match import (
    Floats,
    Form,
    least_samples,
    prepare,
    root_mean_square,
)
from magtiles.stages.road.network import LocalPlane, driven

FEATURE_METHODS = ("feature-ml", "feature-rss")


@dataclass(frozen=True)
class _Shape:
    """A feature: the field (n, 3) of its whole road, and rows in it in the order of driving."""

    values: Floats
    start: int
    peak: int
    end: int
    place: Floats


def feature_misses(
    maps: Sequence[xr.Dataset],
    one: xr.Dataset,
    plane: LocalPlane,
    sigma: float,
    form: Form,
    greatest_rms: float,
) -> Floats:
    """Misses (features, 2), m, of a pass's features by ML and by RSS; NaN where RSS finds none.

    Peaks are aligned and the shorter of both lengths is compared on either side. The
    likelihood is per sample, as lengths differ; RSS takes a feature whose root-mean-square
    misfit is at most `greatest_rms` of sigma. Features that no map has count, too: none should
    be found for them.
    """
    known = [shape for road in maps for shape in _shapes(road, plane)]
    seen = _shapes(one, plane)
    if not known or not seen:
        return np.empty((0, len(FEATURE_METHODS)))
    scale = sigma * (np.sqrt(2.0) if form == "differenced" else 1.0)
    rows = []
    for shape in seen:
        likely, rms = np.array([_compare(shape, other, sigma, form) for other in known]).T
        misses = [float(np.hypot(*(other.place - shape.place))) for other in known]
        by_rms = int(np.argmin(rms))
        told = misses[by_rms] if rms[by_rms] <= greatest_rms * scale else np.nan
        rows.append([misses[int(np.argmax(likely))], told])
    return np.array(rows)


def _shapes(road: xr.Dataset, plane: LocalPlane) -> list[_Shape]:
    if "feature_peak" not in road:
        return []
    values = driven(road, road["field_body"].values.astype(np.float64))
    place, first = plane.metres(road), float(road["distance"][0])
    last = len(values) - 1
    names = ("feature_start", "feature_peak", "feature_end")
    rows = np.rint((np.stack([road[n].values for n in names]) - first) / road.attrs["spacing_m"])
    rows = np.clip(rows, 0, last).astype(int)
    if road.attrs["direction"] == "backward":
        rows = last - rows[::-1]
    return [_Shape(values, s, p, e, place[p]) for s, p, e in rows.T.tolist()]


def _compare(one: _Shape, other: _Shape, sigma: float, form: Form) -> tuple[float, float]:
    """Log-likelihood per sample, and root-mean-square difference, of two features."""
    before = min(one.peak - one.start, other.peak - other.start)
    after = min(one.end - one.peak, other.end - other.peak)
    if before + after + 1 < least_samples(form):
        return -np.inf, np.inf
    mine = one.values[one.peak - before : one.peak + after + 1]
    theirs = other.values[other.peak - before : other.peak + after + 1]
    only = prepare(theirs, np.full(theirs.shape, sigma**2), form)
    likely = float(only.log_likelihood(mine, 0, 1)[0]) / len(mine)
    return likely, root_mean_square(mine - theirs, form)
