"""Where the sensor was, and how it was turned, at the times of the field."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magtiles.catalog.flags import TrackFlag
from magtiles.catalog.kernels.geodesy import metres_per_degree, wrap_longitude
from magtiles.schemas.errors import SourceError

Real = NDArray[np.float64]
Times = NDArray[np.datetime64]
"""datetime64[ns], UTC."""

_BLOCK = 65_536
"""Rows at a time, so that a long log needs little memory beside its own columns."""


@dataclass(frozen=True)
class Fixes:
    """Positions of the antenna, in order of time.

    Attributes
    ----------
    time : (n,) strictly ascending.
    latitude, longitude : (n,) degrees, NaN where the receiver has none.
    height : (n,) m above whatever the log's `height_reference` says.
    status : (n,) -1 no fix, 0 fix, 1 satellite-based, 2 ground-based augmentation.
    horizontal_sigma, vertical_sigma : (n,) m, NaN if unknown.
    """

    time: Times
    latitude: Real
    longitude: Real
    height: Real
    status: NDArray[np.int8]
    horizontal_sigma: Real
    vertical_sigma: Real

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Which fixes have a position."""
        return (self.status >= 0) & np.isfinite(self.latitude) & np.isfinite(self.longitude)


@dataclass(frozen=True)
class Attitudes:
    """Attitude and rates of turn of the body frame forward, right, down, in order of time.

    Attributes
    ----------
    time : (n,) strictly ascending.
    quaternion : (n, 4) w, x, y, z, body to north, east, down; NaN where unknown.
    angular_rate : (n, 3) rad/s about the body axes; NaN where unknown.
    """

    time: Times
    quaternion: Real
    angular_rate: Real


@dataclass(frozen=True)
class Positions:
    """Latitude, longitude (degrees), height (m) and `TrackFlag` bits, each (n,)."""

    latitude: Real
    longitude: Real
    height: Real
    flag: NDArray[np.uint16]


def positions_at(time: Times, fixes: Fixes, *, max_gap_s: float) -> Positions:
    """The antenna's place at each of `time` (n,), linear between the valid fixes around it.

    NaN and flagged where those are more than `max_gap_s` apart (POSITION_GAP, or NO_FIX where
    the receiver said in between that it had none), and before the first and after the last
    (NO_FIX). Linear in degrees: 100 m between fixes bend by less than a millimetre below 80
    degrees of latitude.
    """
    place, flag = np.full((3, time.size), np.nan), np.zeros(time.size, dtype=np.uint16)
    good = fixes.valid
    if not good.any():
        return Positions(place[0], place[1], place[2], flag | np.uint16(TrackFlag.NO_FIX))
    turns = np.degrees(np.unwrap(np.radians(fixes.longitude[good])))
    known = _Known(
        fixes.time[good],
        np.stack([fixes.latitude[good], turns, fixes.height[good]]),
        np.concatenate([[0], np.cumsum(~good)])[np.flatnonzero(good)],
    )
    for start in range(0, time.size, _BLOCK):
        rows = slice(start, start + _BLOCK)
        place[:, rows], flag[rows] = _placed(time[rows], known, max_gap_s)
    latitude, longitude, height = place
    return Positions(latitude, wrap_longitude(longitude), height, flag)


@dataclass(frozen=True)
class _Known:
    """Valid fixes: times (n,), places (3, n), and how many invalid ones came before each (n,)."""

    time: Times
    place: Real
    refusals: NDArray[np.int64]


def _placed(time: Times, fixes: _Known, max_gap_s: float) -> tuple[Real, NDArray[np.uint16]]:
    """Places (3, m), longitudes unwrapped, and flags (m,) at `time` (m,)."""
    at, refusals = fixes.time, fixes.refusals
    place, flag = np.full((3, time.size), np.nan), np.zeros(time.size, dtype=np.uint16)
    outside = (time < at[0]) | (time > at[-1])
    after = np.minimum(np.maximum(np.searchsorted(at, time), 1), at.size - 1)
    before = np.maximum(after - 1, 0)
    after[time == at[before]] = before[time == at[before]]  # on a fix no gap matters
    before[time == at[after]] = after[time == at[after]]
    wide = _seconds(at[after] - at[before]) > max_gap_s
    lost = wide & (refusals[after] > refusals[before])
    flag[outside | lost] |= TrackFlag.NO_FIX.value
    flag[wide & ~lost & ~outside] |= TrackFlag.POSITION_GAP.value
    known = ~(outside | wide)
    for row, values in zip(place, fixes.place, strict=True):
        row[known] = _between(time[known], at, values, before[known], after[known])
    return place, flag


