"""align-log finds known lags, drops false fixes, and puts places where they were."""

from __future__ import annotations

from typing import Any

import lagged_drive as truth
import numpy as np
import pytest
import xarray as xr
from scipy.spatial.transform import Rotation

from magtiles.catalog.flags import TrackFlag
from magtiles.catalog.kernels.geodesy import metres_per_degree
from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError, SourceError
from magtiles.stages.declare import parse_params
from magtiles.stages.vehicle.align import AlignLogParams, align_log
from magtiles.stages.vehicle.fix_gate import fix_outliers, stationary, way_of
from magtiles.stages.vehicle.lag import Samples, estimate_lag


def align(track: xr.Dataset, **params: Any) -> xr.Dataset:
    contracts.check(track, "track/1")
    params = {"antenna_ahead_m": 0.0} | params
    made = align_log(track, params=parse_params(AlignLogParams, params, where="parameters"))
    contracts.check(made, "track/1")
    return made


def seconds_of(track: xr.Dataset) -> np.ndarray:
    return (track["time"].values - truth.START) / np.timedelta64(1, "s")


def flagged(track: xr.Dataset, flag: TrackFlag) -> np.ndarray:
    return (track["quality_flag"].values & flag.value) > 0


def test_lags_without_noise() -> None:
    made = align(truth.drive(attitude_lag_s=0.037, fix_lag_s=0.180))
    assert abs(made.attrs["attitude_lag_s"] - 0.037) < 2e-7  # found 5e-8
    assert abs(made.attrs["fix_lag_s"] - 0.180) < 6e-4  # found 3.6e-4: chords of two seconds
    assert made.attrs["attitude_lag_origin"] == made.attrs["fix_lag_origin"] == "estimated"


@pytest.mark.parametrize(
    ("attitude_lag", "fix_lag"), [(-0.25, 0.4), (0.1, -0.15), (0.003, 0.0), (0.0, 0.9)]
)
def test_lags_through_noise(attitude_lag: float, fix_lag: float) -> None:
    """200 nT, 0.17 deg and 0.3 m of white noise, hard and soft iron of half the field."""
    made = align(
        truth.drive(
            attitude_lag_s=attitude_lag, fix_lag_s=fix_lag, field_noise_nt=200.0,
            fix_noise_m=0.3, attitude_noise_rad=0.003,
        )
    )  # fmt: skip
    assert abs(made.attrs["attitude_lag_s"] - attitude_lag) < 2e-4  # found 4e-5
    assert abs(made.attrs["fix_lag_s"] - fix_lag) < 4e-3  # found 1.3e-3
    assert made.attrs["attitude_lag_sigma_s"] < 1e-3
    assert made.attrs["fix_lag_sigma_s"] < 5e-3


def test_stated_sigma_covers_the_error_of_the_fix_lag() -> None:
    errors = []
    for noise in (0.2, 0.4, 0.6):
        made = align(truth.drive(fix_lag_s=0.2, fix_noise_m=noise))
        errors.append((made.attrs["fix_lag_s"] - 0.2) / made.attrs["fix_lag_sigma_s"])
    assert np.abs(errors).max() < 2.0


def test_places_and_attitude_are_those_of_the_field() -> None:
    made = align(truth.drive(attitude_lag_s=0.037, fix_lag_s=0.180))
    seconds = seconds_of(made)
    apart = truth.metres_apart(made, seconds)
    # Fixes every 0.2 s of a circle of 25 m radius: the chord lies 0.013 m inside the arc.
    assert np.nanmax(apart) < 0.02
    assert np.isfinite(apart).mean() > 0.999
    known = np.isfinite(made["attitude"].values).all(axis=1)
    assert known.mean() > 0.999
    turn = Rotation.from_quat(made["attitude"].values[known], scalar_first=True)
    wrong = (truth.attitude(seconds[known]).inv() * turn).magnitude()
    assert wrong.max() < 5e-5  # of slerp over 10 ms, at the corner where the circles end
    late = align(truth.drive(fix_lag_s=0.180), fix_lag_s=0.0)
    assert np.nanmax(truth.metres_apart(late, seconds)) > 1.4  # 8 m/s for 0.18 s


def test_lags_can_be_stated_and_the_stage_run_again() -> None:
    track = truth.drive(attitude_lag_s=0.037, fix_lag_s=0.180)
    made = align(track, attitude_lag_s=0.037, fix_lag_s=0.18)
    assert made.attrs["attitude_lag_origin"] == made.attrs["fix_lag_origin"] == "stated"
    assert "fix_lag_sigma_s" not in made.attrs
    xr.testing.assert_identical(align(made, attitude_lag_s=0.037, fix_lag_s=0.18), made)
    xr.testing.assert_equal(made["fix_time"], track["fix_time"])


