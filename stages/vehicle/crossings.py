"""Where a track crosses itself, and what it measured there each time.

Segments between neighbouring samples are gathered in boxes of 64 and of 8; only boxes that meet
are looked into, so that the work grows with the crossings and not with the square of the samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial import KDTree

from magtiles.catalog.flags import TrackFlag
from magtiles.catalog.kernels.geodesy import wrap_longitude
from magtiles.stages.vehicle.lines import line_numbers

Real = NDArray[np.float64]
Rows = NDArray[np.intp]

UNPLACED = (
    TrackFlag.NO_FIX | TrackFlag.FIX_OUTLIER | TrackFlag.POSITION_GAP | TrackFlag.STATIONARY
    | TrackFlag.CLOCK_STEP | TrackFlag.FIELD_GAP | TrackFlag.FIELD_SPIKE | TrackFlag.MANOEUVRE
)  # fmt: skip
"""Rows with these flags take no part."""

_COARSE, _FINE = 64, 8
_LONGEST = 10.0
"""A segment longer than so many usual ones of its line is a gap, not a path."""
_PAIRS = 200_000
"""Pairs of boxes that are looked into at once, to bound memory."""


@dataclass(frozen=True)
class Crossings:
    """Crossings of a track, by the samples before them.

    Attributes
    ----------
    first, second : (n,) rows of the track before the crossing, in the earlier and later pass.
    first_share, second_share : (n,) where between that row and the next, 0 to 1.
    latitude, longitude : (n,) degrees.
    first_line, second_line : (n,) numbers of the lines, as `line_numbers` has them.
    """

    first: Rows
    second: Rows
    first_share: Real
    second_share: Real
    latitude: Real
    longitude: Real
    first_line: NDArray[np.int64]
    second_line: NDArray[np.int64]

    def difference(self, values: Real) -> Real:
        """Earlier pass minus later (n,) of values (time,), linear between samples."""
        return self._at(values, self.first, self.first_share) - self._at(
            values, self.second, self.second_share
        )

    @staticmethod
    def _at(values: Real, row: Rows, share: Real) -> Real:
        return np.asarray((1.0 - share) * values[row] + share * values[row + 1])


def find_crossings(track: xr.Dataset, *, apart_s: float = 60.0) -> Crossings:
    """All crossings of a track with itself, between lines and within.

    Parameters
    ----------
    track : with `latitude`, `longitude` and perhaps `line`, `quality_flag`.
    apart_s : passes of one line closer in time are one.

    Flagged samples, and segments across gaps, take no part.
    """
    lines = line_numbers(track)
    latitude, longitude = track["latitude"].values, track["longitude"].values
    middle = _middle(longitude)
    x = wrap_longitude(longitude - middle) * np.cos(np.radians(np.nanmedian(latitude)))
    rows = _segments(track, x, latitude, lines)
    seconds = (track["time"].values - track["time"].values[0]) / np.timedelta64(1, "s")
    found = _cross(x, latitude, rows, _Passes(lines, seconds, apart_s))
    first, second, first_share, second_share = found
    east = x[first] + first_share * (x[first + 1] - x[first])
    north = latitude[first] + first_share * (latitude[first + 1] - latitude[first])
    across = middle + east / np.cos(np.radians(np.nanmedian(latitude)))
    return Crossings(
        first, second, first_share, second_share, north, wrap_longitude(across),
        lines[first], lines[second],
    )  # fmt: skip


def _middle(longitude: Real) -> float:
    turned = np.nanmean(np.exp(1j * np.radians(longitude)))
    return float(np.degrees(np.angle(turned)))


def _segments(track: xr.Dataset, x: Real, y: Real, lines: NDArray[np.int64]) -> Rows:
    """Rows (n,) from which a segment of path leads to the next row."""
    good = np.isfinite(x) & np.isfinite(y)
    if "quality_flag" in track:
        good &= (track["quality_flag"].values & int(UNPLACED)) == 0
    length = np.hypot(np.diff(x), np.diff(y))
    path = good[1:] & good[:-1] & (lines[1:] == lines[:-1]) & (length > 0.0)
    if not path.any():
        return np.zeros(0, dtype=np.intp)
    path[path] = length[path] <= _LONGEST * np.median(length[path])
    return np.flatnonzero(path)


def _cross(x: Real, y: Real, rows: Rows, passes: _Passes) -> tuple[Rows, Rows, Real, Real]:
    """Rows before each crossing in either pass, and shares of the segments."""
    none = np.zeros(0, dtype=np.intp), np.zeros(0)
    if rows.size < 2:
        return none[0], none[0], none[1], none[1]
    ends = _Boxes(x[rows], y[rows], x[rows + 1], y[rows + 1])
    coarse, fine = ends.gathered(_COARSE), ends.gathered(_FINE)
    found = []
    pairs = coarse.meeting()
    for begin in range(0, pairs.shape[0], _PAIRS // _COARSE):
        inner = _inside(pairs[begin : begin + _PAIRS // _COARSE], _COARSE // _FINE, fine)
        inner = _inside(inner, _FINE, ends)
        # A pair of one box with itself holds each pair of its members twice.
        inner = np.unique(np.sort(inner, axis=1), axis=0)
        apart = passes.differ(rows[inner[:, 0]], rows[inner[:, 1]])
        found.append(inner[apart & (inner[:, 0] != inner[:, 1])])
    pairs = np.unique(np.concatenate(found), axis=0) if found else np.zeros((0, 2), np.intp)
    first, second = rows[pairs[:, 0]], rows[pairs[:, 1]]
    shares = _shares(x, y, first, second)
    inside = ((shares >= 0.0) & (shares < 1.0)).all(axis=1)
    return first[inside], second[inside], shares[inside, 0], shares[inside, 1]


@dataclass(frozen=True)
class _Passes:
    """Lines and seconds (time,) of samples, and how far apart two passes of a line are."""

    lines: NDArray[np.int64]
    seconds: Real
    apart_s: float

    def differ(self, first: Rows, second: Rows) -> NDArray[np.bool_]:
        """Which pairs of rows are of two passes."""
        apart = np.abs(self.seconds[first] - self.seconds[second]) >= self.apart_s
        return np.asarray(apart | (self.lines[first] != self.lines[second]))


def _shares(x: Real, y: Real, first: Rows, second: Rows) -> Real:
    """Where two segments' lines meet, as shares (n, 2) of each; NaN where they are parallel."""
    ax, ay = x[first + 1] - x[first], y[first + 1] - y[first]
    bx, by = x[second + 1] - x[second], y[second + 1] - y[second]
    cx, cy = x[second] - x[first], y[second] - y[first]
    area = ax * by - ay * bx
    flat = np.abs(area) <= 1e-12 * np.hypot(ax, ay) * np.hypot(bx, by)
    area = np.where(flat, np.nan, area)
    return np.stack([(cx * by - cy * bx) / area, (cx * ay - cy * ax) / area], axis=1)


