"""A survey of the whole globe, from its file to a validated release without a seam."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from globes import EPOCH, emag2, random_crust, world

from magtiles.catalog import QualityFlag, open_release
from magtiles.catalog.kernels.geodesy import metres_per_degree
from magtiles.catalog.models import evaluate, load_igrf
from magtiles.catalog.releases.anomaly import Anomaly
from magtiles.pipeline.build import build_product
from magtiles.pipeline.validate import validate_release
from magtiles.schemas.errors import ParameterError

_SOURCE = """
[source]
id = "world"
kind = "anomaly-grid"
files = ["world.csv"]
licence = "CC0-1.0"
[grid]
crs = "EPSG:4326"
height_m = 4000
height_reference = "{reference}"
reference_field = "IGRF-13"
reference_epoch = "2000-01-01"
uncertainty_nt = {sigma}
{more}
"""
_PRODUCT = """
[product]
name = "world"
version = "1.0.0"
[anomaly]
source = "source.toml"
height_reference = "{reference}"
region = {{latitude = [-{north}, {north}], longitude = [-180, 180]}}
tile_deg = 90
{anomaly}
"""
_CRUST = random_crust(30, seed=21)


def build(folder: Path, globe: xr.Dataset, north: float, anomaly: str, more: str = "") -> Path:
    """A release of a grid around the globe, written as text."""
    longitude, latitude = np.meshgrid(globe.longitude, globe.latitude)
    values = globe.magnetic_anomaly.values
    known = np.isfinite(values)
    rows = np.stack([longitude[known], latitude[known], values[known]], axis=-1)
    np.savetxt(folder / "world.csv", rows, fmt="%.10g", delimiter=",")
    stated = {
        "reference": globe.attrs["height_reference"],
        "sigma": float(globe.magnetic_anomaly_uncertainty),
    }
    (folder / "source.toml").write_text(_SOURCE.format(more=more, **stated))
    (folder / "product.toml").write_text(_PRODUCT.format(north=north, anomaly=anomaly, **stated))
    return build_product(folder / "product.toml", store=folder / "store", work=folder / "work").path


@pytest.fixture(scope="module")
def release(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nodes six degrees apart, with a void over the date line."""
    globe = world(_CRUST, 6.0, 0.5)
    globe["magnetic_anomaly"][18:21, [0, 1, 58, 59]] = np.nan
    return build(tmp_path_factory.mktemp("world"), globe, 60.0, "heights_m = [14000]")


def test_it_is_valid(release: Path) -> None:
    assert [check for check in validate_release(release) if not check.passed] == []


def date_line_is_seamless(anomaly: Anomaly, north: float, height: float) -> None:
    lat = np.linspace(-north, north, 60)
    for ask in (anomaly.total, anomaly.vector, anomaly.tensor, anomaly.flags):
        np.testing.assert_array_equal(ask(lat, 180.0, height), ask(lat, -180.0, height))
    west, east = (anomaly.total(lat, x, height) for x in (179.999, -179.999))
    assert np.isfinite(west).all()
    _, gradient = anomaly.total_with_gradient(lat, 180.0, height)
    metres = 0.002 * metres_per_degree(lat, np.full(lat.shape, height))[1]
    # What the two sides, 220 m apart at most, differ by is the gradient between them.
    np.testing.assert_allclose(east - west, gradient[:, 1] * metres / 1e3, rtol=0, atol=5e-6)


def test_the_date_line_is_seamless(release: Path) -> None:
    date_line_is_seamless(open_release(release).anomaly, 59.0, 9000.0)


def test_it_answers_with_the_crust(release: Path) -> None:
    """Anywhere, between levels and nodes; the dip equator, where the vector is vague, included."""
    anomaly = open_release(release).anomaly
    random = np.random.default_rng(22)
    lat = np.degrees(np.arcsin(random.uniform(-0.86, 0.86, 2000)))
    lon, height = random.uniform(-180.0, 180.0, 2000), 11_000.0
    void = anomaly.flags(lat, lon, height) & QualityFlag.VOID_FILLED > 0
    assert 5 < np.count_nonzero(void) < 80
    field = evaluate(_CRUST, lat, lon, height, 0.0)
    core = evaluate(load_igrf(13), lat, lon, height, EPOCH)
    total = np.sum(field * core, axis=-1) / np.linalg.norm(core, axis=-1)
    error = anomaly.total(lat, lon, height) - total
    clear = ~void
    assert error[clear].std() < 0.08 * total.std()  # measured 4 %
    off = np.abs(anomaly.vector(lat, lon, height) - field)
    sigma = anomaly.uncertainty(lat, lon, height, quantity="vector")
    assert np.mean(off < 2.0 * sigma[:, None]) > 0.9


def test_expected_fields_answer(release: Path) -> None:
    anomaly = open_release(release).anomaly
    vector = anomaly.expected_vector([10.0, -40.0], [180.0, 20.0], 14_000.0, "2000-01-01")
    assert np.isfinite(vector).all()


def test_nodes_too_far_apart_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=r"anomaly.spacing_m: .*cannot hold degree 30"):
        build(tmp_path, world(_CRUST, 6.0, 0.5), 60.0, "heights_m = [9000]\nspacing_m = 1e6")


def test_emag2_around_the_globe(real_data: Path, tmp_path: Path) -> None:
    """Every fourth of its nodes, smeared poles and all: mostly aliased, and sigma says so."""
    globe = emag2(real_data).isel(latitude=slice(2, None, 4), longitude=slice(0, None, 4))
    release = build(tmp_path, globe, 70.0, "heights_m = [100000]", more="undulation_m = 0.0")
    assert [check for check in validate_release(release) if not check.passed] == []
    anomaly = open_release(release).anomaly
    date_line_is_seamless(anomaly, 69.0, 60_000.0)
    inner = globe.sel(latitude=slice(-69.0, 69.0))
    lat, lon = np.meshgrid(inner.latitude, inner.longitude, indexing="ij")
    known = np.isfinite(inner.magnetic_anomaly.values)
    off = (anomaly.total(lat, lon, 4000.0) - inner.magnetic_anomaly.values)[known]
    sigma = anomaly.uncertainty(lat, lon, 4000.0)[known]
    share = np.mean(np.abs(off) < sigma)
    assert 0.6 < share < 0.9, share
    assert sigma.mean() > 50.0
