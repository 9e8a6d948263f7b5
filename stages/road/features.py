"""Stage ``find-features``: stretches of a road where the field leaves its slow course, for good."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.flags import RoadFlag
from magtiles.stages.declare import Params, Stage, quantity

Real = NDArray[np.float64]
Mask = NDArray[np.bool_]

_EDGE = 0.5
"""Share of the threshold down to which a point belongs to a feature."""
_SEEN = 0.5
"""Share of a feature that every vehicle must have seen for it to be fixed."""
_NAMES = ("feature_start", "feature_end", "feature_peak", "feature_axis", "feature_amplitude")


class FindFeaturesParams(Params):
    """Parameters of find-features."""

    background_m: float = quantity(
        "m", default=60.0, gt=0, doc="Length over which the field changes slowly."
    )
    threshold_nt: float = quantity(
        "nT", default=1000.0, gt=0, doc="Least deviation of a feature at its peak."
    )
    sigma: float = quantity(
        "1", default=5.0, gt=0, doc="Least deviation in standard deviations of one pass."
    )
    passes: int = quantity("1", default=2, ge=1, doc="Passes that make a feature a fixed one.")


@dataclass(frozen=True)
class Feature:
    """One feature: its points `start` to `end` inclusive, the peak's point, axis and nT."""

    start: int
    end: int
    peak: int
    axis: int
    amplitude: float


def find_features(road: xr.Dataset, *, params: FindFeaturesParams) -> xr.Dataset:
    """The map with its features, each with start, end, peak (m), axis and amplitude (nT).

    A feature deviates from the running median of the field over `background_m`, by both limits
    at its peak (Shockley 2012, 4.6.3: a deviation from an otherwise slowly changing field). It
    is fixed if `passes` passes met it and the mean of every vehicle deviates there to the same
    side by half as much at least. Without any the map has no feature variables.
    """
    field = road["field_body"].values.astype(np.float64)
    deviation = _deviation(field, road, params)
    scatter = _scatter(road)
    found = [
        feature
        for run in _runs(np.max(np.abs(deviation), axis=1) > _EDGE * params.threshold_nt)
        if _is_fixed(feature := _feature(run, deviation), road, scatter, params)
    ]
    bare = road.drop_vars([name for name in _NAMES if name in road])
    return bare if not found else bare.assign(_variables(found, road["distance"].values))


def _deviation(field: Real, road: xr.Dataset, params: FindFeaturesParams) -> Real:
    from scipy.ndimage import median_filter

    size = min(int(params.background_m / float(road.attrs["spacing_m"])) | 1, len(field))
    return np.asarray(field - median_filter(field, size=(size, 1), mode="nearest"))


def _scatter(road: xr.Dataset) -> Real:
    """Standard deviation (3,) of one pass, nT: of the map's own passes, else as stated."""
    if "variation_same_vehicle" in road:
        own = road["variation_same_vehicle"].values.astype(np.float64)
        if np.isfinite(own).any():
            return np.asarray(np.nanmedian(own, axis=0))
    return np.asarray(np.nanmedian(road["field_body_uncertainty"].values, axis=0), np.float64)


def _runs(mask: Mask) -> list[slice]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return [slice(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _feature(run: slice, deviation: Real) -> Feature:
    inside = np.abs(deviation[run])
    row, axis = np.unravel_index(np.argmax(inside), inside.shape)
    peak = run.start + int(row)
    return Feature(run.start, run.stop - 1, peak, int(axis), float(deviation[peak, axis]))


def _is_fixed(
    feature: Feature, road: xr.Dataset, scatter: Real, params: FindFeaturesParams
) -> bool:
    size = abs(feature.amplitude)
    if size < max(params.threshold_nt, params.sigma * float(scatter[feature.axis])):
        return False
    if int(road["passes"].values[feature.peak]) < params.passes:
        return False
    if int(road["quality_flag"].values[feature.peak]) & int(RoadFlag.INTERPOLATED):
        return False
    seen = road["vehicle_passes"].values[:, feature.peak] > 0
    own = road["vehicle_mean"].values[seen][:, :, feature.axis].astype(np.float64)
    return bool(np.all(_own_deviation(own, feature, road, params) > _SEEN * size))


def _own_deviation(
    own: Real, feature: Feature, road: xr.Dataset, params: FindFeaturesParams
) -> Real:
    """Deviation (vehicle,) of each vehicle's mean at the peak, counted to the feature's side."""
    half = int(params.background_m / float(road.attrs["spacing_m"])) // 2
    around = own[:, max(feature.peak - half, 0) : feature.peak + half + 1]
    difference = own[:, feature.peak] - np.median(around, axis=1)
    return np.asarray(np.sign(feature.amplitude) * difference)


def _variables(found: list[Feature], distance: Real) -> dict[str, tuple[str, object, object]]:
    def at(points: list[int]) -> Real:
        return np.asarray(distance[points], np.float64)

    axes = np.array([f.axis for f in found], np.int8)
    meaning = {"flag_values": np.array([0, 1, 2], np.int8), "flag_meanings": "forward right down"}
    return {
        "feature_start": ("feature", at([f.start for f in found]), {"units": "m"}),
        "feature_end": ("feature", at([f.end for f in found]), {"units": "m"}),
        "feature_peak": ("feature", at([f.peak for f in found]), {"units": "m"}),
        "feature_axis": ("feature", axes, meaning),
        "feature_amplitude": (
            "feature",
            np.array([f.amplitude for f in found]),
            {"units": "nT", "long_name": "deviation at the peak from the slow field"},
        ),
    }


STAGE = Stage(
    name="find-features",
    version=1,
    params=FindFeaturesParams,
    inputs={"road": "road-map/1"},
    output="road-map/1",
    run=find_features,
)
