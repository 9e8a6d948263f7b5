"""A map on its plane, read window by window, so that memory does not grow with the map."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.schemas.errors import ContractError
from magtiles.stages.field.geometry import axes
from magtiles.stages.field.padding import Padding, plan_padding, taper
from magtiles.stages.field.plane import STEP_M, Plane, choose_plane, index_of, on_lattice
from magtiles.stages.field.prepare import (
    PlaneMap,
    gaps_of,
    nearest_node,
    plane_axes,
    resample,
    sigma_of,
)

Real = NDArray[np.float64]
Span = tuple[int, int]
"""First node and the one behind the last; may reach beyond the map."""

_EXACT, _TAPERED = 64, 64
"""Nodes around a window that it is resampled with: as they are, then fading to the mean."""


@dataclass(frozen=True)
class Reflection:
    """An axis extended beyond both ends as `padding.pad` does.

    Attributes
    ----------
    count : nodes of the map along the axis.
    before, after : nodes added.
    """

    count: int
    before: int
    after: int

    @classmethod
    def pair(cls, padding: Padding) -> tuple[Reflection, Reflection]:
        """Both axes of a padding."""
        first, second = (
            cls(n, before, total - before - n)
            for n, before, total in zip(
                padding.map_shape, padding.offset, padding.shape, strict=True
            )
        )
        return first, second

    @property
    def weights(self) -> Real:
        """By what each node of the extended axis is weighted: 1 over the map, tapered beside it."""
        return taper(self.count, self.before, self.after)

    def at(self, span: Span) -> tuple[NDArray[np.int64], Real]:
        """Which node of the map stands at each of a span, and by what it is weighted.

        1 over the map, the taper beside it, 0 beyond that.
        """
        places = np.arange(*span)
        weights = np.zeros(places.size)
        padded = places + self.before
        within = (padded >= 0) & (padded < self.before + self.count + self.after)
        weights[within] = self.weights[padded[within]]
        last = self.count - 1
        reflected = np.where(weights > 0.0, last - np.abs(last - np.abs(places)), places)
        return np.clip(reflected, 0, last), weights


@dataclass(frozen=True)
class MapWindows:
    """A filled grid on the plane of near-true scale, of which windows can be had.

    Attributes
    ----------
    grid : anomaly-grid/1 without voids; read only where a window needs it.
    plane, y, x : as of `PlaneMap`.
    mean : of the grid's values, nT; beyond its border it is extended to that.
    sigma : what stands in for the survey's sigma where that is void, nT.
    laid : what `lay_on_plane` made of the grid, if it did; else windows are resampled, each by
        itself.
    """

    grid: xr.Dataset
    plane: Plane
    y: Real
    x: Real
    mean: float
    sigma: float
    laid: xr.Dataset | None = None

    @classmethod
    def of(
        cls,
        grid: xr.Dataset,
        known: tuple[float, float] | None = None,
        laid: xr.Dataset | None = None,
    ) -> MapWindows:
        """The windows of a grid; `mean` and `sigma` are read from it where they are not known.

        Raises ContractError for a grid with voids or without sigma, when it is read.
        """
        plane = choose_plane(grid)
        y, x = axes(grid) if plane.is_source else plane_axes(grid, plane)
        mean, sigma = known or (_mean(grid), _median_sigma(grid))
        return cls(grid, plane, y, x, mean, sigma, laid)

    @property
    def shape(self) -> tuple[int, int]:
        """Nodes of the map on its plane."""
        return self.y.size, self.x.size

    @property
    def step(self) -> tuple[float, float]:
        """Node spacing (y, x) in plane metres."""
        return (
            float(self.y[-1] - self.y[0]) / (self.y.size - 1),
            float(self.x[-1] - self.x[0]) / (self.x.size - 1),
        )

    @property
    def spacing(self) -> tuple[float, float]:
        """Node spacing (y, x) in true metres, of the map's mean scale."""
        return self.step[0] / self.plane.scale, self.step[1] / self.plane.scale

    def axis(self, which: int, span: Span) -> Real:
        """Plane coordinates of a span, which may reach beyond the map."""
        first = (self.y, self.x)[which][0]
        return np.asarray(first + self.step[which] * np.arange(*span))

    def read(self, rows: Span, columns: Span) -> PlaneMap:
        """A window within the map."""
        y, x = self.y[slice(*rows)], self.x[slice(*columns)]
        source = self.grid if self.plane.is_source else self.laid
        if source is not None:
            part = _part(source, rows, columns)
            values = part["magnetic_anomaly"].values.astype(float)
            void, beyond = gaps_of(part)
            return PlaneMap(self.plane, y, x, values, void, beyond, sigma_of(part, self.sigma))
        return self._resampled(y, x)

    def extended(self, rows: Span, columns: Span, padding: Padding) -> PlaneMap:
        """A window that may reach beyond the map, where it is continued as `padding.pad` does.

        There nodes are `beyond`, and sigma is that of the border. Beyond the padding, values are
        the map's mean.
        """
        (at_row, down), (at_column, across) = (
            axis.at(span)
            for axis, span in zip(Reflection.pair(padding), (rows, columns), strict=True)
        )
        r, c = _span_of(at_row), _span_of(at_column)
        inner = self.read(r, c)
        pick = np.ix_(at_row - r[0], at_column - c[0])
        outside = np.logical_or.outer(
            *(
                (np.arange(*span) < 0) | (np.arange(*span) >= n)
                for span, n in zip((rows, columns), self.shape, strict=True)
            )
        )
        return PlaneMap(
            self.plane,
            self.axis(0, rows),
            self.axis(1, columns),
            (inner.values[pick] - self.mean) * np.multiply.outer(down, across) + self.mean,
            void=inner.void[pick] & ~outside,
            beyond=inner.beyond[pick] | outside,
            sigma=inner.sigma[pick] if inner.sigma.ndim else inner.sigma,
        )

    def _resampled(self, y: Real, x: Real) -> PlaneMap:
        """A window of the plane from the grid's nodes around it, as `prepare` resamples a map."""
        row, column = on_lattice(
            lambda yy, xx: index_of(self.grid, *self.plane.to_source(xx, yy)), y, x, STEP_M
        )
        size = self.grid["magnetic_anomaly"].shape
        padding = plan_padding((size[0], size[1]), (1.0, 1.0), 0.0)
        around = [_around(index, n) for index, n in zip((row, column), size, strict=True)]
        reflections = zip(Reflection.pair(padding), around, strict=True)
        (at_row, down), (at_column, across) = (axis.at(span) for axis, span in reflections)
        r, c = _span_of(at_row), _span_of(at_column)
        part = _part(self.grid, r, c)
        down, across = down * _fading(down.size), across * _fading(across.size)
        read = part["magnetic_anomaly"].values.astype(float)[
            np.ix_(at_row - r[0], at_column - c[0])
        ]
        values = (read - self.mean) * np.multiply.outer(down, across)
        found = resample(values, row - around[0][0], column - around[1][0]) + self.mean
        gaps = nearest_node(*gaps_of(part), sigma_of(part, self.sigma), row - r[0], column - c[0])
        return PlaneMap(self.plane, y, x, found, *gaps)


