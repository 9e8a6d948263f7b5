"""How a vehicle moved: its path and the distance along it, from fixes and wheel speed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.flags import TrackFlag
from magtiles.schemas.errors import ContractError, CoverageError
from magtiles.stages.road.plane import Plane
from magtiles.stages.road.smoother import Observed, Path, most_probable_path

Real = NDArray[np.float64]
Mask = NDArray[np.bool_]
Times = NDArray[np.datetime64]

_NODE_S = 0.1
"""Nodes are at least this far apart, and at most twice as far."""
_LONGEST_STEP_S = 2 * _NODE_S
_CHORD_S = 4.0
"""Over which a vehicle without wheel speed must have moved."""
_JUMP_WINDOW = 11
_JUMP_M = 30.0
"""A fix this far from the median of those around it, beyond what driving explains, is none."""
_FASTEST = 100.0
"""Of a road vehicle, m/s."""
_BELIEVED = 0.1
"""Weight below which a fix counts as refused."""
_MOST_REFUSED = 0.1
"""Share of refused fixes that a receiver may have."""
_TRUSTED_S = 5.0
"""A place further than this in time from any believed fix is doubtful."""


@dataclass(frozen=True)
class Motion:
    """A vehicle's path at nodes in order of time.

    Attributes
    ----------
    plane : in which `place` counts.
    seconds : (n,) since `start`, strictly ascending.
    place, velocity : (n, 2) m and m/s, north and east.
    distance : (n,) m driven since the first node, along the horizontal path.
    still : (n,) whether the vehicle stood.
    doubtful : (n,) whether no believed fix is near in time.
    wheel_scale : true distance per distance of the wheels; NaN without.
    """

    plane: Plane
    start: np.datetime64
    seconds: Real
    place: Real
    velocity: Real
    distance: Real
    still: Mask
    doubtful: Mask
    wheel_scale: float

    def seconds_of(self, time: Times) -> Real:
        """Seconds since `start`."""
        return np.asarray((time - self.start) / np.timedelta64(1, "s"))

    def at(self, seconds: Real, values: Real) -> Real:
        """`values` (n,) of the nodes at other times, linear between; NaN outside."""
        return np.asarray(np.interp(seconds, self.seconds, values, left=np.nan, right=np.nan))

    def moving(self, seconds: Real) -> Mask:
        """Whether the vehicle moved at each time: both nodes around it do."""
        after = np.clip(np.searchsorted(self.seconds, seconds), 1, len(self.seconds) - 1)
        inside = (seconds >= self.seconds[0]) & (seconds <= self.seconds[-1])
        return np.asarray(inside & ~(self.still[after] & self.still[after - 1]))


def motion_of(track: xr.Dataset, *, position_sigma_m: float, standstill_m_s: float) -> Motion:
    """The most probable motion of a track/1 with places, and wheel speed if it has any.

    Parameters
    ----------
    position_sigma_m : of each coordinate of a fix that does not state its own, m.
    standstill_m_s : speed below which the vehicle stands.

    Raises
    ------
    CoverageError : fewer than two fixes.
    ContractError : places that no vehicle reaches one after the other.
    """
    time, latitude, longitude, sigma = _fixes(track, position_sigma_m)
    if len(time) < 2:
        raise CoverageError(
            f"{len(time)} of its samples have a place",
            where=track.attrs.get("source"),
            expected="at least two fixes",
        )
    middle = len(time) // 2
    heights = track["height"].values
    height = float(np.nanmedian(heights)) if np.isfinite(heights).any() else 0.0
    plane = Plane(float(latitude[middle]), float(longitude[middle]), height)
    start = time[0]
    place = plane.metres(latitude, longitude)
    at = np.asarray((time - start) / np.timedelta64(1, "s"))
    place[_jumps(at, place, sigma)] = np.nan
    seconds, row = _nodes(at)
    seen_place = np.full((len(seconds), 2), np.nan)
    seen_place[row >= 0] = place[row[row >= 0]]
    seen_sigma = np.where(row >= 0, sigma[row], position_sigma_m)
    wheel = _wheel_speed(track, start, seconds)
    still = wheel < standstill_m_s
    if not np.isfinite(wheel).any():
        free = most_probable_path(Observed(seconds, seen_place, seen_sigma, wheel, still))
        still = _stands(seconds, free.place, standstill_m_s)
    path = _path(Observed(seconds, seen_place, seen_sigma, wheel, still))
    _check_speed(path.velocity, seconds, start, track)
    believed = np.nan_to_num(path.weight) > _BELIEVED
    _check_believed(believed[row >= 0], time, track)
    step = np.linalg.norm(np.diff(path.place, axis=0), axis=1)
    distance = np.concatenate([[0.0], np.cumsum(step)])
    return Motion(
        plane, start, seconds, path.place, path.velocity, distance, still,
        _far_in_time(seconds, believed), path.wheel_scale,
    )  # fmt: skip


def _path(seen: Observed) -> Path:
    """The most probable path, in which a standstill of any length is one node.

    Its place counts as one fix, the median of those that it had: the errors of a receiver at
    rest are much the same all the time, and no more certain for lasting.
    """
    begins = seen.still & ~np.concatenate([[False], seen.still[:-1]])
    kept = np.flatnonzero(~seen.still | begins)
    group = np.cumsum(~seen.still | begins) - 1
    place = seen.place[kept]
    for first, stood in enumerate(np.split(seen.place, kept[1:])):
        known = np.isfinite(stood).all(axis=1)
        if len(stood) > 1 and known.any():
            place[first] = np.median(stood[known], axis=0)
    if kept.size == 1:
        return _standing(place[0], len(seen.seconds))
    step = np.diff(seen.seconds)
    step[seen.still[1:] & seen.still[:-1]] = 0.0
    driven = np.concatenate([[0.0], np.cumsum(step)])
    path = most_probable_path(
        Observed(driven[kept], place, seen.sigma[kept], seen.wheel_speed[kept], seen.still[kept])
    )
    weight = np.where(np.isfinite(seen.place).all(axis=1), path.weight[group], np.nan)
    return Path(path.place[group], path.velocity[group], weight, path.wheel_scale)


def _standing(place: Real, count: int) -> Path:
    return Path(np.tile(place, (count, 1)), np.zeros((count, 2)), np.ones(count), np.nan)


def _fixes(track: xr.Dataset, sigma_m: float) -> tuple[Times, Real, Real, Real]:
    """Time, latitude, longitude, sigma of the receiver's own fixes, or of the samples' places.

    Places of samples between two fixes are made of these and say nothing new: one in each
    tenth of a second is used.
    """
    if "fix_time" in track and "lever_arm_m" not in track.attrs:
        names = [f"fix_{name}" for name in ("time", "latitude", "longitude")]
        time, latitude, longitude = (track[name].values for name in names)
        good = track["fix_status"].values >= 0
        stated = track.get("fix_horizontal_sigma")
        sigma = np.full(len(time), sigma_m) if stated is None else stated.values / np.sqrt(2.0)
        sigma = np.where(np.isfinite(sigma) & (sigma > 0.0), sigma, sigma_m)
    else:
        time, latitude, longitude = (track[n].values for n in ("time", "latitude", "longitude"))
        good = np.ones(len(time), dtype=np.bool_)
        sigma = np.full(len(time), sigma_m)
        if "quality_flag" in track:
            bad = TrackFlag.NO_FIX | TrackFlag.FIX_OUTLIER | TrackFlag.POSITION_GAP
            good &= (track["quality_flag"].values & int(bad)) == 0
    kept = np.flatnonzero(good & np.isfinite(latitude) & np.isfinite(longitude))
    if kept.size:
        tenth = ((time[kept] - time[kept[0]]) / np.timedelta64(1, "s") / _NODE_S + 1e-6) // 1
        kept = kept[np.unique(tenth, return_index=True)[1]]
    return time[kept], latitude[kept], longitude[kept], sigma[kept]


def _nodes(at: Real) -> tuple[Real, NDArray[np.intp]]:
    """Seconds of the nodes, and the fix of each (-1 none): long steps are divided evenly."""
    parts = np.maximum(np.ceil(np.diff(at) / _LONGEST_STEP_S - 1e-6).astype(np.intp), 1)
    first = np.concatenate([[0], np.cumsum(parts)])
    seconds = np.interp(np.arange(first[-1] + 1), first, at)
    row = np.full(first[-1] + 1, -1, dtype=np.intp)
    row[first] = np.arange(len(at))
    return seconds, row


def _jumps(at: Real, place: Real, sigma: Real) -> Mask:
    """Which fixes stand apart from those around them by more than driving and noise explain."""
    from scipy.ndimage import median_filter

    middle = median_filter(place, size=(min(_JUMP_WINDOW, len(place)), 1), mode="nearest")
    away = np.linalg.norm(place - middle, axis=1)
    half = _JUMP_WINDOW // 2
    span = (
        at[np.minimum(np.arange(len(at)) + half, len(at) - 1)]
        - at[np.maximum(np.arange(len(at)) - half, 0)]
    )
    return np.asarray(away > np.maximum(_JUMP_M, 8.0 * sigma) + 0.25 * _FASTEST * span)


def _wheel_speed(track: xr.Dataset, start: np.datetime64, seconds: Real) -> Real:
    if "speed" not in track:
        return np.full(len(seconds), np.nan)
    at = np.asarray((track["time"].values - start) / np.timedelta64(1, "s"))
    speed = track["speed"].values.astype(np.float64)
    good = np.isfinite(speed)
    if good.sum() < 2:
        return np.full(len(seconds), np.nan)
    at, speed = at[good], speed[good]
    after = np.clip(np.searchsorted(at, seconds), 1, len(at) - 1)
    near = at[after] - at[after - 1] <= 1.0
    known = np.interp(seconds, at, speed, left=np.nan, right=np.nan)
    return np.asarray(np.where(near, known, np.nan))


def _stands(seconds: Real, place: Real, standstill_m_s: float) -> Mask:
    """Where the chord over some seconds around is that of a standing vehicle."""
    ends = [
        np.column_stack([np.interp(seconds + s, seconds, p) for p in place.T])
        for s in (-_CHORD_S / 2, _CHORD_S / 2)
    ]
    return np.asarray(np.linalg.norm(ends[1] - ends[0], axis=1) < standstill_m_s * _CHORD_S)


def _check_speed(velocity: Real, seconds: Real, start: np.datetime64, track: xr.Dataset) -> None:
    speed = np.linalg.norm(velocity, axis=1)
    worst = int(np.argmax(speed))
    if speed[worst] > _FASTEST:
        when = start + np.timedelta64(int(seconds[worst] * 1e9), "ns")
        raise ContractError(
            f"the places jump: {speed[worst]:.0f} m/s at {when}",
            where=track.attrs.get("source"),
            expected=f"at most {_FASTEST:g} m/s",
            remedy="flag the false fixes FIX_OUTLIER, or cut the log there",
        )


def _check_believed(believed: Mask, time: Times, track: xr.Dataset) -> None:
    """Refuse fixes of which many contradict the others and the wheels."""
    refused = int((~believed).sum())
    if refused > _MOST_REFUSED * len(believed):
        raise ContractError(
            f"the places jump: {refused} of {len(believed)} fixes contradict the others, first "
            f"at {time[np.argmin(believed)]}",
            where=track.attrs.get("source"),
            expected=f"at most {_MOST_REFUSED:.0%}",
            remedy="flag the false fixes FIX_OUTLIER, or cut the log there",
        )


def _far_in_time(seconds: Real, believed: Mask) -> Mask:
    if not believed.any():
        return np.ones(len(seconds), dtype=np.bool_)
    known = seconds[believed]
    after = np.clip(np.searchsorted(known, seconds), 1, max(len(known) - 1, 1))
    before = known[np.minimum(after - 1, len(known) - 1)]
    after_s = known[np.minimum(after, len(known) - 1)]
    away = np.minimum(np.abs(seconds - before), np.abs(after_s - seconds))
    return np.asarray(away > _TRUSTED_S)
