"""MCAP logs become tracks whose every number is known, and bad ones say what is wrong with them."""

from __future__ import annotations

import contextlib
import logging
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import xarray as xr
import zstandard
from logs import (
    MAGNETIC_FIELD,
    SECOND,
    START,
    Bag,
    drive,
    first_chunk,
    header,
    location_fix_type,
    tesla,
    vector,
)
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType
from scipy.spatial.transform import Rotation

from magtiles.catalog.flags import TrackFlag
from magtiles.schemas import contracts
from magtiles.schemas.errors import FormatError, MagtilesError, SourceError
from magtiles.stages.declare import parse_params
from magtiles.stages.ingest.log.source import IngestLogParams
from magtiles.stages.ingest.log.stage import ingest_log

MAG = "sensor_msgs/msg/MagneticField"


def ingest(path: Path, **params: Any) -> xr.Dataset:
    track = ingest_log([path], params=parse_params(IngestLogParams, params, where="parameters"))
    contracts.check(track, "track/1")
    return track


def flags(track: xr.Dataset) -> list[str]:
    """Names of the flags that any row carries."""
    return [f.name for f in TrackFlag if (track["quality_flag"].values & f.value).any()]


def test_a_drive_becomes_a_track_in_nanotesla_with_positions_between_its_fixes(
    tmp_path: Path,
) -> None:
    track = ingest(drive().save(tmp_path / "log.mcap"))
    rows = np.arange(200)
    np.testing.assert_array_equal(
        track["time"].values.astype(np.int64), START + rows * (SECOND // 50)
    )
    field = np.stack([tesla(row) for row in rows])
    np.testing.assert_allclose(track["field_body"], field * 1e9, rtol=1e-15)
    inside = rows <= 150  # the last fix is at the third second
    np.testing.assert_allclose(
        track["latitude"][inside], 45.0 + rows[inside] / 50 * 1e-4, atol=1e-12, rtol=0
    )
    np.testing.assert_allclose(track["height"][inside], 300 + rows[inside] / 50, atol=1e-9)
    assert np.isnan(track["latitude"][~inside]).all()
    np.testing.assert_array_equal(
        track["quality_flag"], np.where(inside, 0, TrackFlag.NO_FIX.value)
    )
    assert track.attrs["height_reference"] == "ellipsoid"
    assert "field_sigma_nt" not in track.attrs  # zero covariance is unknown
    assert track["fix_horizontal_sigma"].values.tolist() == [2.0] * 4
    assert track["fix_vertical_sigma"].values.tolist() == [4.0] * 4


def test_axes_follow_the_toml_and_covariance_is_kept(tmp_path: Path) -> None:
    bag = Bag()
    for row in range(9):
        bag.field(START + row * SECOND, (1e-5, 2e-5, 3e-5), variance=1e-14)
    path = bag.save(tmp_path / "log.mcap")
    words = ingest(path, sensor_to_body="forward,left,up")
    np.testing.assert_allclose(words["field_body"][0], [1e4, -2e4, -3e4], rtol=1e-15)
    assert words.attrs["field_sigma_nt"] == pytest.approx([100.0] * 3)
    matrix = ingest(path, sensor_to_body=[[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(matrix["field_body"][0], [2e4, -1e4, 3e4], rtol=1e-15)


def test_attitude_of_ros_becomes_body_to_north_east_down(tmp_path: Path) -> None:
    """Against the meaning: nose toward 30 degrees, pitched up 10, rolled right 5."""
    heading, pitch, roll = np.radians([30.0, 10.0, 5.0])
    ned = Rotation.from_euler("ZYX", [heading, pitch, roll])
    # The same attitude as ROS has it: from forward, left, up to east, north, up.
    forward, right, down = ned.apply(np.eye(3))
    enu = [[v[1], v[0], -v[2]] for v in (forward, -right, -down)]
    bag = Bag()
    for row in range(11):
        time = START + row * SECOND // 10
        bag.field(time + 7_000_000, tesla(row))
        bag.imu(time, Rotation.from_matrix(np.array(enu).T).as_quat(), (0.1, 0.2, 0.3))
    track = ingest(bag.save(tmp_path / "log.mcap"))
    found = Rotation.from_quat(track["attitude"].values[:10], scalar_first=True)
    assert (ned.inv() * found).magnitude().max() < 1e-7
    assert np.isnan(track["attitude"].values[10]).all()  # after the last sample
    np.testing.assert_array_equal(track["angular_rate"][0], [0.1, -0.2, -0.3])


def test_the_lever_arm_moves_the_place_from_the_antenna_to_the_sensor(tmp_path: Path) -> None:
    bag = drive(101)
    for row in range(21):  # nose to the east: forward, left, up is east, north, up
        bag.imu(START + row * SECOND // 10, (0, 0, 0, 1))
    path = bag.save(tmp_path / "log.mcap")
    antenna, sensor = ingest(path), ingest(path, lever_arm_m=[3.0, 2.0, 1.0])
    one = slice(0, 100)
    east = (
        np.radians(sensor["longitude"] - antenna["longitude"])[one] * 6388.8e3 * np.cos(np.pi / 4)
    )
    south = np.radians(antenna["latitude"] - sensor["latitude"])[one] * 6367.7e3
    np.testing.assert_allclose(east, 3.0, rtol=1e-4)  # radii of curvature at 45 degrees
    np.testing.assert_allclose(south, 2.0, rtol=1e-4)
    np.testing.assert_allclose((antenna["height"] - sensor["height"])[one], 1.0, rtol=1e-9)
    np.testing.assert_array_equal(sensor["fix_latitude"], antenna["fix_latitude"])
    with pytest.raises(SourceError, match="'lever_arm_m' needs the attitude"):
        ingest(drive().save(tmp_path / "no_imu.mcap"), lever_arm_m=[1.0, 0.0, 0.0])


def test_speed_comes_from_twist_or_odometry_and_two_of_them_are_left_out_aloud(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bag = drive(101)
    for row in range(3):
        time = START + row * SECOND
        twist = {"linear": vector((3.0, 4.0, 9.0)), "angular": vector((0, 0, 0))}
        message = {"header": header(time), "twist": twist}
        bag.ros("/twist", "geometry_msgs/msg/TwistStamped", message, time)
        whole = {
            "header": header(time),
            "child_frame_id": "base",
            "pose": {
                "pose": {
                    "position": vector((1, 2, 3)),
                    "orientation": vector((0, 0, 0, 1), "xyzw"),
                },
                "covariance": [0.0] * 36,
            },
            "twist": {"twist": twist | {"linear": vector((0, 1, 0))}, "covariance": [0.0] * 36},
        }
        bag.ros("/odom", "nav_msgs/msg/Odometry", whole, time)
    path = bag.save(tmp_path / "log.mcap")
    assert ingest(path, speed_topic="/twist")["speed"].values == pytest.approx(
        [5.0] * 101, rel=1e-15
    )
    assert ingest(path, speed_topic="/odom")["speed"].values == pytest.approx(
        [1.0] * 101, rel=1e-15
    )
    assert "speed" not in ingest(path)
    assert "speed_topic" in caplog.text


@pytest.mark.parametrize("encoding", ["json", "protobuf"])
def test_fixes_of_foxglove(encoding: str, tmp_path: Path) -> None:
    bag = drive(101, fixes=False)
    kind, schema = location_fix_type()
    for row in range(3):
        time = START + row * SECOND
        place = {"latitude": 45.0 + row * 1e-4, "longitude": 7.0, "altitude": 250.0}
        sigma = {"position_covariance": [9.0, 0, 0, 0, 4.0, 0, 0, 0, 1.0]}
        whole = {**place, **sigma, "position_covariance_type": 2}
        if encoding == "json":
            stamp = {"sec": time // SECOND, "nsec": time % SECOND}
            bag.json("/fix", "foxglove.LocationFix", whole | {"timestamp": stamp}, time)
        else:
            message = kind(**place, **sigma)
            message.timestamp.seconds, message.timestamp.nanos = divmod(time, SECOND)
            channel = bag.channel("/fix", "foxglove.LocationFix", schema, "protobuf", "protobuf")
            bag.raw(channel, message.SerializeToString(), time)
    path = bag.save(tmp_path / "log.mcap")
    track = ingest(path, height_reference="mean_sea_level", undulation_m=47.5)
    np.testing.assert_allclose(
        track["latitude"], 45.0 + np.arange(101) / 50 * 1e-4, atol=1e-12, rtol=0
    )
    assert track["reference_surface_height"].values.tolist() == [47.5] * 101
    # The protobuf messages leave the type of covariance at its default, unknown.
    expected = 3.0 if encoding == "json" else np.nan
    np.testing.assert_array_equal(track["fix_horizontal_sigma"], [expected] * 3)
    with pytest.raises(SourceError, match="'height_reference' is missing"):
        ingest(path)


def test_json_of_no_known_schema_is_read_by_its_columns(tmp_path: Path) -> None:
    bag = Bag()
    for row in range(5):
        time = START + row * SECOND
        bag.json("/m", "acme.Mag", {"b": {"f": [48000.0 + row]}, "at": time / SECOND}, time + 9)
    path = bag.save(tmp_path / "log.mcap")
    columns = {"field_total": "b.f.0", "time": "at"}
    track = ingest(path, magnetometer_topic="/m", columns=columns, units="nT")
    np.testing.assert_array_equal(track["field_total"], 48000.0 + np.arange(5))
    np.testing.assert_array_equal(
        track["time"].values.astype(np.int64) - START, np.arange(5) * SECOND
    )
    with pytest.raises(SourceError, match="'units' is missing"):
        ingest(path, magnetometer_topic="/m", columns=columns)
    with pytest.raises(SourceError, match=r"'acme.Mag' are not known .* \[log.columns\]"):
        ingest(path, magnetometer_topic="/m")
    with pytest.raises(FormatError, match=r"no field 'b\.g'; expected under b, at"):
        ingest(path, magnetometer_topic="/m", columns={"field_total": "b.g"}, units="nT")


class Odd(NamedTuple):
    fix: dict[str, Any]
    says: str


@pytest.mark.parametrize(
    "case",
    [
        Odd({"latitude": "45 N"}, "'latitude' holds text: '45 N'"),
        Odd({"latitude": {"deg": 45}}, "holds {'deg': 45}; expected a number"),
        Odd({"latitude": [4, 5]}, "'latitude' holds 2 numbers a message; expected one"),
        Odd({"latitude": [[1], [1, 2]]}, "holds [[1], [1, 2]]"),
        Odd({"timestamp": {"sec": "now", "nsec": 0}}, "a stamp is not a number"),
        Odd({"timestamp": {"sec": None, "nsec": 0}}, "a stamp is not a number"),
        Odd({"timestamp": 5}, "no field 'timestamp.sec'; expected under latitude, longitude"),
    ],
    ids=lambda case: case.says,
)
def test_json_of_other_kinds_is_refused(case: Odd, tmp_path: Path) -> None:
    bag = drive(10, fixes=False)
    whole = {
        "latitude": 45.0, "longitude": 7.0, "altitude": None, "position_covariance": [],
        "position_covariance_type": 0, "timestamp": {"sec": START // SECOND, "nsec": 0},
    }  # fmt: skip
    bag.json("/fix", "foxglove.LocationFix", whole, START)
    bag.json("/fix", "foxglove.LocationFix", whole | {"position_covariance": [1.0]}, START)
    right = bag.save(tmp_path / "right.mcap")
    assert np.isnan(ingest(right, height_reference="ellipsoid")["fix_horizontal_sigma"]).all()
    bag = drive(10, fixes=False)
    bag.json("/fix", "foxglove.LocationFix", whole | case.fix, START)
    with pytest.raises(FormatError) as raised:
        ingest(bag.save(tmp_path / "wrong.mcap"), height_reference="ellipsoid")
    assert case.says in str(raised.value)


# What is wrong with a log: what it becomes all the same, or what the error says.


def two_magnetometers() -> Bag:
    bag = drive(20)
    bag.field(START, tesla(0), topic="/mag/tail")
    return bag


def two_receivers() -> Bag:
    bag = drive(60)
    bag.fix(START, 45.0, 7.0, 0.0, topic="/other/fix")
    return bag


def only_fixes() -> Bag:
    bag = Bag()
    bag.fix(START, 45.0, 7.0, 0.0)
    return bag


def unknown_encoding() -> Bag:
    bag = Bag()
    bag.raw(bag.channel("/mag", MAG, b"", "cbor", "ros2msg"), b"\0", START)
    return bag


def unknown_schema_encoding() -> Bag:
    bag = Bag()
    bag.raw(bag.channel("/mag", MAG, b"struct x;", "cdr", "omgidl"), bytes(8), START)
    return bag


def liar(old: str, new: str) -> Callable[[], Bag]:
    """A log whose schema text differs from the type that it is named after."""

    def build() -> Bag:
        text = MAGNETIC_FIELD.replace(old, new)
        assert text != MAGNETIC_FIELD
        bag = Bag()
        bag.raw(bag.channel("/mag", MAG, text.encode(), "cdr", "ros2msg"), bytes(128), START)
        return bag

    return build


def payload_of_another_type() -> Bag:
    """The schema is right, the messages are not: three floats are four bytes each."""
    bag = Bag()
    channel = bag.channel("/mag", MAG, MAGNETIC_FIELD.encode(), "cdr", "ros2msg")
    head = struct.pack("<4sIIIxxxx", b"\0\1\0\0", START // SECOND, 0, 1)
    bag.raw(channel, head + struct.pack("<3f", *tesla(0)) + bytes(72), START)
    return bag


def parameter_list_cdr() -> Bag:
    bag = Bag()
    channel = bag.channel("/mag", MAG, MAGNETIC_FIELD.encode(), "cdr", "ros2msg")
    bag.raw(channel, b"\0\3\0\0" + bytes(124), START)
    return bag


def microtesla() -> Bag:
    bag = Bag()
    bag.field(START, (20.0, 0.0, 45.0))
    return bag


def silent_axis() -> Bag:
    bag = Bag()
    for row in range(9):
        bag.field(START + row, (1e-5, np.nan, 1e-5))
    return bag


def stamps_of_1970() -> Bag:
    bag = Bag()
    for row in range(9):
        bag.field(row * SECOND, tesla(row), log_time=START + row * SECOND)
    return bag


def clock_of_1970() -> Bag:
    bag = Bag()
    for row in range(9):
        bag.field(row * SECOND, tesla(row))
    return bag


def radians() -> Bag:
    bag = drive(10)
    bag.fix(START + 1, 785.0, 7.0, 0.0)
    return bag


class Refused(NamedTuple):
    build: Callable[[], Bag]
    error: type[MagtilesError]
    says: str
    id: str


REFUSED = [
    Refused(two_magnetometers, SourceError,
            "2 topics could be the magnetometer: /mag, /mag/tail; say which with "
            "'magnetometer_topic'", "two magnetometers"),
    Refused(two_receivers, SourceError, "say which with 'fix_topic'", "two receivers"),
    Refused(only_fixes, SourceError,
            "no topic is a magnetometer's; expected one of: /gnss/fix (sensor_msgs/msg/NavSatFix, "
            "1 messages)", "no magnetometer"),
    Refused(unknown_encoding, FormatError,
            "topic /mag: the message encoding is 'cbor'; expected cdr", "unknown encoding"),
    Refused(unknown_schema_encoding, FormatError,
            "topic /mag: the schema encoding is 'omgidl'", "unknown encoding of the schema"),
    Refused(liar("float64 x", "float32 x"), FormatError,
            "topic /mag: schema 'sensor_msgs/msg/MagneticField' declares 'float32 "
            "magnetic_field.x' as its field 4; expected 'float64 magnetic_field.x'",
            "a schema that lies about a type"),
    Refused(liar("float64[9] magnetic_field_covariance\n", ""), FormatError,
            "declares 'nothing' as its field 7", "a schema that lacks a field"),
    Refused(liar("float64 x\nfloat64 y\n", "float64 y\nfloat64 x\n"), FormatError,
            "declares 'float64 magnetic_field.y' as its field 4", "a schema in another order"),
    Refused(liar(MAGNETIC_FIELD, "\n"), FormatError, "declares 'uint8", "an empty schema"),
    Refused(payload_of_another_type, FormatError,
            "topic /mag message 0 of its chunk: a message ends", "messages unlike their schema"),
    Refused(parameter_list_cdr, FormatError, "encapsulation 0x0003", "another encapsulation"),
    Refused(microtesla, FormatError, "if the driver writes another unit", "another unit"),
    Refused(silent_axis, FormatError,
            "topic /mag: y is not finite in any of 9 messages", "an axis that is all NaN"),
    Refused(stamps_of_1970, SourceError,
            "9 of 9 messages are stamped before 1980; expected UTC; set time_source = 'log'",
            "header stamps of 1970"),
    Refused(clock_of_1970, SourceError, "set time_source = 'log', or start_time", "a 1970 clock"),
    Refused(radians, FormatError, "fix 1 is at latitude 785", "an impossible latitude"),
    Refused(Bag, SourceError, "none, the file has no topics", "no messages"),
]  # fmt: skip


@pytest.mark.parametrize("case", REFUSED, ids=lambda case: case.id)
def test_what_cannot_be_read_is_refused_by_name(case: Refused, tmp_path: Path) -> None:
    path = case.build().save(tmp_path / "log.mcap")
    with pytest.raises(case.error) as raised:
        ingest(path)
    assert case.says in str(raised.value)
    assert str(path) in str(raised.value) or "log.mcap" in str(raised.value)


def test_what_is_wrong_with_a_topic_that_is_not_asked_for_does_not_matter(tmp_path: Path) -> None:
    bag = drive(10)
    bag.raw(bag.channel("/bad", MAG, b"int8 a", "cdr", "ros2msg"), bytes(8), START)
    path = bag.save(tmp_path / "log.mcap")
    assert ingest(path, magnetometer_topic="/mag").sizes["time"] == 10
    with pytest.raises(SourceError, match=r"topic '/nose' has no messages; expected one of: /bad"):
        ingest(path, magnetometer_topic="/nose")


def test_named_units_and_times_put_right_what_a_driver_does(tmp_path: Path) -> None:
    track = ingest(microtesla().save(tmp_path / "unit.mcap"), units="microtesla")
    np.testing.assert_allclose(track["field_body"][0], [20_000.0, 0.0, 45_000.0])
    path = stamps_of_1970().save(tmp_path / "stamps.mcap")
    logged = ingest(path, time_source="log")
    assert logged["time"].values.astype(np.int64)[3] == START + 3 * SECOND
    shifted = ingest(path, start_time="2024-02-29T12:00:00+02:00")
    assert str(shifted["time"].values[3]) == "2024-02-29T10:00:03.000000000"
    with pytest.raises(SourceError, match="'start_time' is set, but the log's clock is UTC"):
        ingest(path, time_source="log", start_time="2024-02-29T12:00:00")
    with pytest.raises(SourceError, match="furlong"):
        ingest(path, time_source="log", units="furlong")


def test_a_few_stamps_of_1970_give_way_to_log_times(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bag = Bag()
    for row in range(20):
        stamp = START + row * SECOND if row >= 2 else 0
        bag.field(stamp, tesla(row), log_time=START + row * SECOND)
    track = ingest(bag.save(tmp_path / "log.mcap"))
    np.testing.assert_array_equal(
        track["time"].values.astype(np.int64), START + np.arange(20) * SECOND
    )
    stepped = (track["quality_flag"].values & TrackFlag.CLOCK_STEP) > 0
    assert stepped.tolist() == [True] * 2 + [False] * 18
    assert "2 samples are stamped before 1980" in caplog.text


def test_time_that_jumps_back_is_sorted_and_flagged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bag = Bag()
    stamps = [START + s * SECOND for s in (0, 1, 2, 3, 4, 2, 3, 4, 5, 6)]
    for row, stamp in enumerate(stamps):
        bag.field(stamp, tesla(row), log_time=START + row * SECOND)
    track = ingest(bag.save(tmp_path / "log.mcap"))
    seconds = (track["time"].values.astype(np.int64) - START) // SECOND
    assert seconds.tolist() == [0, 1, 2, 2, 3, 3, 4, 4, 5, 6]
    stepped = (track["quality_flag"].values & TrackFlag.CLOCK_STEP) > 0
    assert stepped.tolist() == [False] * 3 + [True, False] * 3 + [False]
    assert (np.diff(seconds[~stepped]) > 0).all()
    assert "goes back 1 times, first at sample 5" in caplog.text


def test_a_log_without_fixes_is_a_track_without_places(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    track = ingest(drive(fixes=False).save(tmp_path / "log.mcap"))
    assert np.isnan(track["latitude"]).all()
    assert flags(track) == ["NO_FIX"]
    assert "no fixes" in caplog.text


def test_lost_fixes_and_gaps_are_told_apart(tmp_path: Path) -> None:
    bag = Bag()
    for row in range(41):
        bag.field(START + row * SECOND // 2, tesla(row))
    for second in (0, 1, 2, 10, 11, 20):  # 12 to 19 without a fix
        bag.fix(START + second * SECOND, 45.0, 180.0 - 1e-5 * (second % 2) * 2, 0.0)
    for second in range(12, 20):
        bag.fix(START + second * SECOND, np.nan, np.nan, np.nan, status=-1)
    track = ingest(bag.save(tmp_path / "log.mcap"))
    seconds = np.arange(41) / 2
    gap = (seconds > 2) & (seconds < 10)
    lost = (seconds > 11) & (seconds < 20)
    expected = TrackFlag.POSITION_GAP.value * gap + TrackFlag.NO_FIX.value * lost
    np.testing.assert_array_equal(track["quality_flag"], expected)
    np.testing.assert_array_equal(np.isnan(track["latitude"]), gap | lost)
    known = track["longitude"].values[~(gap | lost)]
    assert ((known >= 179.9) | (known < -179.9)).all()  # across the date line, not around


def whole_messages(path: Path, topic: str) -> int:
    """How many messages the package mcap finds before the end comes."""
    count = 0
    with path.open("rb") as file, contextlib.suppress(McapError, struct.error):
        reader = NonSeekingReader(file, validate_crcs=True)
        for _, channel, _ in reader.iter_messages(log_time_order=False):
            count += channel.topic == topic
    return count


@pytest.mark.parametrize("percent", range(0, 100, 10))
@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.ZSTD])
def test_a_truncated_log_keeps_its_whole_chunks(
    percent: int, compression: CompressionType, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    whole = drive(compression=compression).finish()
    path = tmp_path / "log.mcap"
    path.write_bytes(whole[: len(whole) * percent // 100])
    _, end = first_chunk(whole)
    if percent == 0:
        with pytest.raises(FormatError, match="the file is empty"):
            ingest(path)
    elif path.stat().st_size < end:
        with pytest.raises(FormatError, match="before its first whole chunk"):
            ingest(path)
    else:
        track = ingest(path)
        rows = track.sizes["time"]
        assert 0 < rows <= 200
        field = np.stack([tesla(row) for row in range(rows)]) * 1e9
        np.testing.assert_allclose(track["field_body"], field, rtol=1e-15)
        assert rows == whole_messages(path, "/mag")
        kept = [r for r in caplog.records if "truncated after byte" in r.getMessage()]
        assert len(kept) == 1
        assert kept[0].levelno == logging.WARNING
        messages = rows + track.sizes.get("fix", 0)
        assert f"{messages} messages, recorded until 2023-11-14T22:13:2" in kept[0].getMessage()


def test_the_zeros_that_a_crash_leaves_behind_are_where_the_log_ends(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    whole = drive().finish()
    _, end = first_chunk(whole)
    path = tmp_path / "log.mcap"
    path.write_bytes(whole[:end] + bytes(5000))
    assert 0 < ingest(path).sizes["time"] < 200
    assert f"truncated after byte {end}" in caplog.text


def flipped(data: bytes, at: int) -> bytes:
    return data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :]


def with_chunk(data: bytes, **changes: Any) -> bytes:
    """The log with its first chunk's size, CRC, compression or records replaced."""
    start, end = first_chunk(data)
    begin, finish, size, crc = struct.unpack_from("<QQQI", data, start + 9)
    length = struct.unpack_from("<I", data, start + 37)[0]
    compression = data[start + 41 : start + 41 + length].decode()
    records = data[start + 49 + length : end]
    size, crc = changes.get("size", size), changes.get("crc", crc)
    compression = changes.get("compression", compression).encode()
    records = changes.get("records", records)
    body = struct.pack("<QQQII", begin, finish, size, crc, len(compression)) + compression
    body += struct.pack("<Q", len(records)) + records
    return data[:start] + b"\x06" + struct.pack("<Q", len(body)) + body + data[end:]


class Damaged(NamedTuple):
    damage: Callable[[bytes, int], bytes]
    says: str
    id: str
    compression: CompressionType = CompressionType.NONE


BOMB = zstandard.ZstdCompressor().compress(bytes(200 << 20))
LONGER = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(4 << 20))


@pytest.mark.parametrize(
    "case",
    [
        Damaged(lambda d, at: flipped(d, at + 400), "the chunk's CRC is", "a flipped bit"),
        Damaged(lambda d, at: flipped(d, at + 70), "the chunk", "a flipped bit in zstd",
                CompressionType.ZSTD),
        Damaged(lambda d, at: flipped(d, at + 70), "the chunk", "a flipped bit in lz4",
                CompressionType.LZ4),
        Damaged(lambda d, at: with_chunk(d, compression="brotli"),
                "the chunk's compression is 'brotli'; expected zstd, lz4 or none", "brotli"),
        Damaged(lambda d, at: with_chunk(d, compression="zstd", size=200 << 20, records=BOMB),
                f"the chunk declares {200 << 20} bytes in {len(BOMB)}; expected at most {64 << 20}",
                "a bomb that says so"),
        Damaged(lambda d, at: with_chunk(d, compression="zstd", size=4096, records=BOMB),
                "the chunk holds more than 4096 bytes", "a bomb that does not"),
        Damaged(lambda d, at: with_chunk(d, compression="zstd", size=4096, records=LONGER),
                "the chunk holds more than 4096 bytes", "a bomb of unknown size"),
        Damaged(lambda d, at: with_chunk(d, size=9999), "expected 9999 as it declares", "short"),
        Damaged(lambda d, at: with_chunk(d, crc=0, size=17, records=b"\x05" + bytes(16)),
                "the record at byte 0 of the chunk leads past its end", "a short record"),
        Damaged(lambda d, at: with_chunk(d, crc=0, size=9, records=b"\x05\xff" + bytes(7)),
                "the record at byte 0 of the chunk leads past its end", "a record past the end"),
        Damaged(lambda d, at: with_chunk(d, crc=0, size=31, records=b"\x05\x16" + bytes(29)),
                "a message belongs to channel 0, which is not defined", "an undefined channel"),
    ],
    ids=lambda case: case.id,
)  # fmt: skip
def test_a_damaged_chunk_is_named_by_its_byte(case: Damaged, tmp_path: Path) -> None:
    whole = drive(compression=case.compression).finish()
    start, _ = first_chunk(whole)
    path = tmp_path / "log.mcap"
    path.write_bytes(case.damage(whole, start))
    with pytest.raises(FormatError) as raised:
        ingest(path)
    assert case.says in str(raised.value)
    assert f"{path} byte {start}" in str(raised.value)


def test_damage_outside_the_chunks_is_found_by_the_crc_of_the_data_section(tmp_path: Path) -> None:
    whole = drive(options={"enable_data_crcs": True, "enable_crcs": False}).finish()
    _, end = first_chunk(whole)  # what follows is the index of its messages
    path = tmp_path / "log.mcap"
    path.write_bytes(flipped(whole, end + 20))
    with pytest.raises(FormatError, match="the data section's CRC is 0x"):
        ingest(path)


def test_a_length_that_is_not_to_be_believed_allocates_nothing(tmp_path: Path) -> None:
    whole = drive().finish()
    start, _ = first_chunk(whole)
    path = tmp_path / "log.mcap"
    path.write_bytes(whole[: start + 1] + struct.pack("<Q", 2**62) + whole[start + 9 :])
    with pytest.raises(FormatError, match=f"truncated after byte {start}, before its first"):
        ingest(path)


def test_damage_that_no_crc_tells_ends_in_an_error_of_ours_or_in_a_track(tmp_path: Path) -> None:
    bag = drive(60, compression=CompressionType.NONE, options={"enable_crcs": False})
    for row in range(10):
        bag.imu(START + row * SECOND // 5, (0, 0, 0, 1))
    whole, path = bag.finish(), tmp_path / "log.mcap"
    rng = np.random.default_rng(11)
    refused = 0
    for _ in range(300):
        data = bytearray(whole)
        data[int(rng.integers(len(data)))] ^= int(rng.integers(1, 256))
        path.write_bytes(data)
        try:
            ingest(path)
        except MagtilesError:
            refused += 1
    assert 30 < refused < 270  # most bytes are values that may be anything


def test_crcs_are_those_of_zlib() -> None:
    """The damage above is found by the CRC and by nothing else: with the CRC right, it is not."""
    whole = drive(compression=CompressionType.NONE).finish()
    start, end = first_chunk(whole)
    records = whole[start + 49 : end]
    assert struct.unpack_from("<I", whole, start + 33)[0] == zlib.crc32(records)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "the file is empty"),
        (b"\x28\xb5\x2f\xfd" + bytes(99), "is zstd-compressed; expected MCAP"),
        (b"SQLite format 3\0" + bytes(99), "is an SQLite database, as older ROS 2 bags are"),
        (b"#ROSBAG V2.0\n", "is a ROS 1 bag"),
        (b"hello world", "is text of an unknown kind"),
    ],
)
def test_other_files_are_refused(content: bytes, says: str, tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(content)
    with pytest.raises(FormatError) as raised:
        ingest(path)
    assert says in str(raised.value)


def test_real_bags_without_a_magnetometer_say_what_they_hold(real_data: Path) -> None:
    logs = sorted((real_data / "mcap_ros2").glob("*.mcap"))
    assert len(logs) == 11
    for path in logs:
        with pytest.raises(
            SourceError, match=r"no topic is a magnetometer's; expected one of: .* \("
        ):
            ingest(path)
