"""Surfaces on a lattice: interpolation, averages, voids, CRS, the date line, what is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import xarray as xr
from draped import Floats, terrain, write_heights
from grids import geographic_grid

from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError, CoverageError, FormatError, SourceError
from magtiles.stages.field.surface import SampleSurfaceParams, sample_surface
from magtiles.stages.ingest.source import IngestSurfaceParams
from magtiles.stages.ingest.surface import ingest_surface

_KEYS = {"surface": "terrain", "height_reference": "ellipsoid"}
_LATITUDE, _LONGITUDE = (45.8, 0.01, 41), (-121.7, 0.0125, 33)


def nodes(axis: tuple[float, float, int]) -> Floats:
    return axis[0] + axis[1] * np.arange(axis[2])


def grid(
    latitude: Floats | None = None, longitude: Floats | None = None, **attributes: Any
) -> xr.Dataset:
    """A survey above terrain, wider than the lattice."""
    lat = nodes((45.5, 0.02, 51)) if latitude is None else latitude
    lon = nodes((-122.2, 0.02, 51)) if longitude is None else longitude
    stated = {"height_reference": "terrain"} | attributes
    return geographic_grid(np.zeros((lat.size, lon.size)), lat, lon, **stated)


def surface(
    height: Callable[[Floats, Floats], Floats], latitude: Floats, longitude: Floats, **attrs: Any
) -> xr.Dataset:
    """A surface-grid/1 on WGS84 degrees."""
    made = grid(latitude, longitude).drop_vars(
        ["magnetic_anomaly", "magnetic_anomaly_uncertainty", "height"]
    )
    values = height(latitude[:, None], longitude[None, :])
    made["surface_height"] = (("latitude", "longitude"), values, {"units": "m"})
    return made.assign_attrs({"source": "dem", **_KEYS, **attrs})


def sampled(dem: xr.Dataset, survey: xr.Dataset | None = None, **more: Any) -> Floats:
    params = SampleSurfaceParams(latitude=_LATITUDE, longitude=_LONGITUDE)
    survey = grid() if survey is None else survey
    found = sample_surface(survey, dem, params=params, **more)
    contracts.check(found, "surface-grid/1")
    assert found.attrs["height_reference"] == "ellipsoid"
    return found["surface_height"].values


def plane(lat: Floats, lon: Floats) -> Floats:
    return 500.0 + 300.0 * (lat - 46.0) + 200.0 * (lon + 121.5)


def on_nodes(height: Callable[[Floats, Floats], Floats]) -> Floats:
    return height(nodes(_LATITUDE)[:, None], nodes(_LONGITUDE)[None, :])


@pytest.mark.parametrize("step", [0.0005, 0.0041, 0.03, 0.25], ids=str)
def test_a_plane_is_exact_however_dense_the_surface_is(step: float) -> None:
    dem = surface(plane, np.arange(45.0, 47.0, step), np.arange(-122.5, -120.5, step))
    np.testing.assert_allclose(sampled(dem), on_nodes(plane), rtol=0, atol=1e-6)


def test_dense_surfaces_are_averaged_over_a_cell_of_the_lattice() -> None:
    """Nine by eleven DEM nodes to a lattice cell, of noise: the mean of those around a node."""
    latitude = 45.8 + 0.01 / 9 * np.arange(-90, 460)
    longitude = -121.7 + 0.0125 / 11 * np.arange(-110, 480)
    noise = np.random.default_rng(0).normal(0.0, 100.0, (latitude.size, longitude.size))
    found = sampled(surface(lambda lat, lon: noise + 0 * lat, latitude, longitude))
    for i, j in ((0, 0), (7, 20), (40, 32)):
        r, c = 90 + 9 * i, 110 + 11 * j
        mean = noise[r - 4 : r + 5, c - 5 : c + 6].mean()
        assert found[i, j] == pytest.approx(mean, abs=1e-6)
    assert found.std() == pytest.approx(100.0 / np.sqrt(99), rel=0.1)


@pytest.mark.parametrize(
    "code",
    ["EPSG:4326", "EPSG:32611", "EPSG:26710", "EPSG:5070", "EPSG:4267"],
    ids=["wgs84", "utm-of-the-next-zone", "nad27", "albers", "degrees-of-nad27"],
)
def test_a_surface_in_another_crs_and_datum(code: str, tmp_path: Path) -> None:
    """Written by GDAL in its own CRS, read by ingest-surface, against the analytic terrain."""
    to_own = pyproj.Transformer.from_crs("EPSG:4326", code, always_xy=True)
    x, y = to_own.transform(*np.meshgrid([-122.0, -121.0], [45.6, 46.4]))
    step = 250.0 if to_own.target_crs.is_projected else 0.003
    axes = np.arange(x.min(), x.max(), step), np.arange(y.min(), y.max(), step)
    toml = write_heights(tmp_path / "dem.toml", terrain, axes, code, **_KEYS)
    dem = ingest_surface([toml], params=IngestSurfaceParams())
    contracts.check(dem, "surface-grid/1")
    # Measured: 0.65 m, what the mean over a cell takes of these hills, 0.83 m where axes are
    # askew; NAD27's 100 m taken for WGS84 would be 4 m.
    assert np.abs(sampled(dem) - on_nodes(terrain)).max() < 0.9


@pytest.mark.parametrize("first", [-180.0, 0.0, -170.0])
def test_a_surface_of_the_globe_has_no_edge(first: float) -> None:
    """A lattice across the date line, and a globe cut there, at Greenwich, and beside it."""
    params = SampleSurfaceParams(latitude=(-1.0, 0.1, 21), longitude=(179.0, 0.1, 21))

    def height(lat: Floats, lon: Floats) -> Floats:
        return 100.0 * np.cos(np.radians(lon)) + 50.0 * np.sin(np.radians(3 * lon)) + lat

    globe = surface(height, np.arange(-90.0, 91.0), first + np.arange(360.0))
    survey = grid(np.arange(-3.0, 3.1, 0.5), np.arange(177.0, 183.1, 0.5))
    found = sample_surface(survey, globe, params=params)["surface_height"].values
    truth = height(nodes((-1.0, 0.1, 21))[:, None], nodes((179.0, 0.1, 21))[None, :])
    # Bilinear over a degree: (pi / 180)^2 (100 + 9 x 50) / 8 = 0.021 m.
    assert np.abs(found - truth).max() < 0.022


class TestCoverage:
    DEM = np.arange(45.0, 47.0, 0.005), np.arange(-122.5, -120.5, 0.005)

    def _with_hole(self, half_width: float) -> xr.Dataset:
        dem = surface(plane, *self.DEM)
        near = (np.abs(dem.latitude - 46.0) < half_width) & (
            np.abs(dem.longitude + 121.5) < half_width
        )
        return dem.assign(surface_height=dem.surface_height.where(~near))

    def test_a_void_of_one_node_is_bridged(self) -> None:
        found = sampled(self._with_hole(0.001))
        assert np.abs(found - on_nodes(plane)).max() < 1.0

    def test_a_larger_void_is_named(self) -> None:
        with pytest.raises(
            CoverageError, match=r"latitude 45\.9\d* to 46\.0\d*, longitude -121\.5"
        ):
            sampled(self._with_hole(0.04))

    def test_what_the_survey_does_not_cover_needs_none(self) -> None:
        survey = grid()
        flags = np.where(survey.latitude > 45.95, 2, 0)[:, None] * np.ones(survey.longitude.size)
        survey["quality_flag"] = (("latitude", "longitude"), flags.astype(np.uint8))
        dem = surface(plane, self.DEM[0][self.DEM[0] < 46.0], self.DEM[1])
        found, exact = sampled(dem, survey), on_nodes(plane)
        inside = nodes(_LATITUDE) < 45.95
        np.testing.assert_allclose(found[inside], exact[inside], rtol=0, atol=1e-6)
        np.testing.assert_array_equal(found[-1], found[-5])  # the nearest one's

    def test_a_surface_elsewhere_is_refused(self) -> None:
        with pytest.raises(CoverageError, match="1353 of the 1353 nodes"):
            sampled(surface(plane, np.arange(10.0, 11.0, 0.1), np.arange(10.0, 11.0, 0.1)))


@dataclass(frozen=True)
class Refuse:
    survey: dict[str, str]
    dem: dict[str, str]
    geoid: dict[str, str] | None
    says: str
    id: str


_SEA = {"height_reference": "mean_sea_level"}
_GEOID = {"surface": "mean_sea_level"}
REFUSED = [
    Refuse({"height_reference": "ellipsoid"}, {}, None, "is a surface of terrain", "ellipsoid"),
    Refuse({}, _GEOID, None, "expected terrain", "geoid-for-dem"),
    Refuse({}, _SEA, None, "give a geoid", "no-geoid"),
    Refuse({}, {}, _GEOID, "leave the geoid out", "needless-geoid"),
    Refuse({}, _SEA, {}, "expected the heights of mean_sea_level", "dem-for-geoid"),
]


@pytest.mark.parametrize("refuse", REFUSED, ids=lambda refuse: refuse.id)
def test_surfaces_that_do_not_fit_are_refused(refuse: Refuse) -> None:
    axes = np.arange(45.0, 47.0, 0.1), np.arange(-122.5, -120.5, 0.1)
    more = {} if refuse.geoid is None else {"geoid": surface(plane, *axes, **refuse.geoid)}
    with pytest.raises(ContractError, match=refuse.says):
        sampled(surface(plane, *axes, **refuse.dem), grid(**refuse.survey), **more)


class TestIngest:
    AXES = np.arange(-121.8, -121.0, 0.1), np.arange(45.5, 46.5, 0.1)

    def test_a_number_makes_heights_ellipsoidal(self, tmp_path: Path) -> None:
        keys = {**_KEYS, "height_reference": "mean_sea_level", "undulation_m": -20.0}
        toml = write_heights(tmp_path / "dem.toml", plane, self.AXES, **keys)
        dem = ingest_surface([toml], params=IngestSurfaceParams())
        assert dem.attrs["height_reference"] == "ellipsoid"
        exact = plane(dem.latitude.values[:, None], dem.longitude.values[None, :]) - 20.0
        np.testing.assert_allclose(dem.surface_height, exact, rtol=0, atol=1e-4)

    def test_feet_and_its_own_output(self, tmp_path: Path) -> None:
        toml = write_heights(tmp_path / "dem.toml", plane, self.AXES, **_KEYS, units="ft")
        dem = ingest_surface([toml], params=IngestSurfaceParams())
        exact = 0.3048 * plane(dem.latitude.values[:, None], dem.longitude.values[None, :])
        np.testing.assert_allclose(dem.surface_height, exact, rtol=0, atol=1e-4)
        dem.to_netcdf(tmp_path / "again.nc", engine="netcdf4")
        again = ingest_surface([tmp_path / "again.nc"], params=IngestSurfaceParams())
        xr.testing.assert_equal(again, dem)

    def test_unmarked_voids_are_named(self, tmp_path: Path) -> None:
        def height(lat: Floats, lon: Floats) -> Floats:
            return np.where(lat > 46.2, -32767.0, plane(lat, lon))

        toml = write_heights(tmp_path / "dem.toml", height, self.AXES, **_KEYS)
        with pytest.raises(FormatError, match=r"-32767 m.*no_data"):
            ingest_surface([toml], params=IngestSurfaceParams())

    @pytest.mark.parametrize("key", ["surface", "height_reference"])
    def test_what_it_is_must_be_said(self, key: str, tmp_path: Path) -> None:
        keys = {k: v for k, v in _KEYS.items() if k != key}
        toml = write_heights(tmp_path / "dem.toml", plane, self.AXES, **keys)
        with pytest.raises(SourceError, match=rf"key '{key}' is missing.*\[surface\]"):
            ingest_surface([toml], params=IngestSurfaceParams())

    def test_anomaly_keys_are_unknown(self, tmp_path: Path) -> None:
        toml = write_heights(tmp_path / "dem.toml", plane, self.AXES, **_KEYS, uncertainty_nt=1.0)
        with pytest.raises(SourceError, match="unknown key 'uncertainty_nt'"):
            ingest_surface([toml], params=IngestSurfaceParams())