def test_the_field_stands_in_where_no_attitude_is_known() -> None:
    """On flat ground. Hills of 3 degrees tilt 2,500 nT of the vertical field into it: refused."""
    found = {}
    for hills in (0.0, 1.0):
        track = truth.drive(fix_lag_s=0.3, field_noise_nt=200.0, fix_noise_m=0.2, hills=hills)
        made = align(track.drop_dims("attitude_sample").drop_vars("attitude"))
        assert "attitude_lag_s" not in made.attrs
        found[hills] = made.attrs
    assert abs(found[0.0]["fix_lag_s"] - 0.3) < 4e-3
    assert found[1.0]["fix_lag_origin"] == "not observable"


def with_antenna_ahead(track: xr.Dataset, metres: float) -> xr.Dataset:
    """The fixes moved forward along the body's axis."""
    heading = truth.heading((track["fix_time"].values - truth.START) / np.timedelta64(1, "s"))
    per_latitude, per_longitude = metres_per_degree(np.array(truth.ORIGIN[0]), 0.0)
    return track.assign(
        fix_latitude=track["fix_latitude"] + metres * np.cos(heading) / per_latitude,
        fix_longitude=track["fix_longitude"] + metres * np.sin(heading) / per_longitude,
    )


@pytest.mark.parametrize("has_attitude", [True, False])
def test_an_antenna_ahead_of_the_axle_is_no_lag(has_attitude: bool) -> None:
    """Its course leads in turns: by 1.8 m / 8 m/s, did the fit not know of it."""
    track = with_antenna_ahead(truth.drive(hills=0.0, field_noise_nt=200.0, fix_noise_m=0.2), 1.8)
    if not has_attitude:
        track = track.drop_dims("attitude_sample").drop_vars("attitude")
    assert abs(align(track, antenna_ahead_m=1.8).attrs["fix_lag_s"]) < 6e-3  # found 3e-3
    assert align(track).attrs["fix_lag_s"] == pytest.approx(-1.8 / 8.0, abs=0.02)


def test_the_lag_of_fixes_is_not_guessed_without_the_antennas_place(
    caplog: pytest.LogCaptureFixture,
) -> None:
    made = align(truth.drive(fix_lag_s=0.18), antenna_ahead_m=None)
    assert made.attrs["fix_lag_s"] == 0.0
    assert made.attrs["fix_lag_origin"] == "not observable"
    assert "'antenna_ahead_m' is not stated" in caplog.text
    assert "state it with 'fix_lag_s'" in caplog.text


def test_what_cannot_be_told_is_said(caplog: pytest.LogCaptureFixture) -> None:
    track = truth.drive()
    straight = track.assign(field_body=track["field_body"] * 0.0 + truth.FIELD_NED)
    made = align(straight.assign(field_body=straight["field_body"].assign_attrs(units="nT")))
    assert made.attrs["attitude_lag_s"] == 0.0
    assert made.attrs["attitude_lag_origin"] == "not observable"
    assert "the lag of the attitude cannot be told" in caplog.text
    noise = np.random.default_rng(4).normal(size=(500, 3))
    seconds = np.arange(500) * 0.1
    turns = Samples(seconds, np.random.default_rng(5).normal(size=(500, 3)), 2.0)
    assert estimate_lag(Samples(seconds, noise, 2.0), turns, max_lag_s=1.0) is None


def test_false_fixes_are_left_out_and_their_rows_flagged() -> None:
    track = truth.drive(fix_noise_m=0.3)
    clean = align(track, attitude_lag_s=0.0, fix_lag_s=0.0)
    assert not flagged(clean, TrackFlag.FIX_OUTLIER).any()
    fixes = track["fix_latitude"].values.copy()
    wrong = [100, 400, 401, 402, 900]  # one alone, three in a row, one while circling slowly
    fixes[wrong] += np.array([5.0, 40.0, 41.0, 39.0, -300.0]) / 111_000
    made = align(
        track.assign(fix_latitude=("fix", fixes, track["fix_latitude"].attrs)),
        attitude_lag_s=0.0, fix_lag_s=0.0,
    )  # fmt: skip
    seconds = seconds_of(made)
    expected = np.zeros(seconds.size, dtype=bool)
    for first, last in ((99, 101), (399, 403), (899, 901)):
        expected |= (seconds > first / 5) & (seconds <= last / 5)
    np.testing.assert_array_equal(flagged(made, TrackFlag.FIX_OUTLIER), expected)
    assert np.nanmax(truth.metres_apart(made, seconds)) < 2.0


