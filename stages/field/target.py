"""The nodes that products are wanted at, and what is needed to know of each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.stages.field.direction import AmbientSource
from magtiles.stages.field.geometry import axes, is_geographic
from magtiles.stages.field.plane import STEP_DEG, STEP_M, Plane, on_lattice
from magtiles.stages.field.prepare import PlaneMap
from magtiles.stages.field.windows import MapWindows

Real = NDArray[np.float64]
Single = NDArray[np.float32]

Axis = tuple[float, float, int]
"""First node, spacing and number of nodes."""


@dataclass(frozen=True)
class Target:
    """A lattice of output nodes: rows (m,) by columns (n,).

    Attributes
    ----------
    dims : names of its dimensions.
    geographic : from row and column coordinates to WGS84 latitude, longitude (degrees).
    step : how far apart smooth functions of position may be sampled, in the axes' unit.
    """

    dims: tuple[str, str]
    rows: Real
    columns: Real
    geographic: Callable[[Real, Real], tuple[Real, Real]]
    step: float

    def part(self, rows: tuple[int, int], columns: tuple[int, int]) -> Target:
        """Some of its rows and columns, from a first to before a last."""
        some = self.rows[slice(*rows)], self.columns[slice(*columns)]
        return Target(self.dims, *some, self.geographic, self.step)


@dataclass(frozen=True)
class Nodes:
    """What the transform needs of each node (m, n).

    `row`, `column`: fractional place in the plane map. `north` (2, m, n): true north along
    the plane's y and x. `ambient` (3, m, n): ambient direction, north, east, down.
    """

    row: Real
    column: Real
    north: Single
    ambient: Single


def geographic_target(latitude: Axis, longitude: Axis) -> Target:
    """A lattice uniform in WGS84 degrees; its nodes are first + i * spacing exactly."""
    rows, columns = (a + d * np.arange(n, dtype=np.float64) for a, d, n in (latitude, longitude))
    return Target(("latitude", "longitude"), rows, columns, lambda lat, lon: (lat, lon), STEP_DEG)


def own_target(grid: xr.Dataset, plane: Plane) -> Target:
    """The grid's own nodes."""
    rows, columns = axes(grid)
    first, second = (str(d) for d in grid["magnetic_anomaly"].dims)

    def geographic(row: Real, column: Real) -> tuple[Real, Real]:
        lon, lat = plane.source.transform(column, row)
        return np.asarray(lat), np.asarray(lon)

    step = STEP_DEG if is_geographic(grid) else STEP_M
    return Target((first, second), rows, columns, geographic, step)


def locate(target: Target, plane_map: PlaneMap | MapWindows, ambient: AmbientSource) -> Nodes:
    """Where each node of a target lies on the plane, and the directions there."""
    plane, (step_y, step_x) = plane_map.plane, plane_map.step

    def smooth(row: Real, column: Real) -> tuple[Real, ...]:
        latitude, longitude = target.geographic(row, column)
        x, y = plane.position(latitude, longitude)
        north_x, north_y = plane.north(latitude, longitude)
        places = (y - plane_map.y[0]) / step_y, (x - plane_map.x[0]) / step_x
        return *places, north_y, north_x, *ambient.at(latitude, longitude)

    row, column, *directions = on_lattice(smooth, target.rows, target.columns, target.step)
    single = [part.astype(np.float32) for part in directions]
    return Nodes(row, column, np.stack(single[:2]), np.stack(single[2:]))
