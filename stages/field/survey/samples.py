"""What tracks measured over an area: samples in one projection, one height, one reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyproj
import xarray as xr
from numpy.typing import NDArray
from scipy import ndimage

from magtiles.catalog.flags import TrackFlag
from magtiles.schemas.errors import ContractError, CoverageError
from magtiles.stages.crs import WGS84
from magtiles.stages.field.core_field import NO_REFERENCE

Real = NDArray[np.float64]
Places = tuple[Real, Real]
"""x and y."""

FIELD_TOTAL = "field_total"
_UNFIT = TrackFlag.NO_FIX | TrackFlag.FIX_OUTLIER | TrackFlag.POSITION_GAP | TrackFlag.FIELD_SPIKE
_LEVEL_M = 1.0
"""A reference surface that rises by more than this is no one height, and is left out."""
_SIGMA_PER_MAD = 1.4826
_OUTLIER_SIGMAS = 8.0
"""Along an even gradient no sample is farther from its block's median than 1.35 such sigmas."""


@dataclass(frozen=True)
class Samples:
    """Places x, y (n,) m in `crs`, `value` nT, `height` m, and what they have in common."""

    x: Real
    y: Real
    value: Real
    height: Real
    crs: pyproj.CRS
    attributes: dict[str, Any]


@dataclass(frozen=True)
class Blocks:
    """Means of the samples in square blocks, each about a node of the grid.

    Attributes
    ----------
    x, y, value, height : (blocks,) means of place (m), value (nT) and height (m).
    weight : (blocks,) how many samples, but no more than a typical block has: a stop lends a
        block no weight.
    samples : those that the means are of; outliers of a block are left out.
    label : (samples,) the block of each.
    """

    x: Real
    y: Real
    value: Real
    height: Real
    weight: Real
    samples: Samples
    label: NDArray[np.intp]

    def mean(self, rows: Real) -> Real:
        """Means (blocks, k) of rows (samples, k)."""
        count = np.bincount(self.label)
        return np.stack([np.bincount(self.label, column) / count for column in rows.T], axis=1)


