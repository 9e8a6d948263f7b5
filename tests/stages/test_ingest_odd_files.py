"""Grid files as people have them: other types, units, marks, orders, and headers that lie."""

from __future__ import annotations

import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pytest
import xarray as xr
from grid_files import SMALL, gdal, text

from magtiles.schemas.errors import FormatError, MagtilesError, SourceError
from magtiles.stages.ingest.grid import ingest_grid
from magtiles.stages.ingest.source import IngestGridParams

_SAID: dict[str, Any] = {
    "height_m": 1500.0,
    "height_reference": "ellipsoid",
    "reference_field": "IGRF-14",
    "reference_epoch": "1990-01-01",
    "uncertainty_nt": 2.0,
}
_UTM = {"crs": "EPSG:32610"}
_GEO = {"crs": "EPSG:4326"}

Write = Callable[[Path], list[Path]]


def read(files: list[Path], **keys: Any) -> xr.Dataset:
    said = {k: v for k, v in (_SAID | keys).items() if v is not None}
    return ingest_grid(files, params=IngestGridParams(**said))


def ers(cell: str, dtype: str, order: str, rotation: str = "0:0:0.0") -> Write:
    """ER Mapper by its published description: a header, and rows from the north."""

    def write(folder: Path) -> list[Path]:
        header = f"""DatasetHeader Begin
    Version = "6.0"
    DataSetType = ERStorage
    DataType = Raster
    ByteOrder = {order}
    CoordinateSpace Begin
        Datum = "WGS84"
        Projection = "NUTM10"
        CoordinateType = EN
        Rotation = {rotation}
    CoordinateSpace End
    RasterInfo Begin
        CellType = {cell}
        NullCellValue = -9999
        CellInfo Begin
            Xdimension = 1000
            Ydimension = 1000
        CellInfo End
        NrOfLines = 3
        NrOfCellsPerLine = 4
        RegistrationCoord Begin
            Eastings = {SMALL.x[0] - 500}
            Northings = {SMALL.y[-1] + 500}
        RegistrationCoord End
        NrOfBands = 1
    RasterInfo End
DatasetHeader End
"""
        path = folder / "grid.ers"
        path.write_text(header)
        stored = np.where(np.isnan(SMALL.values), -9999, np.rint(SMALL.values))[::-1]
        stored.astype(dtype).tofile(folder / "grid")
        return [path, folder / "grid"]

    return write


@pytest.mark.parametrize(
    ("cell", "dtype"),
    [
        ("Signed16BitInteger", "i2"),
        ("Signed32BitInteger", "i4"),
        ("IEEE4ByteReal", "f4"),
        ("IEEE8ByteReal", "f8"),
    ],
)
@pytest.mark.parametrize(("order", "byte"), [("MSBFirst", ">"), ("LSBFirst", "<")])
def test_er_mapper_in_every_type_and_order(
    cell: str, dtype: str, order: str, byte: str, tmp_path: Path
) -> None:
    grid = read(ers(cell, byte + dtype, order)(tmp_path))
    np.testing.assert_array_equal(grid.magnetic_anomaly, np.rint(SMALL.values))
    np.testing.assert_array_equal(grid.x, SMALL.x)


def turned_surfer(folder: Path) -> list[Path]:
    (path,) = gdal("GS7BG", 1.70141e38)(folder)
    data = bytearray(path.read_bytes())
    struct.pack_into("<d", data, data.index(b"GRID") + 8 + 56, 15.0)
    path.write_bytes(bytes(data))
    return [path]


def gxf(*lines: str) -> Write:
    def write(folder: Path) -> list[Path]:
        rows = "\n".join(" ".join(f"{v:g}" for v in row) for row in np.nan_to_num(SMALL.values))
        head = "#POINTS\n4\n#ROWS\n3\n#PTSEPARATION\n1000\n#RWSEPARATION\n1000\n"
        head += f"#XORIGIN\n{SMALL.x[0]}\n#YORIGIN\n{SMALL.y[0]}\n"
        (folder / "grid.gxf").write_text(head + "".join(f"{x}\n" for x in lines) + "#GRID\n" + rows)
        return [folder / "grid.gxf"]

    return write


def written(content: bytes, name: str = "grid.txt") -> Write:
    def write(folder: Path) -> list[Path]:
        (folder / name).write_bytes(content)
        return [folder / name]

    return write


def two_of_a_name(folder: Path) -> list[Path]:
    """As archives with a folder for each grid have them."""
    (plain,) = text(" ")(folder)
    with zipfile.ZipFile(folder / "two.zip", "w") as archive:
        archive.writestr("dem/grid.xyz", plain.read_text().replace("-5.25", "777"))
        archive.write(plain, "mag/grid.xyz")
        archive.writestr("other/grid.xyz", "not for us")
    return [folder / "two.zip"]


