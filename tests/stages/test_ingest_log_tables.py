"""CSV and HDF5 files become tracks whose every number is known; bad ones say where and why."""

from __future__ import annotations

import gzip
import lzma
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import pyproj
import pytest
import xarray as xr

from magtiles.catalog.flags import TrackFlag
from magtiles.schemas import contracts
from magtiles.schemas.errors import FormatError, MagtilesError, SourceError
from magtiles.stages.declare import parse_params
from magtiles.stages.ingest.log.order import longest_ascent, out_of_order
from magtiles.stages.ingest.log.source import IngestLogParams
from magtiles.stages.ingest.log.stage import ingest_log

HEADER = "when,lat,lon,alt,total,line\n"
ROWS = [
    "2021-03-04T05:06:07.250Z,45.0,9.0,300.5,48000.5,10",
    "2021-03-04T05:06:08.250Z,45.1,9.1,301.5,48001.5,10",
    "2021-03-04T05:06:09.250Z,45.2,9.2,302.5,,20",
]
COLUMNS = {
    "time": "when", "latitude": "lat", "longitude": "lon", "height": "alt",
    "field_total": "total", "line": "line",
}  # fmt: skip
START = np.datetime64("2021-03-04T05:06:07.250", "ns")


def ingest(*files: Path, **params: Any) -> xr.Dataset:
    params = {"height_reference": "ellipsoid", "units": "nT", "columns": COLUMNS} | params
    params = {name: value for name, value in params.items() if value is not None}
    track = ingest_log(files, params=parse_params(IngestLogParams, params, where="parameters"))
    contracts.check(track, "track/1")
    return track


def write(path: Path, rows: list[str] = ROWS, header: str = HEADER) -> Path:
    path.write_text(header + "\n".join(rows) + "\n")
    return path


def test_a_table_becomes_a_track(tmp_path: Path) -> None:
    track = ingest(write(tmp_path / "a.csv"))
    seconds = np.arange(3).astype("timedelta64[s]")
    np.testing.assert_array_equal(track["time"], START + seconds)
    np.testing.assert_array_equal(track["latitude"], [45.0, 45.1, 45.2])
    np.testing.assert_array_equal(track["height"], [300.5, 301.5, 302.5])
    np.testing.assert_array_equal(track["field_total"], [48000.5, 48001.5, np.nan])
    np.testing.assert_array_equal(track["line"], [10, 10, 20])
    np.testing.assert_array_equal(track["quality_flag"], [0, 0, TrackFlag.FIELD_GAP])


def pack_xz(path: Path) -> Path:
    out = path.with_suffix(".csv.xz")
    out.write_bytes(lzma.compress(path.read_bytes()))
    return out


def pack_gz(path: Path) -> Path:
    out = path.with_suffix(".csv.gz")
    out.write_bytes(gzip.compress(path.read_bytes()))
    return out


def pack_zip(path: Path) -> Path:
    out = path.with_suffix(".zip")
    with zipfile.ZipFile(out, "w") as archive:
        archive.write(path, path.name)
    return out


@pytest.mark.parametrize("pack", [pack_xz, pack_gz, pack_zip])
def test_a_packed_table_is_the_same(tmp_path: Path, pack: Callable[[Path], Path]) -> None:
    plain = write(tmp_path / "a.csv")
    packed = ingest(pack(plain))
    xr.testing.assert_equal(packed, ingest(plain))


def test_a_damaged_xz_file_is_named(tmp_path: Path) -> None:
    packed = pack_xz(write(tmp_path / "a.csv"))
    packed.write_bytes(packed.read_bytes()[:-20])
    with pytest.raises(FormatError, match=r"a\.csv\.xz: is not a whole xz file"):
        ingest(packed)


class Clock(NamedTuple):
    texts: list[str]
    params: dict[str, Any]
    columns: dict[str, str]
    first: str
    id: str


