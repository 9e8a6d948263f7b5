"""Reading grids: where the nodes are, what is void, which unit, CRS and datum."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import rasterio
import xarray as xr

from magtiles.schemas import contracts
from magtiles.stages import crs as coordinates
from magtiles.stages.ingest.grid import STAGE, ingest_grid
from magtiles.stages.ingest.source import IngestGridParams

_SAID: dict[str, Any] = {
    "height_m": 1500.0,
    "height_reference": "ellipsoid",
    "reference_field": "IGRF-14",
    "reference_epoch": "1990-01-01",
    "uncertainty_nt": 2.0,
}
_VALUES = np.arange(12.0).reshape(3, 4) - 5.0  # zero is a value; rows from the south


def _north_up(west: float, north: float, step: float) -> rasterio.Affine:
    return rasterio.Affine(step, 0.0, west, 0.0, -step, north)


def _ingest(path: Path, **keys: Any) -> xr.Dataset:
    grid = ingest_grid([path], params=IngestGridParams(**(_SAID | keys)))
    contracts.check(grid, STAGE.output)
    return grid


@pytest.fixture
def tiff(tmp_path: Path) -> Callable[..., Path]:
    """Writes `_VALUES`, whose south-western node is (500500, 5000500), 1 km apart."""

    def write(values: np.ndarray = _VALUES, **profile: Any) -> Path:
        path = tmp_path / "grid.tif"
        point = profile.pop("point", False)
        units = profile.pop("units", None)
        corner = (500000.0, 5000000.0 + 1000.0 * values.shape[0])
        settings = {
            "driver": "GTiff",
            "height": values.shape[0],
            "width": values.shape[1],
            "count": 1,
            "dtype": "float64",
            "crs": "EPSG:32610",
            "transform": _north_up(*corner, 1000.0),
        }
        with rasterio.open(path, "w", **(settings | profile)) as dataset:
            if point:
                dataset.update_tags(AREA_OR_POINT="Point")
            if units:
                dataset.units = (units,)
            dataset.write(values[::-1].astype(settings["dtype"]), 1)
        return path

    return write


class TestGeotiff:
    def test_nodes_are_cell_centres_and_rows_ascend(self, tiff):
        grid = _ingest(tiff())
        np.testing.assert_array_equal(grid.x, 500500.0 + 1000.0 * np.arange(4))
        np.testing.assert_array_equal(grid.y, 5000500.0 + 1000.0 * np.arange(3))
        np.testing.assert_array_equal(grid.magnetic_anomaly, _VALUES)

    def test_point_registration_is_read_at_its_points(self, tiff):
        # GDAL gives corners for both registrations, so the nodes stay where they were.
        grid = _ingest(tiff(point=True), registration="point")
        np.testing.assert_array_equal(grid.x, 500500.0 + 1000.0 * np.arange(4))

    def test_rows_stored_from_the_south(self, tiff):
        up = rasterio.Affine(1000.0, 0.0, 500000.0, 0.0, 1000.0, 5000000.0)
        grid = _ingest(tiff(_VALUES[::-1], transform=up))
        np.testing.assert_array_equal(grid.magnetic_anomaly, _VALUES)
        assert grid.y[0] == 5000500.0

    def test_voids_are_the_tag_and_nan_but_never_zero(self, tiff):
        values = _VALUES.copy()
        values[0, 0], values[2, 1] = -999999.0, np.nan
        grid = _ingest(tiff(values, nodata=-999999.0))
        expected = values.copy()
        expected[0, 0] = np.nan
        np.testing.assert_array_equal(grid.magnetic_anomaly, expected)
        assert (grid.magnetic_anomaly == 0.0).sum() == 1

    def test_void_mark_of_the_key_where_the_file_has_none(self, tiff):
        values = _VALUES.copy()
        values[2, 3] = -9999.99
        grid = _ingest(tiff(values, dtype="float32"), no_data=-9999.99)
        assert np.isnan(grid.magnetic_anomaly[2, 3])
        assert np.isnan(grid.magnetic_anomaly).sum() == 1

    @pytest.mark.parametrize(
        ("unit", "factor"), [("nT", 1.0), ("gamma", 1.0), ("uT", 1e3), ("tesla", 1e9)]
    )
    def test_units_of_the_file(self, tiff, unit, factor):
        grid = _ingest(tiff(_VALUES / factor, units=unit))
        np.testing.assert_allclose(grid.magnetic_anomaly, _VALUES, rtol=1e-15)

    def test_chosen_band(self, tiff):
        path = tiff(count=2)
        with rasterio.open(path, "r+") as dataset:
            dataset.write(_VALUES[::-1] * 2.0, 2)
        np.testing.assert_array_equal(_ingest(path, band=2).magnetic_anomaly, 2.0 * _VALUES)

    def test_feet_become_metres_of_the_same_projection(self, tiff):
        foot = 1200.0 / 3937.0
        place = _north_up(6e6, 2e6 + 3 * 1000.0, 1000.0)
        grid = _ingest(tiff(crs="EPSG:2227", transform=place))
        np.testing.assert_allclose(np.diff(grid.x), 1000.0 * foot, rtol=1e-9)
        ours = coordinates.dataset_to_wgs84(grid).transform(float(grid.x[0]), float(grid.y[0]))
        same = pyproj.Transformer.from_crs("EPSG:2227", "EPSG:4269", always_xy=True)
        np.testing.assert_allclose(ours, same.transform(6e6 + 500.0, 2e6 + 500.0), atol=1e-10)

    @pytest.mark.parametrize(
        ("west", "expected"),
        [
            (-121.0, [-120.5, -119.5, -118.5, -117.5]),
            (239.0, [-120.5, -119.5, -118.5, -117.5]),
            (178.0, [178.5, 179.5, 180.5, 181.5]),  # across the date line, unwrapped
            (-181.0, [179.5, 180.5, 181.5, 182.5]),
        ],
    )
    def test_longitudes(self, tiff, west, expected):
        place = _north_up(west, 49.0, 1.0)
        grid = _ingest(tiff(crs="EPSG:4326", transform=place))
        np.testing.assert_allclose(grid.longitude, expected, atol=1e-12)
        np.testing.assert_array_equal(grid.latitude, [46.5, 47.5, 48.5])
        np.testing.assert_array_equal(grid.magnetic_anomaly, _VALUES)

    def test_global_grid_is_cut_at_the_date_line(self, tiff):
        values = np.tile(np.arange(37.0), (3, 1))  # 0, 10, ..., 360: the last repeats the first
        place = _north_up(-5.0, 15.0, 10.0)
        grid = _ingest(tiff(values, crs="EPSG:4326", transform=place))
        np.testing.assert_allclose(grid.longitude, np.arange(-180.0, 180.0, 10.0), atol=1e-12)
        east = np.arange(-180, 180, 10) % 360 / 10
        np.testing.assert_array_equal(grid.magnetic_anomaly[1], east)


_GXF = """#POINTS
4
#ROWS
3
#PTSEPARATION
10
#RWSEPARATION
20
#XORIGIN
500000
#YORIGIN
5000000
#DUMMY
-99
#TRANSFORM
2 1
#GRID
-5 -4 -3 -2
-1 0 -99
2
3 4 5 6
"""


class TestGxf:
    def test_points_rows_dummy_and_transform(self, tmp_path):
        path = tmp_path / "grid.gxf"
        path.write_text(_GXF)
        grid = _ingest(path, crs="EPSG:32610")
        np.testing.assert_array_equal(grid.x, 500000.0 + 10.0 * np.arange(4))
        np.testing.assert_array_equal(grid.y, 5000000.0 + 20.0 * np.arange(3))
        expected = 2.0 * _VALUES + 1.0
        expected[1, 2] = np.nan
        np.testing.assert_array_equal(grid.magnetic_anomaly, expected)

    def test_standard_projection_keyword(self, tmp_path):
        path = tmp_path / "grid.gxf"
        projection = (
            '#MAP_PROJECTION\n"WGS 84 / UTM zone 10N"\n"WGS 84",6378137,0.0818191908426,0\n'
            '"Transverse Mercator",0,-123,0.9996,500000,0\n#UNIT_LENGTH\n"m",1\n#GRID\n'
        )
        path.write_text(_GXF.replace("#GRID\n", projection))
        grid = _ingest(path, crs="EPSG:32610")  # the file and the key must agree
        assert coordinates.dataset_crs(grid).ellipsoid.semi_major_metre == 6378137.0

    def test_real_grid(self, real_data):
        path = real_data / "grids" / "mag5001.gxf"
        nad27 = "+proj=lcc +lat_0=41 +lon_0=-107.5 +lat_1=33 +lat_2=45 +datum=NAD27"
        grid = _ingest(path, crs=nad27, height_m=150.0, height_reference="terrain")
        assert dict(grid.sizes) == {"y": 148, "x": 132}
        assert (float(grid.x[0]), float(grid.y[0])) == (235000.0, 378000.0)
        assert np.isnan(grid.magnetic_anomaly).mean() == pytest.approx(0.3136, abs=1e-4)
        with rasterio.open(path) as dataset:  # GDAL reads this file right, in float32
            peer = dataset.read(1, masked=True).filled(np.nan)[::-1]
        np.testing.assert_allclose(grid.magnetic_anomaly, peer, rtol=6e-8, atol=0)
        # Of NAD27's 30 operations, the one for the western United States.
        assert grid.attrs["datum_operation"].endswith("NAD27 to WGS 84 (6)")
        assert grid.attrs["datum_accuracy_m"] == 7.0
        # The shift there is 48 m, and no shift at all is what a lost datum would look like.
        own = pyproj.Transformer.from_crs(nad27, "EPSG:4267", always_xy=True)
        corner = 235000.0, 378000.0
        wgs84 = pyproj.Geod(ellps="WGS84")
        shift = wgs84.inv(
            *own.transform(*corner), *coordinates.dataset_to_wgs84(grid).transform(*corner)
        )
        assert 30.0 < shift[2] < 70.0


def test_real_geotiff(real_data):
    grid = _ingest(real_data / "grids" / "tempest_magnetics.tif")
    assert dict(grid.sizes) == {"y": 770, "x": 363}
    assert (float(grid.x[0]), float(grid.y[-1])) == (291455.0, 1647785.0)
    assert np.isnan(grid.magnetic_anomaly).mean() == pytest.approx(0.5025, abs=1e-4)
    assert grid.attrs["datum_accuracy_m"] == 4.0
    assert "NAD83 to WGS 84" in grid.attrs["datum_operation"]


def _cf(**changes: Any) -> xr.Dataset:
    crs = pyproj.CRS.from_epsg(32610).to_cf()
    dataset = xr.Dataset(
        {
            "tmi": (("y", "x"), _VALUES.copy(), {"units": "nT", "grid_mapping": "utm"}),
            "utm": ((), np.int32(0), crs),
        },
        coords={
            "y": ("y", 5e6 + 1000.0 * np.arange(3), {"units": "m", "axis": "Y"}),
            "x": ("x", 5e5 + 1000.0 * np.arange(4), {"units": "m", "axis": "X"}),
        },
    )
    return dataset.assign(changes)


class TestCf:
    def _read(self, dataset: xr.Dataset, tmp_path: Path, **keys: Any) -> xr.Dataset:
        path = tmp_path / "grid.nc"
        dataset.to_netcdf(path, engine="netcdf4")
        return _ingest(path, **keys)

    def test_plain(self, tmp_path):
        grid = self._read(_cf(), tmp_path)
        np.testing.assert_array_equal(grid.magnetic_anomaly, _VALUES)
        np.testing.assert_array_equal(grid.x, 5e5 + 1000.0 * np.arange(4))
        assert coordinates.dataset_crs(grid).to_epsg() == 32610

    def test_classic_format(self, tmp_path):
        path = tmp_path / "grid.nc"
        _cf().to_netcdf(path, format="NETCDF3_CLASSIC", engine="netcdf4")
        grid = _ingest(path)
        np.testing.assert_array_equal(grid.magnetic_anomaly, _VALUES)
        assert grid.magnetic_anomaly.dtype == np.dtype("<f8")

    def test_descending_and_transposed(self, tmp_path):
        turned = _cf().isel(y=slice(None, None, -1)).transpose("x", "y")
        grid = self._read(turned, tmp_path)
        np.testing.assert_array_equal(grid.magnetic_anomaly, _VALUES)
        assert grid.magnetic_anomaly.dims == ("y", "x")

    def test_packed_integers_with_fill_and_valid_range(self, tmp_path):
        dataset = _cf()
        packed = np.round((_VALUES - 20.0) / 0.25).astype(np.int16)
        packed[0, 0], packed[2, 3] = -32768, 30000
        attrs = dataset.tmi.attrs | {
            "scale_factor": np.float32(0.25),
            "add_offset": np.float32(20.0),
            "valid_range": np.array([-2000, 2000], dtype=np.int16),
            "_FillValue": np.int16(-32768),
        }
        dataset["tmi"] = (("y", "x"), packed, attrs)
        expected = _VALUES.copy()
        expected[0, 0] = expected[2, 3] = np.nan
        grid = self._read(dataset, tmp_path)
        np.testing.assert_array_equal(grid.magnetic_anomaly, expected)

    def test_coordinates_in_kilometres(self, tmp_path):
        dataset = _cf()
        for axis in "xy":
            km = dataset[axis].copy(data=dataset[axis].values / 1e3)
            dataset[axis] = km.assign_attrs(units="km")
        grid = self._read(dataset, tmp_path)
        np.testing.assert_allclose(grid.y, 5e6 + 1000.0 * np.arange(3), rtol=1e-15)

    def test_value_stands_at_the_middle_of_its_bounds(self, tmp_path):
        dataset = _cf()
        edges = dataset.x.values
        dataset["x_bounds"] = (("x", "two"), np.stack([edges, edges + 1000.0], axis=1))
        dataset["x"].attrs["bounds"] = "x_bounds"
        grid = self._read(dataset, tmp_path)
        np.testing.assert_array_equal(grid.x, edges + 500.0)

    def test_single_precision_coordinates_are_regular(self, tmp_path):
        dataset = _cf().drop_vars("utm").rename(x="lon", y="lat")
        del dataset.tmi.attrs["grid_mapping"]
        longitude = (239.0 + np.arange(4) / 60.0).astype(np.float32)  # rounded by 1e-3 of a step
        dataset["lon"] = ("lon", longitude, {"units": "degrees_east"})
        latitude = (46.0 + np.arange(3) / 60.0).astype(np.float32)
        dataset["lat"] = ("lat", latitude, {"units": "degrees_north"})
        grid = self._read(dataset, tmp_path, crs="EPSG:4326")
        assert np.ptp(np.diff(grid.longitude)) < 1e-12
        np.testing.assert_allclose(grid.longitude, -121.0 + np.arange(4) / 60.0, atol=2e-5)

    def test_gridded_uncertainty_goes_with_its_variable(self, tmp_path):
        spread = (("y", "x"), _VALUES + 6.0, {"units": "nT"})
        grid = self._read(_cf(tmi_uncertainty=spread), tmp_path, uncertainty_nt=None)
        np.testing.assert_array_equal(grid.magnetic_anomaly_uncertainty, _VALUES + 6.0)

    def test_its_own_output_needs_no_keys(self, tmp_path):
        first = self._read(_cf(), tmp_path, line_spacing_m=800.0, wavelength_band_km=(1.0, 300.0))
        path = tmp_path / "again.nc"
        first.to_netcdf(path, engine="netcdf4")
        again = ingest_grid([path], params=IngestGridParams())
        xr.testing.assert_equal(again, first)
        assert again.attrs["wavelength_band_km"] == [1.0, 300.0]
        assert again.attrs["reference_epoch"] == "1990-01-01"


class TestFacts:
    def test_source_distance_is_the_height_above_terrain(self, tiff):
        flown = {"height_m": 150.0, "height_reference": "terrain", "line_spacing_m": 800.0}
        assert _ingest(tiff(), **flown).attrs["source_distance_m"] == 150.0
        assert "source_distance_m" not in _ingest(tiff(), line_spacing_m=800.0).attrs

    def test_missing_source_distance_is_warned_of(self, tiff, caplog):
        _ingest(tiff(), line_spacing_m=800.0)
        assert "no source_distance_m" in caplog.text

    def test_sea_level_with_its_undulation(self, tiff):
        grid = _ingest(tiff(), height_reference="mean_sea_level", undulation_m=-21.5)
        assert float(grid.reference_surface_height) == -21.5

    def test_ballpark_datum_is_marked_where_allowed(self, tiff):
        grid = _ingest(tiff(crs="+proj=utm +zone=10 +ellps=clrk66"), allow_ballpark_datum=True)
        assert grid.attrs["allow_ballpark_datum"] == 1
        assert "Ballpark" in grid.attrs["datum_operation"]
        assert "datum_accuracy_m" not in grid.attrs

    def test_no_path_gets_into_the_attributes(self, tiff):
        path = tiff()
        grid = _ingest(path)
        assert grid.attrs["source"] == "grid.tif"
        assert str(path.parent) not in str(grid.attrs)
