"""The nearest point of a road: an index of the plane around it, in which look-ups are short.

Distances are in metres on the local plane (equirectangular at the place), which is right within
millimetres at 100 m. The plane around the road is cut in square tiles, and these in cells; each
cell lists the map points that are nearest to some place in it. A point is left out of a cell when
one other point is nearer to all four corners: then it is nearer everywhere between (the bisector of
two points is a straight line). Away from the tiles, whole blocks of points are passed over.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.kernels.geodesy import metres_per_degree, wrap_longitude

Floats = NDArray[np.float64]

REACH_M = 32.0
"""Tiles cover the plane at least this far from the road."""
CELL_M = 2.0
TILE_CELLS = 16
BLOCK = 32
"""Points of a block."""


@dataclass(frozen=True)
class RoadIndex:
    """A road's points and where to look for them; built by `make_index`.

    Attributes
    ----------
    nodes : (n, 2) latitude and longitude less `origin`, degrees.
    origin : latitude and longitude, degrees, and height, m.
    scale : of a tile: degrees of latitude and longitude.
    table : (m, 3) hash of tiles: row, column and number, or -1; m is a power of two.
    metres : (tiles, 2) metres per degree of latitude and longitude in each tile.
    cells : (tiles * cells + 1,) where each cell's points begin in `points`.
    points : the points nearest to some place in a cell.
    blocks : (blocks, 5) centre, degrees, radius, m, and metres per degree of successive points.
    """

    nodes: Floats
    origin: Floats
    scale: Floats
    table: NDArray[np.int64]
    metres: Floats
    cells: NDArray[np.int64]
    points: NDArray[np.int32]
    blocks: Floats


def make_index(latitude: Floats, longitude: Floats, height: float) -> RoadIndex:
    """Index a road of two or more points (n,), degrees, at about one height, m."""
    from magtiles.catalog.kernels import road_near_compiled as kernels

    origin = np.array([latitude[0], longitude[0], height])
    nodes = np.column_stack([latitude - origin[0], wrap_longitude(longitude - origin[1])])
    north, east = metres_per_degree(latitude, height)
    scale = CELL_M * TILE_CELLS / np.array([north.max(), east.max()])
    blocks = _blocks(nodes, north, east)
    tiles = _tiles(nodes, scale, north, east)
    middle = (tiles + 0.5) * scale
    metres = np.stack(metres_per_degree(origin[0] + middle[:, 0], height), axis=-1)
    cells, points = kernels.list_points(nodes, tiles, scale, metres, blocks)
    return RoadIndex(nodes, origin, scale, kernels.hash_tiles(tiles), metres, cells, points, blocks)


def gaussian(field: Floats, variance: Floats) -> Floats:
    """What a likelihood needs of each point, (n, 7): field, weights, log of the variances' product.

    Linear between points, all of them. `field` and `variance` are (n, 3).
    """
    return np.column_stack([field, 1.0 / variance, np.log(variance).sum(axis=1)])


def _blocks(nodes: Floats, north: Floats, east: Floats) -> Floats:
    """Centre, radius and metres per degree of each block of points."""
    starts = np.arange(0, len(nodes), BLOCK)
    counts = np.diff(np.append(starts, len(nodes)))
    centre = np.add.reduceat(nodes, starts) / counts[:, None]
    away = nodes - np.repeat(centre, counts, axis=0)
    radius = np.hypot(away[:, 0] * north, away[:, 1] * east)
    # The scale of another latitude may be used: by far less than a thousandth.
    return np.column_stack(
        [centre, 1.001 * np.maximum.reduceat(radius, starts), north[starts], east[starts]]
    )


def _tiles(nodes: Floats, scale: Floats, north: Floats, east: Floats) -> NDArray[np.int64]:
    """Rows and columns of all tiles within reach of the road, in order."""
    reach = REACH_M / np.array([north.min(), east.min()])
    found = []
    for y in (-1, 0, 1):
        for x in (-1, 0, 1):
            found.append(np.floor((nodes + reach * (y, x)) / scale).astype(np.int64))
    return np.unique(np.concatenate(found), axis=0)
