"""Stage ``align-log``: sensors of a track brought to one clock, fixes sifted, places made anew."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magtiles.catalog.flags import TrackFlag, flag_attributes
from magtiles.schemas.errors import ContractError
from magtiles.stages.declare import Params, Stage, quantity
from magtiles.stages.ingest.log.source import Axes, Vector, rotation
from magtiles.stages.vehicle.fix_gate import Way, fix_outliers, stationary, way_of
from magtiles.stages.vehicle.lag import Lag, Samples, estimate_lag
from magtiles.stages.vehicle.positions import (
    Attitudes,
    Fixes,
    Positions,
    Real,
    Times,
    attitude_at,
    moved_by_lever,
    positions_at,
)

_LOG = logging.getLogger(__name__)

_MOVING_MPS = 2.0
"""Below, the course between fixes is noise."""
_CHORD_S = 1.0
"""Course is that from so long before to so long after; noise of fixes hides it over less."""
_TOO_LITTLE = "too little turning, or no vector field"
_OWN = TrackFlag.NO_FIX | TrackFlag.POSITION_GAP | TrackFlag.FIX_OUTLIER | TrackFlag.STATIONARY
_DOUBTFUL = TrackFlag.FIELD_GAP | TrackFlag.FIELD_SPIKE | TrackFlag.CLOCK_STEP


class AlignLogParams(Params):
    """Parameters of align-log."""

    attitude_lag_s: float | None = quantity(
        "s",
        default=None,
        doc="How much later the attitude is stamped than the field; default estimated.",
    )
    fix_lag_s: float | None = quantity(
        "s",
        default=None,
        doc="How much later fixes are stamped than the field; default estimated or zero.",
    )
    antenna_ahead_m: float | None = quantity(
        "m",
        default=None,
        doc="From the middle of the rear axle forward to the antenna; estimates the fixes' lag.",
    )
    max_lag_s: float = quantity("s", default=1.0, gt=0, le=30, doc="Greatest lag to look for.")
    max_gap_s: float | None = quantity(
        "s", default=None, gt=0, doc="Longest gap to interpolate over; default as at ingest."
    )
    max_speed_mps: float = quantity("m s-1", default=100.0, gt=0, doc="Faster fixes are outliers.")
    max_acceleration_mps2: float = quantity(
        "m s-2", default=5.0, gt=0, doc="Fixes that need more are outliers."
    )
    stationary_mps: float = quantity(
        "m s-1", default=0.5, ge=0, doc="Slower rows are flagged as stationary."
    )
    stationary_window_s: float = quantity(
        "s", default=5.0, gt=0, doc="Time over which that speed is meant."
    )
    sensor_to_body: Axes | None = quantity(
        "1",
        default=None,
        doc="Where the magnetometer's x, y, z point, where ingest-log was not told.",
    )
    lever_arm_m: Vector | None = quantity(
        "m", default=None, doc="From antenna to magnetometer: forward, right, down; as at ingest."
    )


def align_log(track: xr.Dataset, *, params: AlignLogParams) -> xr.Dataset:
    """The track with attitude and places of the instants of the field.

    A lag is that at which one sensor explains another best by least squares: the attitude, by
    the nine elements of its rotation, the vector field; the course between fixes where the body
    points, or the field where no attitude is known. No calibration of the magnetometer is
    needed. In a turn the course of an antenna ahead of the rear axle leads, as if stamped early
    by the distance over the speed: the lag of fixes is estimated if `antenna_ahead_m` is stated.
    Where a lag cannot be told it is taken as zero, with a warning. The attributes
    `attitude_lag_s`, `fix_lag_s`, their `_sigma_s` and `_origin` (estimated, stated, not
    observable) record it. Fixes and attitude samples stay as the log has them, so that the stage
    may run again.

    Fixes that break the gates of speed and acceleration are left out; rows between whose fixes
    one was left out are flagged `fix_outlier`, slow ones `stationary`. A track whose rows have
    their own positions keeps them, with these flags.

    Raises ContractError where `sensor_to_body` was already applied, or there is no vector field.
    """
    track = _turned(track, params)
    recorded = _attitudes(track)
    attitude_lag = _attitude_lag(track, recorded, params)
    attitude = None
    if recorded is not None:
        shifted = replace(recorded, time=recorded.time - _nanoseconds(attitude_lag.seconds))
        attitude = attitude_at(_times(track), shifted, max_gap_s=_max_gap(track, params))
        track = track.assign(attitude=(("time", "quaternion"), attitude, track["attitude"].attrs))
    fixes = _fixes(track)
    if fixes is None:
        return _own_positions(track, params).assign_attrs(attitude_lag.attrs("attitude"))
    fixes, outliers = _sifted(fixes, params)
    fix_lag = _fix_lag(track, fixes, attitude, params)
    fixes = replace(fixes, time=fixes.time - _nanoseconds(fix_lag.seconds))
    placed = _placed(track, fixes, attitude, params)
    bits = placed.flag | _moving_flags(_times(track), fixes, outliers, params)
    return _with_places(track, placed, bits).assign_attrs(
        attitude_lag.attrs("attitude") | fix_lag.attrs("fix")
    )


@dataclass(frozen=True)
class _Applied:
    """A lag as it is applied: seconds, 1 sigma (NaN if unknown), and where it comes from."""

    seconds: float
    sigma: float
    origin: str | None

    def attrs(self, sensor: str) -> dict[str, Any]:
        """Attributes that record it; none for a sensor that is not there."""
        if self.origin is None:
            return {}
        found: dict[str, Any] = {
            f"{sensor}_lag_s": self.seconds, f"{sensor}_lag_origin": self.origin
        }  # fmt: skip
        if np.isfinite(self.sigma):
            found[f"{sensor}_lag_sigma_s"] = self.sigma
        return found


_ABSENT = _Applied(0.0, np.nan, None)


def _applied(
    sensor: str, stated: float | None, found: Lag | None, why: str = _TOO_LITTLE
) -> _Applied:
    if stated is not None:
        return _Applied(stated, np.nan, "stated")
    if found is None:
        _LOG.warning(
            "the lag of the %s cannot be told from this track (%s); taken as zero: state it with "
            "'%s_lag_s'", sensor, why, sensor,
        )  # fmt: skip
        return _Applied(0.0, np.nan, "not observable")
    _LOG.info(
        "%s %.1f ms late, 1 sigma %.1f ms, explains %.1f %% of the field's variance",
        sensor, 1e3 * found.seconds, 1e3 * found.sigma, 1e2 * found.explained,
    )  # fmt: skip
    return _Applied(found.seconds, found.sigma, "estimated")


def _attitude_lag(
    track: xr.Dataset, attitudes: Attitudes | None, params: AlignLogParams
) -> _Applied:
    if attitudes is None:
        return _ABSENT
    found = None
    if params.attitude_lag_s is None and "field_body" in track:
        field = track["field_body"].values.astype(np.float64)
        found = estimate_lag(
            _undoubted(track, field, params),
            Samples(
                _seconds(track, attitudes.time), _matrices(attitudes.quaternion),
                _max_gap(track, params),
            ),
            max_lag_s=params.max_lag_s,
        )  # fmt: skip
    return _applied("attitude", params.attitude_lag_s, found)


def _fix_lag(
    track: xr.Dataset, fixes: Fixes, attitude: Real | None, params: AlignLogParams
) -> _Applied:
    """Of the course between fixes, behind where the body points, else behind the field."""
    seen = None if attitude is None else _matrices(attitude)[:, [0, 3]]
    if seen is None and "field_body" in track:
        seen = track["field_body"].values.astype(np.float64)
    good, found, ahead = fixes.valid, None, params.antenna_ahead_m
    if params.fix_lag_s is None and ahead is not None and seen is not None and good.sum() > 2:
        way = way_of(fixes.time[good], fixes.latitude[good], fixes.longitude[good])
        way = replace(way, seconds=_seconds(track, fixes.time[good]))
        found = _lag_of_course(_undoubted(track, seen, params), way, ahead, params)
    why = _TOO_LITTLE if ahead is not None else "'antenna_ahead_m' is not stated"
    return _applied("fix", params.fix_lag_s, found, why)


def _lag_of_course(seen: Samples, way: Way, ahead_m: float, params: AlignLogParams) -> Lag | None:
    """Of the course along a way behind what was seen to turn; seconds of both have one zero.

    The course of an antenna ahead of the point that goes where the body points leads by that
    distance times the turning, over the speed.
    """
    half_s = max(_CHORD_S, float(np.median(np.diff(way.seconds))))
    velocity = way.chord(way.seconds, half_s)
    speed = np.linalg.norm(velocity, axis=1)
    moving = speed > _MOVING_MPS
    seen = seen.known()
    if moving.sum() < 2 or seen.seconds.size < 2:
        return None
    course = velocity / np.where(moving, speed, np.nan)[:, None]
    turning = np.gradient(seen.values, seen.seconds, axis=0)
    leads = ahead_m / np.interp(seen.seconds, way.seconds[moving], speed[moving])
    return estimate_lag(
        replace(seen, values=seen.values + leads[:, None] * turning),
        Samples(way.seconds, course, 2.0 * seen.max_gap_s),
        max_lag_s=params.max_lag_s,
    )


def _undoubted(track: xr.Dataset, values: Real, params: AlignLogParams) -> Samples:
    """Values (time, m) of the rows that nothing is said against."""
    good = np.ones(values.shape[0], dtype=bool)
    if "quality_flag" in track:
        good = (track["quality_flag"].values & int(_DOUBTFUL)) == 0
    time = _seconds(track, _times(track))[good]
    rising = np.concatenate([[True], np.diff(np.maximum.accumulate(time)) > 0])
    return Samples(time[rising], values[good][rising], _max_gap(track, params))


def _matrices(quaternion: Real) -> Real:
    """Rotations (n, 9), rows of NaN where a quaternion (n, 4) is unknown."""
    out = np.full((quaternion.shape[0], 9), np.nan)
    known = np.isfinite(quaternion).all(axis=1)
    if known.any():
        turned = Rotation.from_quat(quaternion[known], scalar_first=True)
        out[known] = turned.as_matrix().reshape(-1, 9)
    return out


def _seconds(track: xr.Dataset, time: Times) -> Real:
    return np.asarray((time - track["time"].values[0]) / np.timedelta64(1, "s"))


def _turned(track: xr.Dataset, params: AlignLogParams) -> xr.Dataset:
    turn = rotation(params.sensor_to_body)
    if turn is None:
        return track
    if "field_body" not in track or "sensor_to_body" in track.attrs:
        raise ContractError(
            "'sensor_to_body' was already applied"
            if "field_body" in track
            else "'field_body' is missing, so there are no axes to turn",
            where=track.attrs.get("source"),
            remedy="leave the parameter 'sensor_to_body' out",
        )
    field = track["field_body"]
    turned = field.values.astype(np.float64) @ turn.T
    return track.assign(field_body=(("time", "axis"), turned, field.attrs)).assign_attrs(
        sensor_to_body=[float(v) for v in turn.ravel()]
    )


def _sifted(fixes: Fixes, params: AlignLogParams) -> tuple[Fixes, Times]:
    """The fixes with outliers marked as having no position, and the outliers' times."""
    good = np.flatnonzero(fixes.valid)
    if not good.size:
        return fixes, fixes.time[:0]
    way = way_of(fixes.time[good], fixes.latitude[good], fixes.longitude[good])
    wrong = good[
        fix_outliers(
            way,
            fixes.horizontal_sigma[good],
            max_speed=params.max_speed_mps,
            max_acceleration=params.max_acceleration_mps2,
        )
    ]
    if wrong.size:
        _LOG.warning(
            "%d of %d fixes are outliers, the first at %s", wrong.size, good.size,
            fixes.time[wrong[0]],
        )  # fmt: skip
    kept = np.ones(fixes.time.size, dtype=bool)
    kept[wrong] = False
    sifted = {name: values[kept] for name, values in vars(fixes).items()}
    return Fixes(**sifted), fixes.time[wrong]