class _Boxes:
    """Boxes (n,) around pieces of path."""

    def __init__(self, x0: Real, y0: Real, x1: Real, y1: Real) -> None:
        self.west, self.east = np.minimum(x0, x1), np.maximum(x0, x1)
        self.south, self.north = np.minimum(y0, y1), np.maximum(y0, y1)

    def gathered(self, size: int) -> _Boxes:
        """Boxes around `size` successive ones."""
        at = np.arange(0, self.west.size, size)
        return _Boxes(
            np.minimum.reduceat(self.west, at), np.minimum.reduceat(self.south, at),
            np.maximum.reduceat(self.east, at), np.maximum.reduceat(self.north, at),
        )  # fmt: skip

    def meet(self, first: Rows, second: Rows) -> NDArray[np.bool_]:
        """Which pairs overlap or touch."""
        return np.asarray(
            (self.west[first] <= self.east[second]) & (self.west[second] <= self.east[first])
            & (self.south[first] <= self.north[second])
            & (self.south[second] <= self.north[first])
        )  # fmt: skip

    def meeting(self) -> Rows:
        """All pairs (n, 2) of boxes that overlap, and each with itself."""
        centre = np.stack([0.5 * (self.west + self.east), 0.5 * (self.south + self.north)], axis=1)
        reach = 0.5 * np.hypot(self.east - self.west, self.north - self.south)
        own = np.arange(reach.size)[:, None].repeat(2, axis=1)
        near = [own]
        # By size: one long box must not widen the search of all the others.
        kinds = np.digitize(reach, np.geomspace(reach.max() / 1024, reach.max(), 6)[:-1])
        members = [np.flatnonzero(kinds == kind) for kind in np.unique(kinds)]
        trees = [KDTree(centre[rows]) for rows in members]
        for i, rows in enumerate(members):
            for j in range(i + 1):
                limit = float(reach[rows].max() + reach[members[j]].max())
                hits = trees[i].query_ball_tree(trees[j], limit)
                counts = [len(hit) for hit in hits]
                left = np.repeat(rows, counts)
                right = members[j][np.concatenate([np.array(h, np.intp) for h in hits])]
                kept = (left != right) & self.meet(left, right)
                near.append(np.sort(np.stack([left[kept], right[kept]], axis=1), axis=1))
        return np.unique(np.concatenate(near), axis=0)


def _inside(pairs: Rows, size: int, members: _Boxes) -> Rows:
    """Pairs (m, 2) of the members, `size` to a box, of pairs (n, 2) of boxes that meet."""
    step = np.arange(size)
    first = (pairs[:, 0, None, None] * size + step[:, None]).repeat(size, axis=2)
    second = (pairs[:, 1, None, None] * size + step).repeat(size, axis=1)
    first, second = first.ravel(), second.ravel()
    kept = (first < members.west.size) & (second < members.west.size)
    first, second = first[kept], second[kept]
    meet = members.meet(first, second)
    return np.stack([first[meet], second[meet]], axis=1)
