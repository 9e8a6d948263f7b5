"""The near-true-scale plane that a map is transformed in, and where positions lie on it.

A Fourier method takes the map for a plane in true metres. A projected grid serves as it is
where its scale is the same everywhere within 0.1 % (whatever that scale is: DNAG's 0.926
is no matter); otherwise the plane is the conformal projection that distorts the region least.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pyproj
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import make_interp_spline

from magtiles.stages.crs import dataset_crs, dataset_to_wgs84
from magtiles.stages.field.geometry import axes, is_geographic, steps

Real = NDArray[np.float64]

SCALE_TOLERANCE = 1e-3
_PROBES = 9

STEP_DEG = 0.25
STEP_M = 25_000.0
"""Spacing of the coarse lattices that projections and core-field directions are splined from."""


@dataclass(frozen=True)
class Plane:
    """A map plane: projected metres, `scale` plane metres to a true metre.

    Attributes
    ----------
    projection : from longitude, latitude of the source's own datum to plane x, y.
    source : from the source grid's coordinates to WGS84 longitude, latitude.
    own : the source grid's projection; None where its coordinates are geographic.
    scale_error : greatest relative departure from `scale` over the map.
    is_source : whether the plane is the source grid's own projection.
    turn : angle (rad) by which plane axes are turned from the projection's, counterclockwise,
        so that the source's outline stays upright in the plane and wastes no corners.
    """

    projection: pyproj.Proj
    source: pyproj.Transformer
    own: pyproj.Proj | None
    scale: float
    scale_error: float
    is_source: bool
    turn: float = 0.0

    def position(self, latitude: ArrayLike, longitude: ArrayLike) -> tuple[Real, Real]:
        """Plane x, y (m) of WGS84 positions (degrees)."""
        x, y = self.source.transform(longitude, latitude, direction="INVERSE")
        return self.from_source(np.asarray(x), np.asarray(y))

    def geographic(self, x: ArrayLike, y: ArrayLike) -> tuple[Real, Real]:
        """WGS84 latitude and longitude (degrees) of plane positions (m)."""
        lon, lat = self.source.transform(*self.to_source(np.asarray(x), np.asarray(y)))
        return np.asarray(lat), np.asarray(lon)

    def from_source(self, x: Real, y: Real) -> tuple[Real, Real]:
        """Plane x, y of positions in the source grid's coordinates."""
        if self.is_source:
            return x, y
        lon, lat = (x, y) if self.own is None else self.own(x, y, inverse=True)
        return _turned(*self.projection(lon, lat), -self.turn)

    def to_source(self, x: Real, y: Real) -> tuple[Real, Real]:
        """Source coordinates of plane positions."""
        if self.is_source:
            return x, y
        lon, lat = self.projection(*_turned(x, y, self.turn), inverse=True)
        x, y = (lon, lat) if self.own is None else self.own(lon, lat)
        return np.asarray(x), np.asarray(y)

    def scale_at(self, y: float, x: float) -> float:
        """Plane metres to a true metre at one plane position, mean of all directions."""
        lon, lat = self.projection(*_turned(x, y, self.turn), inverse=True)
        return _scale(self.projection, np.atleast_1d(lon), np.atleast_1d(lat))[0]

    def north(self, latitude: ArrayLike, longitude: ArrayLike) -> tuple[Real, Real]:
        """The (x, y) components of the plane's unit vector toward true north at positions.

        By differences of the projection itself, so that no convention of sign can intrude.
        """
        step = 1e-4
        lat = np.asarray(latitude, dtype=float)
        x1, y1 = self.position(lat + step, longitude)
        x0, y0 = self.position(lat - step, longitude)
        length = np.hypot(x1 - x0, y1 - y0)
        return (x1 - x0) / length, (y1 - y0) / length


def choose_plane(grid: xr.Dataset) -> Plane:
    """The grid's own projection if its scale is uniform within 0.1 %, else the best conformal one.

    Raises SourceError when the grid's datum cannot be related to WGS84.
    """
    crs = dataset_crs(grid)
    source = dataset_to_wgs84(grid)
    own = pyproj.Proj(crs) if crs.is_projected else None
    lon, lat = _probe_positions(grid, own)
    best: Plane | None = None
    for projection, is_source in _candidates(crs, lon, lat):
        scale, error = _scale(projection, lon, lat)
        if is_source and error <= SCALE_TOLERANCE:
            return Plane(projection, source, own, scale, error, True)
        if not is_source and (best is None or error < best.scale_error):
            best = Plane(projection, source, own, scale, error, False)
    assert best is not None
    return dataclasses.replace(best, turn=_upright_turn(grid, best))


def _upright_turn(grid: xr.Dataset, plane: Plane) -> float:
    """Angle of the source's columns at its middle from the projection's x axis, rad."""
    rows, columns = axes(grid)
    middle, step = (columns[0] + columns[-1]) / 2, steps(grid)[1]
    x, y = plane.from_source(
        np.array([middle - step, middle + step]), np.full(2, (rows[0] + rows[-1]) / 2)
    )
    return float(np.arctan2(y[1] - y[0], x[1] - x[0]))


