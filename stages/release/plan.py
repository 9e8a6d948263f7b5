"""Planning the lattice that a release's tiles are cut from."""

from __future__ import annotations

import math

import pyproj

from magtiles.catalog.kernels.bspline import HALO
from magtiles.catalog.releases.lattice import Lattice
from magtiles.schemas.errors import CoverageError, ParameterError

Bounds = tuple[float, float, float, float]
"""South, north, west, east in degrees; east counted on from west, past 180 if need be."""

POLAR_LIMIT = 85.0
_TILE_SIZES_DEG = (0.01, 0.02, 0.05, 0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0)
_TILE_CELLS = 300
"""A default tile has at least so many cells a side: its halo adds a sixth at most."""

_MOST_NODES = 500_000_000
"""A level's nine arrays of so many nodes are 18 GB: what asks for more is a slip of the unit."""


def plan_lattice(
    bounds: Bounds, spacing_m: float, tile_deg: float | None = None, *, table: str = "anomaly"
) -> Lattice:
    """The lattice of nodes at most `spacing_m` apart that covers `bounds`.

    Spacing is uniform in degrees, and such that `tile_deg` holds whole cells; tiles count from
    the south-west corner. The outermost row never lies beyond 85 degrees. East-west cells are
    sized where the region is widest.
    Raises CoverageError beyond 85 degrees, where north and east turn too fast for a spline,
    ParameterError for a tile smaller than a few cells, for tiles that do not meet around the
    globe, and for too many nodes, naming the key of the product's `table`.
    """
    south, north, west, east = bounds
    if max(abs(south), abs(north)) > POLAR_LIMIT:
        raise CoverageError(
            f"latitude {south:g} to {north:g} reaches beyond {POLAR_LIMIT:g} degrees",
            expected=f"a region within {POLAR_LIMIT:g} degrees of the equator",
            remedy="set region.latitude in the product",
        )
    widest = 0.0 if south <= 0 <= north else min(abs(south), abs(north))
    degree_north, degree_east = _metres_per_degree((south + north) / 2, widest)
    if tile_deg is None:
        wanted = _TILE_CELLS * spacing_m / degree_north
        tile_deg = next((t for t in _TILE_SIZES_DEG if t >= wanted), _TILE_SIZES_DEG[-1])
    cells = [
        math.ceil(tile_deg * degree / spacing_m - 1e-9) for degree in (degree_north, degree_east)
    ]
    if min(cells) <= 2 * HALO:
        raise ParameterError(
            f"tiles of {tile_deg:g} degrees hold {min(cells)} cells of {spacing_m:g} m",
            where=f"{table}.tile_deg",
            expected=f"more than {2 * HALO} cells",
            remedy="raise tile_deg or lower spacing_m",
        )
    step_lat, step_lon = tile_deg / cells[0], tile_deg / cells[1]
    if east - west >= 360.0:
        _check_circle(tile_deg, table)
    nodes = (north - south) / step_lat * (east - west) / step_lon
    if nodes > _MOST_NODES:
        raise ParameterError(
            f"nodes {spacing_m:g} m apart are {nodes:.2g} a level",
            where=f"{table}.spacing_m",
            expected=f"at most {_MOST_NODES:.0e}",
            remedy="raise spacing_m, or set a smaller region",
        )
    highest = math.floor(POLAR_LIMIT / step_lat + 1e-9)
    first_row = max(math.floor(south / step_lat + 1e-9), -highest)
    last_row = min(math.ceil(north / step_lat - 1e-9), highest)
    first_column = math.floor(west / step_lon + 1e-9)
    return Lattice(
        south=first_row * step_lat,
        west=first_column * step_lon,
        latitude_spacing=step_lat,
        longitude_spacing=step_lon,
        rows=max(1, last_row - first_row),
        columns=max(1, math.ceil(east / step_lon - 1e-9) - first_column),
        tile_rows=cells[0],
        tile_columns=cells[1],
    )


def _check_circle(tile_deg: float, table: str) -> None:
    """Raise ParameterError where tiles all around the globe would not meet."""
    around = 360.0 / tile_deg
    if abs(around - round(around)) > 1e-9:
        raise ParameterError(
            f"tiles of {tile_deg:g} degrees do not divide the circle",
            where=f"{table}.tile_deg",
            expected="a divisor of 360 for a region all around",
        )


def _metres_per_degree(latitude: float, widest: float) -> tuple[float, float]:
    """Length (m) of a degree north at a latitude, and of a degree east at another."""
    ellipsoid = pyproj.Geod(ellps="WGS84")
    return (
        ellipsoid.line_length([0, 0], [latitude - 0.5, latitude + 0.5]),
        ellipsoid.line_length([-0.005, 0.005], [widest, widest]) * 100,
    )
