"""Every bad grid ends in one error that names the file, the place and the remedy."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pyproj
import pytest
import rasterio
import xarray as xr
from rasterio.errors import NotGeoreferencedWarning

from magtiles.schemas.errors import FormatError, IntegrityError, MagtilesError, SourceError
from magtiles.stages.ingest.grid import ingest_grid
from magtiles.stages.ingest.source import IngestGridParams

_SAID: dict[str, Any] = {
    "height_m": 1500.0,
    "height_reference": "ellipsoid",
    "reference_field": "IGRF-14",
    "reference_epoch": "1990-01-01",
    "uncertainty_nt": 2.0,
}
_SHAPE = (30, 40)


def _values() -> np.ndarray:
    return np.random.default_rng(0).normal(0.0, 50.0, _SHAPE)


def _tiff(path: Path, values: np.ndarray | None = None, **profile: Any) -> Path:
    values = _values() if values is None else values
    settings = {
        "driver": "GTiff",
        "height": _SHAPE[0],
        "width": _SHAPE[1],
        "count": 1,
        "dtype": "float64",
        "crs": "EPSG:32610",
        "transform": rasterio.Affine(1000.0, 0.0, 5e5, 0.0, -1000.0, 5e6),
    }
    with rasterio.open(path, "w", **(settings | profile)) as dataset:
        for band in range(1, dataset.count + 1):
            dataset.write(values, band)
    return path


def _unplaced_tiff(folder: Path) -> Path:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        return _tiff(folder / "a.tif", transform=None)


def _gxf(path: Path, **changes: str) -> Path:
    keywords = {
        "POINTS": str(_SHAPE[1]),
        "ROWS": str(_SHAPE[0]),
        "PTSEPARATION": "1000",
        "RWSEPARATION": "1000",
        "DUMMY": "1e30",
    }
    header = "".join(f"#{k}\n{v}\n" for k, v in (keywords | changes).items())
    rows = "\n".join(" ".join(f"{v:.2f}" for v in row) for row in _values())
    path.write_text(f"{header}#GRID\n{rows}\n")
    return path


def _cf(path: Path, change: Callable[[xr.Dataset], xr.Dataset] = lambda d: d, **keys: Any) -> Path:
    dataset = xr.Dataset(
        {
            "tmi": (("y", "x"), _values(), {"units": "nT", "grid_mapping": "utm"}),
            "utm": ((), np.int32(0), pyproj.CRS.from_epsg(32610).to_cf()),
        },
        coords={
            "y": ("y", 5e6 + 1000.0 * np.arange(_SHAPE[0]), {"units": "m"}),
            "x": ("x", 5e5 + 1000.0 * np.arange(_SHAPE[1]), {"units": "m"}),
        },
    )
    change(dataset).to_netcdf(path, engine="netcdf4", **keys)
    return path


def _cut(path: Path, keep: float) -> Path:
    content = path.read_bytes()
    path.write_bytes(content[: int(keep * len(content))])
    return path


def _bytes(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def _folder(path: Path) -> Path:
    path.mkdir()
    return path


def _spoilt(row: int, column: int, value: float) -> np.ndarray:
    values = _values()
    values[row, column] = value
    return values


def _uneven(dataset: xr.Dataset) -> xr.Dataset:
    x = dataset.x.values.copy()
    x[7:] += 300.0
    return dataset.assign_coords(x=("x", x, dataset.x.attrs))


def _two_magnetic(dataset: xr.Dataset) -> xr.Dataset:
    return dataset.assign(rtp=dataset.tmi)


def _curvilinear(dataset: xr.Dataset) -> xr.Dataset:
    return dataset.drop_vars(["x", "y"])


def _other_unit(dataset: xr.Dataset) -> xr.Dataset:
    return dataset.assign(tmi=dataset.tmi.assign_attrs(units="mGal"))


def _unplaced(dataset: xr.Dataset) -> xr.Dataset:
    return dataset.drop_vars("utm").assign(tmi=(("y", "x"), dataset.tmi.values, {"units": "nT"}))


@dataclass
class Expect:
    """A file to make, keys to give, and the error that must come of them."""

    id: str
    make: Callable[[Path], Path]
    error: type[MagtilesError]
    message: str
    keys: dict[str, Any] | None = None


_FILES = [
    Expect("missing", lambda f: f / "a.tif", FormatError, "does not exist"),
    Expect("folder", lambda f: _folder(f / "a.tif"), FormatError, "is a folder"),
    Expect("empty", lambda f: _bytes(f / "a.tif", b""), FormatError, "a.tif: the file is empty"),
    Expect(
        "html", lambda f: _bytes(f / "a.tif", b"<!DOCTYPE html><p>404"), FormatError, "an HTML page"
    ),
    Expect("zip", lambda f: _bytes(f / "a.tif", b"PK\x03\x04rest"), FormatError, "whole zip file"),
    Expect("text", lambda f: _bytes(f / "a.tif", b"one 2 3\n"), FormatError, "text of an unknown"),
    Expect("noise", lambda f: _bytes(f / "a.gxf", bytes(99)), FormatError, "binary data"),
    Expect(
        "tiff-header-only",
        lambda f: _cut(_tiff(f / "a.tif"), 0.01),
        FormatError,
        "a.tif: a TIFF directory points past the end",
    ),
    Expect(
        "tiff-half",
        lambda f: _cut(_tiff(f / "a.tif"), 0.5),
        FormatError,
        "a.tif: is not a whole GeoTIFF",
    ),
    Expect(
        "tiff-deflate-half",
        lambda f: _cut(_tiff(f / "a.tif", compress="deflate"), 0.5),
        FormatError,
        "a.tif: is not a whole GeoTIFF",
    ),
    Expect(
        "gxf-half",
        lambda f: _cut(_gxf(f / "a.gxf"), 0.5),
        FormatError,
        r"values after #GRID; expected #POINTS x #ROWS = 40 x 30 = 1200; the file is truncated",
    ),
    Expect(
        "gxf-header-only",
        lambda f: _cut(_gxf(f / "a.gxf"), 0.005),
        FormatError,
        "keyword #GRID is missing",
    ),
    Expect(
        "gxf-word",
        lambda f: _bytes(
            f / "a.gxf", _gxf(f / "b.gxf").read_bytes().replace(b"#GRID\n", b"#GRID\nx", 1)
        ),
        FormatError,
        "row 0, point 0: value 0 after #GRID is 'x",
    ),
    Expect("gxf-rows", lambda f: _gxf(f / "a.gxf", ROWS="many"), FormatError, "#ROWS is followed"),
    Expect(
        "netcdf4-half",
        lambda f: _cut(_cf(f / "a.nc"), 0.5),
        FormatError,
        "a.nc: is not a whole netCDF file",
    ),
    Expect(
        "netcdf3-half",
        lambda f: _cut(_cf(f / "a.nc", format="NETCDF3_64BIT"), 0.5),
        FormatError,
        "a.nc: is not a whole netCDF file",
    ),
    Expect(
        "netcdf-magic-only",
        lambda f: _bytes(f / "a.nc", b"\x89HDF\r\n\x1a\n" + bytes(100)),
        FormatError,
        "a.nc: is not a whole netCDF file",
    ),
]

_GRIDS = [
    Expect(
        "tiff-no-crs",
        lambda f: _tiff(f / "a.tif", crs=None),
        SourceError,
        r"key 'crs' is missing and the file a.tif does not say; add crs",
    ),
    Expect("gxf-no-crs", lambda f: _gxf(f / "a.gxf"), SourceError, "key 'crs' is missing"),
    Expect("cf-no-crs", lambda f: _cf(f / "a.nc", _unplaced), SourceError, "key 'crs' is missing"),
    Expect(
        "no-position",
        _unplaced_tiff,
        FormatError,
        "no position",
        {"crs": "EPSG:32610"},
    ),
    Expect(
        "rotated",
        lambda f: _tiff(f / "a.tif", transform=rasterio.Affine(900, 400, 5e5, 400, -900, 5e6)),
        FormatError,
        "rotated or sheared",
    ),
    Expect(
        "gxf-rotated", lambda f: _gxf(f / "a.gxf", ROTATION="30"), FormatError, "#ROTATION is 30"
    ),
    Expect("gxf-sense", lambda f: _gxf(f / "a.gxf", SENSE="-2"), FormatError, "#SENSE is -2"),
    Expect("gxf-packed", lambda f: _gxf(f / "a.gxf", GTYPE="3"), FormatError, "#GTYPE is 3"),
    Expect(
        "irregular",
        lambda f: _cf(f / "a.nc", _uneven),
        FormatError,
        r"axis x: the axis is irregular: from index 6 to 7 the step is 1300, \+300 from the usual",
    ),
    Expect(
        "curvilinear", lambda f: _cf(f / "a.nc", _curvilinear), FormatError, "has no coordinate"
    ),
    Expect(
        "all-void",
        lambda f: _tiff(f / "a.tif", np.full(_SHAPE, -1.0), nodata=-1.0),
        FormatError,
        "a.tif: every value is void",
    ),
    Expect(
        "infinite",
        lambda f: _tiff(f / "a.tif", _spoilt(3, 5, np.inf)),
        FormatError,
        "row 3, column 5 is infinite",
    ),
    Expect(
        "unmarked-void",
        lambda f: _tiff(f / "a.tif", _spoilt(0, 5, -999999.0)),
        FormatError,
        r"row 29, column 5 \(from the south-west\) is -999999 nT.*key 'no_data'",
    ),
    Expect(
        "latitude-91",
        lambda f: _tiff(
            f / "a.tif", crs="EPSG:4326", transform=rasterio.Affine(1, 0, 0, 0, -1, 100)
        ),
        FormatError,
        "latitude 99.5",
    ),
    Expect("bands", lambda f: _tiff(f / "a.tif", count=2), SourceError, "2 bands.*'band'"),
    Expect("band-9", lambda f: _tiff(f / "a.tif"), SourceError, "'band' is 9", {"band": 9}),
    Expect(
        "variables",
        lambda f: _cf(f / "a.nc", _two_magnetic),
        SourceError,
        "2 variables.*'variable'",
    ),
    Expect(
        "no-variable",
        lambda f: _cf(f / "a.nc", _other_unit),
        SourceError,
        "0 variables.*grids: tmi",
    ),
    Expect(
        "variable-name",
        lambda f: _cf(f / "a.nc"),
        SourceError,
        "no two-dimensional variable 'mag'; expected one of tmi",
        {"variable": "mag"},
    ),
    Expect(
        "ballpark",
        lambda f: _tiff(f / "a.tif", crs="+proj=utm +zone=10 +ellps=clrk66"),
        SourceError,
        "relates to WGS84 is not known.*allow_ballpark_datum",
    ),
    Expect(
        "westward",
        lambda f: _gxf(f / "a.gxf"),
        SourceError,
        "toward",
        {"crs": "EPSG:2053"},
    ),
]

_CONTRADICTIONS = [
    Expect(
        "crs",
        lambda f: _tiff(f / "a.tif"),
        SourceError,
        "'crs' is 'EPSG:32611', but the file a.tif says 'EPSG:32610'",
        {"crs": "EPSG:32611"},
    ),
    Expect(
        "datum",
        lambda f: _tiff(f / "a.tif"),
        SourceError,
        "'crs' is 'EPSG:26910', but",
        {"crs": "EPSG:26910"},
    ),
    Expect(
        "no_data",
        lambda f: _tiff(f / "a.tif", nodata=-9999.0),
        SourceError,
        "'no_data' is -99999.0, but the file a.tif says -9999.0",
        {"no_data": -99999.0},
    ),
    Expect(
        "units",
        lambda f: _cf(f / "a.nc"),
        SourceError,
        "'units' is 'uT', but the file a.nc says 'nT'",
        {"units": "uT"},
    ),
    Expect(
        "registration",
        lambda f: _tiff(f / "a.tif"),
        SourceError,
        "'registration' is 'point', but the file a.tif says 'pixel'",
        {"registration": "point"},
    ),
    Expect(
        "epoch",
        lambda f: _cf(f / "a.nc", lambda d: d.assign_attrs(reference_epoch="1980-01-01")),
        SourceError,
        "'reference_epoch' is '1990-01-01', but the file a.nc says '1980-01-01'",
    ),
    Expect(
        "uncertainty",
        lambda f: _cf(f / "a.nc", lambda d: d.assign(tmi_uncertainty=abs(d.tmi))),
        SourceError,
        "'uncertainty_nt' is 2.0, but the file a.nc has its own",
    ),
    Expect(
        "undulation",
        lambda f: _tiff(f / "a.tif"),
        SourceError,
        "'undulation_m' with height_reference = 'ellipsoid'",
        {"undulation_m": -20.0},
    ),
    Expect(
        "units-unknown",
        lambda f: _tiff(f / "a.tif"),
        SourceError,
        "unit 'G' is not.*'units'",
        {"units": "G"},
    ),
]


@pytest.mark.parametrize("expect", _FILES + _GRIDS + _CONTRADICTIONS, ids=lambda expect: expect.id)
def test_bad_grid(expect: Expect, tmp_path: Path):
    path = expect.make(tmp_path)
    params = IngestGridParams(**(_SAID | (expect.keys or {})))
    with pytest.raises(expect.error) as caught:
        ingest_grid([path], params=params)
    assert type(caught.value) is expect.error
    assert re.search(expect.message, str(caught.value)), str(caught.value)


@pytest.mark.parametrize("key", sorted(_SAID))
def test_missing_key_is_named(key: str, tmp_path: Path):
    params = IngestGridParams(**{k: v for k, v in _SAID.items() if k != key})
    with pytest.raises(SourceError, match=f"key '{key}' is missing and the file a.tif"):
        ingest_grid([_tiff(tmp_path / "a.tif")], params=params)


def test_declared_size_beyond_the_file_is_not_allocated(tmp_path: Path):
    """A netCDF-4 file of a few kB may declare terabytes; they are refused before reading."""
    path = tmp_path / "a.nc"
    with netCDF4.Dataset(path, "w") as dataset:
        dataset.createDimension("y", 4_000_000)
        dataset.createDimension("x", 2_000_000)
        dataset.createVariable("tmi", "f8", ("y", "x"), chunksizes=(1000, 1000)).units = "nT"
    with pytest.raises(FormatError, match="declares 64000000000000 bytes"):
        ingest_grid([path], params=IngestGridParams(**_SAID))


def test_every_truncation_of_a_tiff_is_noticed(tmp_path: Path):
    """A file cut anywhere, even among the tags at its end, is refused or reads the same."""
    path = _tiff(tmp_path / "a.tif", _spoilt(2, 2, -1e9), nodata=-1e9, compress="deflate")
    whole = path.read_bytes()
    params = IngestGridParams(**_SAID)
    expected = ingest_grid([path], params=params)
    refused = 0
    for size in [*range(8, len(whole), 331), len(whole) - 1]:
        path.write_bytes(whole[:size])
        try:
            xr.testing.assert_equal(ingest_grid([path], params=params), expected)
        except FormatError:
            refused += 1
    assert refused > 20


_TOML = """
[source]
id = "here"
kind = "anomaly-grid"
files = ["a.tif"]
licence = "CC0-1.0"
[grid]
height_m = 1500
height_reference = "ellipsoid"
reference_field = "IGRF-14"
reference_epoch = 1990-01-01
uncertainty_nt = 2
"""


class TestSource:
    def _ingest(self, folder: Path, text: str, **keys: Any) -> xr.Dataset:
        path = folder / "here.toml"
        path.write_text(text)
        _tiff(folder / "a.tif")
        return ingest_grid([path], params=IngestGridParams(**keys))

    def test_says_what_the_file_does_not(self, tmp_path):
        grid = self._ingest(tmp_path, _TOML)
        assert grid.attrs["source"] == "here"
        assert grid.attrs["reference_epoch"] == "1990-01-01"
        assert float(grid.height) == 1500.0

    def test_a_copy_elsewhere_stands_in_for_its_file(self, tmp_path):
        toml = tmp_path / "here.toml"
        toml.write_text(_TOML)
        (tmp_path / "copies").mkdir()
        copy = _tiff(tmp_path / "copies" / "a.tif")
        grid = ingest_grid([toml, copy], params=IngestGridParams())
        assert grid.attrs["source"] == "here"

    def test_a_parameter_may_repeat_a_key_but_not_change_it(self, tmp_path):
        self._ingest(tmp_path, _TOML, height_m=1500.0)
        with pytest.raises(SourceError, match=r"\[grid\]: key 'height_m' is 1500.0, but .* 99.0"):
            self._ingest(tmp_path, _TOML, height_m=99.0)

    def test_a_parameter_may_add_a_key(self, tmp_path):
        grid = self._ingest(tmp_path, _TOML, line_spacing_m=500.0)
        assert grid.attrs["line_spacing_m"] == 500.0

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (("uncertainty_nt", "uncertainity_nt"), r"here.toml \[grid\]: unknown key 'uncert"),
            (("licence", "license"), r"here.toml \[source\]: unknown key 'license'"),
            (('licence = "CC0-1.0"\n', ""), r"\[source\]: key 'licence' is missing"),
            (("height_m = 1500", 'height_m = "high"'), r"\[grid\]: key 'height_m' is 'high'"),
            (("height_m = 1500", "height_m = nan"), r"\[grid\]: key 'height_m' is nan"),
            (("height_m = 1500\n", ""), r"here.toml \[grid\]: key 'height_m' is missing"),
            (("1990-01-01", '"1990-13-01"'), r"key 'reference_epoch' is '1990-13-01'.*ISO date"),
            (('"ellipsoid"', '"geoid"'), r"key 'height_reference' is 'geoid'.*'terrain'"),
            (("uncertainty_nt = 2", "uncertainty_nt = 0"), "greater than 0"),
            (("anomaly-grid", "track"), r"key 'kind' is 'track'"),
            (('"a.tif"', '"a.tif", "b.tif"'), "2 data files: a.tif, b.tif"),
            (('"a.tif"', ""), "key 'files' is"),
            (("[grid]", "[gird]"), r"unknown table \[gird\]"),
            (("[source]", ""), "stands outside any table"),
            (("[grid]", "[grid"), r"here.toml: is not TOML: .*line 7"),
            (("uncertainty_nt = 2", "wavelength_band_km = [9, 1]"), "the shorter first"),
        ],
    )
    def test_bad_toml(self, tmp_path, change, message):
        with pytest.raises(SourceError, match=message):
            self._ingest(tmp_path, _TOML.replace(*change))

    def test_missing_toml(self, tmp_path):
        with pytest.raises(SourceError, match=r"gone.toml: cannot be read"):
            ingest_grid([tmp_path / "gone.toml"], params=IngestGridParams())

    def test_stray_file(self, tmp_path):
        toml = tmp_path / "here.toml"
        toml.write_text(_TOML)
        with pytest.raises(SourceError, match=r"does not name the data file 'b.tif'"):
            ingest_grid([toml, tmp_path / "b.tif"], params=IngestGridParams())

    def test_changed_file(self, tmp_path):
        digest = f'licence = "CC0-1.0"\nsha256 = {{"a.tif" = "{"0" * 64}"}}'
        with pytest.raises(IntegrityError, match=r"a.tif: sha256 is .*as here.toml states"):
            self._ingest(tmp_path, _TOML.replace('licence = "CC0-1.0"', digest))
