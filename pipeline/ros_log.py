"""ROS 2 logs as MCAP: whole columns encoded at once (CDR), written by the package mcap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, IndexType, Writer
from numpy.typing import ArrayLike, NDArray

from magtiles.stages.release.atomic import atomic_path

Floats = NDArray[np.float64]
Times = NDArray[np.datetime64]

_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_CHUNK_BYTES = 1 << 20
_INDEX = IndexType.ALL & ~IndexType.MESSAGE
"""An index of messages, as long as they are once compressed, spares no reader a chunk here."""
_RULE = "=" * 80
_HEADER = f"""{_RULE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_RULE}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_VECTOR = f"""{_RULE}
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""
_DEFINITIONS = {
    "sensor_msgs/msg/MagneticField": f"""std_msgs/Header header
geometry_msgs/Vector3 magnetic_field
float64[9] magnetic_field_covariance
{_HEADER}{_VECTOR}""",
    "sensor_msgs/msg/NavSatFix": f"""std_msgs/Header header
sensor_msgs/NavSatStatus status
float64 latitude
float64 longitude
float64 altitude
float64[9] position_covariance
uint8 position_covariance_type
{_HEADER}{_RULE}
MSG: sensor_msgs/NavSatStatus
int8 status
uint16 service
""",
    "sensor_msgs/msg/Imu": f"""std_msgs/Header header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance
{_HEADER}{_RULE}
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
{_VECTOR}""",
    "geometry_msgs/msg/TwistStamped": f"""std_msgs/Header header
Twist twist
{_HEADER}{_RULE}
MSG: geometry_msgs/Twist
Vector3 linear
Vector3 angular
{_VECTOR}""",
}


@dataclass(frozen=True)
class Topic:
    """The messages of one topic.

    Attributes
    ----------
    schema : a ROS 2 type.
    logged : (n,) int64, when each was recorded, ns since 1970.
    messages : (n, bytes) uint8, encoded.
    """

    name: str
    schema: str
    logged: NDArray[np.int64]
    messages: NDArray[np.uint8]


def magnetic_field(
    name: str, time: Times, tesla: Floats, *, sigma_t: float, delay_s: float = 0.003
) -> Topic:
    """Fields (n, 3) T in the sensor's axes, stamped `time` and recorded `delay_s` later."""
    covariance = _covariance(len(time), sigma_t**2)
    fields = {"field": tesla, "covariance": covariance}
    return _topic(name, "sensor_msgs/msg/MagneticField", time, delay_s, "mag_link", fields)


def nav_sat_fix(
    name: str, time: Times, place: Floats, *, sigma_m: ArrayLike | None, delay_s: float = 0.08
) -> Topic:
    """Fixes (n, 3): latitude, longitude, degrees, and height above the ellipsoid, m.

    `sigma_m` is 1 sigma toward east, north and up, (3,) or (n, 3); None where it is not known.
    """
    known = sigma_m is not None
    covariance = _covariance(len(time), 0.0 if sigma_m is None else np.square(sigma_m))
    fields = {
        "status": np.zeros(len(time), "i1"),
        "service": np.ones(len(time), "<u2"),  # GPS
        "place": place,
        "covariance": covariance,
        "covariance_type": np.full(len(time), 2 if known else 0, "u1"),  # the diagonal, or nothing
    }
    return _topic(name, "sensor_msgs/msg/NavSatFix", time, delay_s, "gnss_link", fields)


def imu(
    name: str,
    time: Times,
    orientation: Floats | None,
    rate: Floats,
    acceleration: Floats,
    *,
    delay_s: float = 0.003,
) -> Topic:
    """Inertial measurements in axes forward, left, up (REP 103).

    Orientation (n, 4) is x, y, z, w, from those axes to east, north, up, or None where it is not
    measured; rate (n, 3) rad/s; acceleration (n, 3) m/s2, with what holds the sensor up.
    """
    known = orientation is not None
    unknown = np.tile([0.0, 0.0, 0.0, 1.0], (len(time), 1))
    covariance = _covariance(len(time), 0.0)
    fields = {
        "orientation": unknown if orientation is None else orientation,
        "orientation_covariance": covariance if known else _not_measured(len(time)),
        "rate": rate,
        "rate_covariance": covariance,
        "acceleration": acceleration,
        "acceleration_covariance": covariance,
    }
    return _topic(name, "sensor_msgs/msg/Imu", time, delay_s, "imu_link", fields)