def _turned(x: ArrayLike, y: ArrayLike, angle: float) -> tuple[Real, Real]:
    """Coordinates of points turned counterclockwise by `angle`."""
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = np.asarray(x), np.asarray(y)
    return cos * x - sin * y, sin * x + cos * y


def on_lattice(
    function: Callable[[Real, Real], tuple[Real, ...]], rows: Real, columns: Real, step: float
) -> tuple[Real, ...]:
    """Evaluate a smooth function of position on a whole lattice, by splines from a coarse one.

    Map projections and core-field directions vary over thousands of kilometres, so that
    cubic splines through points a quarter of a degree apart follow them to micrometres, and
    a hundred times faster than evaluating each of millions of nodes.
    `rows` (m,) and `columns` (n,) give arrays (m, n); the coarse points are `step` apart.
    """
    coarse = coarse_axis(rows, step), coarse_axis(columns, step)
    # A spline is linear in its data: from those of unit data, all functions are products.
    down, across = (
        make_interp_spline(nodes, np.eye(nodes.size))(axis)
        for nodes, axis in zip(coarse, (rows, columns), strict=True)
    )
    return tuple(
        np.asarray(down @ values @ across.T)
        for values in function(*np.meshgrid(*coarse, indexing="ij"))
    )


def coarse_axis(axis: Real, step: float) -> Real:
    """At least eight points over the span of an axis, at most `step` apart."""
    low, high = float(axis[0]), float(axis[-1])
    if low == high:
        low, high = low - step / 8, high + step / 8
    return np.linspace(low, high, max(8, int(np.ceil((high - low) / step)) + 1))


def _probe_positions(grid: xr.Dataset, own: pyproj.Proj | None) -> tuple[Real, Real]:
    """Longitude and latitude (source datum) of a net of points over the grid's extent."""
    rows, columns = axes(grid)
    y, x = np.meshgrid(
        np.linspace(rows[0], rows[-1], _PROBES),
        np.linspace(columns[0], columns[-1], _PROBES),
        indexing="ij",
    )
    lon, lat = (x, y) if own is None else own(x, y, inverse=True)
    return np.asarray(lon), np.asarray(lat)


def grid_index(
    grid: xr.Dataset, plane: Plane, latitude: Real, longitude: Real
) -> tuple[Real, Real]:
    """Fractional row and column in `grid` of WGS84 positions (degrees)."""
    x, y = plane.source.transform(longitude, latitude, direction="INVERSE")
    return index_of(grid, np.asarray(x), np.asarray(y))


def index_of(grid: xr.Dataset, x: Real, y: Real) -> tuple[Real, Real]:
    """Fractional row and column in `grid` of positions in its own coordinates."""
    rows, columns = axes(grid)
    if is_geographic(grid):
        # Unwrapped about the grid's middle, so that a grid across the date line stays whole.
        middle = (columns[0] + columns[-1]) / 2
        x = middle + (x - middle + 180.0) % 360.0 - 180.0
    step_row, step_column = steps(grid)
    return (y - rows[0]) / step_row, (x - columns[0]) / step_column


def _candidates(
    crs: pyproj.CRS, longitude: Real, latitude: Real
) -> Iterator[tuple[pyproj.Proj, bool]]:
    if crs.is_projected:
        yield pyproj.Proj(crs), True
    ellipsoid = crs.ellipsoid
    assert ellipsoid is not None
    shape = {"a": ellipsoid.semi_major_metre, "rf": ellipsoid.inverse_flattening or None}
    if not shape["rf"]:
        shape = {"a": shape["a"], "b": ellipsoid.semi_minor_metre}
    unwrapped = np.unwrap(longitude, period=360.0)
    middle = {
        "lat_0": float((latitude.min() + latitude.max()) / 2),
        "lon_0": float((unwrapped.min() + unwrapped.max()) / 2),
    }
    third = float(np.ptp(latitude)) / 3
    parallels = {"lat_1": middle["lat_0"] - third, "lat_2": middle["lat_0"] + third}
    yield pyproj.Proj({"proj": "tmerc", **middle, **shape}), False
    yield pyproj.Proj({"proj": "stere", **middle, **shape}), False
    if abs(middle["lat_0"]) > 1.0:
        yield pyproj.Proj({"proj": "lcc", **middle, **parallels, **shape}), False
    else:
        mercator = {"proj": "merc", "lon_0": middle["lon_0"], "lat_ts": third}
        yield pyproj.Proj({**mercator, **shape}), False


def _scale(projection: pyproj.Proj, longitude: Real, latitude: Real) -> tuple[float, float]:
    """Mean scale factor and the greatest relative departure from it, in any direction."""
    found = projection.get_factors(longitude, latitude)
    axes = np.stack([found.tissot_semimajor, found.tissot_semiminor])
    if not np.all(np.isfinite(axes)):
        return 1.0, np.inf
    scale = float((axes.min() + axes.max()) / 2)
    return scale, float(axes.max() / scale - 1.0)