@dataclass(frozen=True)
class Refuse:
    write: Write
    error: type[MagtilesError]
    message: str
    id: str
    keys: tuple[tuple[str, Any], ...] = ()


REFUSED = [
    Refuse(
        ers("IEEE4ByteReal", "<f4", "LSBFirst", "30:0:0.0"),
        FormatError,
        "rotated by 30:0:0.0 degrees",
        "er-mapper-rotated",
    ),
    Refuse(turned_surfer, FormatError, "rotated by 15 degrees", "surfer-7-rotated"),
    Refuse(
        gxf("#UNIT_LENGTH", "ftUS,0.3048006096"),
        SourceError,
        r"counts in metre \(1 m\), but #UNIT_LENGTH is ftUS, 0.3048",
        "gxf-feet",
    ),
    Refuse(
        written(b"0 0 1\n1 0 2\n0 1 three\n1 1 4\n"),
        FormatError,
        "line 3, '0 1 three', is no row of x, y and value",
        "text-word",
    ),
    Refuse(written("0 0 1\n1 0 2\n".encode("utf-16")), FormatError, "text in UTF-16", "utf-16"),
    Refuse(written(b"CDF\x05" + bytes(60)), FormatError, "CDF-5, which nccopy -k nc4", "cdf-5"),
    Refuse(two_of_a_name, SourceError, "3 files: dem/grid.xyz, mag/grid.xyz", "zip-names"),
    Refuse(
        two_of_a_name,
        SourceError,
        "'grid.xyz', 3 times there; expected one of dem/grid.xyz",
        "zip-member-ambiguous",
        (("member", "grid.xyz"),),
    ),
]


@pytest.mark.parametrize("refuse", REFUSED, ids=lambda refuse: refuse.id)
def test_what_cannot_be_told_is_refused(refuse: Refuse, tmp_path: Path) -> None:
    with pytest.raises(refuse.error, match=refuse.message):
        read(refuse.write(tmp_path), **_UTM, **dict(refuse.keys))


def test_a_member_is_chosen_by_its_whole_path(tmp_path: Path) -> None:
    grid = read(two_of_a_name(tmp_path), member="mag/grid.xyz", **_UTM)
    np.testing.assert_array_equal(grid.magnetic_anomaly, SMALL.values)


def test_messages_of_gdal_are_one_line_and_name_the_file(tmp_path: Path) -> None:
    (path,) = gdal("AAIGrid", -9999.0)(tmp_path)
    path.write_bytes(path.read_bytes()[:-25])
    with pytest.raises(FormatError, match=r"ESRI ASCII grid: grid\.asc, band 1") as caught:
        read([path], **_UTM)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("head", ["\ufeff", "\ufeffx y tmi\n", "/ exported\n", "> segment\n"])
def test_no_node_is_lost_to_what_comes_before_the_first(head: str, tmp_path: Path) -> None:
    """A byte order mark made the first row of numbers look like a row of names."""
    (path,) = text(" ", head)(tmp_path)
    np.testing.assert_array_equal(read([path], **_UTM).magnetic_anomaly, SMALL.values)


def test_a_star_is_geosofts_dummy(tmp_path: Path) -> None:
    (path,) = text(" ", tail="502500.00 5001500.00 *\n")(tmp_path)
    np.testing.assert_array_equal(read([path], **_UTM).magnetic_anomaly, SMALL.values)


@pytest.mark.parametrize("name", ["NAD83", "WGS 84"])
def test_a_gxf_names_its_datum(name: str, tmp_path: Path) -> None:
    """Eccentricities are written with few digits; the name then says which datum it is."""
    eccentricity = {"NAD83": "0.081819191", "WGS 84": "0.0818191908"}[name]
    lines = f'"{name} / UTM zone 10N"', f'"{name}",6378137,{eccentricity},0'
    projection = '"Transverse Mercator",0,-123,0.9996,500000,0'
    grid = read(gxf("#MAP_PROJECTION", *lines, projection)(tmp_path))
    assert "ballpark" not in grid.attrs["datum_operation"].lower()
    np.testing.assert_array_equal(grid.x, SMALL.x)


_EAST = 175.0 + np.arange(11)  # to 185, which is -175


def test_text_across_the_date_line_is_one_piece(tmp_path: Path) -> None:
    rows = [(x if x < 180 else x - 360, y, x + y) for y in (0.0, 1.0, 2.0) for x in _EAST]
    (path,) = written("\n".join("{} {} {}".format(*r) for r in rows).encode())(tmp_path)
    grid = read([path], **_GEO)
    np.testing.assert_array_equal(grid.longitude, _EAST)
    np.testing.assert_array_equal(grid.magnetic_anomaly, np.add.outer([0, 1, 2], _EAST))


