"""Stage calibrate-vector: from tracks, real and made, to a calibration or a refusal."""

from __future__ import annotations

import datetime
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import ppigrf
import pytest
import xarray as xr
from calibration_tracks import (
    BIAS,
    CORE,
    GIVEN,
    LEVEL_DISTORTION,
    TOTAL,
    circles,
    track,
    tumbling,
)
from scipy.spatial.transform import Rotation

from magtiles.catalog.flags import TrackFlag, flag_attributes
from magtiles.pipeline.artifacts import open_artifact, write_artifact
from magtiles.pipeline.main import main
from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError, CoverageError, MagtilesError, ParameterError
from magtiles.stages.vehicle.calibration.calibrate import (
    CalibrateVectorParams,
    calibrate_vector,
)


def calibrate(made: xr.Dataset, **params) -> xr.Dataset:
    contracts.check(made, "track/1")
    out = calibrate_vector(made, params=CalibrateVectorParams(**params))
    contracts.check(out, "sensor-calibration/1")
    return out


def with_flags(made: xr.Dataset, flags: np.ndarray) -> xr.Dataset:
    attrs = flag_attributes(TrackFlag, np.uint16)
    return made.assign(quality_flag=("time", flags.astype(np.uint16), attrs))


def changed(made: xr.Dataset, values: np.ndarray) -> xr.Dataset:
    return made.assign(field_body=(("time", "axis"), values, {"units": "nT"}))


def whole_drive() -> np.ndarray:
    """Headings of two minutes straight, three circles in 48 s, three minutes nearly straight."""
    turn = circles()
    after = turn[-1] + 0.1 * np.sin(np.arange(9000) / 500.0)
    return 0.3 + np.concatenate([np.linspace(-0.3, 0.0, 6000), turn, after])


@pytest.mark.parametrize("attitude", [False, True], ids=["by the field", "by attitude"])
def test_circles_in_a_drive_are_found(attitude: bool) -> None:
    out = calibrate(track(whole_drive(), noise=200.0, attitude=attitude), core_field_nt=GIVEN)
    assert out.attrs["revolutions"] == pytest.approx(3.0, abs=0.12)
    start, end = (np.datetime64(out.attrs[k]) for k in ("start", "end"))
    began = track(whole_drive())["time"].values[6000]
    seconds = (np.array([start, end]) - began) / np.timedelta64(1, "s")
    assert seconds[0] < 6.0
    assert seconds[1] > 42.0
    # Measured: 0.0005 and 6 nT.
    product = out["matrix"].values @ LEVEL_DISTORTION
    np.testing.assert_allclose(product, np.eye(3), atol=0.002)
    np.testing.assert_allclose(out["bias"].values, BIAS, atol=25.0)
    assert float(out["residual_rms"]) == pytest.approx(200.0, rel=0.05)


def test_times_choose_the_circles() -> None:
    made = track(whole_drive())
    begin = str(made["time"].values[6000])[:19] + "Z"
    end = str(made["time"].values[8399])[:23]
    out = calibrate(made, core_field_nt=GIVEN, start=begin, end=end)
    assert out.attrs["samples"] == 2400
    np.testing.assert_allclose(out["matrix"].values @ LEVEL_DISTORTION, np.eye(3), atol=1e-12)
    with pytest.raises(CoverageError, match=r"turns by 0\.0 degrees"):
        calibrate(made, core_field_nt=GIVEN, end="2011-08-11T14:01:30")
    with pytest.raises(ParameterError, match="no sample lies between start and end"):
        calibrate(made, core_field_nt=GIVEN, end="2001-08-11T14:01:30")


def test_the_core_field_is_that_of_the_place_and_date() -> None:
    out = calibrate(track(circles()), method="modified-ellipsoid")
    when = datetime.datetime.fromisoformat("2011-08-11T14:00:24")
    east, north, up = ppigrf.igrf(-84.08, 39.78, 0.25, when)
    expected = [float(np.squeeze(c)) for c in (north, east, -up)]
    np.testing.assert_allclose(out.attrs["core_field_nt"], expected, atol=0.5)
    assert out.attrs["reference_field"] == "IGRF-14"


@pytest.mark.parametrize("method", ["ellipsoid", "attitude"])
def test_spikes_and_flags_do_not_count(method: str) -> None:
    made = track(*tumbling(), attitude=True)
    raw = made["field_body"].values.copy()
    raw[100:200] = [90_000.0, 0.0, 0.0]
    raw[::50] += 30_000.0
    raw[7] = np.nan
    flags = np.zeros(len(raw))
    flags[100:200] = TrackFlag.FIELD_SPIKE
    out = calibrate(with_flags(changed(made, raw), flags), method=method, core_field_nt=GIVEN)
    assert out.attrs["samples"] == len(raw) - 101
    assert out.attrs["outliers"] == 58  # one in fifty of the samples that bear no flag
    np.testing.assert_allclose(out["bias"].values, BIAS, atol=1e-6)


