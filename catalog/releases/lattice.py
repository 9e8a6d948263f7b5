"""The one lattice that every tile of a release is cut from.

Node (i, j) lies at latitude ``south + i * latitude_spacing`` and longitude ``west +
j * longitude_spacing``; nodes run from ``-HALO`` to ``rows + HALO``, cells from 0 to
``rows``. Tile (r, c) owns the cells from ``r * tile_rows`` on, half-open; the last one owns
its edge. Longitudes count east from `west` without a jump at the date line.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.kernels.bspline import EDGE, Floats
from magtiles.catalog.kernels.bspline import HALO as HALO
from magtiles.catalog.kernels.geodesy import degrees_east_of

Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Lattice:
    """Where the nodes of a release are.

    Attributes
    ----------
    south, west : degrees of cell (0, 0)'s lower left node.
    latitude_spacing, longitude_spacing : degrees.
    rows, columns : cells of the release, without halo.
    tile_rows, tile_columns : cells of a whole tile; the last row and column may have fewer.
    """

    south: float
    west: float
    latitude_spacing: float
    longitude_spacing: float
    rows: int
    columns: int
    tile_rows: int
    tile_columns: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of tiles."""
        return -(-self.rows // self.tile_rows), -(-self.columns // self.tile_columns)

    @property
    def north(self) -> float:
        """Latitude of the northern edge."""
        return self.south + self.rows * self.latitude_spacing

    @property
    def east(self) -> float:
        """Longitude of the eastern edge, counted on from `west`."""
        return self.west + self.columns * self.longitude_spacing

    def core(self, row: int, column: int) -> tuple[int, int]:
        """Rows and columns of cells that a tile owns."""
        return (
            min(self.tile_rows, self.rows - row * self.tile_rows),
            min(self.tile_columns, self.columns - column * self.tile_columns),
        )

    def tile_axes(self, row: int, column: int) -> tuple[Floats, Floats]:
        """Latitudes and longitudes of a tile's nodes, halo included."""
        rows, columns = self.core(row, column)
        i = row * self.tile_rows + np.arange(-HALO, rows + HALO + 1)
        j = column * self.tile_columns + np.arange(-HALO, columns + HALO + 1)
        return self.latitudes(i), self.longitudes(j)

    def latitudes(self, nodes: NDArray[np.intp]) -> Floats:
        """Latitude of node rows."""
        return np.asarray(self.south + nodes * self.latitude_spacing, np.float64)

    def longitudes(self, nodes: NDArray[np.intp]) -> Floats:
        """Longitude of node columns, counted on from `west`."""
        return np.asarray(self.west + nodes * self.longitude_spacing, np.float64)

    def bounds(self, row: int, column: int) -> dict[str, tuple[float, float]]:
        """South and north, west and east of the cells a tile owns."""
        latitudes, longitudes = self.tile_axes(row, column)
        return {
            "latitude": (float(latitudes[HALO]), float(latitudes[-HALO - 1])),
            "longitude": (float(longitudes[HALO]), float(longitudes[-HALO - 1])),
        }

    def locate(self, latitude: Floats, longitude: Floats) -> tuple[Floats, Floats, Bools]:
        """Positions in cells north and east of the corner, and whether they are inside."""
        y = (latitude - self.south) / self.latitude_spacing
        x = degrees_east_of(self.west, longitude) / self.longitude_spacing
        x = np.where(x >= 360.0 / self.longitude_spacing - EDGE, 0.0, x)
        y = np.where((y < 0.0) & (y >= -EDGE), 0.0, y)
        y = np.where((y > self.rows) & (y <= self.rows + EDGE), self.rows, y)
        x = np.where((x > self.columns) & (x <= self.columns + EDGE), self.columns, x)
        with np.errstate(invalid="ignore"):
            inside = (y >= 0.0) & (y <= self.rows) & (x >= 0.0) & (x <= self.columns)
        return y, x, inside

    def cells(self, y: Floats, x: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """The cells that positions inside the lattice fall in."""
        i = np.minimum(np.floor(y).astype(np.intp), self.rows - 1)
        j = np.minimum(np.floor(x).astype(np.intp), self.columns - 1)
        return i, j