def test_outliers_by_speed_where_fixes_are_far_apart() -> None:
    time = truth.stamps(np.arange(0.0, 3600.0, 60.0))
    latitude = 45.0 + np.arange(60) * 1e-3
    latitude[30] += 0.5
    way = way_of(time, latitude, np.full(60, 9.0))
    wrong = fix_outliers(way, np.full(60, np.nan), max_speed=30.0, max_acceleration=5.0)
    assert np.flatnonzero(wrong).tolist() == [30]


def test_standing_still_is_flagged_in_spite_of_noise() -> None:
    made = align(truth.drive(fix_noise_m=0.3), fix_lag_s=0.0, attitude_lag_s=0.0)
    still = flagged(made, TrackFlag.STATIONARY)
    seconds = seconds_of(made)
    assert not still[seconds < truth.STANDS_FROM_S - 2.0].any()
    fixed = (
        seconds
        < made["fix_time"].values[-1].astype(np.int64) * 1e-9 - truth.START.astype(np.int64) * 1e-9
    )
    assert still[(seconds > truth.STANDS_FROM_S + 1.0) & fixed].all()


def test_a_way_too_short_for_the_window_does_not_stand() -> None:
    way = way_of(truth.stamps(np.array([0.0, 1.0])), np.full(2, 45.0), np.full(2, 9.0))
    assert not stationary(way, np.array([0.5]), speed=1.0, window_s=5.0).any()


def test_invalid_fixes_and_gaps_are_flagged() -> None:
    track = truth.drive()
    status = track["fix_status"].values.copy()
    status[200:260] = -1  # twelve seconds
    kept = np.ones(status.size, dtype=bool)
    kept[600:650] = False  # ten
    made = align(
        track.assign(fix_status=("fix", status)).isel(fix=kept), fix_lag_s=0.0, attitude_lag_s=0.0
    )
    seconds = seconds_of(made)
    lost = (seconds > 39.8) & (seconds < 52.0)
    gap = (seconds > 119.8) & (seconds < 130.0)
    np.testing.assert_array_equal(flagged(made, TrackFlag.POSITION_GAP), gap)
    outside = seconds > 299.8
    np.testing.assert_array_equal(flagged(made, TrackFlag.NO_FIX), lost | outside)
    np.testing.assert_array_equal(np.isnan(made["latitude"]), lost | gap | outside)


def test_a_lever_arm_moves_places_with_the_attitude() -> None:
    """An arm straight ahead: displaced along the heading, by its length."""
    track = truth.drive()
    plain = align(track, fix_lag_s=0.0, attitude_lag_s=0.0)
    moved = align(track, fix_lag_s=0.0, attitude_lag_s=0.0, lever_arm_m=[2.0, 0.0, 0.0])
    level = seconds_of(plain) > truth.STANDS_FROM_S  # it stands level
    heading = truth.heading(np.array([truth.STANDS_FROM_S]))[0]
    north = (moved["latitude"] - plain["latitude"]).values[level] * 111_131.8
    np.testing.assert_allclose(north[np.isfinite(north)], 2.0 * np.cos(heading), atol=2e-4)
    with pytest.raises(SourceError, match="'lever_arm_m' needs the attitude"):
        align(track.drop_dims("attitude_sample"), fix_lag_s=0.0, lever_arm_m=[1.0, 0.0, 0.0])


def test_axes_are_turned_once() -> None:
    track = truth.drive()
    made = align(track, sensor_to_body="forward,left,up", fix_lag_s=0.0)
    np.testing.assert_array_equal(made["field_body"], track["field_body"] * [1.0, -1.0, -1.0])
    with pytest.raises(ContractError, match="already applied"):
        align(made, sensor_to_body="forward,left,up")


def test_rows_with_their_own_places_keep_them_and_are_judged() -> None:
    seconds = np.arange(0.0, 100.0)
    latitude = 45.0 + np.minimum(seconds, 60.0) * 1e-4
    latitude[20] += 0.01
    track = xr.Dataset(
        {
            "latitude": ("time", latitude, {"units": "degrees_north"}),
            "longitude": ("time", np.full(100, 9.0), {"units": "degrees_east"}),
            "height": ("time", np.zeros(100), {"units": "m"}),
            "field_total": ("time", np.full(100, 48e3), {"units": "nT"}),
        },
        coords={"time": truth.stamps(seconds)},
        attrs={"height_reference": "ellipsoid", "source": "line"},
    )
    made = align(track)
    np.testing.assert_array_equal(made["latitude"], latitude)
    assert np.flatnonzero(flagged(made, TrackFlag.FIX_OUTLIER)).tolist() == [20]
    assert np.flatnonzero(flagged(made, TrackFlag.STATIONARY)).tolist() == list(range(63, 100))