def twist_stamped(name: str, time: Times, speed: Floats, *, delay_s: float = 0.01) -> Topic:
    """Speeds (n,) forward, m/s."""
    linear = np.column_stack([speed, np.zeros((len(speed), 2))])
    fields = {"linear": linear, "angular": np.zeros_like(linear)}
    return _topic(name, "geometry_msgs/msg/TwistStamped", time, delay_s, "base_link", fields)


def write_ros_log(path: Path, topics: Sequence[Topic]) -> None:
    """Write topics as MCAP (zstd, CRCs) in the order of recording; the same bytes every time."""
    logged = np.concatenate([topic.logged for topic in topics])
    which = np.repeat(np.arange(len(topics)), [len(topic.logged) for topic in topics])
    row = np.concatenate([np.arange(len(topic.logged)) for topic in topics])
    order = np.lexsort((which, logged))
    rows = [[message.tobytes() for message in topic.messages] for topic in topics]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        writer = Writer(
            file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD, index_types=_INDEX
        )
        writer.start(profile="ros2", library="magtiles")
        channels = [_channel(writer, topic) for topic in topics]
        steps = zip(which[order].tolist(), row[order].tolist(), logged[order].tolist(), strict=True)
        for topic, index, time in steps:
            writer.add_message(channels[topic], time, rows[topic][index], time, index)
        writer.finish()  # type: ignore[no-untyped-call]


def _channel(writer: Writer, topic: Topic) -> int:
    definition = _DEFINITIONS[topic.schema].encode("ascii")
    schema = writer.register_schema(topic.schema, "ros2msg", definition)
    return writer.register_channel(topic.name, "cdr", schema)


def _topic(
    name: str, schema: str, time: Times, delay_s: float, frame: str, fields: dict[str, Any]
) -> Topic:
    stamp = time.astype("datetime64[ns]").astype(np.int64)
    logged = stamp + round(1e9 * delay_s)
    return Topic(name, schema, logged, _encoded(stamp, frame, fields))


def _encoded(stamp: NDArray[np.int64], frame: str, fields: dict[str, Any]) -> NDArray[np.uint8]:
    """Messages as CDR: a header, then `fields` in order, each (n,) or (n, k).

    CDR aligns each number to its size as C does, counted after the four bytes that say how it
    is encoded; unlike a C structure it ends with its last number.
    """
    name = frame.encode("ascii") + b"\0"
    columns: dict[str, Any] = {
        "sec": (stamp // 10**9).astype("<i4"),
        "nanosec": (stamp % 10**9).astype("<u4"),
        "length": np.full(len(stamp), len(name), "<u4"),
        "frame": np.full(len(stamp), name, f"S{len(name)}"),
        **fields,
    }
    layout: Any = [(key, column.dtype, column.shape[1:]) for key, column in columns.items()]
    records = np.zeros(len(stamp), np.dtype(layout, align=True))
    for key, column in columns.items():
        records[key] = column
    layout = records.dtype.fields
    kind, offset = layout[next(reversed(columns))]
    body = records.view(np.uint8).reshape(len(stamp), -1)[:, : offset + kind.itemsize]
    start = np.frombuffer(_LITTLE_ENDIAN, np.uint8)
    return np.hstack([np.broadcast_to(start, (len(stamp), start.size)), body])


def _covariance(rows: int, variance: ArrayLike) -> Floats:
    covariance = np.zeros((rows, 9))
    covariance[:, [0, 4, 8]] = variance
    return covariance


def _not_measured(rows: int) -> Floats:
    covariance = _covariance(rows, 0.0)
    covariance[:, 0] = -1.0
    return covariance
