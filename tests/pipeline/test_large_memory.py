"""Stages before the transform hold a strip of rows, not the map, and make the same of it."""

from __future__ import annotations

import gc
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import netCDF4
import numpy as np
import pyproj
import pytest
import rasterio
import xarray as xr
from rasterio.windows import Window

from magtiles.pipeline.artifacts import open_artifact
from magtiles.pipeline.runner import run_stage
from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError, FormatError
from magtiles.stages import rows
from magtiles.stages.field import core_field, crop, rereference, voids
from magtiles.stages.field.extent import data_bounds
from magtiles.stages.ingest import grid as ingest

COLUMNS, SPACING_M = 200, 250.0
CRS = pyproj.CRS("+proj=tmerc +lat_0=46 +lon_0=-120 +datum=WGS84")
SAID = {
    "height_m": 300.0,
    "height_reference": "ellipsoid",
    "reference_epoch": "2010-01-01",
    "uncertainty_nt": 1.0,
    "line_spacing_m": 500.0,
    "source_distance_m": 1000.0,
}


def strip(first: int, count: int, level: float = 0.0) -> np.ndarray:
    """Rows from the north, with voids and a ragged border, float32."""
    i, j = np.mgrid[first : first + count, :COLUMNS]
    values = level + 50.0 * np.sin(i / 19.0) * np.cos(j / 23.0) + 10.0 * np.cos(i / 5.0 + j / 4.0)
    values[(i % 150 - 70) ** 2 + (j - 110) ** 2 < 12**2] = np.nan
    values[j < 20 + 10 * np.sin(i / 30)] = np.nan
    return values.astype(np.float32)


def write_tiff(path: Path, count: int, level: float = 0.0) -> Path:
    profile = {"driver": "GTiff", "width": COLUMNS, "height": count, "count": 1, "crs": CRS}
    place = rasterio.Affine(SPACING_M, 0, 0, 0, -SPACING_M, 0)
    with rasterio.open(
        path, "w", dtype="float32", nodata=np.nan, transform=place, **profile
    ) as file:
        for first in range(0, count, 100):
            file.write(strip(first, 100, level), 1, window=Window(0, first, COLUMNS, 100))
    return path


def write_netcdf(path: Path, count: int) -> Path:
    """The same as the TIFF, from the south."""
    with netCDF4.Dataset(path, "w") as file:
        for name, size in ("y", count), ("x", COLUMNS):
            file.createDimension(name, size)
            axis = file.createVariable(name, "f8", (name,))
            start = -SPACING_M * count if name == "y" else 0.0
            axis[:] = start + SPACING_M * (np.arange(size) + 0.5)
            axis.setncatts({"units": "m", "standard_name": f"projection_{name}_coordinate"})
        cf = {k: list(v) if isinstance(v, tuple) else v for k, v in CRS.to_cf().items()}
        file.createVariable("crs", "i4", ()).setncatts(cf)
        values = file.createVariable("t", "f4", ("y", "x"), fill_value=np.float32(np.nan))
        values.setncatts({"units": "nT", "grid_mapping": "crs"})
        for first in range(0, count, 100):
            values[count - first - 100 : count - first] = strip(first, 100)[::-1]
    return path


def survey(folder: Path, count: int, level: float = 0.0) -> Path:
    tiff = write_tiff(folder / f"{count}-{level:g}.tif", count, level)
    reference = "none" if level else "IGRF-14"
    said = SAID | {"reference_field": reference}
    return run_stage(ingest.STAGE, {"files": tiff}, tiff.with_suffix(".nc"), said).out


def ingest_tiff(folder: Path, count: int) -> Callable[[Path], object]:
    tiff, said = write_tiff(folder / f"{count}.tif", count), SAID | {"reference_field": "IGRF-14"}
    return lambda out: run_stage(ingest.STAGE, {"files": tiff}, out, said, force=True)


def fill(folder: Path, count: int) -> Callable[[Path], object]:
    grid = survey(folder, count)
    return lambda out: run_stage(voids.STAGE, {"grid": grid}, out, {}, force=True)


def cut(folder: Path, count: int) -> Callable[[Path], object]:
    grid = survey(folder, count)
    limits = {"latitude": [40.0, 45.95], "longitude": [-119.9, -119.5]}
    return lambda out: run_stage(crop.STAGE, {"grid": grid}, out, limits, force=True)


def remove_core(folder: Path, count: int) -> Callable[[Path], object]:
    grid = survey(folder, count, level=52_000.0)
    return lambda out: run_stage(core_field.GRID_STAGE, {"grid": grid}, out, {}, force=True)


def re_reference(folder: Path, count: int) -> Callable[[Path], object]:
    grid, wanted = survey(folder, count), {"reference_field": "IGRF-13"}
    return lambda out: run_stage(rereference.STAGE, {"grid": grid}, out, wanted, force=True)