def cf(path: Path, values: Any, dtype: str = "f4", **attributes: Any) -> Path:
    """A netCDF of raw values: nothing is scaled or masked in writing."""
    rows, columns = np.shape(values)
    with netCDF4.Dataset(path, "w") as file:
        for name, size, unit in (("lat", rows, "north"), ("lon", columns, "east")):
            file.createDimension(name, size)
            file.createVariable(name, "f8", (name,))[:] = 40 + np.arange(size)
            file[name].units = f"degrees_{unit}"
        fill = attributes.pop("_FillValue", None)
        variable = file.createVariable("tmi", dtype, ("lat", "lon"), fill_value=fill)
        variable.set_auto_maskandscale(False)
        variable.setncatts(attributes)
        variable[:] = values
    return path


def test_longitudes_that_jump_at_the_date_line(tmp_path: Path) -> None:
    path = cf(tmp_path / "a.nc", np.ones((3, _EAST.size)), units="nT")
    with netCDF4.Dataset(path, "a") as file:
        file["lon"][:] = np.where(_EAST < 180, _EAST, _EAST - 360)
    np.testing.assert_array_equal(read([path], **_GEO).longitude, _EAST)


_WHOLE = np.arange(12).reshape(3, 4)


@dataclass(frozen=True)
class Marked:
    """Attributes beside stored values of which [1, 2] is `stored` and void."""

    id: str
    dtype: str
    stored: float
    attributes: dict[str, Any]


MARKED = [
    Marked("fill", "i2", -32768, {"_FillValue": -32768, "units": "nT"}),
    Marked("default-fill", "i2", -32767, {"units": "nT"}),
    Marked("missing-value", "i4", -9999, {"missing_value": np.int32(-9999), "units": "nT"}),
    Marked("two-marks", "f4", 1e20, {"_FillValue": np.float32(-1), "missing_value": 1e20}),
    Marked("too-large-for-it", "i2", -1, {"_FillValue": -1, "missing_value": 1e20}),
    Marked("as-text", "f4", 99999, {"missing_value": "99999"}),
    Marked("valid-range-text", "f4", 500, {"valid_range": "-100, 100"}),
    Marked("valid-max", "f4", 500, {"valid_max": np.float32(100)}),
]


@pytest.mark.parametrize("marked", MARKED, ids=lambda marked: marked.id)
def test_what_a_netcdf_marks_missing(marked: Marked, tmp_path: Path) -> None:
    """Without a unit, the one grid of the file is in nT."""
    values = _WHOLE.astype(marked.dtype)
    values[1, 2] = marked.stored
    grid = read([cf(tmp_path / "a.nc", values, marked.dtype, **marked.attributes)], **_GEO)
    expected = _WHOLE.astype(float)
    expected[1, 2] = np.nan
    np.testing.assert_array_equal(grid.magnetic_anomaly, expected)


def test_text_that_is_no_number_is_named(tmp_path: Path) -> None:
    path = cf(tmp_path / "a.nc", _WHOLE, "f4", scale_factor="a tenth")
    with pytest.raises(FormatError, match=r"'tmi': attribute 'scale_factor' is 'a tenth'"):
        read([path], **_GEO)


def test_columns_count_from_one(tmp_path: Path) -> None:
    toml = tmp_path / "a.toml"
    toml.write_text(
        '[source]\nid = "a"\nkind = "anomaly-grid"\nfiles = ["grid.xyz"]\nlicence = "own"\n'
        "[grid]\ncolumns = [0, 1, 2]\n"
    )
    text(" ")(tmp_path)
    with pytest.raises(SourceError, match=r"a\.toml \[grid\].*columns.*greater than or equal to 1"):
        ingest_grid([toml], params=IngestGridParams())


class TestUncertaintyMarks:
    """EMAG2 version 3 writes -888 and -999 where it states no error."""

    _KEYS = _GEO | {"uncertainty_column": 4, "no_data": 99999.0}

    def _file(self, folder: Path) -> list[Path]:
        rows = "10 40 1 3\n11 40 2 -888\n10 41 99999 -999\n11 41 4 5\n"
        return written(rows.encode())(folder)

    def test_the_key_serves_where_the_file_has_none(self, tmp_path: Path) -> None:
        grid = read(self._file(tmp_path), **self._KEYS | {"uncertainty_nt": 50.0})
        np.testing.assert_array_equal(grid.magnetic_anomaly_uncertainty, [[3, 50], [np.nan, 5]])

    def test_without_it_they_are_refused(self, tmp_path: Path) -> None:
        with pytest.raises(FormatError, match=r"1 values of its uncertainty are -888.*set unc"):
            read(self._file(tmp_path), **self._KEYS | {"uncertainty_nt": None})