def _placed(
    track: xr.Dataset, fixes: Fixes, attitude: Real | None, params: AlignLogParams
) -> Positions:
    positions = positions_at(_times(track), fixes, max_gap_s=_max_gap(track, params))
    arm = params.lever_arm_m or track.attrs.get("lever_arm_m")
    if arm is None:
        return positions
    turns = np.full((positions.latitude.size, 4), np.nan) if attitude is None else attitude
    return moved_by_lever(positions, turns, np.asarray(arm, dtype=np.float64))


def _moving_flags(
    time: Times, fixes: Fixes, outliers: Times, params: AlignLogParams
) -> NDArray[np.uint16]:
    """FIX_OUTLIER between fixes of which one was left out, STATIONARY where it is slow."""
    flag = np.zeros(time.size, dtype=np.uint16)
    at = fixes.time[fixes.valid]
    if not at.size:
        return flag
    before = np.searchsorted(at, outliers)  # so many good fixes before each outlier
    flag[np.isin(np.searchsorted(at, time), before)] |= TrackFlag.FIX_OUTLIER.value
    way = way_of(at, fixes.latitude[fixes.valid], fixes.longitude[fixes.valid])
    flag[_still(way, at[0], time, params)] |= TrackFlag.STATIONARY.value
    return flag


def _still(
    way: Way, start: np.datetime64, time: Times, params: AlignLogParams
) -> NDArray[np.bool_]:
    seconds = (time - start) / np.timedelta64(1, "s")
    window = params.stationary_window_s
    return stationary(way, seconds, speed=params.stationary_mps, window_s=window)