def local(plane_map: PlaneMap) -> PlaneMap:
    """The same window, on a plane whose scale is that of the window's middle.

    On a conformal projection that differs little within a window, however much over the map.
    """
    plane = plane_map.plane
    if plane.is_source:
        return plane_map
    y, x = (float((a[0] + a[-1]) / 2) for a in (plane_map.y, plane_map.x))
    scale = plane.scale_at(y, x)
    return dataclasses.replace(plane_map, plane=dataclasses.replace(plane, scale=scale))


def spans(count: int, most: int) -> list[Span]:
    """Spans of nearly equal size, at most `most` nodes each, that follow one another."""
    number = max(1, -(-count // most))
    bounds = [count * i // number for i in range(number + 1)]
    return list(itertools.pairwise(bounds))


_ROWS = 512


def _mean(grid: xr.Dataset) -> float:
    total, size = 0.0, grid["magnetic_anomaly"].shape
    for rows in spans(size[0], _ROWS):
        values = _part(grid, rows, (0, size[1]))["magnetic_anomaly"].values
        if not np.isfinite(values).all():
            row, column = np.argwhere(~np.isfinite(values))[0]
            raise ContractError(
                "the grid has voids",
                where=f"magnetic_anomaly[{rows[0] + row}, {column}]",
                expected="a value at every node",
                remedy="run fill-voids first",
            )
        total += float(values.sum(dtype=float))
    return total / (size[0] * size[1])


def _median_sigma(grid: xr.Dataset) -> float:
    """The survey's median sigma, from some of its rows where it is gridded."""
    sigma = grid["magnetic_anomaly_uncertainty"]
    if sigma.ndim:
        sigma = sigma[:: max(1, sigma.shape[0] // _ROWS)]
    return float(np.nanmedian(sigma_of(xr.Dataset({"magnetic_anomaly_uncertainty": sigma}))))


def _part(grid: xr.Dataset, rows: Span, columns: Span) -> xr.Dataset:
    first, second = grid["magnetic_anomaly"].dims
    return grid.isel({first: slice(*rows), second: slice(*columns)})


def _span_of(places: NDArray[np.int64]) -> Span:
    return int(places.min()), int(places.max()) + 1


def _around(index: Real, size: int) -> Span:
    """The grid's nodes that a window is resampled from, along one axis."""
    most = size + _EXACT
    low = int(np.clip(np.floor(index.min()), -_EXACT, most)) - _EXACT - _TAPERED
    high = int(np.clip(np.ceil(index.max()), -_EXACT, most)) + _EXACT + _TAPERED + 1
    return low, high


def _fading(size: int) -> Real:
    return taper(size - 2 * _TAPERED, _TAPERED, _TAPERED)
