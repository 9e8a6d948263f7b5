"""Logs whose every message is known, written by the packages mcap and mcap_ros2, not by us."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from mcap.writer import CompressionType, Writer
from mcap_ros2._dynamic import serialize_dynamic

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
"""2023-11-14T22:13:20 UTC, nanoseconds."""

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
_QUATERNION = f"""{_RULE}
MSG: geometry_msgs/Quaternion
float64 x 0
float64 y 0
float64 z 0
float64 w 1
"""
_TWIST = f"""{_RULE}
MSG: geometry_msgs/Twist
Vector3  linear
Vector3  angular
"""
MAGNETIC_FIELD = (
    "std_msgs/Header header   # when\n\ngeometry_msgs/Vector3 magnetic_field\n"
    "float64[9] magnetic_field_covariance\n" + _HEADER + _VECTOR
)
NAV_SAT_FIX = (
    "std_msgs/Header header\nsensor_msgs/NavSatStatus status\nfloat64 latitude\n"
    "float64 longitude\nfloat64 altitude\nfloat64[9] position_covariance\n"
    "uint8 COVARIANCE_TYPE_UNKNOWN = 0\nuint8 position_covariance_type\n" + _HEADER + f"{_RULE}\n"
    "MSG: sensor_msgs/NavSatStatus\nint8 STATUS_NO_FIX =  -1\nint8 status\n"
    "uint16 SERVICE_GPS=1\nuint16 service\n"
)
IMU = (
    "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\n"
    "float64[9] orientation_covariance\ngeometry_msgs/Vector3 angular_velocity\n"
    "float64[9] angular_velocity_covariance\ngeometry_msgs/Vector3 linear_acceleration\n"
    "float64[9] linear_acceleration_covariance\n" + _HEADER + _QUATERNION + _VECTOR
)
TWIST_STAMPED = "std_msgs/Header header\nTwist twist\n" + _HEADER + _TWIST + _VECTOR
ODOMETRY = (
    "std_msgs/Header header\nstring child_frame_id\n"
    "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist\n"
    + _HEADER
    + f"{_RULE}\nMSG: geometry_msgs/PoseWithCovariance\nPose pose\nfloat64[36] covariance\n"
    + f"{_RULE}\nMSG: geometry_msgs/Pose\nPoint position\nQuaternion orientation\n"
    + f"{_RULE}\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
    + _QUATERNION
    + f"{_RULE}\nMSG: geometry_msgs/TwistWithCovariance\nTwist twist\nfloat64[36] covariance\n"
    + _TWIST
    + _VECTOR
)
SCHEMAS = {
    "sensor_msgs/msg/MagneticField": MAGNETIC_FIELD,
    "sensor_msgs/msg/NavSatFix": NAV_SAT_FIX,
    "sensor_msgs/msg/Imu": IMU,
    "nav_msgs/msg/Odometry": ODOMETRY,
    "geometry_msgs/msg/TwistStamped": TWIST_STAMPED,
}


def header(time: int, frame: str = "imu_link") -> dict[str, Any]:
    return {
        "stamp": {"sec": time // SECOND, "nanosec": time % SECOND},
        "frame_id": frame,
    }


def vector(values: Any, names: str = "xyz") -> dict[str, float]:
    return dict(zip(names, map(float, values), strict=True))


@dataclass
class Bag:
    """An MCAP file in the making; `finish` returns its bytes."""

    compression: CompressionType = CompressionType.ZSTD
    chunk_size: int = 4096
    options: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._out = io.BytesIO()
        self.writer = Writer(
            self._out, chunk_size=self.chunk_size, compression=self.compression, **self.options
        )
        self.writer.start(profile="ros2", library="tests")
        self._channels: dict[str, int] = {}
        self._encoders: dict[str, Callable[[Any], bytes]] = {}
        self._messages = 0

    def channel(self, topic: str, schema: str, text: bytes, encoding: str, form: str) -> int:
        if topic not in self._channels:
            number = self.writer.register_schema(schema, form, text)
            self._channels[topic] = self.writer.register_channel(topic, encoding, number)
        return self._channels[topic]

    def raw(self, channel: int, data: bytes, log_time: int) -> None:
        self._messages += 1
        self.writer.add_message(channel, log_time, data, log_time, self._messages)

    def ros(
        self, topic: str, schema: str, message: Any, log_time: int, text: str | None = None
    ) -> None:
        """A message of a ROS 2 type, as mcap_ros2 encodes it."""
        text = SCHEMAS[schema] if text is None else text
        channel = self.channel(topic, schema, text.encode(), "cdr", "ros2msg")
        if topic not in self._encoders:
            self._encoders[topic] = serialize_dynamic(schema, text)[schema]
        self.raw(channel, self._encoders[topic](message), log_time)

    def field(
        self, time: int, tesla: Any, *, topic: str = "/mag", frame: str = "imu_link",
        log_time: int | None = None, variance: float = 0.0,
    ) -> None:  # fmt: skip
        message = {
            "header": header(time, frame),
            "magnetic_field": vector(tesla),
            "magnetic_field_covariance": list(np.diag([variance] * 3).ravel()),
        }
        recorded = time + 3_000_000 if log_time is None else log_time
        self.ros(topic, "sensor_msgs/msg/MagneticField", message, recorded)

    def fix(
        self, time: int, latitude: float, longitude: float, altitude: float, *,
        status: int = 0, topic: str = "/gnss/fix", variance: float = 4.0,
    ) -> None:  # fmt: skip
        message = {
            "header": header(time, "gnss"),
            "status": {"status": status, "service": 1},
            "latitude": latitude,
            "longitude": longitude,
            "altitude": altitude,
            "position_covariance": list(np.diag([variance, variance, 4 * variance]).ravel()),
            "position_covariance_type": 2,
        }
        self.ros(topic, "sensor_msgs/msg/NavSatFix", message, time + 50_000_000)

    def imu(self, time: int, xyzw: Any, rate: Any = (0, 0, 0), *, topic: str = "/imu") -> None:
        zeros = [0.0] * 9
        message = {
            "header": header(time),
            "orientation": vector(xyzw, "xyzw"),
            "orientation_covariance": zeros,
            "angular_velocity": vector(rate),
            "angular_velocity_covariance": zeros,
            "linear_acceleration": vector((0, 0, 9.8)),
            "linear_acceleration_covariance": zeros,
        }
        self.ros(topic, "sensor_msgs/msg/Imu", message, time)

    def json(self, topic: str, schema: str, message: Any, log_time: int) -> None:
        channel = self.channel(topic, schema, b'{"type": "object"}', "json", "jsonschema")
        self.raw(channel, json.dumps(message).encode(), log_time)

    def finish(self) -> bytes:
        self.writer.finish()
        return self._out.getvalue()

    def save(self, path: Path) -> Path:
        path.write_bytes(self.finish())
        return path


def tesla(row: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """The field of a sample: 50,000 nT that turns slowly."""
    angle = 0.01 * row
    return np.array([2e-5 * np.cos(angle), 2e-5 * np.sin(angle), 4.5e-5])


def drive(rows: int = 200, *, fixes: bool = True, **how: Any) -> Bag:
    """A vehicle at 50 Hz that goes north at 10 m/s or so, with a fix every second."""
    bag = Bag(**how)
    for row in range(rows):
        time = START + row * SECOND // 50
        bag.field(time, tesla(row))
        if fixes and row % 50 == 0:
            bag.fix(time, 45.0 + row / 50 * 1e-4, 7.0, 300.0 + row / 50)
    return bag


def location_fix_type() -> tuple[Any, bytes]:
    """Foxglove's LocationFix as a protobuf class, and the file descriptor set that goes with it."""
    file = descriptor_pb2.FileDescriptorProto(
        name="foxglove/LocationFix.proto", package="foxglove", syntax="proto3",
        dependency=["google/protobuf/timestamp.proto"],
    )  # fmt: skip
    message = file.message_type.add(name="LocationFix")
    kinds = descriptor_pb2.FieldDescriptorProto
    single, repeated = kinds.LABEL_OPTIONAL, kinds.LABEL_REPEATED
    message.enum_type.add(name="PositionCovarianceType").value.add(name="UNKNOWN", number=0)
    for number, name, kind, label in [
        (1, "latitude", kinds.TYPE_DOUBLE, single),
        (2, "longitude", kinds.TYPE_DOUBLE, single),
        (3, "altitude", kinds.TYPE_DOUBLE, single),
        (4, "position_covariance", kinds.TYPE_DOUBLE, repeated),
        (7, "frame_id", kinds.TYPE_STRING, single),
    ]:
        message.field.add(name=name, number=number, type=kind, label=label)
    message.field.add(
        name="position_covariance_type", number=5, type=kinds.TYPE_ENUM, label=single,
        type_name=".foxglove.LocationFix.PositionCovarianceType",
    )  # fmt: skip
    message.field.add(
        name="timestamp", number=6, type=kinds.TYPE_MESSAGE, label=single,
        type_name=".google.protobuf.Timestamp",
    )  # fmt: skip
    stamp = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(stamp)
    files = descriptor_pb2.FileDescriptorSet(file=[stamp, file])
    pool = descriptor_pool.DescriptorPool()
    for one in files.file:
        pool.Add(one)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName("foxglove.LocationFix"))
    return kind, files.SerializeToString()


