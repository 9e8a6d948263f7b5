"""Many files make one series: gaps, overlaps by a rule, and reductions of the cadence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import iaga
import numpy as np
import pytest
import xarray as xr
from scipy import signal

from magtiles.catalog.flags import RecordFlag
from magtiles.schemas import contracts
from magtiles.schemas.errors import ParameterError
from magtiles.stages.ingest.observatory.stage import IngestObservatoryParams, ingest_observatory
from magtiles.stages.temporal.cadence import gaussian_filter, reduce_cadence

RESOLVED = np.uint8(RecordFlag.OVERLAP_RESOLVED)


def ingest(*files: Path, **keys: Any) -> xr.Dataset:
    return ingest_observatory(list(files), params=IngestObservatoryParams(**keys))


def day(folder: Path, name: str, start: str, field: Any, step_s: int = 60, **header: str) -> Path:
    time = iaga.minutes(start, field.shape[1], step_s)
    return iaga.write(folder / name, iaga.header(**header) + iaga.rows(time, field))


def test_days_in_any_order_make_one_series_with_gaps(tmp_path: Path) -> None:
    field = iaga.field(2880)
    files = [
        day(tmp_path, "c", "2016-01-03T06:00", field[:, 1440:]),
        day(tmp_path, "a", "2016-01-01", field[:, :1440]),
    ]
    series = ingest(*files)
    gap = slice(1440, 1440 + 1440 + 360)
    assert series.sizes["time"] == 2880 + 1800
    assert (np.diff(series.time.values) == np.timedelta64(60, "s")).all()
    assert np.isnan(series.field_total.values[gap]).all()
    assert series.attrs["samples_without_row"] == 1800
    assert not series.quality_flag.values.any()  # a gap has no mark
    np.testing.assert_array_equal(series.field_north.values[gap.stop :], field[0, 1440:])


def test_a_day_given_twice_alike_is_counted_and_no_more(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    field = iaga.field(100)
    files = [day(tmp_path, name, "2016-01-01", field) for name in "ab"]
    series = ingest(*files)
    assert series.attrs["duplicate_rows"] == 100
    assert series.attrs["overlaps_resolved"] == 0
    assert not series.quality_flag.values.any()
    assert caplog.text == ""


@pytest.mark.parametrize(
    ("types", "stands"),
    [
        (("variation", "variation"), 1),
        (("definitive", "variation"), 0),
        (("variation", "quasi-definitive"), 1),
        (("provisional", "variation"), 0),
    ],
)
def test_of_two_days_that_differ_the_better_or_the_last_stands(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, types: tuple[str, str], stands: int
) -> None:
    fields = [iaga.field(100, seed) for seed in (1, 2)]
    fields[1][:, :40] = fields[0][:, :40]
    files = [day(tmp_path, f"{i}", "2016-01-01", fields[i], Data_Type=types[i]) for i in (0, 1)]
    series = ingest(*files)
    np.testing.assert_array_equal(series.field_north.values, fields[stands][0])
    assert series.attrs["overlaps_resolved"] == 60
    assert np.flatnonzero(series.quality_flag.values == RESOLVED).tolist() == [*range(40, 100)]
    assert "60 of 100 rows differ" in caplog.text


def test_a_repeated_transmission_fills_what_the_first_lacked(tmp_path: Path) -> None:
    whole = iaga.field(10)
    parts = [whole.copy(), whole.copy()]
    parts[0][:, :3], parts[1][:, 6:] = np.nan, np.nan
    series = ingest(*(day(tmp_path, f"{i}", "2016-01-01", parts[i]) for i in (0, 1)))
    np.testing.assert_array_equal(series.field_down.values, whole[2])
    assert not series.quality_flag.values.any()


def test_what_definitive_data_leave_out_stays_out(tmp_path: Path) -> None:
    raw, definitive = iaga.field(10), iaga.field(10)
    definitive[:, 4] = np.nan
    series = ingest(
        day(tmp_path, "d", "2016-01-01", definitive, Data_Type="definitive"),
        day(tmp_path, "v", "2016-01-01", raw),
    )
    assert np.flatnonzero(np.isnan(series.field_north.values)).tolist() == [4]
    assert series.quality_flag.values[4] == RecordFlag.MISSING_MARK | RESOLVED


def test_a_magnitude_does_not_mix_with_scalars(tmp_path: Path) -> None:
    one, two = iaga.field(10), iaga.field(10)
    one[3] += 500.0  # a raw scalar is far from the vector
    two[3] = np.nan
    series = ingest(day(tmp_path, "1", "2016-01-01", one), day(tmp_path, "2", "2016-01-02", two))
    assert series.attrs["total_field_from"] == "scalar"
    assert np.isnan(series.field_total.values[-10:]).all()


def second_series(seconds: int, start: str = "2016-01-01T00:00:00") -> xr.Dataset:
    rng = np.random.default_rng(5)
    field = 20000.0 + rng.standard_normal((4, seconds)).cumsum(axis=1)
    names = ("field_north", "field_east", "field_down", "field_total")
    attrs = {
        "iaga_code": "BOU", "latitude": 40.0, "longitude": -105.0, "elevation": 0.0,
        "cadence_s": 1.0, "data_type": "variation", "reported_elements": "XYZF", "source": "test",
    }  # fmt: skip
    flags = {"flag_masks": np.array([1], np.uint8), "flag_meanings": "missing_mark"}
    return xr.Dataset(
        {n: ("time", v, {"units": "nT"}) for n, v in zip(names, field, strict=True)}
        | {"quality_flag": ("time", np.zeros(seconds, np.uint8), flags)},
        coords={"time": iaga.minutes(start, seconds, 1)},
        attrs=attrs,
    )


def test_minutes_are_scipys_convolution_at_the_full_minute() -> None:
    series = second_series(7200, "2016-01-01T00:00:17")
    minutes = reduce_cadence(series, "minute")
    contracts.check(minutes, "observatory-series/1")
    window = np.exp(-0.5 * ((np.arange(91) - 45) / 15.8734) ** 2)
    smooth = signal.convolve(series.field_east.values, window / window.sum(), mode="same")
    at = np.arange(43, 7200, 60)  # the first full minute is 43 s on
    np.testing.assert_array_equal(minutes.time.values, series.time.values[at])
    inner = slice(1, -1)
    np.testing.assert_allclose(minutes.field_east.values[inner], smooth[at][inner], rtol=1e-13)
    assert gaussian_filter().sum() == pytest.approx(1.0, abs=1e-15)


def test_a_linear_trend_passes_the_centred_filter_and_lags_in_the_shifted_one() -> None:
    series = second_series(600)
    series["field_north"].values[:] = np.arange(600.0)
    for kind, lag in (("intermagnet", 0.0), ("usgs", 0.5)):
        north = reduce_cadence(series, "minute", kind).field_north.values[1:-1]
        # The shifted one is cut at one end, by 2e-4 of its weight 45 s away.
        assert north - np.arange(60.0, 540.0, 60.0) == pytest.approx(lag, abs=0.02)


def test_nine_tenths_of_the_weight_must_be_there() -> None:
    series = second_series(600)
    weights = gaussian_filter()
    north = series["field_north"].values
    taps = int((weights.cumsum() < 0.1).sum())  # so many may be missing at one end
    north[300 - 45 : 300 - 45 + taps + 1] = np.nan  # of minute 5
    north[420 - 45 : 420 - 45 + taps] = np.nan  # of minute 7
    minutes = reduce_cadence(series, "minute")
    incomplete = (minutes.quality_flag.values & RecordFlag.INCOMPLETE_AVERAGE) != 0
    assert np.isnan(minutes.field_north.values[5])
    assert np.isfinite(minutes.field_north.values[7])
    assert incomplete.tolist() == [True, *[False] * 3, True, True, True, True, False, False]
    expected = weights[taps:] @ north[375 + taps : 466] / weights[taps:].sum()
    assert minutes.field_north.values[7] == pytest.approx(expected, rel=1e-13)


def test_hours_are_means_of_sixty_minutes_at_half_past(tmp_path: Path) -> None:
    field = iaga.field(240)
    field[:, 60:67] = np.nan  # 53 of 60 left
    field[:, 120:126] = np.nan  # 54 left
    hours = ingest(day(tmp_path, "a", "2016-01-01", field), cadence="hour")
    contracts.check(hours, "observatory-series/1")
    assert str(hours.time.values[0]) == "2016-01-01T00:29:30.000000000"
    expected = [field[0, :60].mean(), np.nan, field[0, 126:180].mean(), field[0, 180:].mean()]
    np.testing.assert_allclose(hours.field_north.values, expected, rtol=1e-14)
    partly = np.uint8(RecordFlag.INCOMPLETE_AVERAGE | RecordFlag.MISSING_MARK)
    assert hours.quality_flag.values.tolist() == [0, partly, partly, 0]
    assert hours.attrs["cadence_s"] == 3600.0


def test_seconds_become_hours_by_way_of_minutes() -> None:
    hours = reduce_cadence(second_series(3 * 3600), "hour")
    minutes = reduce_cadence(second_series(3 * 3600), "minute")
    assert hours.field_down.values[1] == pytest.approx(minutes.field_down.values[60:120].mean())


def test_a_series_of_the_wanted_cadence_stays_and_a_coarser_one_is_refused() -> None:
    minutes = reduce_cadence(second_series(3600), "minute")
    assert reduce_cadence(minutes, "minute") is minutes
    with pytest.raises(ParameterError, match="3600 s apart"):
        reduce_cadence(minutes.assign_attrs(cadence_s=3600.0), "minute")
