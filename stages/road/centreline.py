"""Where along a known road a vehicle is: its path laid onto the road's points, in order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.stages.road.plane import Plane

Real = NDArray[np.float64]

_SAME_WAY = np.cos(np.radians(60.0))
_SEEDS_M = 25.0
"""Nodes this far apart are looked at for where a path comes onto the road."""
_AHEAD = 1.5
"""How far along the road the path may be, per metre that it went."""


@dataclass(frozen=True)
class Centreline:
    """The points (m, 2) of a road in a plane, their distances (m,) along it, and courses."""

    place: Real
    distance: Real
    course: Real

    @classmethod
    def of(cls, road: xr.Dataset, plane: Plane) -> Centreline:
        """The points of a road-map/1 in a plane."""
        place = plane.metres(road["latitude"].values, road["longitude"].values)
        return cls.through(place, road["distance"].values)

    @classmethod
    def through(cls, place: Real, distance: Real) -> Centreline:
        """A line through points (m, 2), m at least 2."""
        step = np.gradient(place, axis=0)
        length = np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9)
        return cls(place, distance, step / length)

    def reversed(self) -> Centreline:
        """The same points, driven the other way; distances stay those of the road."""
        return Centreline(self.place[::-1], self.distance[::-1], -self.course[::-1])


def along(line: Centreline, path: Real, *, max_offset_m: float) -> tuple[Real, Real]:
    """Distance along `line` and to the right of it of each node of a path (n, 2), m.

    NaN for nodes off the longest run that keeps to the line: within `max_offset_m`, in its
    direction, and forward. At both ends the line goes straight on.
    """
    course = _course(path)
    driven = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    best, longest = np.full((2, len(path)), np.nan), 0.0
    node = 0
    while (found := _next_seed(line, path, course, driven, node, max_offset_m)) is not None:
        node, points = found
        runs = [_follow(line, path, driven, node, point, max_offset_m) for point in points]
        run = max(runs, key=_covered)
        if _covered(run) > longest:
            longest = _covered(run)
            best = np.full((2, len(path)), np.nan)
            best[:, node : node + run.shape[1]] = run
        node += max(run.shape[1], 1)
    return best[0], best[1]


def _covered(run: Real) -> float:
    return abs(float(run[0, -1] - run[0, 0])) if run.shape[1] else 0.0


def _course(path: Real) -> Real:
    """Unit course (n, 2) of a path, held where it stands."""
    step = np.diff(path, axis=0, append=path[-1:])
    length = np.linalg.norm(step, axis=1)
    going = np.flatnonzero(length > 1e-3)
    if going.size == 0:
        return np.zeros_like(path)
    last = going[np.clip(np.searchsorted(going, np.arange(len(path)), "right") - 1, 0, None)]
    return np.asarray(step[last] / length[last][:, None])


def _next_seed(
    line: Centreline, path: Real, course: Real, driven: Real, start: int, max_offset_m: float
) -> tuple[int, list[int]] | None:
    """The next node on the line, and the points of each stretch of the line nearest to it."""
    node = start
    while node < len(path):
        away = np.linalg.norm(line.place - path[node], axis=1)
        near = (away < max_offset_m) & (line.course @ course[node] > _SAME_WAY)
        if near.any():
            where = np.flatnonzero(near)
            stretches = np.split(where, np.flatnonzero(np.diff(where) > 1) + 1)
            return node, [int(s[np.argmin(away[s])]) for s in stretches]
        node = max(node + 1, int(np.searchsorted(driven, driven[node] + _SEEDS_M)))
    return None


def _follow(
    line: Centreline, path: Real, driven: Real, node: int, point: int, max_offset_m: float
) -> Real:
    """Distance and offset (2, k) of successive nodes, until the path leaves the line."""
    spacing = float(np.median(np.abs(np.diff(line.distance))))
    found: list[tuple[float, float]] = []
    last = len(line.distance) - 2
    segment, beyond = min(point, last), max_offset_m
    previous = driven[node]
    for k in range(node, len(path)):
        reach = int((_AHEAD * (driven[k] - previous) + beyond) / spacing) + 2
        first = max(segment - (reach if k == node else 1), 0)
        segment, share, offset = _project(line, path[k], first, min(segment + reach, last))
        over = max(share - 1.0 if segment == last else 0.0, -share if segment == 0 else 0.0)
        if abs(offset) > max_offset_m or over * spacing > max_offset_m:
            break
        ends = line.distance[segment], line.distance[segment + 1]
        found.append((ends[0] + share * (ends[1] - ends[0]), offset))
        previous, beyond = driven[k], 0.0
    run = np.array(found).reshape(-1, 2).T
    if run.shape[1]:
        up = line.distance[-1] > line.distance[0]
        run[0] = (np.maximum if up else np.minimum).accumulate(run[0])
    return run


def _project(line: Centreline, place: Real, first: int, last: int) -> tuple[int, float, float]:
    """The nearest of the segments `first` to `last`: its number, share along it, offset."""
    start = line.place[first : last + 1]
    step = line.place[first + 1 : last + 2] - start
    away = place - start
    square = np.maximum(np.einsum("ni,ni->n", step, step), 1e-12)
    share = np.einsum("ni,ni->n", away, step) / square
    held = np.clip(share, 0.0, 1.0)
    if first == 0:
        held[0] = min(share[0], 1.0)
    if last == len(line.place) - 2:
        held[-1] = max(share[-1], 0.0)
    apart = np.linalg.norm(away - held[:, None] * step, axis=1)
    nearest = int(np.argmin(apart))
    side = step[nearest, 0] * away[nearest, 1] - step[nearest, 1] * away[nearest, 0]
    return first + nearest, float(held[nearest]), float(np.sign(side) * apart[nearest])