def first_chunk(data: bytes) -> tuple[int, int]:
    """Where the first chunk record of an MCAP file starts and ends."""
    at = 8
    while data[at] != 0x06:
        at += 9 + struct.unpack_from("<Q", data, at + 1)[0]
    return at, at + 9 + struct.unpack_from("<Q", data, at + 1)[0]


def ulog(topics: dict[str, tuple[str, list[bytes]]], *, start_us: int = 1000) -> bytes:
    """A ULog file: for ``name`` or ``name/instance`` the fields and each message's bytes."""

    def message(kind: str, content: bytes) -> bytes:
        return struct.pack("<HB", len(content), ord(kind)) + content

    out = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", start_us)
    out += message("B", bytes(40))
    for name in dict.fromkeys(topic.partition("/")[0] for topic in topics):
        fields = next(f for topic, (f, _) in topics.items() if topic.partition("/")[0] == name)
        out += message("F", f"{name}:{fields}".encode())
    for number, topic in enumerate(topics):
        name, _, instance = topic.partition("/")
        out += message("A", struct.pack("<BH", int(instance or 0), number) + name.encode())
    rows = [
        (struct.unpack_from("<Q", content)[0], number, content)
        for number, (_, contents) in enumerate(topics.values())
        for content in contents
    ]
    for _, number, content in sorted(rows):
        out += message("D", struct.pack("<H", number) + content)
    return out
