"""Cropping to a region: what it covers, its margin, the date line, and regions without data."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest
from grids import geographic_grid, projected_grid

from magtiles.schemas import contracts
from magtiles.schemas.errors import CoverageError, ParameterError
from magtiles.stages.field.crop import CropGridParams, crop_grid


def crop(grid, latitude, longitude, margin_m=0.0):
    params = CropGridParams(latitude=latitude, longitude=longitude, margin_m=margin_m)
    return crop_grid(grid, params=params)


@pytest.fixture
def utm():
    """300 by 240 km in UTM 10, each value its own."""
    y, x = 4.95e6 + 2000.0 * np.arange(120), 450e3 + 2000.0 * np.arange(150)
    return projected_grid(np.arange(120.0 * 150).reshape(120, 150), y, x)


@pytest.mark.parametrize("margin", [0.0, 15e3])
def test_covers_the_region_and_its_margin_and_little_more(utm, margin):
    region = {"latitude": (45.3, 46.1), "longitude": (-122.4, -121.2)}
    cropped = crop(utm, **region, margin_m=margin)
    contracts.check(cropped, "anomaly-grid/1")
    to_grid = pyproj.Transformer.from_crs(4326, 32610, always_xy=True)
    t = np.linspace(0, 1, 101)
    outline = [(-122.4 + 1.2 * u, 45.3 + 0.8 * v) for u in (0, 1) for v in t]
    outline += [(-122.4 + 1.2 * u, 45.3 + 0.8 * v) for u in t for v in (0, 1)]
    x, y = to_grid.transform(*np.transpose(outline))
    for axis, wanted in (("x", x), ("y", y)):
        nodes = cropped[axis].values
        low, high = wanted.min() - margin - nodes[0], nodes[-1] - margin - wanted.max()
        assert 0.0 <= low < 3 * 2000.0
        assert 0.0 <= high < 3 * 2000.0
    same = utm["magnetic_anomaly"].sel(y=cropped["y"], x=cropped["x"])
    assert np.array_equal(cropped["magnetic_anomaly"].values, same.values)


def test_a_margin_ends_where_the_grid_does(utm):
    cropped = crop(utm, (45.3, 46.1), (-122.4, -121.2), 1e6)
    assert cropped["magnetic_anomaly"].shape == utm["magnetic_anomaly"].shape


@pytest.mark.parametrize(
    ("latitude", "longitude"),
    [
        ((60.0, 61.0), (-122.0, -121.0)),
        ((45.3, 46.0), (100.0, 101.0)),
        ((-46.0, -45.3), (-122.0, -121.0)),
    ],
    ids=["north", "other side of the Earth", "other hemisphere"],
)
def test_outside_is_refused_with_the_extent(utm, latitude, longitude):
    with pytest.raises(CoverageError, match=r"has no data.*latitude 44\.\d+ to 46\.\d+"):
        crop(utm, latitude, longitude)


def test_a_region_of_voids_is_refused(utm):
    utm["magnetic_anomaly"][30:70, 20:90] = np.nan
    with pytest.raises(CoverageError, match="has no data"):
        crop(utm, (45.3, 45.6), (-122.9, -121.9))


@pytest.mark.parametrize("latitude", [(46.0, 45.0), (45.0, 45.0), (-91.0, 45.0), (45.0, 90.5)])
def test_limits_out_of_order(utm, latitude):
    with pytest.raises(ParameterError, match="south < north"):
        crop(utm, latitude, (-122.0, -121.0))


@pytest.mark.parametrize("longitude", [(179.5, -179.0), (179.5, 181.0), (-180.5, -179.0)])
def test_across_the_date_line(longitude):
    latitude, across = 50.0 + 0.05 * np.arange(61), 178.0 + 0.05 * np.arange(81)
    values = np.arange(61.0 * 81).reshape(61, 81)
    cropped = crop(geographic_grid(values, latitude, across), (51.0, 52.0), longitude)
    nodes = cropped["longitude"].values
    assert 179.5 - 0.15 < nodes[0] <= 179.5
    assert 181.0 <= nodes[-1] < 181.0 + 0.15
    assert 52.0 <= cropped["latitude"].values[-1] < 52.15


@pytest.mark.parametrize("first", [-180.0, 0.0, -170.0])
def test_a_globe_is_whole_across_its_own_cut(first):
    longitude = first + np.arange(360.0)
    values = np.cos(np.radians(longitude)) + np.arange(-90.0, 91.0)[:, None]
    globe = geographic_grid(values, np.arange(-90.0, 91.0), longitude)
    cropped = crop(globe, (-10.0, 10.0), (170.0, -170.0), margin_m=111e3)
    nodes = cropped["longitude"].values
    np.testing.assert_array_equal(np.diff(nodes), 1.0)
    assert 166.0 <= nodes[0] <= 169.0
    assert 191.0 <= nodes[-1] <= 194.0
    exact = np.cos(np.radians(nodes)) + cropped["latitude"].values[:, None]
    np.testing.assert_allclose(cropped["magnetic_anomaly"], exact, rtol=0, atol=1e-12)
    contracts.check(cropped, "anomaly-grid/1")