def collect(tracks: Sequence[xr.Dataset], variable: str) -> Samples:
    """The samples of tracks that have place, height and value, in the UTM zone of their middle.

    `variable` is ``magnetic_anomaly``, or ``field_total``: the field itself, less `diurnal`
    where the tracks have one. Samples flagged as misplaced or spikes are left out.

    Raises ContractError for tracks without the variable, or that differ in reference field,
    definition or height reference; CoverageError where no sample is left.
    """
    stated = [_statements(track, variable) for track in tracks]
    for track, statement in zip(tracks[1:], stated[1:], strict=True):
        _check_alike(stated[0], statement, tracks[0], track)
    columns = np.concatenate([_columns(track, variable) for track in tracks], axis=1)
    used = np.isfinite(columns).all(axis=0) & ~np.concatenate([_unfit(t) for t in tracks])
    if not used.any():
        raise CoverageError(
            f"none of {used.size} samples has a place, a height and '{variable}', unflagged",
            where=_sources(tracks),
            expected="measured samples",
        )
    latitude, longitude, height, value, surface = columns[:, used]
    crs = local_crs(latitude, longitude)
    to_plane = pyproj.Transformer.from_crs(WGS84, crs, always_xy=True)
    x, y = (np.asarray(a) for a in to_plane.transform(longitude, latitude))
    times = np.concatenate([track["time"].values for track in tracks])[used]
    attributes = stated[0] | {
        "reference_epoch": str(times.min() + (times.max() - times.min()) // 2)[:10],
        "source": _sources(tracks),
    }
    if all(_has_surface(track) for track in tracks) and np.ptp(surface) <= _LEVEL_M:
        attributes["reference_surface_height"] = float(surface.mean())
    return Samples(x, y, value, height, crs, attributes)


def _statements(track: xr.Dataset, variable: str) -> dict[str, Any]:
    """What the values of a track are, and what its heights count from."""
    if variable not in track:
        raise ContractError(
            f"'{variable}' is missing",
            where=track.attrs["source"],
            expected=f"a track with '{variable}'",
            remedy="calibrate the magnetometer first: the length of its vector is the total field",
        )
    if variable == FIELD_TOTAL:
        less = ", less the diurnal variation" if "diurnal" in track else ""
        reference, definition = NO_REFERENCE, "total field" + less
    else:
        reference, definition = (
            str(track.attrs[name]) for name in ("reference_field", "anomaly_definition")
        )
    return {
        "reference_field": reference,
        "anomaly_definition": definition,
        "height_reference": track.attrs["height_reference"],
    }


def _check_alike(
    first: dict[str, Any], other: dict[str, Any], first_track: xr.Dataset, track: xr.Dataset
) -> None:
    for name, value in first.items():
        if other[name] != value:
            raise ContractError(
                f"{name} is '{other[name]}' here and '{value}' in {first_track.attrs['source']}",
                where=track.attrs["source"],
                expected="tracks that are alike in it",
                remedy="reduce all tracks in the same way, or grid them apart",
            )


def _has_surface(track: xr.Dataset) -> bool:
    return "reference_surface_height" in track and track.attrs["height_reference"] != "ellipsoid"


def _columns(track: xr.Dataset, variable: str) -> Real:
    """Latitude, longitude, height, value and height of the reference surface (5, time)."""
    value = track[variable].values.astype(np.float64)
    if variable == FIELD_TOTAL and "diurnal" in track:
        value = value - track["diurnal"].values
    surface = track["reference_surface_height"].values if _has_surface(track) else 0.0 * value
    return np.stack(
        [*(track[n].values for n in ("latitude", "longitude", "height")), value, surface]
    )


def _unfit(track: xr.Dataset) -> NDArray[np.bool_]:
    if "quality_flag" not in track:
        return np.zeros(track.sizes["time"], bool)
    return np.asarray((track["quality_flag"].values & _UNFIT.value) != 0)


def _sources(tracks: Sequence[xr.Dataset]) -> str:
    return ", ".join(dict.fromkeys(str(track.attrs["source"]) for track in tracks))


def local_crs(latitude: Real, longitude: Real) -> pyproj.CRS:
    """The UTM zone (UPS beyond its 84 N and 80 S) of the middle of places, degrees."""
    turns = np.exp(1j * np.radians(longitude)).mean()
    middle = float(latitude.mean()), float(np.degrees(np.angle(turns)))
    if middle[0] > 84.0 or middle[0] < -80.0:
        return pyproj.CRS.from_epsg(32661 if middle[0] > 0.0 else 32761)
    zone = int((middle[1] + 180.0) // 6.0) % 60 + 1
    return pyproj.CRS.from_epsg((32600 if middle[0] >= 0.0 else 32700) + zone)


def block_means(samples: Samples, spacing: float) -> Blocks:
    """Means of samples in blocks `spacing` m wide, without those far off their block's median."""
    label = _labels(samples, spacing)
    kept = _near_median(samples.value, label)
    samples = replace(
        samples,
        x=samples.x[kept],
        y=samples.y[kept],
        value=samples.value[kept],
        height=samples.height[kept],
    )
    label = _labels(samples, spacing)
    count = np.bincount(label)
    x, y, value, height = (
        np.bincount(label, a) / count for a in (samples.x, samples.y, samples.value, samples.height)
    )
    weight = np.minimum(count, np.median(count)).astype(np.float64)
    return Blocks(x, y, value, height, weight, samples, label)


def _labels(samples: Samples, spacing: float) -> NDArray[np.intp]:
    nodes = np.rint(np.stack([samples.y, samples.x], axis=1) / spacing).astype(np.int64)
    label: NDArray[np.intp] = np.unique(nodes, axis=0, return_inverse=True)[1].reshape(-1)
    return label


def _near_median(value: Real, label: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Which samples (n,) lie within eight sigmas of their block's median.

    Sigma is the block's median absolute deviation, or the mean one where that is greater, as in
    blocks of which most samples are equal. Of two samples neither can be told to be wrong.
    """
    count = np.bincount(label)
    index = np.arange(count.size)
    off = np.abs(value - np.asarray(ndimage.median(value, label, index))[label])
    spread = np.asarray(ndimage.median(off, label, index))
    typical = spread[count > 2].mean() if (count > 2).any() else np.inf
    sigma = _SIGMA_PER_MAD * np.maximum(spread, typical)
    return np.asarray((off <= _OUTLIER_SIGMAS * sigma[label]) | (count[label] <= 2))
