from __future__ import annotations

import numpy as np
import pyproj
import pytest

from magtiles.catalog.kernels import geodesy


def test_the_ellipsoid_is_the_one_proj_carries() -> None:
    wgs84 = pyproj.Geod(ellps="WGS84")
    assert wgs84.a == geodesy.SEMI_MAJOR_AXIS_M
    assert abs(geodesy.FLATTENING / wgs84.f - 1.0) < 1e-15


@pytest.mark.parametrize("latitude", [-84.0, -45.0, 0.0, 17.3, 60.0])
@pytest.mark.parametrize("height", [-400.0, 0.0, 12_000.0])
def test_metres_per_degree_are_those_of_small_steps_in_space(
    latitude: float, height: float
) -> None:
    to_space = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    step = 1e-4

    def distance(dlat: float, dlon: float) -> float:
        ends = [
            np.array(to_space.transform(30.0 + s * dlon, latitude + s * dlat, height))
            for s in (-0.5, 0.5)
        ]
        return float(np.linalg.norm(ends[1] - ends[0])) / step

    north, east = geodesy.metres_per_degree(np.array(latitude), height)
    assert north == pytest.approx(distance(step, 0.0), rel=1e-9)
    assert east == pytest.approx(distance(0.0, step), rel=1e-8)


def test_longitudes_wrap() -> None:
    longitudes = np.array([-180.0, 180.0, 179.5, 540.5, -0.25])
    np.testing.assert_array_equal(
        geodesy.wrap_longitude(longitudes), [-180.0, -180.0, 179.5, -179.5, -0.25]
    )
    np.testing.assert_array_equal(
        geodesy.degrees_east_of(179.0, np.array([-179.0, 179.0, 178.0])), [2.0, 0.0, 359.0]
    )