def test_swinging_is_not_spoilt_by_a_spike() -> None:
    made = track(circles(), noise=200.0)
    raw = made["field_body"].values.copy()
    raw[500] += 40_000.0
    out = calibrate(changed(made, raw), method="swinging", core_field_nt=GIVEN)
    np.testing.assert_allclose(out["bias"].values[:2], BIAS[:2], atol=200.0)


def test_what_is_assumed_is_said() -> None:
    level = calibrate(track(circles()), core_field_nt=GIVEN)
    assert "vertical scale factor 1" in level.attrs["assumed"]
    assert list(level["parameter"].values) == [
        "matrix_xx", "matrix_xy", "matrix_yx", "matrix_yy", "bias_x", "bias_y", "bias_z",
    ]  # fmt: skip
    solid = calibrate(track(*tumbling()), method="ellipsoid", core_field_nt=GIVEN)
    assert "on average" in solid.attrs["assumed"]
    triangular = calibrate(
        track(*tumbling()), method="ellipsoid", core_field_nt=GIVEN, distortion="triangular"
    )
    assert (np.triu(triangular["matrix"].values, 1) == 0.0).all()


class Bad(NamedTuple):
    change: Callable[[xr.Dataset], xr.Dataset]
    params: dict[str, object]
    error: type[MagtilesError]
    message: str
    id: str


def _axis(number: int, value: float) -> Callable[[xr.Dataset], xr.Dataset]:
    def change(made: xr.Dataset) -> xr.Dataset:
        raw = made["field_body"].values.copy()
        raw[:, number] = value
        return changed(made, raw)

    return change


def _scaled(factor: float) -> Callable[[xr.Dataset], xr.Dataset]:
    return lambda made: changed(made, factor * made["field_body"].values)


def _only_total(made: xr.Dataset) -> xr.Dataset:
    total = np.linalg.norm(made["field_body"].values, axis=1)
    return made.drop_vars("field_body").assign(field_total=("time", total, {"units": "nT"}))


def _mirrored(made: xr.Dataset) -> xr.Dataset:
    return changed(made, made["field_body"].values * [1.0, -1.0, -1.0])


BAD = [
    Bad(_axis(1, np.nan), {}, CoverageError, "axis right has no finite value", "NaN axis"),
    Bad(_axis(2, 41.0), {}, CoverageError, "axis down is 41 nT throughout", "stuck axis"),
    Bad(_scaled(0.0), {}, CoverageError, "axis forward is 0 nT throughout", "constant field"),
    Bad(_scaled(1e-3), {}, ContractError, "64 nT.*core field is 53214 nT; expected readings in nT",
        "microtesla"),
    Bad(_scaled(1e5), {}, ContractError, "correct the unit in the log's TOML", "gauss times 1e10"),
    Bad(_only_total, {}, ContractError, "'field_body' is missing.*fit-tolles-lawson", "scalar"),
    Bad(lambda t: t.drop_vars("attitude"), {"method": "attitude"}, CoverageError,
        "0 of 2400 samples have an attitude.*ellipsoid", "no attitude"),
    Bad(lambda t: t.isel(time=slice(0, 40)), {}, CoverageError,
        "40 samples are fit for use of 40", "too few samples"),
    Bad(lambda t: with_flags(t, np.full(2400, int(TrackFlag.FIELD_SPIKE))), {}, CoverageError,
        "axis forward has no finite value|0 samples are fit", "all flagged"),
    Bad(lambda t: t.assign(latitude=t["latitude"] * np.nan), {}, CoverageError,
        "no sample has a place and height.*core_field_nt", "no place"),
    Bad(_mirrored, {}, ContractError, "turns with the vehicle, not against it.*forward, left, up",
        "ROS axes"),
    Bad(lambda t: t.assign_attrs(calibration="swinging from x"), {}, ContractError,
        "calibrated already", "calibrated"),
    Bad(lambda t: t.assign_attrs(height_reference="terrain"), {}, ContractError,
        "heights count from terrain", "height above terrain"),
]  # fmt: skip


@pytest.mark.parametrize("bad", BAD, ids=lambda b: b.id)
def test_bad_input_is_named_with_what_to_do(bad: Bad) -> None:
    made = bad.change(track(circles(), noise=100.0, attitude=True).copy())
    with pytest.raises(bad.error, match=bad.message):
        calibrate_vector(made, params=CalibrateVectorParams(**bad.params))


@pytest.mark.parametrize(
    "method", ["swinging", "strict-ellipse", "modified-ellipsoid", "ellipsoid", "attitude"]
)
def test_a_straight_drive_is_refused_by_all(method: str) -> None:
    heading = 1.0 + 0.005 * np.sin(np.arange(3000) / 200.0)
    made = track(heading, noise=200.0, attitude=True)
    with pytest.raises(CoverageError, match=r"not observed.*core field is 53244 nT"):
        calibrate(made, method=method, core_field_nt=GIVEN)


