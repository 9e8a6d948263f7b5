"""Stage ``resample-by-distance``: from a drive in time to one pass of a road in distance."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.flags import RoadFlag, TrackFlag
from magtiles.schemas.errors import ContractError, CoverageError
from magtiles.stages.declare import OptionalInput, Stage, quantity
from magtiles.stages.road.cells import Cells, between_sparse_samples, cells_of, filled
from magtiles.stages.road.centreline import Centreline, along
from magtiles.stages.road.motion import Motion, motion_of
from magtiles.stages.road.road_map import road_dataset
from magtiles.stages.road.split import SplitParams, part_of

Real = NDArray[np.float64]
Mask = NDArray[np.bool_]

_NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]*$"
_UNFIT = TrackFlag.FIELD_SPIKE | TrackFlag.FIELD_GAP
_DOUBTFUL = TrackFlag.NO_FIX | TrackFlag.FIX_OUTLIER | TrackFlag.POSITION_GAP


class ResampleParams(SplitParams):
    """Parameters of resample-by-distance."""

    spacing_m: float = quantity("m", default=1.0, gt=0, doc="Distance between the map's points.")
    road: str | None = quantity(
        "1", default=None, pattern=_NAME, doc="Name of the road; default that of the role road."
    )
    vehicle: str = quantity("1", default="vehicle", min_length=1, doc="Name of the vehicle.")
    pass_name: str | None = quantity(
        "1", default=None, min_length=1, doc="Name of this pass; default its first instant."
    )
    calibrated: bool | None = quantity(
        "1", default=None, doc="Whether the field is calibrated; default as the track says."
    )
    part: int | None = quantity(
        "1", default=None, ge=0, doc="Part of the drive, split at junctions, U-turns and gaps."
    )
    sampling_limit_m: float = quantity(
        "m", default=3.0, gt=0, doc="Samples further apart than this miss small features."
    )
    direction: Literal["forward", "backward"] | None = quantity(
        "1", default=None, doc="Which way along the role road; default the longer run."
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


@dataclass(frozen=True)
class Drive:
    """The samples of a pass with a field, moving, in order of time.

    `distance` (n,) m along the road; `row` (n,) their rows in the track.
    """

    row: NDArray[np.intp]
    seconds: Real
    distance: Real


def resample_by_distance(
    track: xr.Dataset, *, params: ResampleParams, road: xr.Dataset | None = None
) -> xr.Dataset:
    """The field of one pass at equal distances along its road, in the body frame, nT.

    Distance is that of the most probable path (`smoother`); a standing vehicle adds nothing.
    Each point has the mean of the samples within half a spacing, or, flagged INTERPOLATED,
    what lies between its neighbours. With `road` distances are that road's, for the longest
    run of the drive that keeps to it, in either direction or that asked for; without, they count
    from the start. The uncertainty is the variation of Shockley (2012, table 4.1), or as stated:
    one pass has none of its own.

    Raises ContractError for a track without a vector field or whose places jump, CoverageError
    for a drive that stands, is shorter than the spacing, has gaps, or does not keep to `road`.
    """
    _check(track, params, road)
    motion = motion_of(
        track, position_sigma_m=params.position_sigma_m, standstill_m_s=params.standstill_m_s
    )
    place, low, high, backward = _distance_along(motion, track, params, road)
    drive = _drive(track, motion, place)
    cells, inside = cells_of(drive.distance, params.spacing_m, low=low, high=high)
    drive = Drive(drive.row[inside], drive.seconds[inside], drive.distance[inside])
    _check_length(cells, drive, motion, track)
    _check_gaps(drive, params, track)
    values = _values(track, motion, drive, cells, place)
    values["quality_flag"] = _flags(track, motion, drive, cells, params, values["samples"])
    values |= _statistics(values["field_body"], params, _is_calibrated(track, params))
    values |= _identity(track, drive, params)
    attrs = _attributes(track, motion, drive, params, road, backward, cells)
    return road_dataset(values, attrs)


def _check(track: xr.Dataset, params: ResampleParams, road: xr.Dataset | None) -> None:
    source = track.attrs.get("source")
    if "field_body" not in track:
        raise ContractError(
            "'field_body' is missing",
            where=source,
            expected="the three-axis field in the body frame",
            remedy="a scalar magnetometer cannot map a road",
        )
    if road is None:
        return
    if abs(float(road.attrs["spacing_m"]) / params.spacing_m - 1.0) > 1e-9:
        raise ContractError(
            f"the road's spacing is {road.attrs['spacing_m']:g} m, the pass's is to be "
            f"{params.spacing_m:g} m",
            where="spacing_m",
            expected="the same",
        )
    if params.road not in (None, road.attrs["road"]):
        raise ContractError(
            f"the road is '{road.attrs['road']}', not '{params.road}'", where="road"
        )


def _distance_along(
    motion: Motion, track: xr.Dataset, params: ResampleParams, road: xr.Dataset | None
) -> tuple[Real, float, float, bool]:
    """Distance (n,) of the motion's nodes, its bounds, and whether the road is driven back."""
    if road is None:
        if params.part is None:
            return motion.distance, 0.0, float(motion.distance[-1]), False
        part = part_of(motion, track, params, params.part)
        inside = (motion.seconds >= part.start_s) & (motion.seconds <= part.end_s)
        base = float(motion.distance[inside][0])
        distance = np.where(inside, motion.distance - base, np.nan)
        return distance, 0.0, float(np.nanmax(distance)), False
    line = Centreline.of(road, motion.plane)
    runs = [
        along(way, motion.place, max_offset_m=params.max_offset_m)[0]
        for way in (line, line.reversed())
    ]
    covered = [np.ptp(r[np.isfinite(r)]) if np.isfinite(r).any() else 0.0 for r in runs]
    backward = bool(covered[1] > covered[0])
    if params.direction is not None:
        backward = params.direction == "backward"
    if covered[backward] < params.spacing_m:
        way = f", driven {params.direction}" if params.direction else ""
        raise CoverageError(
            f"the drive does not keep to road '{road.attrs['road']}'{way}",
            where=track.attrs.get("source"),
            expected=f"a stretch within {params.max_offset_m:g} m of it",
            remedy="name another road, or leave out the role road to start a new one",
        )
    return runs[backward], float(line.distance[0]), float(line.distance[-1]), backward


