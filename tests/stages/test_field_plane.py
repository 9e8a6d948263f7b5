"""Which plane a map is transformed on, and that places on it are where PROJ says."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest
from grids import geographic_grid, projected_grid

from magtiles.stages.field.plane import SCALE_TOLERANCE, choose_plane, on_lattice

WGS84 = pyproj.Geod(ellps="WGS84")
# Of the Decade of North American Geology.
DNAG = "+proj=tmerc +lat_0=0 +lon_0=-100 +k=0.926 +x_0=0 +y_0=0 +datum=NAD27 +units=m"


def projected(crs: str, longitude: float, latitude: float, width: float = 200e3):
    middle = pyproj.Transformer.from_crs(4326, crs, always_xy=True).transform(longitude, latitude)
    x, y = (
        c + np.linspace(-width / 2, width / 2, n) for c, n in zip(middle, (51, 41), strict=True)
    )
    return projected_grid(np.zeros((41, 51)), y, x, crs)


def geographic(latitude: tuple[float, float], longitude: tuple[float, float]):
    axes = np.linspace(*latitude, 31), np.linspace(*longitude, 41)
    return geographic_grid(np.zeros((31, 41)), *axes)


GRIDS = {
    "UTM at its meridian": (projected("EPSG:32610", -123.0, 46.0), True, 0.9996),
    "UTM 12 degrees off": (projected("EPSG:32610", -111.0, 46.0), False, 1.0),
    "DNAG": (projected(DNAG, -100.0, 45.0), True, 0.926),
    "Mercator at 60 N": (projected("EPSG:3395", 10.0, 60.0, 900e3), False, 1.0),
    "southern polar": (projected("EPSG:3031", 0.0, -70.0), False, 1.0),
    "degrees": (geographic((45.0, 47.0), (10.0, 13.0)), False, 1.0),
    "degrees, south": (geographic((-35.0, -33.0), (147.0, 150.0)), False, 1.0),
    "on the equator": (geographic((-1.0, 1.0), (20.0, 23.0)), False, 1.0),
    "over the date line": (geographic((50.0, 52.0), (178.5, 181.5)), False, 1.0),
}


@pytest.mark.parametrize(("grid", "own", "scale"), GRIDS.values(), ids=GRIDS)
def test_choice(grid, own, scale):
    plane = choose_plane(grid)
    assert plane.is_source is own
    assert plane.scale_error < SCALE_TOLERANCE == 1e-3
    assert plane.scale == pytest.approx(scale, abs=2e-3)


@pytest.mark.parametrize("grid", [g for g, _, _ in GRIDS.values()], ids=GRIDS)
def test_distances_and_north_by_geodesics(grid):
    """Scale, direction of north and handedness against geodesics on the ellipsoid."""
    plane = choose_plane(grid)
    rows, columns = (grid[d].values for d in grid["magnetic_anomaly"].dims)
    x, y = np.meshgrid(columns[5:-5:10], rows[5:-5:10])
    longitude, latitude = plane.source.transform(x, y)
    px, py = plane.position(latitude, longitude)
    back = plane.geographic(px, py)
    assert back[0] == pytest.approx(latitude, abs=1e-8)
    assert (back[1] - longitude + 180) % 360 - 180 == pytest.approx(0.0 * latitude, abs=1e-8)
    north_x, north_y = plane.north(latitude, longitude)
    for azimuth in (0.0, 90.0):
        # 200 m along a geodesic, east being a quarter turn clockwise from north.
        lon2, lat2, _ = WGS84.fwd(
            longitude, latitude, np.full_like(latitude, azimuth), 200.0 + 0 * latitude
        )
        step = np.array(plane.position(lat2, lon2)) - [px, py]
        unit = (north_x, north_y) if azimuth == 0.0 else (north_y, -north_x)
        tolerance = 1.2 * SCALE_TOLERANCE
        assert step[0] / (200.0 * plane.scale) == pytest.approx(unit[0], abs=tolerance)
        assert step[1] / (200.0 * plane.scale) == pytest.approx(unit[1], abs=tolerance)


def test_the_outline_stays_upright():
    """Twelve degrees off, grid north is 9 degrees from true; the plane follows the grid."""
    grid = GRIDS["UTM 12 degrees off"][0]
    plane = choose_plane(grid)
    y, x = grid["y"].values, grid["x"].values
    px, py = plane.from_source(x[[10, 40]], y[[20, 20]])
    assert abs(np.degrees(np.arctan2(np.diff(py)[0], np.diff(px)[0]))) < 0.1
    assert plane.to_source(px, py)[0] == pytest.approx(x[[10, 40]], abs=1e-3)


def test_smooth_functions_on_a_lattice():
    """A projection over 5 degrees through coarse nodes, to a millimetre."""
    projection = pyproj.Proj("EPSG:32610")
    rows, columns = np.linspace(44.0, 49.0, 61), np.linspace(-125.0, -119.0, 71)

    def position(latitude, longitude):
        return projection(longitude, latitude)

    exact = position(*np.meshgrid(rows, columns, indexing="ij"))
    for found, wanted in zip(on_lattice(position, rows, columns, 0.25), exact, strict=True):
        assert np.abs(found - wanted).max() < 1e-3
