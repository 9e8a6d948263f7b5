"""A drive split into roads: at junctions, U-turns and gaps, the same stretch under one name."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from magtiles.schemas.errors import CoverageError, ParameterError
from magtiles.stages.declare import Params, quantity
from magtiles.stages.road.motion import Motion, motion_of

Real = NDArray[np.float64]

_STEP_M = 2.0
"""Between the points at which the shape of a drive is looked at."""
_TURN_M = 30.0
"""Length over which a turn is one."""
_U_TURN_DEG = 150.0
_U_TURN_M = 60.0
_STRAIGHT_DEG = 20.0
_PARALLEL_DEG = 30.0
_COURSE_STEPS = 5
"""To either side, over which the course of a drive is compared with that of another visit: fixes
that wander while a vehicle stands put a bend into its path."""
_APART_WIDTHS = 3.0
"""Widths of the road driven between two visits of one place, at least."""
_SHORTEST_M = 25.0
"""Of a part; what is shorter lies within a junction."""
_SHARED = 0.8
"""Of the shorter of two parts that are the same road."""


class SplitParams(Params):
    """What the shape of a drive is judged by."""

    position_sigma_m: float = quantity(
        "m", default=1.5, gt=0, doc="Standard deviation of fixes that do not state theirs."
    )
    standstill_m_s: float = quantity(
        "m s-1", default=0.3, gt=0, doc="Speed below which the vehicle stands."
    )
    max_gap_m: float = quantity(
        "m", default=30.0, gt=0, doc="Longest distance without a sample inside one road."
    )
    turn_deg: float = quantity(
        "degree", default=60.0, gt=0, doc="A turn this sharp, within 30 m, is a junction."
    )
    road_width_m: float = quantity(
        "m", default=12.0, gt=0, doc="Paths that run side by side within it are on one road."
    )


@dataclass(frozen=True)
class DrivePart:
    """A stretch of a drive between two junctions, U-turns or gaps.

    Attributes
    ----------
    start_s, end_s : seconds since the drive's first fix.
    start, end : the same as UTC.
    length_m : driven.
    road : number of the road, the same for every part that runs along it.
    direction : of driving, "forward" as the road was first driven.
    """

    start_s: float
    end_s: float
    start: np.datetime64
    end: np.datetime64
    length_m: float
    road: int
    direction: Literal["forward", "backward"]


def split_drive(track: xr.Dataset, *, params: SplitParams) -> list[DrivePart]:
    """The parts of a drive (track/1), in order of time.

    A drive is cut where it turns sharply, where it comes to, crosses or leaves a road that it
    drives another time, and at gaps and U-turns, which belong to no part. Parts along the same
    stretch get one number. Raises as `motion_of`.
    """
    motion = motion_of(
        track, position_sigma_m=params.position_sigma_m, standstill_m_s=params.standstill_m_s
    )
    return _parts(motion, track, params)


def part_of(motion: Motion, track: xr.Dataset, params: SplitParams, number: int) -> DrivePart:
    """One part of a drive, by its number. Raises ParameterError, naming all, if there is none."""
    parts = _parts(motion, track, params)
    if number < len(parts):
        return parts[number]
    listed = "; ".join(
        f"{i}: road {p.road} {p.direction}, {p.length_m:.0f} m from {p.start.astype('M8[s]')}"
        for i, p in enumerate(parts)
    )
    raise ParameterError(
        f"part is {number}, and the parts of the drive are ({listed})",
        where=track.attrs.get("source"),
        expected=f"0 to {len(parts) - 1}",
    )


@dataclass(frozen=True)
class _Shape:
    """A drive at even steps of distance: distance (n,), place (n, 2), course (n,) radians."""

    distance: Real
    place: Real
    course: Real


def _parts(motion: Motion, track: xr.Dataset, params: SplitParams) -> list[DrivePart]:
    shape = _shape(motion, track)
    lost = np.concatenate([_gaps(motion, track, params), _u_turns(shape)])
    cuts = _merged(np.concatenate([_turns(shape, params), _visits(shape, params)]), params)
    ends = np.concatenate([[shape.distance[0], shape.distance[-1]], lost.ravel()])
    bounds = np.unique(np.concatenate([ends, cuts]))
    pieces = [
        (low, high)
        for low, high in itertools.pairwise(bounds)
        if high - low >= _SHORTEST_M and not ((lost[:, 0] <= low) & (high <= lost[:, 1])).any()
    ]
    return _named(pieces, shape, motion, params)


def _shape(motion: Motion, track: xr.Dataset) -> _Shape:
    if motion.distance[-1] < _SHORTEST_M:
        raise CoverageError(
            f"the drive is {motion.distance[-1]:.1f} m long",
            where=track.attrs.get("source"),
            expected=f"at least {_SHORTEST_M:g} m",
        )
    going = np.concatenate([[True], np.diff(motion.distance) > 0.0])
    at = np.arange(0.0, motion.distance[-1], _STEP_M)
    place = np.column_stack(
        [np.interp(at, motion.distance[going], p[going]) for p in motion.place.T]
    )
    step = np.gradient(place, axis=0)
    return _Shape(at, place, np.unwrap(np.arctan2(step[:, 1], step[:, 0])))


def _gaps(motion: Motion, track: xr.Dataset, params: SplitParams) -> Real:
    """Distances (n, 2) between which there is no sample of the field, or no trusted place."""
    seconds = motion.seconds_of(track["time"].values)
    known = np.isfinite(track["field_body"].values).all(axis=1)
    known &= motion.at(seconds, motion.doubtful.astype(np.float64)) == 0.0
    at = motion.at(seconds[known], motion.distance)
    at = np.concatenate([[0.0], at[np.isfinite(at)], motion.distance[-1:]])
    at = np.sort(at)
    wide = np.flatnonzero(np.diff(at) > params.max_gap_m)
    return np.column_stack([at[wide], at[wide + 1]])


def _turns(shape: _Shape, params: SplitParams) -> Real:
    """Distances of the middle of sharp turns."""
    turned = np.abs(_turned(shape.course, int(_TURN_M / _STEP_M)))
    return shape.distance[_peaks(turned, np.radians(params.turn_deg))]


def _u_turns(shape: _Shape) -> Real:
    """Distances (n, 2) between which the drive turns back: from leaving one course to the other."""
    steps = int(_U_TURN_M / _STEP_M)
    found = []
    for peak in _peaks(np.abs(_turned(shape.course, steps)), np.radians(_U_TURN_DEG)):
        around = np.arange(max(peak - steps, 0), min(peak + steps, len(shape.course) - 1) + 1)
        course = shape.course[around]
        left = around[np.abs(course - course[0]) > np.radians(_STRAIGHT_DEG)]
        joined = around[np.abs(course - course[-1]) > np.radians(_STRAIGHT_DEG)]
        found.append(shape.distance[[left[0], joined[-1]]])
    return np.array(found).reshape(-1, 2)


def _turned(course: Real, steps: int) -> Real:
    """Turning (n,) over `steps` around each point, radians."""
    half = max(steps // 2, 1)
    padded = np.pad(course, half, mode="edge")
    return np.asarray(padded[2 * half :] - padded[: -2 * half])


def _peaks(values: Real, limit: float) -> NDArray[np.intp]:
    """The highest point of each stretch above a limit."""
    above = np.flatnonzero(values > limit)
    if above.size == 0:
        return above
    runs = np.split(above, np.flatnonzero(np.diff(above) > 1) + 1)
    return np.array([run[np.argmax(values[run])] for run in runs], dtype=np.intp)


def _visits(shape: _Shape, params: SplitParams) -> Real:
    """Distances where the drive crosses itself, or begins or ends to run along itself."""
    pairs = cKDTree(shape.place).query_pairs(params.road_width_m, output_type="ndarray")
    if pairs.size == 0:
        return np.empty(0)
    apart = (
        np.abs(np.diff(shape.distance[pairs], axis=1)[:, 0]) > _APART_WIDTHS * params.road_width_m
    )
    pairs = pairs[apart]
    course = _chord_course(shape.place)
    turn = np.abs((np.diff(course[pairs], axis=1)[:, 0] + np.pi) % (2 * np.pi) - np.pi)
    line = np.minimum(turn, np.pi - turn) < np.radians(_PARALLEL_DEG)
    along = np.zeros(len(shape.distance), dtype=np.bool_)
    along[pairs[line].ravel()] = True
    cuts = list(_run_ends(along))
    for number in np.unique(pairs[~line].ravel()):
        if not along[number]:
            cuts.append(int(number))
    return shape.distance[np.array(cuts, dtype=np.intp)]


def _chord_course(place: Real) -> Real:
    """Course (n,) of the chord around each place (n, 2), radians."""
    number = np.arange(len(place))
    ahead = np.minimum(number + _COURSE_STEPS, len(place) - 1)
    chord = place[ahead] - place[np.maximum(number - _COURSE_STEPS, 0)]
    return np.asarray(np.arctan2(chord[:, 1], chord[:, 0]))


def _run_ends(mask: NDArray[np.bool_]) -> NDArray[np.intp]:
    return np.asarray(np.flatnonzero(np.diff(mask.astype(np.int8)) != 0), dtype=np.intp)


def _merged(at: Real, params: SplitParams) -> Real:
    """The middle of each cluster of cuts closer together than a junction is wide."""
    if at.size == 0:
        return at
    at = np.sort(at)
    wide = np.flatnonzero(np.diff(at) > 2.0 * params.road_width_m) + 1
    return np.array([run.mean() for run in np.split(at, wide)])


def _named(
    pieces: list[tuple[float, float]], shape: _Shape, motion: Motion, params: SplitParams
) -> list[DrivePart]:
    """The parts with the number of their road: that of an earlier one along the same stretch."""
    firsts: list[tuple[Real, Real]] = []
    parts: list[DrivePart] = []
    going = np.concatenate([[True], np.diff(motion.distance) > 0.0])
    for low, high in pieces:
        inside = (shape.distance >= low) & (shape.distance <= high)
        place, course = shape.place[inside], shape.course[inside]
        road, direction = _same_road(place, course, firsts, params)
        if road == len(firsts):
            firsts.append((place, course))
        start, end = np.interp([low, high], motion.distance[going], motion.seconds[going])
        first, last = (motion.start + np.timedelta64(int(1e9 * s), "ns") for s in (start, end))
        length = float(high - low)
        parts.append(DrivePart(float(start), float(end), first, last, length, road, direction))
    return parts


def _same_road(
    place: Real, course: Real, firsts: list[tuple[Real, Real]], params: SplitParams
) -> tuple[int, Literal["forward", "backward"]]:
    for number, (other, other_course) in enumerate(firsts):
        away, nearest = cKDTree(other).query(place)
        back, _ = cKDTree(place).query(other)
        shared = max(np.mean(away < params.road_width_m), np.mean(back < params.road_width_m))
        if shared < _SHARED or min(len(place), len(other)) < _SHARED * max(len(place), len(other)):
            continue
        agree = float(np.median(np.cos(course - other_course[nearest])))
        if abs(agree) > np.cos(np.radians(_PARALLEL_DEG)):
            return number, "forward" if agree > 0.0 else "backward"
    return len(firsts), "forward"
