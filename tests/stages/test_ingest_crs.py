"""The way to WGS84: which operation, how accurate, and when two systems agree."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest

from magtiles.schemas.errors import ContractError, SourceError
from magtiles.stages import crs as coordinates

_X, _Y = np.array([4.0e5, 6.0e5]), np.array([4.9e6, 5.1e6])


@pytest.mark.parametrize(
    ("crs", "accuracy", "name"),
    [
        ("EPSG:32610", 0.0, "UTM zone 10N"),
        ("EPSG:4326", 0.0, "WGS 84"),
        ("EPSG:5070", 4.0, "NAD83 to WGS 84"),
        ("EPSG:28354", 3.0, "GDA94 to WGS 84"),
    ],
)
def test_operation_and_accuracy(crs, accuracy, name):
    operation = coordinates.datum_operation(coordinates.to_wgs84(pyproj.CRS(crs)))
    assert operation.accuracy_m == accuracy
    assert name in operation.name


def test_geographic_axes_are_longitude_then_latitude():
    transformer = coordinates.to_wgs84(pyproj.CRS("EPSG:4326"))
    assert transformer.transform(-121.5, 46.0) == (-121.5, 46.0)


def test_region_chooses_the_operation():
    nad27 = pyproj.CRS("EPSG:4267")
    alaska = coordinates.to_wgs84(nad27, region=(-155.0, 62.0, -150.0, 65.0))
    cuba = coordinates.to_wgs84(nad27, region=(-80.0, 21.0, -77.0, 22.5))
    assert alaska.definition != cuba.definition


def test_ballpark_is_refused_unless_allowed():
    unknown = pyproj.CRS("+proj=utm +zone=10 +ellps=clrk66")
    with pytest.raises(SourceError, match="how the datum 'Unknown based on Clarke 1866"):
        coordinates.to_wgs84(unknown)
    allowed = coordinates.datum_operation(coordinates.to_wgs84(unknown, allow_ballpark=True))
    assert allowed.accuracy_m is None
    assert "Ballpark" in allowed.name


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ("+proj=utm +zone=10 +datum=WGS84", True),
        ("+proj=utm +zone=10 +ellps=WGS84", True),  # the datum is not stated
        ("EPSG:26910", False),  # another datum on nearly the same ellipsoid
        ("+proj=utm +zone=10 +ellps=clrk66", False),
        ("EPSG:32611", False),
        ("+proj=tmerc +lat_0=0 +lon_0=-123 +k=0.9996 +x_0=500000.02 +datum=WGS84", False),
        ("EPSG:4326", False),
    ],
)
def test_agreement(other, expected):
    mine = pyproj.CRS("EPSG:32610")
    assert coordinates.agree(mine, pyproj.CRS(other), _X, _Y) is expected


def test_coordinates_outside_the_projection():
    far = np.array([1e9, 2e9])
    with pytest.raises(SourceError, match=r"lie outside the projection.*check the CRS"):
        coordinates.geographic_bounds(pyproj.CRS("EPSG:5070"), far, far)


def test_dataset_without_a_grid_mapping():
    import xarray as xr

    with pytest.raises(ContractError, match="no variable 'crs'"):
        coordinates.dataset_crs(xr.Dataset())
