"""Stage resample-by-distance against drives along a road whose field and length are known."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import xarray as xr
from roads import CORE, PLANE, Road, Trip, Vehicle, drive, follow, turned

from magtiles.catalog.flags import RoadFlag, TrackFlag, flag_attributes
from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError, CoverageError, ParameterError
from magtiles.stages.declare import parse_params
from magtiles.stages.road.directions import field_at_heading
from magtiles.stages.road.motion import motion_of
from magtiles.stages.road.resample import ResampleParams, resample_by_distance

ROAD = Road()
SHORT = Road(length_m=400.0, dipoles=80)


def resample(track: xr.Dataset, onto: xr.Dataset | None = None, **params: object) -> xr.Dataset:
    contracts.check(track, "track/1")
    parsed = parse_params(ResampleParams, params, where="test")
    made = resample_by_distance(track, params=parsed, road=onto)
    contracts.check(made, "road-map/1")
    return made


def flagged(made: xr.Dataset, flag: RoadFlag) -> np.ndarray:
    return (made["quality_flag"].values & int(flag)) != 0


@pytest.mark.parametrize("spacing", [0.5, 1.0, 3.0, 2.7])
def test_points_are_equally_spaced_and_hold_the_field(spacing: float) -> None:
    made = resample(drive(ROAD), spacing_m=spacing)
    np.testing.assert_allclose(np.diff(made["distance"]), spacing, rtol=1e-12)
    assert made["distance"].values[0] == 0.0
    true = ROAD.distance_of(made["latitude"].values, made["longitude"].values)
    error = made["field_body"].values - ROAD.body_field(true)
    # The lane and the receiver's 1.2 m make 100 to 150 nT; one point in a hundred meets steel.
    assert np.median(np.abs(error)) < 150.0
    assert np.corrcoef(made["field_body"][:, 2], ROAD.body_field(true)[:, 2])[0, 1] > 0.9


@pytest.mark.parametrize("wheels", [True, False])
def test_length_is_the_road_s_within_a_thousandth(wheels: bool) -> None:
    for seed in (1, 2, 3):
        trip = Trip(seed=seed, wheels=wheels, fix_drift_m=0.0, fix_noise_m=0.5, weave_m=0.0)
        made = resample(drive(ROAD, Vehicle(wheel_scale=1.012), trip))
        # Measured: 0.1 to 0.8 m of 1500 m.
        assert made.attrs["length_m"] == pytest.approx(ROAD.length_m, abs=2.0)
        if wheels:
            assert made.attrs["wheel_scale"] == pytest.approx(1.012, abs=0.002)


@pytest.mark.parametrize("wheels", [True, False])
def test_time_spent_standing_changes_neither_size_nor_values(wheels: bool) -> None:
    track = drive(SHORT, trip=Trip(stops=((200.0, 10.0),), wheels=wheels, fix_noise_m=0.0))
    short, long = resample(track), resample(_held(track, 300.0))
    assert short.sizes == long.sizes
    # Measured: nothing with wheels; without, where the stop ends is seen anew: 58 nT at most.
    difference = float(np.abs(short["field_body"] - long["field_body"]).max())
    assert difference < (1e-6 if wheels else 100.0)
    np.testing.assert_allclose(long["samples"], short["samples"], atol=2)


def _held(track: xr.Dataset, seconds: float) -> xr.Dataset:
    """The track with its vehicle standing so much longer, at the same place."""
    place = PLANE.metres(track["latitude"].values, track["longitude"].values)
    moved = np.linalg.norm(place[250:] - place[:-250], axis=1)
    row = int(np.argmin(moved)) + 125
    extra = int(50 * seconds)
    made = track.isel(time=np.r_[0:row, np.full(extra, row), row : track.sizes["time"]])
    time = track["time"].values[0] + np.arange(made.sizes["time"]) * np.timedelta64(20, "ms")
    return made.assign_coords(time=time)


def test_jitter_at_a_light_is_no_distance() -> None:
    for wheels in (True, False):
        trip = Trip(stops=((200.0, 300.0),), fix_noise_m=1.5, fix_drift_m=1.5, wheels=wheels)
        made = resample(drive(SHORT, trip=trip))
        # Measured: up to 6 m with wheels, 11 m without, by the receiver's drift; its jitter alone
        # runs to over 5 km.
        assert made.attrs["length_m"] == pytest.approx(400.0, abs=8.0)


def test_samples_speed_and_heading_are_kept() -> None:
    made = resample(drive(ROAD))
    true = ROAD.distance_of(made["latitude"].values, made["longitude"].values)
    assert made["samples"].values.mean() == pytest.approx(
        50.0 / made["speed"].values.mean(), rel=0.1
    )
    course = np.interp(true, ROAD.distance, ROAD.course)
    away = (np.radians(made["heading"].values) - course + np.pi) % (2 * np.pi) - np.pi
    assert np.degrees(np.abs(away)).max() < 6.0
    assert (made["passes"] == 1).all()
    assert flagged(made, RoadFlag.SINGLE_PASS).all()


def test_empty_cells_are_interpolated_and_sparse_samples_flagged() -> None:
    slow = resample(drive(SHORT, trip=Trip(rate_hz=10.0, speed_m_s=14.0)))
    assert flagged(slow, RoadFlag.INTERPOLATED).any()
    np.testing.assert_array_equal(flagged(slow, RoadFlag.INTERPOLATED), slow["samples"].values == 0)
    assert not flagged(slow, RoadFlag.UNDERSAMPLED).any()  # 1.4 m apart
    fast = resample(drive(SHORT, trip=Trip(rate_hz=5.0, speed_m_s=22.0)))
    assert flagged(fast, RoadFlag.UNDERSAMPLED).mean() > 0.9  # 4.4 m apart
    assert flagged(resample(drive(SHORT), spacing_m=4.0), RoadFlag.UNDERSAMPLED).all()


def test_a_gap_is_flagged_where_it_is_and_refused_where_it_is_long() -> None:
    track = drive(SHORT)
    made = resample(track)
    row = int(np.searchsorted(made["distance"], 200.0))
    second = 50 * 14
    short = track.isel(time=np.r_[0:second, second + 60 : track.sizes["time"]])
    gap = flagged(resample(short), RoadFlag.UNDERSAMPLED)
    assert 10 <= gap.sum() <= 25
    assert row > 0
    long = track.isel(time=np.r_[0:second, second + 300 : track.sizes["time"]])
    with pytest.raises(CoverageError, match=r"no sample for \d+ m after 2011.*part"):
        resample(long)


def test_doubtful_places_are_flagged() -> None:
    track = drive(SHORT)
    flags = np.zeros(track.sizes["time"], np.uint16)
    flags[300:900] = TrackFlag.NO_FIX
    attrs = flag_attributes(TrackFlag, np.uint16)
    lost = track.assign(quality_flag=("time", flags, attrs))
    lost["latitude"].values[300:900] = np.nan
    made = resample(lost)
    assert 100 < flagged(made, RoadFlag.POSITION_DOUBTFUL).sum() < 250
    assert np.isfinite(made["latitude"]).all()


@pytest.mark.parametrize("backward", [False, True])
def test_a_pass_is_laid_onto_a_known_road(backward: bool) -> None:
    road = resample(drive(ROAD), road="main")
    trip = Trip(seed=2, backward=backward, start_m=300.0, end_m=1200.0, stops=((600.0, 20.0),))
    made = resample(drive(ROAD, trip=trip), road)
    assert made.attrs["road"] == "main"
    assert made.attrs["direction"] == ("backward" if backward else "forward")
    where = made["distance"].values
    np.testing.assert_allclose(where % 1.0, 0.0, atol=1e-9)
    assert where[0] == pytest.approx(300.0, abs=8.0)
    assert where[-1] == pytest.approx(1200.0, abs=8.0)
    # The same distance is the same place, within what two receivers differ.
    true = ROAD.distance_of(made["latitude"].values, made["longitude"].values)
    mapped = ROAD.distance_of(road["latitude"].values, road["longitude"].values)
    away = true - np.interp(where, road["distance"], mapped)
    assert np.abs(away).max() < 2.5


def test_a_loop_keeps_its_origin() -> None:
    block = np.array([[0, 0], [300, 0], [300, 200], [0, 200], [0, 0]], float)
    road = resample(follow(block))
    again = resample(follow(block + 0.5), road)
    assert again["distance"].values[0] <= 2.0
    assert again.attrs["length_m"] == pytest.approx(road.attrs["length_m"], abs=3.0)


@pytest.mark.parametrize("direction", ["forward", "backward"])
def test_of_a_drive_out_and_back_either_way_can_be_asked_for(direction: str) -> None:
    out_and_back = np.array([(0.0, 0.0), (400.0, 0.0), (400.0, 8.0), (0.0, 8.0)])
    road = resample(follow(out_and_back), part=0)
    made = resample(follow(out_and_back), road, direction=direction)
    assert made.attrs["direction"] == direction
    assert made.attrs["length_m"] == pytest.approx(400.0, abs=8.0)
    # A map's direction is that along the road's distance, also where the road is such a map.
    again = resample(follow(out_and_back), made, direction=direction)
    assert again.attrs["direction"] == direction
    with pytest.raises(CoverageError, match="'road', driven backward"):
        resample(follow(out_and_back[:2]), road, direction="backward")


def test_the_other_direction_follows_from_the_heading() -> None:
    track = drive(SHORT, trip=Trip(fix_drift_m=0.0, fix_noise_m=0.05, weave_m=0.0))
    yaw = np.interp(np.arange(track.sizes["time"]), *_yaw(track))
    quaternion = np.column_stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)])
    made = resample(track.assign(attitude=(("time", "quaternion"), quaternion, {"units": "1"})))
    assert made.attrs["heading_source"] == "attitude"
    back = resample(
        drive(SHORT, trip=Trip(backward=True, fix_drift_m=0.0, fix_noise_m=0.05, weave_m=0.0)), made
    )
    seen = field_at_heading(made, made["heading"].values + 180.0)
    first, last = back["distance"].values[[0, -1]]
    both = (made["distance"].values >= first) & (made["distance"].values <= last)
    difference = seen[both] - back["field_body"].values
    # Measured: 30 nT, where forward and right change by 40,000 nT.
    assert np.median(np.abs(difference)) < 60.0
    with pytest.raises(ContractError, match=r"heading is that of the course"):
        field_at_heading(back, back["heading"].values)


def _yaw(track: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    motion = motion_of(track, position_sigma_m=0.1, standstill_m_s=0.3)
    rows = np.searchsorted(motion.seconds_of(track["time"].values), motion.seconds)
    return rows, np.unwrap(np.arctan2(motion.velocity[:, 1], motion.velocity[:, 0]))


def test_a_few_false_fixes_are_left_out() -> None:
    track = drive(SHORT)
    true = resample(track)
    for row in (200, 500, 800):
        track["latitude"].values[row : row + 10] += 0.002  # 220 m
    made = resample(track)
    assert made.attrs["length_m"] == pytest.approx(true.attrs["length_m"], abs=1.0)


class Refused(NamedTuple):
    id: str
    change: object
    error: type[Exception]
    message: str


def _stand(track: xr.Dataset) -> xr.Dataset:
    for name in ("latitude", "longitude"):
        track[name].values[:] = track[name].values[0]
    track["speed"].values[:] = 0.0
    return track


def _jump(track: xr.Dataset) -> xr.Dataset:
    track["latitude"].values[400:] += 0.05
    return track


def _leap(track: xr.Dataset) -> xr.Dataset:
    track["latitude"].values[600:] += 0.05
    return track.drop_vars("speed")


REFUSED = [
    Refused("stands", _stand, CoverageError, "the vehicle stands throughout"),
    Refused("jumps", _jump, ContractError, r"the places jump: \d+ of \d+ fixes.*2011"),
    Refused("leaps", _leap, ContractError, r"the places jump: \d+ m/s at 2011"),
    Refused(
        "scalar",
        lambda t: t.drop_vars("field_body").assign(
            field_total=("time", np.full(t.sizes["time"], 5e4), {"units": "nT"})
        ),
        ContractError,
        "'field_body' is missing",
    ),
    Refused(
        "no fix", lambda t: t.assign(latitude=t["latitude"] * np.nan), CoverageError, "0 of its"
    ),
]


@pytest.mark.parametrize("case", REFUSED, ids=lambda case: case.id)
def test_what_is_no_drive_is_refused(case: Refused) -> None:
    track = drive(SHORT)
    names = {"latitude": "degrees_north"}
    changed = case.change(track)  # type: ignore[operator]
    for name, unit in names.items():
        changed[name].attrs["units"] = unit
    with pytest.raises(case.error, match=case.message):
        resample(changed)


def test_a_road_shorter_than_the_spacing_is_refused() -> None:
    with pytest.raises(CoverageError, match=r"road is 400\.?\d* m long|road is \d+\.\d+ m long"):
        resample(drive(SHORT), spacing_m=900.0, max_gap_m=1e4)


def test_another_road_and_another_spacing_are_refused() -> None:
    road = resample(drive(SHORT), road="main")
    with pytest.raises(ContractError, match=r"spacing is 1 m.*2 m"):
        resample(drive(SHORT), road, spacing_m=2.0)
    with pytest.raises(ContractError, match="the road is 'main', not 'side'"):
        resample_by_distance(drive(SHORT), params=ResampleParams(road="side"), road=road)
    away = drive(SHORT)
    away["latitude"].values[:] += 0.01
    with pytest.raises(CoverageError, match="does not keep to road 'main'"):
        resample(away, road)


def test_parts_of_a_drive() -> None:
    track = follow(np.array([[0, 0], [300, 0], [300, 300]], float))
    second = resample(track, part=1)
    assert second.attrs["length_m"] == pytest.approx(297.0, abs=4.0)
    np.testing.assert_allclose(second["heading"][15:], 90.0, atol=4.0)
    east = turned(CORE[None], np.array([np.pi / 2]))[0]
    np.testing.assert_allclose(second["field_body"][50], east, atol=100.0)
    with pytest.raises(ParameterError, match=r"part is 5, and the parts of the drive are.*0 to 1"):
        resample(track, part=5)


def test_uncalibrated_is_said() -> None:
    raw = drive(SHORT)
    del raw.attrs["calibration"]
    made = resample(raw)
    assert made.attrs["calibrated"] == "false"
    assert flagged(made, RoadFlag.UNCALIBRATED).all()
    assert resample(raw, calibrated=True).attrs["calibrated"] == "true"


def comma2k19(folder: Path) -> tuple[xr.Dataset, float]:
    """The minute's track/1, and the distance of its wheel odometry, m."""

    def stream(name: str) -> tuple[np.ndarray, np.ndarray]:
        base = folder / "drive_comma2k19/processed_log" / name
        return np.load(base / "t.npy"), np.load(base / "value.npy")

    time, field = stream("IMU/magnetometer")
    fixed, fixes = stream("GNSS/live_gnss_ublox")
    rolled, speed = stream("CAN/speed")
    inside = (time >= fixed[0]) & (time <= fixed[-1])
    time, field = time[inside], field[inside]
    utc = np.median(1e6 * fixes[:, 3] - 1e9 * fixed)
    column = {"latitude": 0, "longitude": 1, "height": 4}
    units = {"latitude": "degrees_north", "longitude": "degrees_east", "height": "m"}
    wheel = np.interp(time, rolled, speed[:, 0])
    track = xr.Dataset(
        {
            **{
                name: ("time", np.interp(time, fixed, fixes[:, i]), {"units": units[name]})
                for name, i in column.items()
            },
            "field_body": (("time", "axis"), 1e3 * field, {"units": "nT"}),
            "speed": ("time", wheel, {"units": "m s-1"}),
        },
        coords={"time": (1e9 * time + utc).astype("int64").astype("datetime64[ns]")},
        attrs={"height_reference": "ellipsoid", "source": "comma2k19"},
    )
    return track, float(np.sum(np.diff(time) * (wheel[1:] + wheel[:-1]) / 2.0))


@pytest.mark.parametrize("wheels", [True, False])
def test_a_real_minute_is_as_long_as_the_wheels_say(real_data: Path, wheels: bool) -> None:
    track, rolled = comma2k19(real_data)
    made = resample(track if wheels else track.drop_vars("speed"), vehicle="comma")
    # Measured: 1008 m, the fixes alone 1009 m, where the wheels say 999.6 m: 0.8 % less.
    assert made.attrs["length_m"] == pytest.approx(rolled, rel=0.01)
    assert made.attrs["calibrated"] == "false"
    assert flagged(made, RoadFlag.UNCALIBRATED).all()
    # 10 Hz at 17 m/s: a sample every 1.7 m.
    assert not flagged(made, RoadFlag.UNDERSAMPLED).any()
    assert 0.3 < flagged(made, RoadFlag.INTERPOLATED).mean() < 0.5