def bounds(folder: Path, count: int) -> Callable[[Path], object]:
    def look(_: Path) -> object:
        with open_artifact(grid) as opened:
            return data_bounds(opened)

    grid = survey(folder, count)
    return look


ALL = (ingest_tiff, cut, remove_core, re_reference, fill, bounds)


@pytest.fixture
def small_strips(monkeypatch: pytest.MonkeyPatch) -> None:
    """Strips of some 50 rows, so that small maps are large."""
    monkeypatch.setattr(rows, "STRIP_NODES", 50 * COLUMNS)
    monkeypatch.setattr(contracts, "_STRIP_NODES", 50 * COLUMNS)
    monkeypatch.setattr(core_field, "_NODES_AT_ONCE", 50 * COLUMNS)
    monkeypatch.setattr(voids, "_COARSE_NODES", 1 << 12)
    monkeypatch.setattr(voids, "_MARGIN", 64)
    monkeypatch.setattr(voids, "_WORK", 1e5)


def peak(work: Callable[[Path], object], out: Path) -> int:
    """Most bytes that Python and numpy hold while it works."""
    gc.collect()
    tracemalloc.start()
    try:
        work(out)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.usefixtures("small_strips")
@pytest.mark.parametrize("stage", [s for s in ALL if s is not re_reference])
def test_memory_does_not_grow_with_the_map(stage, tmp_path: Path) -> None:
    """A map four times as long takes at most 1.5 times as much, measured; 3.3 when held whole."""
    short, long = (stage(tmp_path, count) for count in (400, 1600))
    short(tmp_path / "first.nc")  # imports, compiles, and reads the models
    less, more = (peak(work, tmp_path / "out.nc") for work in (short, long))
    assert more < 2.2 * less


def made(stage: Callable[..., Callable[[Path], object]], folder: Path) -> xr.Dataset | object:
    found = stage(folder, 400)(folder / "out.nc")
    if stage is bounds:
        return found
    with open_artifact(folder / "out.nc") as opened:
        return opened.load()


@pytest.mark.parametrize("stage", [s for s in ALL if s is not fill])
def test_strips_make_the_same_as_the_whole(stage, tmp_path: Path, request) -> None:
    whole = made(stage, tmp_path)
    request.getfixturevalue("small_strips")
    in_strips = made(stage, tmp_path)
    if isinstance(whole, xr.Dataset):
        xr.testing.assert_identical(in_strips, whole)
    else:
        assert in_strips == whole


@pytest.mark.usefixtures("small_strips")
def test_formats_of_one_survey_agree(tmp_path: Path) -> None:
    said = SAID | {"reference_field": "IGRF-14"}
    values = []
    for file in write_tiff(tmp_path / "a.tif", 400), write_netcdf(tmp_path / "a.nc", 400):
        made = run_stage(ingest.STAGE, {"files": file}, tmp_path / "out.nc", said, force=True)
        with open_artifact(made.out) as opened:
            values.append(opened["magnetic_anomaly"].values)
    np.testing.assert_array_equal(*values)
    np.testing.assert_array_equal(values[0], strip(0, 400)[::-1])


@pytest.mark.usefixtures("small_strips")
def test_the_same_map_gives_the_same_bytes(tmp_path: Path) -> None:
    grid = survey(tmp_path, 400)
    for name in ("one.nc", "two.nc"):
        run_stage(voids.STAGE, {"grid": grid}, tmp_path / name, {})
    assert (tmp_path / "one.nc").read_bytes() == (tmp_path / "two.nc").read_bytes()


@pytest.mark.usefixtures("small_strips")
def test_what_breaks_the_contract_late_is_not_left_behind(tmp_path: Path) -> None:
    """No anomaly is as low as what is left of -99,000 nT without the core field."""
    grid = survey(tmp_path, 400, level=52_000.0)
    with netCDF4.Dataset(grid, "r+") as file:
        file["magnetic_anomaly"][390, 100] = -99_000.0
    before = sorted(path.name for path in tmp_path.iterdir())
    with pytest.raises(ContractError, match=r"out\.nc variables\.magnetic_anomaly\.minimum"):
        run_stage(core_field.GRID_STAGE, {"grid": grid}, tmp_path / "out.nc", {})
    assert sorted(path.name for path in tmp_path.iterdir()) == before


@pytest.mark.usefixtures("small_strips")
def test_an_infinite_value_is_named_by_its_row_of_the_file(tmp_path: Path) -> None:
    tiff = write_tiff(tmp_path / "a.tif", 400)
    with rasterio.open(tiff, "r+") as file:
        file.write(np.full((1, 1), np.inf, np.float32), 1, window=Window(122, 333, 1, 1))
    with pytest.raises(FormatError, match="row 333, column 122 is infinite"):
        ingest.ingest_grid([tiff], params=ingest.IngestGridParams(**SAID))
