"""Filling what a survey did not measure, flagged, so that a transform can be taken."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage

from magtiles.catalog.flags import QualityFlag, flag_attributes
from magtiles.schemas.errors import SourceError
from magtiles.stages.declare import Params, Stage
from magtiles.stages.field.gaps import OpenGaps
from magtiles.stages.field.geometry import true_spacing
from magtiles.stages.rows import Span, by_rows, rows_of, strips

Real = NDArray[np.float64]
Mask = NDArray[np.bool_]

_COARSEST = 8
_SWEEPS = 40, 2000
_WORK = 4e6
"""Fewest and most sweeps of a level, and how many nodes they should visit in all."""
_TAPER_CELLS = 20
_COARSE_NODES = 1 << 20
_MARGIN = 128
"""Of a large map, at most so many nodes of the surface below; rows around a strip."""


class FillVoidsParams(Params):
    """fill-voids has no parameters."""


def fill_voids(grid: xr.Dataset, *, params: FillVoidsParams) -> xr.Dataset:
    """Give every node a value, and say in `quality_flag` which are made up.

    A gap the survey surrounds is a void (flag 1), bridged by minimum curvature (Briggs 1974).
    A gap connected to the border is beyond coverage (flag 2): the same surface, faded to
    the survey's mean over some cells so that it carries no false long wavelengths. A large map is
    filled strip by strip, each from a surface through every few of all nodes.

    Input and output (rows, columns) nT. Raises SourceError when nothing was measured.
    """
    gaps = _Gaps.of(grid)
    anomaly = grid["magnetic_anomaly"]
    filled = by_rows(anomaly.shape, np.float64, gaps.filled)
    flags = by_rows(anomaly.shape, np.uint8, gaps.flags)
    return grid.assign(
        magnetic_anomaly=(anomaly.dims, filled, anomaly.attrs),
        quality_flag=(anomaly.dims, flags, flag_attributes()),
    )


@dataclass(frozen=True)
class _Gaps:
    """The gaps of a grid, and what fills them.

    Attributes
    ----------
    mean : of the measured values, nT.
    open : by first row of a strip, which of the gaps in it, by label, are open to the border.
    below : what a strip is filled from; None where there is but one.
    """

    grid: xr.Dataset
    mean: float
    open: Mapping[int, Mask]
    below: Below | None

    @classmethod
    def of(cls, grid: xr.Dataset) -> _Gaps:
        """Look over a grid once. Raises SourceError for one without any value."""
        shape = grid["magnetic_anomaly"].shape
        halvings = _halvings(shape)
        open_gaps, coarse, total, count = OpenGaps(), [], 0.0, 0
        for first, last in strips(shape):
            values = _values(grid, first, last)
            missing = np.isnan(values)
            open_gaps.add(missing)
            total, count = total + float(values[~missing].sum()), count + int((~missing).sum())
            step = 1 << halvings
            coarse.append(values[-first % step :: step, ::step].copy())
        if count == 0:
            raise SourceError(
                "every node of the grid is void",
                where=grid.attrs.get("source"),
                expected="at least one value",
                remedy="check no_data in the source's TOML",
            )
        below, mean = None, total / count
        if halvings:
            thinned = np.concatenate(coarse) - mean
            below = Below(halvings, minimum_curvature(thinned, np.isnan(thinned)))
        firsts = (first for first, _ in strips(shape))
        return cls(grid, mean, dict(zip(firsts, open_gaps.found(), strict=True)), below)

    def flags(self, first: int, last: int) -> NDArray[np.uint8]:
        """Flags of a strip."""
        missing = np.isnan(_values(self.grid, first, last))
        beyond = self._beyond(first, missing)
        flags = np.where(beyond, QualityFlag.BEYOND_COVERAGE, 0)
        return np.where(missing & ~beyond, QualityFlag.VOID_FILLED, flags).astype(np.uint8)

    def filled(self, first: int, last: int) -> Real:
        """Values of a strip (rows, columns), nT."""
        spacing, out = true_spacing(self.grid), _values(self.grid, first, last).copy()
        missing = np.isnan(out)
        beyond = self._beyond(first, missing)
        if self.below is None:
            return _filled(out, beyond, spacing, self.mean, None)
        # Gaps are filled with the nodes around them, each run of columns that has any by itself.
        margins = [max(_MARGIN, int(np.ceil(exterior_taper(spacing) / d))) for d in spacing]
        size = self.grid["magnetic_anomaly"].shape
        rows = self.below.around((first, last), margins[0], size[0])
        values, own = _values(self.grid, *rows), slice(first - rows[0], last - rows[0])
        outside = np.zeros(values.shape, dtype=bool)
        outside[own] = beyond
        for run in _runs(missing.any(axis=0), 2 * margins[1]):
            columns = self.below.around(run, margins[1], size[1])
            part = slice(None), slice(*columns)
            below = self.below.part(rows, columns)
            made = _filled(values[part], outside[part], spacing, self.mean, below)
            made = made[own, run[0] - columns[0] : run[1] - columns[0]]
            np.copyto(out[:, slice(*run)], made, where=missing[:, slice(*run)])
        return out

    def _beyond(self, first: int, missing: Mask) -> Mask:
        return np.asarray(self.open[first][ndimage.label(missing)[0]])


@dataclass(frozen=True)
class Below:
    """The surface through every 2^halvings-th node of a map, relative to the map's mean, nT."""

    halvings: int
    surface: Real

    def around(self, span: Span, margin: int, size: int) -> Span:
        """A span of a map's rows or columns with those around it, from a node of the surface on."""
        step = 1 << self.halvings
        return max(0, span[0] - margin) // step * step, min(size, span[1] + margin)

    def part(self, *spans: Span) -> Below:
        """The surface over rows and columns of the map that begin at nodes of it."""
        step = 1 << self.halvings
        rows, columns = (slice(first // step, -(-last // step)) for first, last in spans)
        return Below(self.halvings, self.surface[rows, columns])


def _filled(
    values: Real, beyond: Mask, spacing: tuple[float, float], mean: float, below: Below | None
) -> Real:
    measured = ~np.isnan(values)
    distance = distance_to(measured, spacing) if beyond.any() else np.zeros(values.shape)
    return extend(values, beyond, distance, exterior_taper(spacing), mean, below)


def _runs(wanted: Any, apart: int) -> list[Span]:
    """Spans that hold all wanted places, those less than so far apart in one."""
    places = np.flatnonzero(wanted)
    runs = np.split(places, np.flatnonzero(np.diff(places) > apart) + 1) if places.size else []
    return [(int(run[0]), int(run[-1]) + 1) for run in runs]


def _halvings(shape: tuple[int, ...]) -> int:
    """How often a map is thinned by two for the surface that its strips are filled from."""
    if len(strips(shape)) == 1:
        return 0
    return int(np.ceil(np.log2(shape[0] * shape[1] / _COARSE_NODES) / 2))


def _values(grid: xr.Dataset, first: int, last: int) -> Real:
    return np.asarray(rows_of(grid, first, last)["magnetic_anomaly"].values, dtype=float)


def distance_to(target: Mask, spacing: tuple[float, float]) -> Real:
    """Distance (m) of every node to the nearest true one of `target`; infinite if there is none."""
    if not target.any():
        return np.full(target.shape, np.inf)
    return np.asarray(ndimage.distance_transform_edt(~target, sampling=spacing), dtype=float)


def exterior_taper(spacing: tuple[float, float]) -> float:
    """Distance (m) over which the fill beyond a survey's outline fades to the mean."""
    return float(_TAPER_CELLS * np.hypot(*spacing) / np.sqrt(2.0))


def extend(
    values: Real,
    beyond: Mask,
    distance: Real,
    taper_m: float,
    mean: float | None = None,
    below: Below | None = None,
) -> Real:
    """Minimum-curvature fill of NaN, faded to the mean where `beyond`; shape kept.

    `mean` and `below` are those of the map that the values are a part of; default their own.
    """
    missing = np.isnan(values)
    if not missing.any():
        return values
    if mean is None:
        mean = values[~missing].mean()
    filled = minimum_curvature(values - mean, missing, below)
    fade = 0.5 + 0.5 * np.cos(np.pi * np.clip(distance / taper_m, 0.0, 1.0))
    return np.asarray(np.where(beyond, filled * fade, filled) + mean)


def minimum_curvature(values: Real, missing: Mask, below: Below | None = None) -> Real:
    """Fill `missing` nodes with the smoothest surface through the rest, coarse to fine.

    Each level starts from the next coarser one (half the resolution) and is relaxed toward
    the biharmonic equation, its known nodes held; outside the array the surface goes on flat.
    """
    filled = np.where(missing, 0.0, values)
    if not missing.any():
        return filled
    filled[missing] = _start(filled, missing, below)
    nodes = np.argwhere(missing)
    _relax(filled, nodes, int(np.clip(_WORK / len(nodes), *_SWEEPS)))
    return filled


def _start(values: Real, missing: Mask, below: Below | None) -> Real:
    """A first guess for the missing nodes, from the same problem on every second node."""
    if below is not None and below.halvings == 1:
        coarse = below.surface
    else:
        coarse_missing = missing[::2, ::2]
        if below is None and (coarse_missing.all() or min(values.shape) <= _COARSEST):
            known = values[~missing]
            return np.full(np.count_nonzero(missing), known.mean() if known.size else 0.0)
        less = below and Below(below.halvings - 1, below.surface)
        coarse = minimum_curvature(values[::2, ::2], coarse_missing, less)
    places = np.argwhere(missing).T / 2.0
    return np.asarray(ndimage.map_coordinates(coarse, places, order=3, mode="nearest"))


@njit(cache=True, nogil=True)
def _relax(u: Real, nodes: NDArray[np.int64], sweeps: int) -> None:
    """Gauss-Seidel sweeps of the biharmonic stencil over `nodes`, forth and back, in place."""
    ny, nx = u.shape
    for sweep in range(sweeps):
        for n in range(nodes.shape[0]):
            at = n if sweep % 2 == 0 else nodes.shape[0] - 1 - n
            i, j = nodes[at, 0], nodes[at, 1]
            n1, s1 = min(i + 1, ny - 1), max(i - 1, 0)
            n2, s2 = min(i + 2, ny - 1), max(i - 2, 0)
            e1, w1 = min(j + 1, nx - 1), max(j - 1, 0)
            e2, w2 = min(j + 2, nx - 1), max(j - 2, 0)
            u[i, j] = (
                8.0 * (u[n1, j] + u[s1, j] + u[i, e1] + u[i, w1])
                - 2.0 * (u[n1, e1] + u[n1, w1] + u[s1, e1] + u[s1, w1])
                - (u[n2, j] + u[s2, j] + u[i, e2] + u[i, w2])
            ) / 20.0


STAGE = Stage(
    name="fill-voids",
    version=2,
    params=FillVoidsParams,
    inputs={"grid": "anomaly-grid/1"},
    output="anomaly-grid/1",
    run=fill_voids,
)
