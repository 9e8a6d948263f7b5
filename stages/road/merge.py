"""Stage ``merge-passes``: one map of a road from many passes, or one more pass into a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from magtiles.catalog.flags import RoadFlag
from magtiles.schemas.errors import ContractError, CoverageError
from magtiles.stages.declare import Many, OptionalInput, Params, Stage, quantity
from magtiles.stages.road.agreement import check_passes
from magtiles.stages.road.centreline import Centreline, along
from magtiles.stages.road.plane import Plane
from magtiles.stages.road.road_map import road_dataset
from magtiles.stages.road.shift import shifts
from magtiles.stages.road.statistics import Statistics, estimate
from magtiles.stages.road.transient import drop_transients

Real = NDArray[np.float64]
Mask = NDArray[np.bool_]

_NO_FIELD = RoadFlag.INTERPOLATED | RoadFlag.UNDERSAMPLED
"""A point of a pass with both says nothing of the field."""
_EVERY_PASS = RoadFlag.INTERPOLATED | RoadFlag.UNDERSAMPLED | RoadFlag.POSITION_DOUBTFUL
"""Flags that a point of the map has only where every pass has them."""


class MergeParams(Params):
    """Parameters of merge-passes."""

    position_sigma_m: float = quantity(
        "m", default=1.5, gt=0, doc="Standard deviation of a pass's place along the road."
    )
    max_offset_m: float = quantity(
        "m", default=15.0, gt=0, doc="Distance across the road at which a pass has left it."
    )
    same_vehicle_nt: tuple[float, float, float] = quantity(
        "nT", default=(266.0, 251.0, 277.0), doc="Standard deviation of one vehicle's passes."
    )
    cross_vehicle_nt: tuple[float, float, float] = quantity(
        "nT", default=(719.0, 701.0, 742.0), doc="Standard deviation of different vehicles."
    )


@dataclass
class Merged:
    """A map that passes are added to.

    Attributes
    ----------
    base : the map that laid down the points.
    place : (point, 2) m, mean of the passes; likewise `along` (point, 4): height, speed and
        the north and east parts of the heading's unit vector, NaN where unknown.
    flag, samples : (point,) of the passes together.
    identity : name, digest, vehicle and start of each pass.
    """

    base: xr.Dataset
    plane: Plane
    place: Real
    along: Real
    flag: NDArray[np.uint8]
    samples: NDArray[np.int32]
    statistics: Statistics
    identity: list[tuple[Any, ...]]

    @property
    def distance(self) -> Real:
        """Of the points (point,), m."""
        return np.asarray(self.base["distance"].values)

    @property
    def spacing(self) -> float:
        """Of the points, m."""
        return float(self.base.attrs["spacing_m"])


@dataclass(frozen=True)
class Aligned:
    """A pass at the points of a map.

    Attributes
    ----------
    field, place, along : (point, 3), (point, 2), (point, 4) as in `Merged`.
    row : (point,) the pass's nearest point.
    where : (point,) whether the pass has a field there.
    """

    field: Real
    place: Real
    along: Real
    row: NDArray[np.intp]
    where: Mask


def merge_passes(
    passes: Sequence[xr.Dataset], *, params: MergeParams, road: xr.Dataset | None = None
) -> xr.Dataset:
    """One map of a road, in the body frame, nT, from passes in one direction.

    The points are those of `road`, else of the first pass. Every pass is laid onto them by
    position, then shifted along the road by the shape of its field (`shift`), and compared with
    the passes before it (`transient`). The field is a random-effects mean over vehicles, its
    uncertainty that of the mean (`statistics`). The map holds the sums that it was made of: to
    merge at once and to merge one by one give the same.

    Raises ContractError for passes that differ in road, spacing, direction or calibration, for
    one that is there already, for what is no single pass, and for uncalibrated passes of
    different vehicles; CoverageError for a pass that does not run along the road.
    """
    check_passes(passes, road)
    first, rest = (road, list(passes)) if road is not None else (passes[0], list(passes[1:]))
    merged = _start(first)
    for one in rest:
        _add(merged, one, params)
    return _dataset(merged, params)


def _start(base: xr.Dataset) -> Merged:
    names = ("latitude", "longitude", "height")
    latitude, longitude, height = (base[n].values.astype(np.float64) for n in names)
    level = float(np.nanmedian(height)) if np.isfinite(height).any() else 0.0
    middle = len(latitude) // 2
    plane = Plane(float(latitude[middle]), float(longitude[middle]), level)
    statistics = Statistics(
        [str(n) for n in base["vehicle_name"].values],
        *(base[f"vehicle_{n}"].values.copy() for n in ("passes", "mean", "square_sum")),
    )
    statistics.mean = statistics.mean.astype(np.float64)
    statistics.square_sum = statistics.square_sum.astype(np.float64)
    return Merged(
        base, plane, plane.metres(latitude, longitude), _along_of(base),
        base["quality_flag"].values.astype(np.uint8), base["samples"].values.copy(), statistics,
        _identity(base),
    )  # fmt: skip


def _along_of(road: xr.Dataset) -> Real:
    heading = np.radians(road["heading"].values.astype(np.float64))
    height = road["height"].values.astype(np.float64)
    speed = road["speed"].values if "speed" in road else np.full(len(height), np.nan)
    return np.column_stack([height, speed, np.cos(heading), np.sin(heading)])


def _identity(road: xr.Dataset) -> list[tuple[Any, ...]]:
    names = ("pass_name", "pass_digest", "pass_vehicle", "pass_start")
    missing = np.full(road.sizes["pass"], np.datetime64("NaT"), dtype="datetime64[ns]")
    columns = [road[n].values if n in road else missing for n in names]
    return list(zip(*columns, strict=True))


def _add(merged: Merged, one: xr.Dataset, params: MergeParams) -> None:
    aligned = _align(merged, one, params)
    vehicle = merged.statistics.index(str(one["vehicle_name"].values[0]))
    already = (merged.flag & np.uint8(RoadFlag.TRANSIENT_DROPPED)) != 0
    where, dropped = drop_transients(
        merged.statistics, vehicle, aligned.field, aligned.where, merged.spacing, already
    )
    before = merged.statistics.passes[where, None].astype(np.float64)
    merged.statistics.add(vehicle, aligned.field, where)
    merged.place[where] += (aligned.place - merged.place)[where] / (before + 1.0)
    known, new = merged.along[where], aligned.along[where]
    both = known + (new - known) / (before + 1.0)
    merged.along[where] = np.where(np.isfinite(both), both, np.where(np.isfinite(new), new, known))
    flag = one["quality_flag"].values.astype(np.uint8)[aligned.row]
    cleared = np.uint8(_EVERY_PASS) & ~flag[where]
    merged.flag[where] &= ~cleared
    merged.flag[dropped] |= np.uint8(RoadFlag.TRANSIENT_DROPPED)
    merged.samples[where] += one["samples"].values[aligned.row[where]]
    merged.identity += _identity(one)


def _align(merged: Merged, one: xr.Dataset, params: MergeParams) -> Aligned:
    """A pass laid onto the map by position, then by the field."""
    path = merged.plane.metres(one["latitude"].values, one["longitude"].values)
    line = Centreline.through(merged.place, merged.distance)
    at, _ = along(line, path, max_offset_m=params.max_offset_m)
    rows = np.flatnonzero(np.isfinite(at))
    rows = rows[np.concatenate([[True], np.diff(at[rows]) > 1e-6])] if rows.size else rows
    low, high = merged.distance[0], merged.distance[-1]
    if rows.size < 2 or at[rows[0]] > high or at[rows[-1]] < low:
        raise _beside(merged, one, path, params)
    field = one["field_body"].values.astype(np.float64)[rows]
    sigma = params.position_sigma_m * np.sqrt(1.0 + 1.0 / merged.statistics.passes.max())
    shift = shifts(
        merged.distance, merged.statistics.plain_mean, at[rows], field, sigma_m=float(sigma)
    )
    wanted = merged.distance + shift
    where = (wanted >= at[rows[0]]) & (wanted <= at[rows[-1]])
    held = np.clip(wanted, at[rows[0]], at[rows[-1]])
    nearest = rows[_nearest(at[rows], held)]
    where &= (one["quality_flag"].values[nearest] & int(_NO_FIELD)) != int(_NO_FIELD)
    others = np.column_stack([path, _along_of(one)])[rows]
    there = np.column_stack([np.interp(held, at[rows], column) for column in others.T])
    return Aligned(CubicSpline(at[rows], field)(held), there[:, :2], there[:, 2:], nearest, where)


def _nearest(known: Real, wanted: Real) -> NDArray[np.intp]:
    after = np.clip(np.searchsorted(known, wanted), 1, len(known) - 1)
    return np.asarray(after - (wanted - known[after - 1] < known[after] - wanted))


def _beside(merged: Merged, one: xr.Dataset, path: Real, params: MergeParams) -> Exception:
    name, road = one["pass_name"].values[0], merged.base.attrs["road"]
    back = Centreline.through(merged.place, merged.distance).reversed()
    if np.isfinite(along(back, path, max_offset_m=params.max_offset_m)[0]).any():
        return ContractError(
            f"pass '{name}' is driven the other way along road '{road}'",
            where="passes",
            expected="passes in one direction",
            remedy="resample it with the role road, and make a map of each direction",
        )
    return CoverageError(
        f"pass '{name}' does not run along road '{road}'",
        where="passes",
        expected=f"a stretch within {params.max_offset_m:g} m of it",
        remedy="leave it out, or name its own road",
    )


def _dataset(merged: Merged, params: MergeParams) -> xr.Dataset:
    calibrated = merged.base.attrs["calibrated"] == "true"
    same, cross = np.array(params.same_vehicle_nt), np.array(params.cross_vehicle_nt)
    between = np.sqrt(np.maximum(cross**2 - same**2, 0.0)) if calibrated else np.zeros(3)
    found = estimate(merged.statistics, same_nt=same, between_nt=between, spacing_m=merged.spacing)
    latitude, longitude = merged.plane.degrees(merged.place)
    height, speed, north, east = merged.along.T
    passes = merged.statistics.passes
    flag = merged.flag & ~np.uint8(RoadFlag.SINGLE_PASS)
    flag[passes == 1] |= np.uint8(RoadFlag.SINGLE_PASS)
    names, digests, vehicles, starts = zip(*merged.identity, strict=True)
    values = {
        "distance": merged.distance,
        "latitude": latitude,
        "longitude": longitude,
        "height": height,
        "heading": np.asarray(np.degrees(np.arctan2(east, north)) % 360.0),
        "speed": speed,
        "field_body": found.field,
        "field_body_uncertainty": found.sigma,
        "variation_same_vehicle": found.same_vehicle,
        "variation_cross_vehicle": found.cross_vehicle,
        "passes": passes,
        "samples": merged.samples,
        "quality_flag": flag,
        "vehicle_name": np.array(merged.statistics.names),
        "vehicle_passes": merged.statistics.number,
        "vehicle_mean": merged.statistics.mean,
        "vehicle_square_sum": merged.statistics.square_sum,
        "pass_name": np.array(names, dtype=str),
        "pass_digest": np.array(digests, dtype=str),
        "pass_vehicle": np.array(vehicles, dtype=str),
        "pass_start": np.array(starts, dtype="datetime64[ns]"),
    }
    kept = ("road", "spacing_m", "length_m", "calibrated", "direction", "height_reference")
    attrs = {name: merged.base.attrs[name] for name in kept}
    attrs["source"] = f"{len(merged.identity)} passes of {len(merged.statistics.names)} vehicles"
    if "heading_source" in merged.base.attrs:
        attrs["heading_source"] = merged.base.attrs["heading_source"]
    return road_dataset(values, attrs)


STAGE = Stage(
    name="merge-passes",
    version=1,
    params=MergeParams,
    inputs={"passes": Many("road-map/1"), "road": OptionalInput("road-map/1")},
    output="road-map/1",
    run=merge_passes,
)
