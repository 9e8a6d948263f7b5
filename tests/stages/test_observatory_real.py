"""Real records: Boulder's and eight other observatories', against what is published of them."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from scipy.signal import get_window

from magtiles.schemas import contracts
from magtiles.schemas.errors import SourceError
from magtiles.stages.ingest.observatory.stage import IngestObservatoryParams, ingest_observatory
from magtiles.stages.temporal.cadence import gaussian_filter
from magtiles.stages.temporal.check import CheckObservatoryParams, check_observatory
from magtiles.stages.temporal.faults import find_spikes, find_steps

VECTOR = ("field_north", "field_east", "field_down")
NAMES = (*VECTOR, "field_total")
STATIONS = ("bou", "brw", "clf", "frd", "gua", "her", "hon", "kak", "kou")


def ingest(*files: Path, **keys: Any) -> xr.Dataset:
    series = ingest_observatory(list(files), params=IngestObservatoryParams(**keys))
    contracts.check(series, "observatory-series/1")
    return series


@pytest.fixture(scope="module")
def usgs(real_data: Path) -> Path:
    return real_data / "observatory_usgs_bou"


@pytest.fixture(scope="module")
def january(usgs: Path) -> xr.Dataset:
    return ingest(usgs / "adjusted/BOU201601adj.min")


@pytest.fixture(scope="module")
def november(usgs: Path) -> xr.Dataset:
    """Raw (H, D, Z, F) week with a moderate storm on the 4th."""
    return ingest(*sorted((usgs / "iaga2002/BOU/OneMinute").glob("*.min")))


def test_january_2016_is_read_exactly(usgs: Path, january: xr.Dataset) -> None:
    lines = (usgs / "adjusted/BOU201601adj.min").read_text().splitlines()
    rows = [line.split() for line in lines if line.startswith("2016")]
    assert january.sizes["time"] == len(rows) == 41_592
    text = np.array([[float(word) for word in row[3:]] for row in rows]).T
    np.testing.assert_array_equal(np.stack([january[n].values for n in NAMES]), text)
    stamps = np.array([f"{row[0]}T{row[1]}" for row in rows], "datetime64[ns]")
    np.testing.assert_array_equal(january["time"].values, stamps)
    assert not january.quality_flag.values.any()


def test_raw_and_adjusted_are_one_affine_to_rounding(usgs: Path, january: xr.Dataset) -> None:
    raw = ingest(usgs / "adjusted/BOU201601vmin.min")
    assert "d = 552.7 arcmin" in raw.attrs["conversion"]
    known = np.stack([raw[n].values for n in VECTOR] + [np.ones(raw.sizes["time"])])
    for name in VECTOR:
        fit, *_ = np.linalg.lstsq(known.T, january[name].values, rcond=None)
        residual = january[name].values - fit @ known
        # Two roundings to 0.01 nT: 0.0041 rms found, and no outlier beyond 0.011 nT.
        assert residual.std() == pytest.approx(0.01 / np.sqrt(6.0), rel=0.02)
        assert np.abs(residual).max() < 0.011
    total = january.field_total.values - raw.field_total.values
    assert np.abs(total + 22.0).max() < 1e-9  # the published pier correction


def test_the_week_is_seven_days_of_minutes(november: xr.Dataset) -> None:
    assert november.sizes["time"] == 7 * 1440
    assert november.attrs["samples_without_row"] == 0
    declination = np.degrees(np.arctan2(november.field_east, november.field_north)) * 60.0
    assert declination.values[0] == pytest.approx(552.7 - 9.99, abs=1e-9)


AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@pytest.mark.parametrize(
    ("kind", "worst", "typical"), [("usgs", 0.0062, 0.003), ("intermagnet", 4.8, 0.006)]
)
def test_seconds_reduce_to_the_published_minutes(
    usgs: Path, kind: str, worst: float, typical: float
) -> None:
    """The published minutes are of SciPy's periodic window, half a second late: to rounding.

    INTERMAGNET's centred filter gives the same but where this test station's field jumps by
    hundreds of nT in a second.
    """
    place = {"latitude": 32.0, "longitude": -106.0, "elevation_m": 0.0, "sensor_axes": AXES}
    published = ingest(usgs / "filter/LLO20200106vmin.min", **place)
    seconds = usgs / "filter/LLO20200106vsec.sec"
    ours = ingest(seconds, cadence="minute", minute_filter=kind, **place)
    np.testing.assert_array_equal(ours.time.values, published.time.values)
    for name in VECTOR:
        error = np.abs(ours[name].values - published[name].values)
        # The first and last minute lack half their samples.
        assert np.flatnonzero(np.isnan(error)).tolist() == [0, 240]
        assert np.nanmax(error) < worst
        assert np.nanmedian(error) < typical


def test_the_usgs_filter_is_scipys_periodic_window() -> None:
    window = get_window(("gaussian", 15.8734), 91)
    np.testing.assert_allclose(gaussian_filter("usgs"), window / window.sum(), rtol=1e-15)
    assert not np.allclose(gaussian_filter("usgs"), gaussian_filter("usgs")[::-1])


def place(real_data: Path, code: str) -> dict[str, float]:
    with (real_data / "observatory_wdc_hourly/stations_from_ack.csv").open() as file:
        row = next(row for row in csv.DictReader(file) if row["iaga"] == code)
    return {"latitude": float(row["lat"]), "longitude": float(row["lon_e"]), "elevation_m": 0.0}


@pytest.fixture(scope="module")
def hourly(real_data: Path) -> dict[str, xr.Dataset]:
    folder = real_data / "observatory_wdc_hourly/2013"
    return {
        code: ingest(next(folder.glob(f"{code}2013.wdc*")), **place(real_data, code))
        for code in STATIONS
    }


@pytest.mark.parametrize("code", STATIONS)
def test_hourly_means_of_2013(hourly: dict[str, xr.Dataset], code: str) -> None:
    series = hourly[code]
    assert series.sizes["time"] == 8760
    assert series.attrs["iaga_code"] == code.upper()
    magnitude = np.sqrt(sum(series[name].values ** 2 for name in VECTOR))
    assert np.nanmedian(np.abs(magnitude - series.field_total.values)) < 4.0
    assert np.isfinite(series.sel(time="2013-10").field_total).mean() > 0.95


@pytest.mark.parametrize("code", STATIONS)
def test_a_right_position_passes_and_a_wrong_latitude_sign_is_named(
    hourly: dict[str, xr.Dataset], code: str
) -> None:
    params = CheckObservatoryParams()
    checked = check_observatory(hourly[code], params=params)
    assert {f["check"] for f in json.loads(checked.attrs["findings"])} <= {"missing"}
    wrong = hourly[code].assign_attrs(latitude=-hourly[code].attrs["latitude"])
    with pytest.raises(SourceError, match="the latitude's sign is wrong"):
        check_observatory(wrong, params=params)
    allowed = CheckObservatoryParams(allow_position_mismatch=True)
    findings = json.loads(check_observatory(wrong, params=allowed).attrs["findings"])
    assert "position_mismatch" in {f["check"] for f in findings}


def test_noon_at_boulder_dips_and_at_kourou_rises(hourly: dict[str, xr.Dataset]) -> None:
    """Canciani and Raquet 2016, figures 8 and 9, on the five quietest days of October 2013."""
    for code, sign in (("bou", -1.0), ("kou", 1.0)):
        series = hourly[code].sel(time="2013-10")
        local = (series.time.dt.hour + 0.5 + series.attrs["longitude"] / 15.0) % 24.0
        quiet = series.time.dt.day.isin([5, 28, 4, 19, 21])
        total = series.field_total.where(quiet)
        noon = total.where(abs(local - 11.5) < 1.0).mean()
        night = total.where((local < 2.0) | (local > 22.0)).mean()
        assert sign * float(noon - night) > 8.0


def test_real_storms_raise_no_alarm(january: xr.Dataset, november: xr.Dataset) -> None:
    """36 days at Boulder with three storms: one event of two samples, which F saw, too."""
    for series, expected in ((november, 0), (january, 2)):
        checked = check_observatory(series, params=CheckObservatoryParams())
        assert int((checked.quality_flag.values != 0).sum()) == expected
        checks = [f["check"] for f in json.loads(checked.attrs["findings"])]
        assert checks == ["spike"] * bool(expected)


@pytest.mark.parametrize(
    ("size_nt", "share"), [(3.0, 0.45), (5.0, 0.66), (10.0, 0.89), (20.0, 0.99)]
)
def test_spikes_put_into_a_real_week_are_found(
    november: xr.Dataset, size_nt: float, share: float
) -> None:
    """Found: 46, 67, 90, 99.9 % of spikes of one to three minutes; no other sample is flagged."""
    rng = np.random.default_rng(1)
    hits = put = 0
    for name in NAMES:
        values, spiked = november[name].values.copy(), np.zeros(november.sizes["time"], bool)
        for at in rng.choice(np.arange(10, 10_000, 12), 100, replace=False):
            part = slice(at, at + int(rng.integers(1, 4)))
            values[part] += size_nt * rng.choice([-1.0, 1.0])
            spiked[part] = True
        found = find_spikes(values, 8.0, 2.0)
        assert not (found & ~spiked).any()
        hits, put = hits + int((found & spiked).sum()), put + int(spiked.sum())
    assert hits / put > share


@pytest.mark.parametrize(("size_nt", "share"), [(5.0, 0.5), (10.0, 0.79), (20.0, 0.92)])
def test_steps_put_into_a_real_week_are_found(
    november: xr.Dataset, size_nt: float, share: float
) -> None:
    """Found: 51, 80, 93 %; and nothing where no step is."""
    rng = np.random.default_rng(2)
    hits = 0
    for _ in range(90):
        vector = [november[name].values.copy() for name in VECTOR]
        element, at = int(rng.integers(3)), int(rng.integers(200, 9_800))
        vector[element][at:] += size_nt * rng.choice([-1.0, 1.0])
        for i in range(3):
            others = [v for j, v in enumerate(vector) if j != i]
            found, heights = find_steps(vector[i], others, 10.0, 3.0)
            assert found.tolist() in ([], [at] if i == element else [])
            hits += found.size
            assert not heights.size or abs(heights[0]) == pytest.approx(
                size_nt, abs=7.0
            )  # the storm
    assert hits / 90 > share