def attitude_at(time: Times, attitudes: Attitudes, *, max_gap_s: float) -> Real:
    """Quaternions (n, 4) at each of `time` (n,), turning evenly between the two samples around.

    NaN where those are more than `max_gap_s` apart, and before the first and after the last.
    """
    good = np.isfinite(attitudes.quaternion).all(axis=1)
    at = attitudes.time[good]
    out = np.full((time.size, 4), np.nan)
    if at.size < 2:
        return out
    after = np.clip(np.searchsorted(at, time), 1, at.size - 1)
    known = (time >= at[0]) & (time <= at[-1])
    known &= _seconds(at[after] - at[after - 1]) <= max_gap_s
    if known.any():
        turns = Rotation.from_quat(attitudes.quaternion[good], scalar_first=True)
        first, second = turns[after[known] - 1], turns[after[known]]
        share = _share(time[known], at, after[known] - 1, after[known])
        step = Rotation.from_rotvec(share[:, None] * (first.inv() * second).as_rotvec())
        out[known] = (first * step).as_quat(scalar_first=True)
    return out


def moved_by_lever(positions: Positions, quaternion: Real, lever_arm_m: Real) -> Positions:
    """Places of the sensor from places of the antenna.

    Parameters
    ----------
    quaternion : (n, 4) body to north, east, down; where it is NaN the place becomes NaN with
        POSITION_GAP.
    lever_arm_m : (3,) from the antenna to the sensor: forward, right, down.

    Raises
    ------
    SourceError : no attitude is known at all.
    """
    known = np.isfinite(quaternion).all(axis=1)
    if not known.any():
        raise SourceError(
            "key 'lever_arm_m' needs the attitude, and the log has none",
            remedy="name its topic with 'attitude_topic', or remove 'lever_arm_m'",
        )
    north, east, down = np.full((3, known.size), np.nan)
    turn = Rotation.from_quat(quaternion[known], scalar_first=True)
    north[known], east[known], down[known] = turn.apply(lever_arm_m).T
    placed = np.isfinite(positions.latitude)
    per_latitude, per_longitude = metres_per_degree(
        positions.latitude, np.nan_to_num(positions.height)
    )
    flag = positions.flag.copy()
    flag[placed & ~known] |= TrackFlag.POSITION_GAP.value
    return Positions(
        positions.latitude + north / per_latitude,
        wrap_longitude(positions.longitude + east / per_longitude),
        positions.height - down,
        flag,
    )


def interpolated(time: Times, at: Times, values: Real, *, max_gap_s: float) -> Real:
    """`values` (m,) of the times `at` at each of `time`, NaN in gaps and outside."""
    good = np.isfinite(values)
    at, values = at[good], values[good]
    out = np.full(time.size, np.nan)
    if at.size < 2:
        return out
    after = np.clip(np.searchsorted(at, time), 1, at.size - 1)
    known = (time >= at[0]) & (time <= at[-1])
    known &= _seconds(at[after] - at[after - 1]) <= max_gap_s
    out[known] = _between(time[known], at, values, after[known] - 1, after[known])
    return out


def _between(
    time: Times, at: Times, values: Real, before: NDArray[np.intp], after: NDArray[np.intp]
) -> Real:
    share = _share(time, at, before, after)
    mixed: Real = (1.0 - share) * values[before] + share * values[after]
    return mixed


def _share(time: Times, at: Times, before: NDArray[np.intp], after: NDArray[np.intp]) -> Real:
    """How far each time lies from the sample before it to the one after: 0 to 1."""
    # Differences of times first: nanoseconds since 1970 do not fit a float.
    span = _seconds(at[after] - at[before])
    return np.divide(_seconds(time - at[before]), span, out=np.zeros_like(span), where=span > 0)


def _seconds(span: NDArray[np.timedelta64]) -> Real:
    return span / np.timedelta64(1, "s")