CLOCKS = [
    Clock(["1614834367.25,0"], {}, {}, "2021-03-04T05:06:07.250", "seconds since 1970"),
    Clock(
        ["1614834367250,0"], {"time_unit": "ms"}, {}, "2021-03-04T05:06:07.250", "ms since 1970"
    ),
    Clock(
        ["18367.25,20210304"], {}, {"date": "day"}, "2021-03-04T05:06:07.250", "seconds of a day"
    ),
    Clock(
        ["5.5,000304"], {"time_unit": "h", "date_format": "%y%m%d"}, {"date": "day"},
        "2000-03-04T05:30:00", "hours of a day of six digits with zeros in front",
    ),
    Clock(
        ["0.25,04/03/2021"], {"time_unit": "day", "date_format": "%d/%m/%Y"}, {"date": "day"},
        "2021-03-04T06:00:00", "fraction of a day",
    ),
    Clock(
        ["50607.25,0"], {"time_format": "%H%M%S", "date": "2021-03-04"}, {},
        "2021-03-04T05:06:07.250", "clock digits without a leading zero",
    ),
    Clock(
        ["15:30:00,2021-03-04"], {"date_format": "%Y-%m-%d", "utc_offset_h": 9.5},
        {"date": "day"}, "2021-03-04T06:00:00", "ISO clock in local time",
    ),
    Clock(
        ["01:00:00,2021-03-04"], {"date_format": "%Y-%m-%d", "utc_offset_h": 9.5},
        {"date": "day"}, "2021-03-03T15:30:00", "local time of the day before",
    ),
    Clock(
        ["04 Mar 2021 05:06:07.25,0"], {"time_format": "%d %b %Y %H:%M:%S"}, {},
        "2021-03-04T05:06:07.250", "a layout with its date",
    ),
    Clock(
        ["2021-03-04T07:06:07.25+02:00,0"], {}, {}, "2021-03-04T05:06:07.250", "ISO with a zone"
    ),
    Clock(
        ["90000,20201231"], {}, {"date": "day"}, "2021-01-01T01:00:00", "past midnight"
    ),
]  # fmt: skip


@pytest.mark.parametrize("case", [pytest.param(c, id=c.id) for c in CLOCKS])
def test_times_are_utc(tmp_path: Path, case: Clock) -> None:
    rows = [f"{text},45,9,0,48000,1" for text in case.texts]
    path = write(tmp_path / "a.csv", rows, "when,day,lat,lon,alt,total,line\n")
    track = ingest(path, columns=COLUMNS | case.columns, **case.params)
    assert track["time"].values[0] == np.datetime64(case.first, "ns")


def test_vector_total_diurnal_and_own_columns_in_their_units(tmp_path: Path) -> None:
    header = "t,x,y,z,f,base,res,v\n"
    path = write(tmp_path / "a.csv", ["1614834367,0.2,-0.1,0.4,48.1,48250.5,-7.5,36"], header)
    columns = {
        "time": "t", "field_x": "x", "field_y": "y", "field_z": "z", "field_total": "f",
        "diurnal": "base", "speed": "v", "source": {"residual": "res"},
    }  # fmt: skip
    track = ingest(
        path, columns=columns, units="gauss", sensor_to_body="forward,left,up",
        column_units={"f": "uT", "base": "nT", "res": "nT", "v": "km/h"}, diurnal_datum_nt=48240.0,
    )  # fmt: skip
    np.testing.assert_allclose(track["field_body"], [[20000.0, 10000.0, -40000.0]], rtol=1e-15)
    np.testing.assert_allclose(track["field_total"], [48100.0])
    np.testing.assert_allclose(track["diurnal"], [10.5])
    np.testing.assert_allclose(track["speed"], [10.0])
    assert track["source_residual"].values.tolist() == [-7.5]
    assert track["source_residual"].attrs["units"] == "nT"
    assert track["quality_flag"].values.tolist() == [TrackFlag.NO_FIX]