def test_a_field_that_is_no_surface_is_refused() -> None:
    """Lorries pass during a third of the circles."""
    made = track(circles(), noise=200.0)
    raw = made["field_body"].values.copy()
    beside = np.random.default_rng(0).random(len(raw)) < 0.35
    raw[beside] += np.random.default_rng(1).normal(0.0, 15_000.0, (beside.sum(), 3))
    with pytest.raises(CoverageError, match="of the samples do not fit the calibration"):
        calibrate(changed(made, raw), core_field_nt=GIVEN)


@pytest.mark.parametrize("value", ["tomorrow", 12, "2018-13-01"])
def test_times_that_are_none(value: object) -> None:
    with pytest.raises(ValueError, match="an ISO date and time in UTC"):
        CalibrateVectorParams(start=value)


def test_times_are_kept_in_utc() -> None:
    zone = datetime.timezone(datetime.timedelta(hours=2))
    given = datetime.datetime(2018, 8, 2, 10, 34, 30, tzinfo=zone)  # as TOML has it
    params = CalibrateVectorParams(start=given, end="2018-08-02T08:35:30Z")
    assert (params.start, params.end) == ("2018-08-02T08:34:30", "2018-08-02T08:35:30")


def test_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, out = tmp_path / "track.nc", tmp_path / "calibration.nc"
    write_artifact(track(whole_drive(), noise=200.0), source, "track/1")
    run = ["run", "calibrate-vector", "--in", f"track={source}", "--out", str(out)]
    assert main([*run, "--param", 'method="modified-ellipsoid"']) == 0
    applied = tmp_path / "calibrated.nc"
    assert main(["run", "apply-calibration", "--in", f"track={source}",
                 "--in", f"calibration={out}", "--out", str(applied)]) == 0  # fmt: skip
    with open_artifact(applied) as made:
        assert float(made["field_total"].median()) == pytest.approx(TOTAL, rel=0.01)
    assert main([*run, "--param", 'method="ellipsoid"']) == 1
    assert "rotation about a single axis" in capsys.readouterr().err


def comma_track(folder: Path, *, attitude: bool) -> xr.Dataset:
    """The real minute of driving as a track: readings in microtesla, axes as written."""
    log = folder / "drive_comma2k19/processed_log"
    seconds, field = (np.load(log / f"IMU/magnetometer/{n}.npy") for n in ("t", "value"))
    fix_seconds, fix = (np.load(log / f"GNSS/live_gnss_ublox/{n}.npy") for n in ("t", "value"))
    offset = np.median(fix[:, 3] / 1e3 - fix_seconds)
    time = ((seconds + offset) * 1e9).astype("datetime64[ns]")
    place = {n: np.interp(seconds, fix_seconds, fix[:, i])
             for n, i in (("latitude", 0), ("longitude", 1), ("height", 4))}  # fmt: skip
    units = {"latitude": "degrees_north", "longitude": "degrees_east", "height": "m"}
    made = xr.Dataset(
        {n: ("time", v, {"units": units[n]}) for n, v in place.items()}
        | {"field_body": (("time", "axis"), 1e3 * field, {"units": "nT"})},
        coords={"time": time},
        attrs={"height_reference": "ellipsoid", "source": "comma2k19"},
    )
    if attitude:
        heading = np.radians(np.interp(seconds, fix_seconds, fix[:, 5]))
        quaternion = Rotation.from_euler("Z", heading[:, None]).as_quat(scalar_first=True)
        made["attitude"] = (("time", "quaternion"), quaternion, {"units": "1"})
    return made


@pytest.mark.parametrize(
    "method", ["swinging", "strict-ellipse", "modified-ellipsoid", "ellipsoid", "attitude"]
)
def test_a_real_minute_of_driving_straight_cannot_calibrate_itself(
    real_data: Path, method: str
) -> None:
    made = comma_track(real_data, attitude=True)
    with pytest.raises(CoverageError) as caught:
        calibrate(made, method=method)
    # Both magnitudes: 42.5 microtesla where the core field has 48.1.
    assert "the field measures 42533 nT in the median, the core field is 48130 nT" in str(
        caught.value
    )
    assert "not observed" in str(caught.value)
    if method == "modified-ellipsoid":
        assert "the vehicle turns by 2.2 degrees in all" in str(caught.value)


def test_without_attitude_the_real_minute_is_refused_by_its_field(real_data: Path) -> None:
    with pytest.raises(CoverageError, match=r"turns by 0\.0 degrees.*42533.*48130"):
        calibrate(comma_track(real_data, attitude=False))


def test_a_core_field_given_is_used() -> None:
    out = calibrate(track(circles()), core_field_nt=tuple(2.0 * CORE))
    assert out.attrs["reference_field"] == "given"
    product = out["matrix"].values[:2, :2] @ LEVEL_DISTORTION[:2, :2]
    np.testing.assert_allclose(product, 2.0 * np.eye(2), atol=1e-12)