def _drive(track: xr.Dataset, motion: Motion, place: Real) -> Drive:
    seconds = motion.seconds_of(track["time"].values)
    field = np.isfinite(track["field_body"].values).all(axis=1)
    if "quality_flag" in track:
        field &= (track["quality_flag"].values & int(_UNFIT)) == 0
    distance = motion.at(seconds, place)
    row = np.flatnonzero(field & motion.moving(seconds) & np.isfinite(distance))
    return Drive(row, seconds[row], distance[row])


def _check_length(cells: Cells, drive: Drive, motion: Motion, track: xr.Dataset) -> None:
    length = float(np.ptp(drive.distance)) if drive.distance.size else 0.0
    if cells.count >= 2 and length >= cells.spacing:
        return
    driven = float(motion.distance[-1])
    standing = driven < cells.spacing and not (~motion.still).any()
    raise CoverageError(
        "the vehicle stands throughout"
        if standing
        else f"the road is {length:.2f} m long, the spacing {cells.spacing:g} m",
        where=track.attrs.get("source"),
        expected="a drive over two points of the map at least",
        remedy="use a longer log or a smaller spacing_m",
    )


def _check_gaps(drive: Drive, params: ResampleParams, track: xr.Dataset) -> None:
    step = np.abs(np.diff(drive.distance))
    worst = int(np.argmax(step))
    if step[worst] > params.max_gap_m:
        time = track["time"].values[drive.row[worst]]
        raise CoverageError(
            f"no sample for {step[worst]:.0f} m after {time}",
            where=track.attrs.get("source"),
            expected=f"at most {params.max_gap_m:g} m",
            remedy="map the parts of the drive one by one with part, or raise max_gap_m",
        )


def _values(
    track: xr.Dataset, motion: Motion, drive: Drive, cells: Cells, place: Real
) -> dict[str, NDArray[Any]]:
    """What the samples say of each cell, and where it lies."""
    field = cells.mean(track["field_body"].values[drive.row].astype(np.float64))
    where, course = _centreline(motion, place, cells.distance)
    latitude, longitude = motion.plane.degrees(where)
    speed = motion.at(drive.seconds, np.linalg.norm(motion.velocity, axis=1))
    height = track["height"].values[drive.row].astype(np.float64)
    attitude = _mean_yaw(track, drive, cells)
    unit = course if attitude is None else attitude
    return {
        "distance": cells.distance,
        "latitude": latitude,
        "longitude": longitude,
        "height": _filled_or_nan(cells.distance, cells.mean(height)),
        "heading": np.asarray(np.degrees(np.arctan2(unit[:, 1], unit[:, 0])) % 360.0),
        "speed": filled(cells.distance, cells.mean(speed)[:, None])[:, 0],
        "field_body": filled(cells.distance, field),
        "samples": cells.samples,
    }


def _centreline(motion: Motion, place: Real, distance: Real) -> tuple[Real, Real]:
    """Place and direction of driving (count, 2), m, at distances along the road."""
    known = np.flatnonzero(np.isfinite(place))
    sign = 1.0 if place[known[-1]] >= place[known[0]] else -1.0
    furthest = np.maximum.accumulate(sign * place[known])
    new = np.concatenate([[True], np.diff(furthest) > 1e-9])
    order = known[new][:: int(sign)]
    where = np.column_stack([np.interp(distance, place[order], p[order]) for p in motion.place.T])
    return where, sign * np.gradient(where, axis=0)


