"""reduce-track against lines whose levels, noise and crossings are known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from magtiles.catalog.flags import TrackFlag, flag_attributes
from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError
from magtiles.stages.declare import parse_params
from magtiles.stages.field.core_field import RemoveCoreFieldParams, remove_from_track
from magtiles.stages.vehicle.crossings import find_crossings
from magtiles.stages.vehicle.levels import crossover_levels, misfit
from magtiles.stages.vehicle.lines import fourth_difference_noise, line_names, line_numbers
from magtiles.stages.vehicle.reduce import ReduceTrackParams, reduce_track

START = np.datetime64("2020-01-01T00:00:00", "ns")
FLIGHT_LINES, TIES, SAMPLES = 12, 4, 300


def crust(latitude: np.ndarray, longitude: np.ndarray) -> np.ndarray:
    """A smooth anomaly, nT."""
    return 80.0 * np.sin(120.0 * (latitude - 45.0)) * np.cos(90.0 * (longitude - 9.0))


def survey(levels: np.ndarray, noise: float = 0.0, west: float = 9.0) -> xr.Dataset:
    """Flight lines east and ties north, at 10 Hz, with a level of its own in each."""
    share = np.linspace(0.0, 1.0, SAMPLES)
    latitude, longitude, line = [], [], []
    for k in range(FLIGHT_LINES):
        latitude.append(45.0 + 0.1 * (k + 0.5) / FLIGHT_LINES + 1e-4 * np.sin(9 * share))
        longitude.append(west + 0.14 * share)
        line.append(np.full(SAMPLES, 100 + k))
    for k in range(TIES):
        latitude.append(45.0 - 0.01 + 0.12 * share)
        longitude.append(np.full(SAMPLES, west + 0.14 * (k + 0.5) / TIES))
        line.append(np.full(SAMPLES, 900 + k))
    at, across, lines = map(np.concatenate, (latitude, longitude, line))
    anomaly = crust(at, across - west + 9.0) + np.repeat(levels, SAMPLES)
    anomaly += noise * np.random.default_rng(8).normal(size=anomaly.size)
    across = (across + 180.0) % 360.0 - 180.0
    track = xr.Dataset(
        {
            "latitude": ("time", at, {"units": "degrees_north"}),
            "longitude": ("time", across, {"units": "degrees_east"}),
            "height": ("time", np.full(at.size, 500.0), {"units": "m"}),
            "line": ("time", lines),
            "field_total": ("time", np.full(at.size, 48e3), {"units": "nT"}),
        },
        coords={"time": START + (np.arange(at.size) * 100).astype("timedelta64[ms]")},
        attrs={"height_reference": "ellipsoid", "source": "sample"},
    )
    core = remove_from_track(track, params=RemoveCoreFieldParams())["core_field_total"].values
    return track.assign(field_total=("time", core + anomaly, {"units": "nT"}))


def reduce(track: xr.Dataset, **params: Any) -> xr.Dataset:
    contracts.check(track, "track/1")
    made = reduce_track(track, params=parse_params(ReduceTrackParams, params, where="parameters"))
    contracts.check(made, "track-anomaly/1")
    return made


NO_LEVEL = np.zeros(FLIGHT_LINES + TIES)


@pytest.mark.parametrize("west", [9.0, 179.93], ids=["europe", "date line"])
def test_every_crossing_is_found_and_no_other(west: float) -> None:
    track = survey(NO_LEVEL, west=west)
    found = find_crossings(track)
    assert found.first.size == FLIGHT_LINES * TIES
    ties = west + 0.14 * (np.arange(TIES) + 0.5) / TIES
    expected = (np.sort(np.tile(ties, FLIGHT_LINES)) + 180.0) % 360.0 - 180.0
    np.testing.assert_allclose(np.sort(found.longitude), np.sort(expected), atol=1e-9)
    assert (found.second > found.first).all()
    # Linear between samples 40 m apart: the anomaly bends by some 0.01 nT.
    anomaly = reduce(track)["magnetic_anomaly"].values
    assert np.abs(found.difference(anomaly)).max() < 0.02


def test_crossings_are_those_of_all_pairs_of_segments() -> None:
    """A winding track against the test of each segment with each other."""
    rng = np.random.default_rng(2)
    turn = np.cumsum(0.1 + rng.normal(scale=0.3, size=700))
    y, x = 0.001 * np.cumsum(np.cos(turn)), 0.001 * np.cumsum(np.sin(turn))
    track = xr.Dataset(
        {"latitude": ("time", y), "longitude": ("time", x)},
        coords={"time": START + np.arange(700).astype("timedelta64[s]")},
    )
    found = find_crossings(track, apart_s=2.0)
    expected = set()
    for i in range(699):
        for j in range(i + 2, 699):
            sides = [
                (x[b + 1] - x[b]) * (y[p] - y[b]) - (y[b + 1] - y[b]) * (x[p] - x[b])
                for b, points in ((i, (j, j + 1)), (j, (i, i + 1)))
                for p in points
            ]
            if sides[0] * sides[1] < 0 and sides[2] * sides[3] < 0:
                expected.add((i, j))
    assert len(expected) > 20
    assert set(zip(found.first.tolist(), found.second.tolist(), strict=True)) == expected


def test_flagged_rows_and_gaps_do_not_cross() -> None:
    track = survey(NO_LEVEL)
    flag = np.where(track["line"] == 900, TrackFlag.FIX_OUTLIER.value, 0).astype(np.uint16)
    attributes = flag_attributes(TrackFlag, np.uint16)
    marked = track.assign(quality_flag=("time", flag, attributes))
    assert find_crossings(marked).first.size == FLIGHT_LINES * (TIES - 1)
    kept = (track["line"] != 900) | (abs(track["latitude"] - 45.05) > 0.02)
    gap = find_crossings(track.isel(time=kept.values))
    inside = int((np.abs(0.1 * (np.arange(FLIGHT_LINES) + 0.5) / FLIGHT_LINES - 0.05) < 0.02).sum())
    assert gap.first.size == FLIGHT_LINES * TIES - inside


def test_levels_of_lines_are_recovered_from_crossings() -> None:
    levels = np.random.default_rng(5).normal(scale=20.0, size=NO_LEVEL.size)
    made = reduce(survey(levels), level="crossovers")
    expected = levels - levels.mean()  # a common level does not show where lines cross
    numbers = line_numbers(made)
    found = np.array([made["level"].values[numbers == n][0] for n in range(levels.size)])
    np.testing.assert_allclose(found, expected, atol=0.02)
    table = json.loads(made.attrs["crossover_misfit"])
    assert table["before"]["count"] == table["after"]["count"] == FLIGHT_LINES * TIES
    assert table["before"]["rms"] > 15.0
    assert table["after"]["rms"] < 0.02
    assert made.attrs["anomaly_definition"].endswith("less a level of each line from crossings")


def test_levels_bear_false_crossings() -> None:
    levels = np.random.default_rng(6).normal(scale=20.0, size=NO_LEVEL.size)
    track = survey(levels)
    crossings = find_crossings(track)
    differences = crossings.difference(reduce(track)["magnetic_anomaly"].values)
    differences[[3, 20, 33]] += [500.0, -300.0, 800.0]
    found = crossover_levels(crossings, differences, levels.size)
    np.testing.assert_allclose(found, levels - levels.mean(), atol=0.05)


def test_lines_that_cross_nothing_keep_their_level(caplog: pytest.LogCaptureFixture) -> None:
    track = survey(NO_LEVEL + 7.0)
    short = track.isel(time=(track["line"] != 103).values | (track["longitude"] < 9.01).values)
    made = reduce(short, level="crossovers")
    assert "1 of 16 lines cross no other and keep their level: 103" in caplog.text
    assert (made["level"].values[made["line"].values == 103] == 0.0).all()


@pytest.mark.parametrize(
    ("params", "expected"),
    [
        pytest.param({"level": "median"}, lambda a, n: np.full(a.size, np.median(a)), id="track"),
        pytest.param(
            {"level": "line-median"},
            lambda a, n: np.array([np.median(a[n == k]) for k in range(n.max() + 1)])[n],
            id="lines",
        ),
        pytest.param({"level_nt": 12.5}, lambda a, n: np.full(a.size, 12.5), id="constant"),
    ],
)
def test_other_levels(params: dict[str, Any], expected: Any) -> None:
    track = survey(NO_LEVEL)
    plain = reduce(track)["magnetic_anomaly"].values
    made = reduce(track, **params)
    level = expected(plain, line_numbers(track))
    np.testing.assert_allclose(made["level"], level, rtol=1e-12)
    np.testing.assert_allclose(made["magnetic_anomaly"], plain - level, atol=1e-9)
    assert "less" in made.attrs["anomaly_definition"]


def test_statistics_of_lines() -> None:
    made = reduce(survey(NO_LEVEL, noise=0.25))
    table = json.loads(made.attrs["line_statistics"])
    assert [row["line"] for row in table] == line_names(made)
    assert all(row["count"] == SAMPLES for row in table)
    first = made["magnetic_anomaly"].values[:SAMPLES]
    assert abs(table[0]["mean"] - first.mean()) < 1e-3
    assert abs(table[0]["standard_deviation"] - first.std()) < 1e-3
    assert abs(np.mean([row["noise"] for row in table]) - 0.25) < 0.02  # found 0.263


def test_fourth_differences_see_noise_and_not_the_signal() -> None:
    seconds = np.arange(20_000) * 0.1
    noise = 0.02 * np.random.default_rng(1).normal(size=seconds.size)
    signal = 100.0 * np.sin(2 * np.pi * seconds / 20.0)  # of 200 samples
    assert abs(fourth_difference_noise(seconds, signal + noise) - 0.02) < 4e-4
    uneven = np.delete(np.arange(20_000), np.arange(0, 20_000, 4))
    assert np.isnan(fourth_difference_noise(seconds[uneven], (signal + noise)[uneven]))


def test_lines_of_several_flights_are_apart() -> None:
    named = {"line": ("time", [7, 7, 8]), "flight": ("time", ["a", "b", "b"])}
    track = xr.Dataset({**named, "height": ("time", np.zeros(3))})
    assert line_names(track) == ["a/7", "b/7", "b/8"]
    assert line_numbers(track).tolist() == [0, 1, 2]
    assert line_names(track.drop_vars(["line", "flight"])) == ["all"]


def test_flags_and_the_diurnal_are_kept_and_honoured() -> None:
    track = survey(NO_LEVEL)
    flag = np.zeros(track.sizes["time"], np.uint16)
    flag[5] = TrackFlag.MANOEUVRE
    diurnal = np.full(flag.size, 3.25)
    track = track.assign(
        quality_flag=("time", flag, flag_attributes(TrackFlag, np.uint16)),
        diurnal=("time", diurnal, {"units": "nT"}),
    )
    made = reduce(track)
    np.testing.assert_array_equal(made["quality_flag"], flag)
    expected = crust(track["latitude"].values, track["longitude"].values) - 3.25
    np.testing.assert_allclose(made["magnetic_anomaly"], expected, atol=1e-8)
    assert "less the diurnal variation" in made.attrs["anomaly_definition"]


def test_a_model_can_be_given(real_data: Path) -> None:
    track = survey(NO_LEVEL)
    model = real_data / "harmonics/IGRF13.shc"
    made = reduce_track(track, params=ReduceTrackParams(), model=model)
    default = reduce(track, reference_field="IGRF-13")
    np.testing.assert_allclose(made["magnetic_anomaly"], default["magnetic_anomaly"], atol=1e-6)


def test_a_track_without_a_total_field_is_refused() -> None:
    with pytest.raises(ContractError, match="'field_total' is missing"):
        reduce_track(survey(NO_LEVEL).drop_vars("field_total"), params=ReduceTrackParams())


def test_misfit_of_nothing() -> None:
    assert misfit(np.array([np.nan])).count == 0
