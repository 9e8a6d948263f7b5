"""PX4 logs: gauss, boot clock, several sensors; made ones whose numbers are known, and real."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from logs import START, ulog
from scipy.spatial.transform import Rotation

from magtiles.catalog.flags import TrackFlag
from magtiles.schemas import contracts
from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages.declare import parse_params
from magtiles.stages.ingest.log.boot_clock import fit_boot_clock
from magtiles.stages.ingest.log.source import IngestLogParams
from magtiles.stages.ingest.log.stage import ingest_log

MAG = "uint64_t timestamp;uint64_t timestamp_sample;float x;float y;float z;"
GPS = (
    "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;int32_t alt;"
    "int32_t alt_ellipsoid;float eph;float epv;float vel_m_s;uint8_t fix_type;"
)
NEW_GPS = (
    "uint64_t timestamp;uint64_t time_utc_usec;double latitude_deg;double longitude_deg;"
    "double altitude_msl_m;double altitude_ellipsoid_m;float eph;float epv;float vel_m_s;"
    "uint8_t fix_type;"
)
ATTITUDE = "uint64_t timestamp;float[4] q;"
COMBINED = (
    "uint64_t timestamp;float[3] gyro_rad;int32_t magnetometer_timestamp_relative;"
    "float[3] magnetometer_ga;"
)
OFFSET_US = START // 1000 - 5_000_000  # UTC of boot, for a log that begins at 5 s


def ingest(path: Path, **params: Any) -> xr.Dataset:
    track = ingest_log([path], params=parse_params(IngestLogParams, params, where="parameters"))
    contracts.check(track, "track/1")
    return track


def mags(rows: int = 100, scale: float = 1.0) -> tuple[str, list[bytes]]:
    """At 10 Hz from 5 s, sampled 2 ms before they were logged."""
    return MAG, [
        struct.pack(
            "<QQfff", 5_002_000 + r * 100_000, 5_000_000 + r * 100_000, 0.25 * scale, r / 1024, 0.5
        )
        for r in range(rows)
    ]


def gps(rows: int = 11, *, utc: bool = True, drift: float = 0.0, kind: int = 3) -> Any:
    """At 1 Hz from 5 s, going north."""
    return GPS, [
        struct.pack(
            "<QQiiiifffB",
            5_000_000 + r * 1_000_000,
            OFFSET_US + 5_000_000 + round(r * 1e6 * (1 + drift)) if utc else 0,
            450_000_000 + 1000 * r, 70_000_000, 250_000, 300_000, 1.5, 2.5, 11.0, kind,
        )
        for r in range(rows)
    ]  # fmt: skip


def save(path: Path, topics: dict[str, Any]) -> Path:
    path.write_bytes(ulog(topics))
    return path


def test_gauss_and_the_boot_clock_become_nanotesla_and_utc(tmp_path: Path) -> None:
    path = save(tmp_path / "log.ulg", {"sensor_mag": mags(), "vehicle_gps_position": gps()})
    track = ingest(path)
    rows = np.arange(100)
    np.testing.assert_array_equal(track["field_body"], np.stack(
        [np.full(100, 25_000.0), rows / 1024 * 1e5, np.full(100, 50_000.0)], axis=1
    ))  # fmt: skip
    late = track["time"].values - np.datetime64(START, "ns") - rows * np.timedelta64(100, "ms")
    assert abs(late).max() < np.timedelta64(1, "us")
    np.testing.assert_allclose(track["latitude"], 45.0 + rows * 1e-5, atol=1e-11)
    np.testing.assert_allclose(track["height"], 300.0, rtol=1e-15)
    np.testing.assert_array_equal(track["speed"], 11.0)
    assert track.attrs["height_reference"] == "ellipsoid"
    assert track.attrs["clock_fixes"] == 11
    assert not track["quality_flag"].any()
    above_sea = ingest(path, height_reference="mean_sea_level", undulation_m=50.0)
    np.testing.assert_allclose(above_sea["height"], 250.0, rtol=1e-15)
    assert above_sea.attrs["height_reference"] == "mean_sea_level"


def test_newer_receivers_messages_and_a_two_dimensional_fix(tmp_path: Path) -> None:
    rows = [
        struct.pack(
            "<QQddddfffB", 5_000_000 + r * 1_000_000, OFFSET_US + 5_000_000 + r * 1_000_000,
            45.0 + r, 7.0, 250.0, 300.0, 1.5, 2.5, 0.0, 2 if r == 1 else 3,
        )
        for r in range(4)
    ]  # fmt: skip
    path = save(tmp_path / "log.ulg", {"sensor_mag": mags(20), "sensor_gps": (NEW_GPS, rows)})
    track = ingest(path)
    np.testing.assert_allclose(track["latitude"], 45.0 + np.arange(20) / 10, atol=1e-12)
    assert np.isnan(track["fix_height"].values).tolist() == [False, True, False, False]
    assert track["fix_status"].values.tolist() == [0] * 4


def test_attitude_is_px4_s_own_and_rates_are_the_gyroscope_s(tmp_path: Path) -> None:
    turn = Rotation.from_euler("ZYX", [120.0, 5.0, -3.0], degrees=True)
    q = turn.as_quat(scalar_first=True)
    attitude = [struct.pack("<Q4f", 5_000_000 + r * 50_000, *q) for r in range(201)]
    none = 2**31 - 1
    combined = [  # the field is new in every fourth row
        struct.pack(
            "<Q3fi3f", 4_900_000 + r * 25_000, 0.5, -0.25, 0.125,
            none if r % 4 == 3 else -(r % 4) * 25_000, 0.25, (r // 4) / 1024, 0.5,
        )
        for r in range(440)
    ]  # fmt: skip
    topics = {
        "sensor_combined": (COMBINED, combined),
        "vehicle_attitude": (ATTITUDE, attitude),
        "vehicle_gps_position": gps(),
    }
    track = ingest(save(tmp_path / "log.ulg", topics))
    assert track.sizes["time"] == 110  # each once
    np.testing.assert_array_equal(track["field_body"][:, 1], np.arange(110) / 1024 * 1e5)
    found = Rotation.from_quat(track["attitude"].values[1:101], scalar_first=True)
    assert (turn.inv() * found).magnitude().max() < 3e-7  # stored in single precision
    np.testing.assert_array_equal(track["angular_rate"], np.tile([0.5, -0.25, 0.125], (201, 1)))
    mounted = ingest(tmp_path / "log.ulg", imu_to_body="right,back,down")
    np.testing.assert_array_equal(mounted["angular_rate"][0], [0.25, 0.5, 0.125])


@pytest.mark.parametrize("drift", [0.0, 40e-6, -15e-6])
def test_the_clock_is_robust_and_its_drift_is_found_where_it_can_be(drift: float) -> None:
    """An hour of fixes that come up to 100 ms late now and then, three of them by leap seconds."""
    rng = np.random.default_rng(3)
    boot = np.arange(3600) * 1_000_000 + rng.integers(0, 4000, 3600)
    utc = OFFSET_US + np.round(boot * (1 + drift)).astype(np.int64)
    seen = utc + np.round(rng.normal(0, 2000, 3600)).astype(np.int64)
    seen[::20] -= 100_000
    seen[:3] += 18_000_000
    clock = fit_boot_clock(boot, seen)
    assert abs(clock.drift - drift) < 0.3e-6  # found within 0.1 ppm
    miss = (clock.utc(boot).astype(np.int64) // 1000 - utc) * 1e-6
    assert abs(miss).max() < 1e-3  # found 0.4 ms
    assert clock.residual_s == pytest.approx(2e-3, rel=0.1)


def test_a_short_log_does_not_extrapolate_its_noise() -> None:
    rng = np.random.default_rng(4)
    boot = np.arange(6) * 1_000_000
    clock = fit_boot_clock(boot, OFFSET_US + boot + np.round(rng.normal(0, 3e4, 6)).astype(int))
    assert abs(clock.drift) < 50e-6  # ordinary least squares finds thousands of ppm


def test_without_utc_the_log_needs_a_start(tmp_path: Path, caplog: Any) -> None:
    topics = {"sensor_mag": mags(), "vehicle_gps_position": gps(utc=False)}
    path = save(tmp_path / "log.ulg", topics)
    with pytest.raises(SourceError, match=r"counts from boot, .* 'start_time'"):
        ingest(path)
    track = ingest(path, start_time="2023-11-14T22:13:20Z")
    assert track["time"].values[0] == np.datetime64(START, "ns")
    np.testing.assert_allclose(track["latitude"], 45.0 + np.arange(100) * 1e-5, atol=1e-11)
    alone = save(tmp_path / "alone.ulg", {"sensor_mag": mags()})
    with pytest.raises(SourceError, match="counts from boot"):
        ingest(alone)
    lost = ingest(alone, start_time="2023-11-14T22:13:20Z")
    assert (lost["quality_flag"] == TrackFlag.NO_FIX.value).all()
    assert "no fixes" in caplog.text
    with_utc = save(tmp_path / "utc.ulg", topics | {"vehicle_gps_position": gps()})
    with pytest.raises(SourceError, match="'start_time' is set, but the log's clock is UTC"):
        ingest(with_utc, start_time="2023-11-14T22:13:20Z")


def test_several_sensors_are_asked_about(tmp_path: Path) -> None:
    topics = {
        "sensor_mag/0": mags(), "sensor_mag/1": mags(scale=0.5), "vehicle_gps_position": gps(),
    }  # fmt: skip
    path = save(tmp_path / "log.ulg", topics)
    with pytest.raises(
        SourceError, match="2 topics could be meant: sensor_mag/0, sensor_mag/1; say which"
    ):
        ingest(path)
    assert ingest(path, magnetometer_topic="sensor_mag/1")["field_body"][0, 0] == 12_500.0
    with pytest.raises(SourceError, match="no topic 'sensor_mag/2' of that kind; expected one of"):
        ingest(path, magnetometer_topic="sensor_mag/2")
    none = save(tmp_path / "none.ulg", {"vehicle_gps_position": gps()})
    with pytest.raises(
        SourceError, match=r"no topic is a magnetometer's; .* the log has vehicle_gps"
    ):
        ingest(none)


def test_a_topic_whose_format_lacks_a_field_is_named(tmp_path: Path) -> None:
    fields = GPS.replace("float epv;", "float xpv;")
    topics = {"sensor_mag": mags(), "vehicle_gps_position": (fields, gps()[1])}
    path = save(tmp_path / "log.ulg", topics)
    with pytest.raises(FormatError, match=r"topic vehicle_gps_position: messages have no .* 'epv'"):
        ingest(path)


@pytest.mark.parametrize("percent", range(0, 100, 10))
def test_a_truncated_log_keeps_its_whole_messages(
    percent: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    whole = ulog({"sensor_mag": mags(), "vehicle_gps_position": gps()})
    path = tmp_path / "log.ulg"
    path.write_bytes(whole[: len(whole) * percent // 100])
    kept = path.read_bytes()
    head = struct.pack("<HBH", 30, ord("D"), 0)  # size, type, topic, and 28 bytes of it follow
    messages = sum(kept.startswith(head, at) and at + 33 <= len(kept) for at in range(len(kept)))
    if percent == 0:
        with pytest.raises(FormatError, match="the file is empty"):
            ingest(path)
    elif messages == 0:
        with pytest.raises((FormatError, SourceError)):
            ingest(path)
    else:
        assert ingest(path).sizes["time"] == messages
        assert caplog.text.count("truncated after byte") == 1


def test_garbage_behind_the_magic_is_refused_or_said(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    for _ in range(20):
        path = tmp_path / "log.ulg"
        path.write_bytes(b"ULog\x01\x12\x35\x01" + rng.bytes(400))
        with pytest.raises((FormatError, SourceError)):
            ingest(path)


def test_real_logs_in_nanotesla(real_data: Path) -> None:
    folder = real_data / "ulog_px4"
    with pytest.raises(SourceError, match="sensor_mag/0, sensor_mag/1, vehicle_magnetometer"):
        ingest(folder / "sample_log_small.ulg")
    track = ingest(folder / "sample_log_small.ulg", magnetometer_topic="vehicle_magnetometer")
    # Trondheim, where the core field is 52,000 nT, inside a vehicle that was not calibrated.
    magnitude = np.linalg.norm(track["field_body"], axis=1)
    assert 42_000 < magnitude.min() < magnitude.max() < 48_000
    known = np.isfinite(track["latitude"].values)
    assert track["latitude"].values[known] == pytest.approx(63.41706, abs=1e-4)
    assert (track["quality_flag"].values[~known] == TrackFlag.NO_FIX.value).all()
    assert str(track["time"].values[0]).startswith("2021-04-21T06:30:58")
    assert track.attrs["clock_residual_s"] < 5e-3  # 2.9 ms
    assert track["fix_height"].values[0] == pytest.approx(106.766)
    other = ingest(folder / "sample_log_small.ulg", magnetometer_topic="sensor_mag/0")
    assert np.linalg.norm(other["field_body"], axis=1) == pytest.approx([61_500.0] * 6, rel=0.02)
    older = ingest(folder / "sample.ulg", start_time="2016-01-01T00:00:00Z")
    assert 43_000 < np.linalg.norm(older["field_body"], axis=1).mean() < 53_000
    assert older.sizes["time"] == 6759