def _own_positions(track: xr.Dataset, params: AlignLogParams) -> xr.Dataset:
    """Flags for a track whose rows carry their own positions, which stay."""
    time = _times(track)
    latitude, longitude = track["latitude"].values, track["longitude"].values
    known = np.isfinite(latitude) & np.isfinite(longitude)
    if "quality_flag" in track:
        known &= (track["quality_flag"].values & TrackFlag.CLOCK_STEP.value) == 0
    rows = np.flatnonzero(known)
    bits = np.zeros(time.size, dtype=np.uint16)
    bits[~np.isfinite(latitude)] |= TrackFlag.NO_FIX.value
    if rows.size > 1:
        way = way_of(time[rows], latitude[rows], longitude[rows])
        wrong = fix_outliers(
            way,
            np.full(rows.size, np.nan),
            max_speed=params.max_speed_mps,
            max_acceleration=params.max_acceleration_mps2,
        )
        bits[rows[wrong]] |= TrackFlag.FIX_OUTLIER.value
        bits[_still(way, time[rows[0]], time, params)] |= TrackFlag.STATIONARY.value
    return _flagged(track, bits)


def _with_places(track: xr.Dataset, placed: Positions, bits: NDArray[np.uint16]) -> xr.Dataset:
    values = {"latitude": placed.latitude, "longitude": placed.longitude, "height": placed.height}
    return _flagged(track.assign({n: ("time", v, track[n].attrs) for n, v in values.items()}), bits)