def test_projected_coordinates_lead_to_wgs84(tmp_path: Path) -> None:
    """On the central meridian the northing is the meridian's arc, 0.9996 of it, by geodesics."""
    arc = pyproj.Geod(ellps="GRS80").inv(147.0, 0.0, 147.0, -35.0)[2]
    northing = 10_000_000 - 0.9996 * arc
    header = "when,e,n,alt,total,line\n"
    path = write(tmp_path / "a.csv", [f"2021-03-04T05:06:07,500000,{northing!r},0,48000,1"], header)
    columns = {k: v for k, v in COLUMNS.items() if k not in ("latitude", "longitude")}
    columns |= {"easting": "e", "northing": "n"}
    track = ingest(path, columns=columns, crs="EPSG:28355")
    np.testing.assert_allclose(track["latitude"], [-35.0], atol=1e-9)
    np.testing.assert_allclose(track["longitude"], [147.0], atol=1e-9)
    assert "GDA94" in track.attrs["datum_operation"]


def test_rows_in_runs_by_line_may_start_earlier_without_a_flag(tmp_path: Path) -> None:
    second = "2021-03-04T05:06:{:02d},45,9,0,48000,{}"
    rows = [second.format(s, line) for s, line in ((30, 1), (31, 1), (10, 2), (11, 2))]
    track = ingest(write(tmp_path / "a.csv", rows))
    assert track["line"].values.tolist() == [2, 2, 1, 1]
    assert not track["quality_flag"].values.any()


def test_fewest_rows_that_break_the_order_of_their_line_are_flagged(tmp_path: Path) -> None:
    second = "2021-03-04T05:06:{:02d},45,9,0,48000,1"
    rows = [second.format(s) for s in (10, 50, 11, 12, 13, 13, 14)]
    track = ingest(write(tmp_path / "a.csv", rows))
    steps = track["quality_flag"].values == TrackFlag.CLOCK_STEP
    assert steps.sum() == 2  # the stray one and either of the equal ones
    assert (np.diff(track["time"].values[~steps]) > np.timedelta64(0)).all()


def test_longest_ascent_is_longest() -> None:
    rng = np.random.default_rng(3)
    for _ in range(50):
        values = rng.integers(0, 12, 9)
        member = longest_ascent(values)
        assert (np.diff(values[member]) > 0).all()
        every = [
            bin(mask).count("1")
            for mask in range(1, 512)
            if (np.diff(values[[i for i in range(9) if mask >> i & 1]]) > 0).all()
        ]
        assert member.sum() == max(every)


def test_equal_times_of_two_runs_leave_the_earlier_row() -> None:
    times = np.array([1, 2, 3, 2, 5], dtype="datetime64[ns]")
    late = out_of_order(times, np.array([0, 0, 0, 1, 1]))
    assert late.tolist() == [False, False, False, True, False]


def flight(path: Path, **changes: Any) -> Path:
    """As the MagNav flights: columns of one length, seconds of the day, year and day of year."""
    rows = 50
    data: dict[str, Any] = {
        "tt": 45100.0 + np.arange(rows) * 0.1,
        "year": np.array([2020.0]),
        "doy": np.array([172.0]),
        "lat": np.full(rows, np.radians(45.0)),
        "lon": np.full(rows, np.radians(-76.0)),
        "utm_z": np.linspace(400, 410, rows),
        "mag_1_uc": np.full(rows, 53_000.0),
        "flux/x": np.full(rows, 1.0),
    } | changes
    with h5py.File(path, "w") as file:
        for name, values in data.items():
            file[name] = values
        file["mag_1_uc"].attrs["units"] = "nT"
    return path


FLIGHT = {
    "time": "tt", "year": "year", "day_of_year": "doy", "latitude": "lat", "longitude": "lon",
    "height": "utm_z", "field_total": "mag_1_uc",
}  # fmt: skip
RADIANS = {"lat": "rad", "lon": "rad"}


