"""Every format of observatory records gives the numbers that were written into it."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any, NamedTuple

import cdflib.cdfwrite
import iaga
import numpy as np
import pandas as pd
import pytest
import xarray as xr

from magtiles.catalog.flags import RecordFlag
from magtiles.schemas import contracts
from magtiles.stages.ingest.observatory.stage import IngestObservatoryParams, ingest_observatory

NAMES = ("field_north", "field_east", "field_down", "field_total")
IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def ingest(*files: Path, **keys: Any) -> xr.Dataset:
    series = ingest_observatory(list(files), params=IngestObservatoryParams(**keys))
    contracts.check(series, "observatory-series/1")
    return series


def values(series: xr.Dataset) -> np.ndarray[Any, Any]:
    return np.stack([series[name].values for name in NAMES])


def test_iaga2002_gives_exactly_the_numbers_of_its_text(tmp_path: Path) -> None:
    lines = iaga.rows(iaga.minutes(), iaga.field())
    file = iaga.write(tmp_path / "bou.min", iaga.header() + lines)
    series = ingest(file)
    text = pd.read_csv(file, sep=r"\s+", skiprows=13, header=None)
    np.testing.assert_array_equal(values(series), text.iloc[:, 3:].to_numpy().T)
    np.testing.assert_array_equal(series["time"].values, iaga.minutes())
    assert {k: series.attrs[k] for k in ("iaga_code", "latitude", "elevation", "cadence_s")} == {
        "iaga_code": "BOU",
        "latitude": 40.137,
        "elevation": 1682.0,
        "cadence_s": 60.0,
    }
    assert series.attrs["longitude"] == pytest.approx(-105.236)
    assert series.attrs["total_field_from"] == "scalar"


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("packed", [False, True])
def test_line_ends_and_gzip_change_nothing(tmp_path: Path, end: str, packed: bool) -> None:
    lines = iaga.header() + iaga.rows(iaga.minutes(count=50), iaga.field(50))
    file = iaga.write(tmp_path / "bou.min", lines, end)
    if packed:
        file.write_bytes(gzip.compress(file.read_bytes()))
    np.testing.assert_array_equal(values(ingest(file)), iaga.field(50))


def test_columns_of_other_widths_are_read_by_their_words(tmp_path: Path) -> None:
    lines = [line.replace(".000 ", ".000  ") for line in iaga.rows(iaga.minutes(), iaga.field())]
    series = ingest(iaga.write(tmp_path / "bou.min", iaga.header() + lines))
    np.testing.assert_array_equal(values(series), iaga.field())
    np.testing.assert_array_equal(series["time"].values, iaga.minutes())


@pytest.mark.parametrize("text", ["-9999.99", "    0.00", "   -0.01", "99998.99", "-0.50"])
def test_any_number_that_fits_is_that_number(tmp_path: Path, text: str) -> None:
    lines = iaga.rows(iaga.minutes(count=2), iaga.field(2))
    lines[1] = lines[1][:31] + f"{text:>9}" + lines[1][40:]
    assert ingest(iaga.write(tmp_path / "f", iaga.header() + lines)).field_north[1] == float(text)


@pytest.mark.parametrize(
    ("step_s", "start"),
    [(1, "2016-02-28T23:59:58"), (3600, "2015-12-31T20:30"), (86400, "2016-02-27T11:59:30")],
)
def test_every_cadence_across_the_ends_of_days_and_years(
    tmp_path: Path, step_s: int, start: str
) -> None:
    time = iaga.minutes(start, 40, step_s)
    series = ingest(iaga.write(tmp_path / "f", iaga.header() + iaga.rows(time, iaga.field(40))))
    np.testing.assert_array_equal(series["time"].values, time)
    assert series.attrs["cadence_s"] == step_s


class Elements(NamedTuple):
    name: str
    keys: dict[str, Any]
    comments: tuple[str, ...]
    total: str
    tolerance: float


def reported(name: str, field: Any) -> Any:
    """The elements of a field (4, n), by their definitions."""
    x, y, z, f = field
    h, d = np.hypot(x, y), np.degrees(np.arctan2(y, x)) * 60.0
    base = np.radians(552.7 / 60.0)
    known = {
        "X": x, "Y": y, "Z": z, "F": f, "H": h, "D": d, "S": f,
        "I": np.degrees(np.arctan2(z, h)) * 60.0,
        "G": np.linalg.norm(field[:3], axis=0) - f,
        "U": y, "V": z, "W": x,
    }  # fmt: skip
    if name.startswith("HE"):
        known |= {"H": x * np.cos(base) + y * np.sin(base)}
        known |= {"E": y * np.cos(base) - x * np.sin(base)}
    if "d" in name:
        known["D"] = d - 552.7
    columns = np.stack([known[e] for e in name.upper()])
    if name == "DIFF":  # the first F is the vector's
        columns[2] = np.linalg.norm(field[:3], axis=0)
    return columns


DECBAS = ("DECBAS               5527    (Baseline declination value in",)
TO_NED = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


@pytest.mark.parametrize(
    "case",
    [
        Elements("XYZF", {}, (), "scalar", 0.0151),
        Elements("XYZG", {}, (), "vector minus G", 0.0151),
        Elements("XYZS", {}, (), "scalar", 0.0151),
        Elements("HDZF", {}, (), "scalar", 0.036),
        Elements("HdZF", {}, DECBAS, "scalar", 0.036),
        Elements("HdZF", {"declination_base_arcmin": 552.7}, (), "scalar", 0.036),
        Elements("DIFF", {}, (), "scalar", 0.08),
        Elements("DHIF", {}, (), "scalar", 0.21),
        Elements("HEZF", {}, DECBAS, "scalar", 0.0151),
        Elements("HEZF", {"declination_base_arcmin": 552.7}, (), "scalar", 0.0151),
        Elements("UVWF", {"sensor_axes": TO_NED}, (), "scalar", 0.0151),
    ],
    ids=str,
)
def test_each_set_of_elements_becomes_north_east_down(tmp_path: Path, case: Elements) -> None:
    field = iaga.field(200)
    field[3] += 0.25  # the scalar has a level of its own
    lines = iaga.header(case.name.upper(), case.comments)
    lines += iaga.rows(iaga.minutes(count=200), reported(case.name, field))
    series = ingest(iaga.write(tmp_path / "f", lines), **case.keys)
    # Angles are written to 0.01 arcmin: half of that is 0.03 nT of H, 0.076 nT of F and, where
    # Z = H tan I, 0.19 nT of Z.
    assert np.abs(values(series) - field).max() < case.tolerance
    assert series.attrs["total_field_from"] == case.total
    assert series.attrs["reported_elements"] == case.name.upper()
    assert series.attrs["conversion"]


def test_hez_without_a_baseline_takes_the_core_declination_and_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    lines = iaga.header("HEZF")
    lines += iaga.rows(iaga.minutes(count=20), reported("HEZF", iaga.field(20)))
    series = ingest(iaga.write(tmp_path / "f", lines))
    assert "approximate" in series.attrs["conversion"]
    assert "stands in" in caplog.text
    # The record's axis is at 552.7 arcmin, the IGRF's declination is 516: 0.61 degrees of 20,800.
    assert abs(values(series)[1] - iaga.field(20)[1]).max() == pytest.approx(222, abs=5)


def test_marks_are_missing_and_an_element_not_recorded_is_no_mark(tmp_path: Path) -> None:
    field = iaga.field(10)
    field[0, 3] = np.nan
    field[3] = 88888.0
    lines = iaga.header() + iaga.rows(iaga.minutes(count=10), field)
    series = ingest(iaga.write(tmp_path / "f", lines))
    assert series.quality_flag.values.tolist() == [0, 0, 0, RecordFlag.MISSING_MARK, *[0] * 6]
    assert series.attrs["elements_not_recorded"] == "F"
    assert series.attrs["samples_marked_missing"] == 1
    assert series.attrs["total_field_from"] == "vector"
    magnitude = np.linalg.norm(values(series)[:3], axis=0)
    np.testing.assert_array_equal(series.field_total.values, magnitude)
    assert np.flatnonzero(np.isnan(series.field_total.values)).tolist() == [3]


def wdc_line(element: str, day: int, base: int, hours: list[int]) -> str:
    return f"BOU1310{element}{day:02d}    20{base:4d}" + "".join(f"{h:4d}" for h in [*hours, 9999])


def test_wdc_hourly_means(tmp_path: Path) -> None:
    hours = list(range(0, 240, 10))
    lines = [
        wdc_line("H", 1, 207, hours), wdc_line("H", 3, 207, [*hours[:-1], 9999]),
        wdc_line("D", 1, 8, hours), wdc_line("D", 3, 8, hours),
        wdc_line("Z", 1, 480, hours), wdc_line("Z", 3, 480, hours),
    ]  # fmt: skip
    place = {"latitude": 40.14, "longitude": 254.767, "elevation_m": 1682.0}
    series = ingest(iaga.write(tmp_path / "bou2013.wdc", lines, "\r\n"), **place)
    h, d = 20700.0 + np.arange(24) * 10, np.radians(8.0 + np.arange(24) * 10 / 600.0)
    np.testing.assert_allclose(series.field_north.values[:24], h * np.cos(d), rtol=1e-14)
    np.testing.assert_allclose(series.field_east.values[:24], h * np.sin(d), rtol=1e-14)
    np.testing.assert_array_equal(series.field_down.values[:24], 48000.0 + np.arange(24) * 10)
    assert series.sizes["time"] == 72
    assert str(series.time.values[0]) == "2013-10-01T00:30:00.000000000"
    assert np.isnan(series.field_north.values[24:48]).all()
    assert np.isnan(series.field_north.values[-1])
    assert series.quality_flag.values[[23, 30, 71]].tolist() == [0, 0, 1]


def imf_lines(field: np.ndarray[Any, Any], hours: int, elements: str = "XYZF") -> list[str]:
    """Blocks of hours of stored whole numbers (4, 60 * hours)."""
    lines = []
    for hour in range(hours):
        base = "005527" if "D" in elements else "000000"
        lines.append(f"BOU MAR1516 075 {hour:02d} {elements} A GOL 04992548 {base} {'R' * 16}")
        for row in range(30):
            a, b = (field[:, 60 * hour + 2 * row + i].astype(int) for i in (0, 1))
            lines.append("  ".join(f"{v[0]:7d} {v[1]:7d} {v[2]:7d} {v[3]:6d}" for v in (a, b)))
    return lines


def test_imf_hours(tmp_path: Path) -> None:
    stored = np.round(iaga.field(120) * 10)
    stored[:, 7] = 999999
    series = ingest(iaga.write(tmp_path / "MAR1516.BOU", imf_lines(stored, 2)), elevation_m=1682.0)
    expected = np.where(stored == 999999, np.nan, stored * 0.1)
    np.testing.assert_array_equal(values(series), expected)
    np.testing.assert_array_equal(series.time.values, iaga.minutes("2016-03-15", 120))
    assert series.quality_flag.values[7] == RecordFlag.MISSING_MARK
    assert (series.attrs["latitude"], series.attrs["data_type"]) == (
        pytest.approx(40.1),
        "adjusted",
    )


def test_imf_declination_counts_from_its_baseline_in_hundredths(tmp_path: Path) -> None:
    stored = np.tile(np.array([208070.0, -1230.0, 480480.0, 523600.0])[:, None], (1, 60))
    file = iaga.write(tmp_path / "MAR1516.BOU", imf_lines(stored, 1, "HDZF"))
    d = np.radians((552.7 - 12.30) / 60.0)
    series = ingest(file, elevation_m=1682.0)
    assert series.field_east.values[0] == pytest.approx(20807.0 * np.sin(d), abs=1e-9)


def write_cdf(path: Path, names: str, data: Any, units: tuple[str, ...], scalar_step: int) -> Path:
    file = cdflib.cdfwrite.CDF(path, cdf_spec={"Compressed": 6})
    said = {"IagaCode": "BOU", "ElementsRecorded": names, "PublicationLevel": "4"}
    said |= {"FormatDescription": "INTERMAGNET CDF Format"}
    place = {"Latitude": 40.137, "Longitude": 254.764, "Elevation": 1682.0}
    attrs: dict[str, Any] = {k: {0: [v, "CDF_CHAR"]} for k, v in said.items()}
    file.write_globalattrs(attrs | {k: {0: [v, "CDF_DOUBLE"]} for k, v in place.items()})
    stamps = [[2016, 1, 1, 0, 0, s, 0, 0, 0] for s in range(data.shape[1])]
    times = np.asarray(cdflib.cdfepoch.compute_tt2000(stamps))

    def spec(name: str, kind: int) -> dict[str, Any]:
        return {
            "Variable": name, "Data_Type": kind, "Num_Elements": 1, "Rec_Vary": True,
            "Dim_Sizes": [],
        }  # fmt: skip

    for name, unit, values_ in zip(names, units, data, strict=True):
        scalar = name in "FSG"
        step, axis = (scalar_step, "Scalar") if scalar else (1, "Vector")
        meta = {"UNITS": unit, "FILLVAL": 99999.0, "DEPEND_0": f"Geomagnetic{axis}Times"}
        file.write_var(spec(f"GeomagneticField{name}", 45), meta, values_[::step].copy())
    file.write_var(spec("GeomagneticVectorTimes", 33), {}, times)
    file.write_var(spec("GeomagneticScalarTimes", 33), {}, times[::scalar_step].copy())
    file.close()
    return path


def test_imagcdf_with_angles_and_a_slower_scalar(tmp_path: Path) -> None:
    field = iaga.field(30)
    data = reported("HDZS", field)
    data[1] /= 60.0  # degrees there
    data[2, 4] = 99999.0
    units = ("nT", "Degrees of arc", "nT", "nT")
    series = ingest(write_cdf(tmp_path / "bou_20160101.cdf", "HDZS", data, units, 5))
    np.testing.assert_allclose(series.field_east.values, field[1], atol=1e-9)
    assert np.flatnonzero(np.isnan(series.field_down.values)).tolist() == [4]
    assert np.flatnonzero(np.isfinite(series.field_total.values)).tolist() == [*range(0, 30, 5)]
    np.testing.assert_array_equal(series.time.values, iaga.minutes(count=30, step_s=1))
    assert series.attrs["data_type"] == "definitive"