def _filled_or_nan(distance: Real, values: Real) -> Real:
    if not np.isfinite(values).any():
        return values
    return filled(distance, values[:, None])[:, 0]


def _has_attitude(track: xr.Dataset, rows: NDArray[np.intp]) -> bool:
    if "attitude" not in track:
        return False
    return bool(np.isfinite(track["attitude"].values[rows]).all(axis=1).mean() > 0.5)


def _mean_yaw(track: xr.Dataset, drive: Drive, cells: Cells) -> Real | None:
    """Mean heading of the attitude (count, 2) north and east; None where most have none."""
    if not _has_attitude(track, drive.row):
        return None
    w, x, y, z = track["attitude"].values[drive.row].astype(np.float64).T
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y**2 + z**2))
    return filled(cells.distance, cells.mean(np.column_stack([np.cos(yaw), np.sin(yaw)])))


def _flags(
    track: xr.Dataset, motion: Motion, drive: Drive, cells: Cells, params: ResampleParams,
    samples: NDArray[np.int32],
) -> NDArray[np.uint8]:  # fmt: skip
    flag = np.full(cells.count, RoadFlag.SINGLE_PASS, dtype=np.uint8)
    flag[samples == 0] |= RoadFlag.INTERPOLATED.value
    sparse = between_sparse_samples(cells, drive.distance, params.sampling_limit_m)
    flag[sparse | (params.spacing_m > params.sampling_limit_m)] |= RoadFlag.UNDERSAMPLED.value
    doubtful = motion.at(drive.seconds, motion.doubtful.astype(np.float64)) > 0.0
    if "quality_flag" in track:
        doubtful |= (track["quality_flag"].values[drive.row] & int(_DOUBTFUL)) != 0
    flag[cells.any(doubtful)] |= RoadFlag.POSITION_DOUBTFUL.value
    if not _is_calibrated(track, params):
        flag |= np.uint8(RoadFlag.UNCALIBRATED)
    return flag


def _is_calibrated(track: xr.Dataset, params: ResampleParams) -> bool:
    return "calibration" in track.attrs if params.calibrated is None else params.calibrated


def _statistics(field: Real, params: ResampleParams, calibrated: bool) -> dict[str, NDArray[Any]]:
    """The statistics of one pass of one vehicle, to which others can be added."""
    count = len(field)
    sigma = params.cross_vehicle_nt if calibrated else params.same_vehicle_nt
    return {
        "field_body_uncertainty": np.tile(np.array(sigma), (count, 1)),
        "passes": np.ones(count, np.int32),
        "vehicle_name": np.array([params.vehicle]),
        "vehicle_passes": np.ones((1, count), np.int32),
        "vehicle_mean": field[None].copy(),
        "vehicle_square_sum": np.zeros((1, count, 3)),
    }


def _identity(track: xr.Dataset, drive: Drive, params: ResampleParams) -> dict[str, NDArray[Any]]:
    time = track["time"].values[drive.row]
    digest = hashlib.sha256(np.ascontiguousarray(time.astype("int64")).tobytes())
    field = track["field_body"].values[drive.row].astype(np.float64)
    digest.update(np.ascontiguousarray(field).tobytes())
    start = np.array([time.min()], dtype="datetime64[ns]")
    name = params.pass_name or str(start[0].astype("datetime64[s]"))
    return {
        "pass_name": np.array([name]),
        "pass_digest": np.array([digest.hexdigest()]),
        "pass_vehicle": np.array([params.vehicle]),
        "pass_start": start,
    }


def _attributes(
    track: xr.Dataset, motion: Motion, drive: Drive, params: ResampleParams,
    road: xr.Dataset | None, backward: bool, cells: Cells,
) -> dict[str, Any]:  # fmt: skip
    name = params.road or ("road" if road is None else str(road.attrs["road"]))
    attrs: dict[str, Any] = {
        "road": name,
        "spacing_m": params.spacing_m,
        "length_m": float(np.ptp(cells.distance)),
        "calibrated": "true" if _is_calibrated(track, params) else "false",
        "direction": "backward" if backward else "forward",
        "height_reference": str(track.attrs["height_reference"]),
        "heading_source": "attitude" if _has_attitude(track, drive.row) else "course",
        "source": str(track.attrs["source"]),
    }
    if np.isfinite(motion.wheel_scale):
        attrs["wheel_scale"] = motion.wheel_scale
    return attrs


STAGE = Stage(
    name="resample-by-distance",
    version=1,
    params=ResampleParams,
    inputs={"track": "track/1", "road": OptionalInput("road-map/1")},
    output="road-map/1",
    run=resample_by_distance,
)