def test_an_hdf5_flight_becomes_a_track(tmp_path: Path) -> None:
    track = ingest(flight(tmp_path / "a.h5"), columns=FLIGHT, column_units=RADIANS, units=None)
    assert track["time"].values[0] == np.datetime64("2020-06-20T12:31:40", "ns")
    assert track["time"].values[-1] == np.datetime64("2020-06-20T12:31:44.900", "ns")
    np.testing.assert_allclose(track["longitude"], -76.0, atol=1e-12)
    np.testing.assert_allclose(track["field_total"], 53_000.0)


def test_hdf5_lies_are_refused(tmp_path: Path) -> None:
    path = flight(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        del file["mag_1_uc"]
        outside = [(str(tmp_path / "secret"), 0, 400)]
        file.create_dataset("mag_1_uc", (50,), dtype="f8", external=outside)
    with pytest.raises(FormatError, match="'/mag_1_uc' lies in other files"):
        ingest(path, columns=FLIGHT, column_units=RADIANS)
    with h5py.File(path, "a") as file:
        del file["mag_1_uc"]
        file.create_dataset("mag_1_uc", (1 << 40,), dtype="f8", chunks=(1 << 20,))
    with pytest.raises(FormatError, match="declares 8796093"):
        ingest(path, columns=FLIGHT, column_units=RADIANS)
    with h5py.File(path, "a") as file:
        del file["mag_1_uc"]
        file["mag_1_uc"] = h5py.ExternalLink("other.h5", "mag_1_uc")
    with pytest.raises(FormatError, match="'/mag_1_uc' is a link to another file"):
        ingest(path, columns=FLIGHT, column_units=RADIANS)
    path.write_bytes(path.read_bytes()[:600])
    with pytest.raises(FormatError, match="is not a whole HDF5 file"):
        ingest(path, columns=FLIGHT, column_units=RADIANS)


def test_hdf5_lengths_must_agree(tmp_path: Path) -> None:
    path = flight(tmp_path / "a.h5", lat=np.zeros(49))
    with pytest.raises(FormatError, match="differ in length: lat 49"):
        ingest(path, columns=FLIGHT, column_units=RADIANS)


class Bad(NamedTuple):
    content: str
    params: dict[str, Any]
    error: type[MagtilesError]
    message: str
    id: str


GOOD = HEADER + "\n".join(ROWS) + "\n"


def without(key: str) -> dict[str, Any]:
    return {"columns": {k: v for k, v in COLUMNS.items() if k != key}}


BAD = [
    Bad("", {}, FormatError, "the file is empty", "zero length"),
    Bad("\n\n", {}, FormatError, "is text of an unknown kind", "blank"),
    Bad("<!DOCTYPE html><p>a,b", {}, FormatError, "is an HTML page", "HTML"),
    Bad(HEADER, {}, FormatError, "holds no rows", "no rows"),
    Bad(GOOD, {"columns": COLUMNS | {"time": "clock"}}, SourceError,
        "'columns.time' names the column 'clock', which is missing; expected one of", "no column"),
    Bad(GOOD, without("time"), SourceError, "no column holds the time", "no time"),
    Bad(GOOD, without("field_total"), SourceError, "no column holds the field", "no field"),
    Bad(GOOD, without("height"), SourceError, "no column holds the height", "no height"),
    Bad(GOOD, without("latitude"), SourceError, "latitude and longitude, or easting", "half place"),
    Bad(GOOD, {"units": None}, SourceError,
        "the unit of column 'total' is not known; state it: column_units", "unit unknown"),
    Bad(GOOD, {"units": "furlong"}, SourceError, "'furlong' is not a magnetic", "no unit"),
    Bad(GOOD, {"column_units": {"alt": "fathom"}}, SourceError, "'alt' is 'fathom'", "depth"),
    Bad(GOOD, {"column_units": {"altitude": "m"}}, SourceError,
        "'column_units.altitude' names the column 'altitude', which is missing", "unit of nothing"),
    Bad(GOOD, {"height_reference": None}, SourceError, "'height_reference' is missing", "heights"),
    Bad(GOOD, {"height_m": 3.0}, SourceError, "'height_m' is set, but column 'alt'", "two heights"),
    Bad(GOOD, {"crs": "EPSG:28355"}, SourceError, "a geographic CRS", "projected CRS"),
    Bad(GOOD, {"crs": "EPSG:0"}, SourceError, "key 'crs' is 'EPSG:0'", "no CRS"),
    Bad(HEADER + "13500,45,9,0,48000,1\n", {}, FormatError,
        "line 2: column 'when' gives 1970-01-01T03:45:00, counted from 1970", "1970 stamps"),
    Bad(HEADER + ROWS[0] + "\nnoon,45,9,0,48000,1\n", {}, FormatError,
        "line 3: column 'when' holds 'noon'", "no such time"),
    Bad(HEADER + ROWS[0] + "\n\n" + ROWS[1].replace("48001.5", "4800l"), {}, FormatError,
        "line 4: column 'total' holds '4800l'; expected a number", "no number"),
    Bad(HEADER + ROWS[0].replace("45.0", "450"), {}, FormatError, "line 2: latitude 450", "place"),
    Bad(HEADER + ROWS[0][:30] + "\n" + ROWS[1], {}, FormatError,
        "line 2: the line is truncated: 3 fields; expected 6 fields", "truncated line"),
    Bad(HEADER + ROWS[0] + ",7\n", {}, FormatError, "line 2: the line has 7 fields", "long line"),
    Bad(HEADER + "\n".join(r.replace("48001.5", "").replace("48000.5", "") for r in ROWS), {},
        FormatError, "the field is not finite in any of 3", "all NaN"),
    Bad(HEADER + ROWS[0].replace("48000.5", "4.8e9"), {}, FormatError, "is 4.8e+09 nT", "too much"),
    Bad("1,2\n3,4\n", {}, FormatError, "line 1: holds numbers; expected the names", "no header"),
    Bad("a,a\n3,4\n", {}, FormatError, "the column 'a' occurs twice", "same names"),
    Bad(GOOD, {"columns": COLUMNS | {"date": "alt"}, "date": "2021-03-04"}, SourceError,
        "the date is given twice", "two dates"),
    Bad(GOOD, {"columns": COLUMNS | {"field_x": "alt"}}, SourceError,
        "1 of field_x, field_y and field_z", "one axis"),
    Bad("DEFN   ST=RECD,RT=;a:F10.1\n", {}, FormatError, "definition", "definitions alone"),
]  # fmt: skip


@pytest.mark.parametrize("case", [pytest.param(b, id=b.id) for b in BAD])
def test_bad_tables_say_where_and_why(tmp_path: Path, case: Bad) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(case.content)
    with pytest.raises(case.error) as caught:
        ingest(path, **case.params)
    assert case.message in str(caught.value)
    assert "bad.csv" in str(caught.value) or "parameters" in str(caught.value)


def test_a_truncated_last_line_is_left_out_with_its_number(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "a.csv").write_text(HEADER + "\n".join(ROWS)[:-30])
    assert ingest(tmp_path / "a.csv").sizes["time"] == 2
    assert "truncated: line 4 has 1 fields of 6 fields; kept 2 lines" in caplog.text


def test_rows_without_a_time_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write(tmp_path / "a.csv", [ROWS[0], "," + ROWS[1].split(",", 1)[1], ROWS[2]])
    assert ingest(path).sizes["time"] == 2
    assert "1 of 3 rows have no time and are left out, the first at line 3" in caplog.text


def test_a_source_toml_explains_a_table(tmp_path: Path) -> None:
    write(tmp_path / "a.csv")
    toml = tmp_path / "a.toml"
    toml.write_text(
        '[source]\nid = "line"\nkind = "track"\nfiles = ["a.csv"]\nlicence = "none"\n'
        '[log]\nunits = "nT"\nheight_reference = "ellipsoid"\n[log.columns]\n'
        + "".join(f'{key} = "{name}"\n' for key, name in COLUMNS.items())
    )
    track = ingest(toml, units=None, height_reference=None, columns=None)
    assert track.attrs["source"] == "line"