def _flagged(track: xr.Dataset, bits: NDArray[np.uint16]) -> xr.Dataset:
    flag = np.zeros(bits.size, np.uint16)
    if "quality_flag" in track:
        flag = track["quality_flag"].values.astype(np.uint16) & np.uint16(~int(_OWN) & 0xFFFF)
    return track.assign(quality_flag=("time", flag | bits, flag_attributes(TrackFlag, np.uint16)))


def _fixes(track: xr.Dataset) -> Fixes | None:
    if "fix_time" not in track:
        return None
    blank = np.full(track.sizes["fix"], np.nan)
    sigmas = (
        track[name].values if name in track else blank
        for name in ("fix_horizontal_sigma", "fix_vertical_sigma")
    )
    names = ("fix_time", "fix_latitude", "fix_longitude", "fix_height", "fix_status")
    return Fixes(*(track[name].values for name in names), *sigmas)


def _attitudes(track: xr.Dataset) -> Attitudes | None:
    if "attitude_quaternion" not in track:
        return None
    quaternion = track["attitude_quaternion"].values
    blank = np.full((quaternion.shape[0], 3), np.nan)
    rate = track["angular_rate"].values if "angular_rate" in track else blank
    return Attitudes(track["attitude_time"].values, quaternion, rate)


def _times(track: xr.Dataset) -> Times:
    return np.asarray(track["time"].values)


def _max_gap(track: xr.Dataset, params: AlignLogParams) -> float:
    return float(params.max_gap_s or track.attrs.get("max_gap_s", 2.0))


def _nanoseconds(seconds: float) -> np.timedelta64:
    return np.timedelta64(round(seconds * 1e9), "ns")


STAGE = Stage(
    name="align-log",
    version=1,
    params=AlignLogParams,
    inputs={"track": "track/1"},
    output="track/1",
    run=align_log,
)
