"""The variation along a track: from a record with known variation, and from known curves."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from daily import MEAN_FIELD, Floats, daily, gauss_markov, quiet_curve, quiet_list, record, times

from magtiles.catalog.flags import TrackFlag, flag_attributes
from magtiles.catalog.models import evaluate
from magtiles.pipeline.artifacts import write_artifact
from magtiles.pipeline.commands.run import find_stage
from magtiles.pipeline.runner import run_stage
from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError, CoverageError
from magtiles.stages.field.core_field import RemoveCoreFieldParams, remove_from_track
from magtiles.stages.ingest.field_model import igrf
from magtiles.stages.temporal.baseline import QuietDayBaselineParams, quiet_day_baseline
from magtiles.stages.temporal.diurnal import (
    BASELINE_STAGE,
    RECORD_STAGE,
    SubtractBaselineParams,
    SubtractRecordParams,
    subtract_baseline,
    subtract_record,
)

STATION = -105.237
DATUM = 51_500.0
LIST = quiet_list({f"2024-{m:02d}": list(range(4, 14)) for m in (1, 2)})
Build = Callable[[], Any]


def flight(
    start: str = "2024-01-15T14:00:13.7",
    hours: float = 6.0,
    count: int = 900,
    longitude: float = STATION,
    latitude: float = 40.0,
) -> xr.Dataset:
    """A track/1 at times between those of any record, eastward over a degree."""
    at = np.linspace(0.0, hours * 3600e9, count).astype("m8[ns]")
    lon = longitude + np.linspace(0.0, 1.0, count)
    return xr.Dataset(
        {
            "latitude": ("time", np.full(count, latitude), {"units": "degrees_north"}),
            "longitude": ("time", lon, {"units": "degrees_east"}),
            "height": ("time", np.full(count, 2500.0), {"units": "m"}),
            "field_total": ("time", np.full(count, 52_000.0), {"units": "nT"}),
        },
        coords={"time": np.datetime64(start, "ns") + at},
        attrs={"height_reference": "ellipsoid", "source": "flight of tests"},
    )


def sunny(time: np.ndarray, longitude: float) -> Floats:
    """Total field of the quiet curve at a longitude (time,)."""
    return np.linalg.norm(MEAN_FIELD[:, None] + daily(time, longitude), axis=0)


def station(start: str = "2024-01-14", end: str = "2024-01-17", cadence_s: float = 60.0) -> Any:
    time = times(start, end, cadence_s)
    vector = MEAN_FIELD[:, None] + daily(time, STATION)
    return record(time, vector, cadence_s=cadence_s)


def by_record(track: xr.Dataset, series: xr.Dataset | None = None, **params: Any) -> xr.Dataset:
    series = station() if series is None else series
    made = subtract_record(series, track, params=SubtractRecordParams(**params))
    contracts.check(made, RECORD_STAGE.output)
    return made


def test_the_record_is_read_at_the_track_s_time() -> None:
    track = flight()
    made = by_record(track, datum_nt=DATUM)
    truth = sunny(track["time"].values, STATION) - DATUM
    # Linear over a minute of a curve that turns over hours: measured 4.4e-5 nT.
    assert np.abs(made["diurnal"].values - truth).max() < 1e-4
    np.testing.assert_array_equal(made["field_total"], track["field_total"])
    assert not made["quality_flag"].values.any()
    assert "total field of BOU less 51500.00 nT" in made["diurnal"].attrs["long_name"]
    of_median = by_record(track)["diurnal"].values
    own = float(np.median(station()["field_total"].values))
    np.testing.assert_allclose(of_median, made["diurnal"].values + DATUM - own, atol=1e-9)


def test_a_lag_reads_the_record_earlier() -> None:
    track = flight()
    made = by_record(track, datum_nt=DATUM, lag_s=754.0)
    truth = sunny(track["time"].values - np.timedelta64(754, "s"), STATION) - DATUM
    assert np.abs(made["diurnal"].values - truth).max() < 1e-4


@pytest.mark.parametrize("longitude", [STATION - 11.0, STATION + 7.0, 250.0, -179.5])
def test_local_time_reads_it_where_the_sun_stands_alike(longitude: float) -> None:
    track = flight(longitude=longitude)
    made = by_record(track, datum_nt=DATUM, local_time=True)
    truth = sunny(track["time"].values, track["longitude"].values) - DATUM
    assert np.abs(made["diurnal"].values - truth).max() < 1e-4
    by_universal_time = by_record(track, datum_nt=DATUM)["diurnal"].values
    # By UTC it is 0.9 nT wrong some degrees away, and more farther.
    assert np.abs(by_universal_time - truth).max() > 0.8


def test_gaps_are_bridged_up_to_a_limit_and_flagged_beyond(
    caplog: pytest.LogCaptureFixture,
) -> None:
    series = station(end="2024-01-15T19:00")
    time = series["time"].values
    total = series["field_total"].values.copy()
    for start, minutes in (("2024-01-15T15:00", 1), ("2024-01-15T16:00", 2)):
        first = np.datetime64(start, "ns")
        total[(time >= first) & (time < first + np.timedelta64(minutes, "m"))] = np.nan
    series["field_total"] = ("time", total, {"units": "nT"})
    track = flight()
    track["longitude"][5] = np.nan
    with caplog.at_level(logging.WARNING):
        made = by_record(track, series)
    at = track["time"].values
    lost = (at > np.datetime64("2024-01-15T15:59")) & (at < np.datetime64("2024-01-15T16:02"))
    lost |= at > np.datetime64("2024-01-15T18:59")
    np.testing.assert_array_equal(np.isnan(made["diurnal"].values), lost)
    np.testing.assert_array_equal(np.isnan(made["diurnal_uncertainty"].values), lost)
    np.testing.assert_array_equal(made["quality_flag"].values, lost * TrackFlag.NO_DIURNAL)
    assert f"{lost.sum()} of 900 samples of the track have no diurnal" in caplog.text
    wider = by_record(track, series, longest_gap_s=180.0)
    assert np.isnan(wider["diurnal"].values).sum() == (at > np.datetime64("2024-01-15T18:59")).sum()
    assert np.isnan(by_record(track, series, local_time=True)["diurnal"].values[5])


def test_flags_of_the_track_stay() -> None:
    track = flight(start="2024-01-16T22:00:00")
    flag = np.full(900, TrackFlag.MANOEUVRE, np.uint16)
    track["quality_flag"] = ("time", flag, flag_attributes(TrackFlag, np.uint16))
    first = by_record(track)
    lost = np.isnan(first["diurnal"].values)
    assert 0 < lost.sum() < 900
    expected = TrackFlag.MANOEUVRE + lost * TrackFlag.NO_DIURNAL
    np.testing.assert_array_equal(first["quality_flag"].values, expected)
    # A longer record later replaces the variation, and the flag with it.
    second = by_record(first, station(end="2024-01-18"))
    np.testing.assert_array_equal(second["quality_flag"].values, flag)


def test_the_uncertainty_between_samples_is_honest() -> None:
    # A random walk known each five minutes, asked anywhere between: errors over their sigma.
    ratios = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        fine = times("2024-01-14", "2024-01-17", 1.0)
        walk = gauss_markov(rng, fine.size, 1.0, 20.0, 36_000.0)
        series = record(
            fine[::300], MEAN_FIELD[:, None] + np.zeros(fine[::300].size),
            total=DATUM + walk[::300], cadence_s=300.0,
        )  # fmt: skip
        track = flight(count=4000)
        made = by_record(track, series, datum_nt=DATUM)
        at = (track["time"].values - fine[0]) / np.timedelta64(1, "s")
        error = made["diurnal"].values - np.interp(at, np.arange(fine.size), walk)
        sigma = made["diurnal_uncertainty"].values
        ratios.append(np.mean((error / sigma) ** 2))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.1)  # measured 0.97
    assert sigma.max() == pytest.approx(1.25, abs=0.1)
    wide = by_record(track, series, uncertainty_nt=3.0)["diurnal_uncertainty"].values
    np.testing.assert_allclose(wide, np.hypot(sigma, 3.0))


def test_the_anomaly_lacks_the_diurnal_whichever_comes_first() -> None:
    track = flight()
    crust = 80.0 * np.sin(np.linspace(0.0, 30.0, 900))
    core = np.linalg.norm(
        evaluate(igrf(), track["latitude"], track["longitude"], 2500.0, track["time"].values),
        axis=-1,
    )
    variation = sunny(track["time"].values, STATION) - DATUM
    track["field_total"] = ("time", core + crust + variation, {"units": "nT"})
    before = by_record(track, datum_nt=DATUM)
    one = remove_from_track(before, params=RemoveCoreFieldParams())
    other = by_record(remove_from_track(track, params=RemoveCoreFieldParams()), datum_nt=DATUM)
    for made in (one, other, by_record(one, datum_nt=DATUM)):
        contracts.check(made, "track-anomaly/1")
        assert np.abs(made["magnetic_anomaly"].values - crust).max() < 1e-4
        assert made.attrs["anomaly_definition"].count(", less the diurnal variation") == 1


def test_a_base_station_s_whole_field_is_no_variation() -> None:
    track = flight().assign(diurnal=("time", np.full(900, 51_510.0), {"units": "nT"}))
    with pytest.raises(ContractError, match=r"diurnal: its median is 51510 nT; .*base station"):
        remove_from_track(track, params=RemoveCoreFieldParams())


def curves(latitude: float = 40.137, longitude: float = STATION, code: str = "BOU") -> xr.Dataset:
    """A model of January and February 2024 with standard errors of 1.5 nT."""
    time = times("2024-01-01", "2024-03-02", 300.0)
    series = record(
        time, MEAN_FIELD[:, None] + daily(time, longitude), code=code, latitude=latitude,
        longitude=longitude, cadence_s=300.0,
    )  # fmt: skip
    model = quiet_day_baseline(series, params=QuietDayBaselineParams(), index=LIST)
    error = model["baseline_standard_error"]
    return model.assign(baseline_standard_error=error.copy(data=np.full(error.shape, 1.5)))


def with_classes(model: xr.Dataset) -> xr.Dataset:
    shape, of_class = (1, 4, 1), ("observatory", "element", "class")
    return model.assign(
        class_kp=("class", np.array([-1], np.int8)),
        class_season=("class", np.array([-1], np.int8)),
        class_local_time=("class", np.array([-1], np.int8)),
        class_sigma=(of_class, np.full(shape, 8.0), {"units": "nT"}),
        class_tau=(of_class, np.full(shape, 900.0), {"units": "s"}),
        class_segments=(of_class, np.full(shape, 99, np.int32)),
    )


def by_curves(track: xr.Dataset, model: xr.Dataset) -> xr.Dataset:
    made = subtract_baseline(model, track, params=SubtractBaselineParams())
    contracts.check(made, BASELINE_STAGE.output)
    return made


def test_quiet_curves_lie_along_the_track_s_core_field() -> None:
    track = flight(start="2024-01-20T14:00", longitude=STATION - 30.0, latitude=35.0)
    made = by_curves(track, curves())
    time, lon = track["time"].values, track["longitude"].values
    core = evaluate(igrf(), track["latitude"].values, lon, 0.0, time)
    direction = core / np.linalg.norm(core, axis=-1, keepdims=True)
    minute = (time - time.astype("M8[D]")) / np.timedelta64(1, "m") + 4.0 * lon
    truth = np.sum(direction * quiet_curve(minute % 1440.0).T, axis=1)
    # Lines over five minutes of the record: measured 7e-4 nT.
    assert np.abs(made["diurnal"].values - truth).max() < 2e-3
    assert "quiet days at BOU" in made["diurnal"].attrs["long_name"]
    sigma = made["diurnal_uncertainty"].values
    # Alike in three components, so along any vector; of two months with squared weights.
    later = (time - np.datetime64("2024-01-16T12:00", "ns")) / np.timedelta64(30, "D")
    np.testing.assert_allclose(sigma, 1.5 * np.hypot(1.0 - later, later), rtol=1e-9)
    with_residual = by_curves(track, with_classes(curves()))["diurnal_uncertainty"].values
    np.testing.assert_allclose(with_residual, np.hypot(sigma, 8.0), rtol=1e-6)


def test_curves_of_another_season_or_no_place_say_nothing() -> None:
    track = flight(start="2024-02-29T21:00:00", hours=72.0)
    track["latitude"][7] = np.nan
    spring = flight(start="2024-03-16T00:00:00", hours=72.0)
    made = by_curves(track, curves())
    assert np.flatnonzero(np.isnan(made["diurnal"].values)).tolist() == [7]
    assert made["quality_flag"].values[7] == TrackFlag.NO_DIURNAL
    # Mid-February and 31 days is 17 March, 12 UTC.
    at = spring["time"].values
    lost = np.isnan(by_curves(spring, curves())["diurnal"].values)
    np.testing.assert_array_equal(lost, at > np.datetime64("2024-03-17T12:00", "ns"))
    with pytest.raises(CoverageError, match=r"has a quiet-day curve; .*2024-01 to 2024-02"):
        by_curves(flight(start="2024-07-01"), curves())


def nowhere(track: xr.Dataset) -> xr.Dataset:
    return track.assign(latitude=track["latitude"] * np.nan)


def backwards(series: xr.Dataset) -> xr.Dataset:
    return series.isel(time=slice(None, None, -1))


def empty(series: xr.Dataset) -> xr.Dataset:
    return series.assign({k: series[k] * np.nan for k in series if str(k).startswith("field_")})


BAD: dict[str, tuple[Build, type[Exception], str]] = {
    "another day": (
        lambda: by_record(flight("2024-02-20T00:00")), CoverageError,
        "record from 2024-01-14T00:00 to 2024-01-16T23:59: no sample of the track has a value of "
        "the record; expected the time of the track, 2024-02-20T00:00 to 2024-02-20T06:00"),
    "moved away by the lag": (
        lambda: by_record(flight("2024-01-14T12:00"), lag_s=86400.0), CoverageError,
        "moved by lag and local time"),
    "empty record": (lambda: by_record(flight(), empty(station())), CoverageError, "no sample of"),
    "backwards": (lambda: by_record(flight(), backwards(station())), ContractError,
        r"time\[1\]: 2024-01-16T23:58.* does not come after"),
    "no place": (lambda: by_curves(nowhere(flight()), curves()), CoverageError,
        "no sample of the track, 2024-01-15T14:00"),
    "no curves": (lambda: by_curves(flight(), curves().drop_vars("baseline")), ContractError,
        "'baseline' is missing; .*or give a record instead"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_be_subtracted(case: str) -> None:
    call, error, message = BAD[case]
    with pytest.raises(error, match=message):
        call()


def test_roles_tell_the_two_stages_apart(tmp_path: Path) -> None:
    inputs = {
        "track": (flight(), "track/1"),
        "series": (station(), "observatory-series/1"),
        "baseline": (curves(), "temporal-model/1"),
    }
    for role, (dataset, contract) in inputs.items():
        write_artifact(dataset, tmp_path / f"{role}.nc", contract)
    for role, stage in (("series", RECORD_STAGE), ("baseline", BASELINE_STAGE)):
        assert find_stage("subtract-diurnal", ["track", role]) is stage
        paths = {name: tmp_path / f"{name}.nc" for name in ("track", role)}
        made = run_stage(stage, paths, tmp_path / f"by_{role}.nc", {}).dataset
        assert made is not None
        assert np.isfinite(made["diurnal"].values).all()
