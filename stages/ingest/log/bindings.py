"""Which messages mean what: known schemas, and those that a source's columns describe.

A binding says for one schema where in its messages each quantity stands. The types of ROS 2 are
those of common_interfaces, the others Foxglove's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages.ingest.log.rosmsg import Leaf
from magtiles.stages.ingest.log.source import Columns

Role = Literal["magnetometer", "fix", "attitude", "speed"]
ROLES: tuple[Role, ...] = ("magnetometer", "fix", "attitude", "speed")


@dataclass(frozen=True)
class Binding:
    """Where a type's messages hold a role's quantities.

    Attributes
    ----------
    columns : quantity to path.
    stamp : paths of the seconds and nanoseconds of the message's own time, or of the one value
        that holds it, or () where it has none.
    unit : of the field; None where the type does not say.
    height_reference : what heights count from; None where the type does not say.
    """

    columns: Mapping[str, str]
    stamp: tuple[str, ...] = ()
    unit: str | None = None
    height_reference: str | None = None

    @property
    def paths(self) -> tuple[str, ...]:
        """All that is to be decoded."""
        return (*self.stamp, *self.columns.values())


_ROS_STAMP = ("header.stamp.sec", "header.stamp.nanosec")


def _vector(prefix: str, names: str = "xyz") -> dict[str, str]:
    return {axis: f"{prefix}.{axis}" for axis in names}


_MAGNETIC_FIELD = Binding(
    _vector("magnetic_field") | {"covariance": "magnetic_field_covariance"}, _ROS_STAMP, "T"
)
_PLACE = {
    "latitude": "latitude",
    "longitude": "longitude",
    "height": "altitude",
    "covariance": "position_covariance",
    "covariance_type": "position_covariance_type",
}
_NAV_SAT_FIX = Binding(
    _PLACE | {"status": "status.status"}, _ROS_STAMP, height_reference="ellipsoid"
)
_IMU = Binding(
    {f"q{axis}": path for axis, path in _vector("orientation", "wxyz").items()}
    | {f"rate_{axis}": path for axis, path in _vector("angular_velocity").items()}
    | {"covariance": "orientation_covariance", "rate_covariance": "angular_velocity_covariance"},
    _ROS_STAMP,
)
_ODOMETRY = Binding(_vector("twist.twist.linear"), _ROS_STAMP)
_TWIST = Binding(_vector("twist.linear"), _ROS_STAMP)

KNOWN: Mapping[tuple[str, str], tuple[Role, Binding]] = {
    ("sensor_msgs/MagneticField", "cdr"): ("magnetometer", _MAGNETIC_FIELD),
    ("sensor_msgs/NavSatFix", "cdr"): ("fix", _NAV_SAT_FIX),
    ("sensor_msgs/Imu", "cdr"): ("attitude", _IMU),
    ("nav_msgs/Odometry", "cdr"): ("speed", _ODOMETRY),
    ("geometry_msgs/TwistStamped", "cdr"): ("speed", _TWIST),
    ("foxglove.LocationFix", "json"): (
        "fix",
        Binding(_PLACE, ("timestamp.sec", "timestamp.nsec")),
    ),
    ("foxglove.LocationFix", "protobuf"): (
        "fix",
        Binding(_PLACE, ("timestamp.seconds", "timestamp.nanos")),
    ),
}
"""By schema name (without ``/msg``) and encoding of the messages."""


def role_of(schema: str) -> Role | None:
    """What messages of a schema are good for, whatever their encoding."""
    name = schema.replace("/msg/", "/")
    return next((role for (known, _), (role, _) in KNOWN.items() if known == name), None)


def binding_of(
    schema: str, encoding: str, role: Role, columns: Columns | None, *, where: str
) -> Binding:
    """Where messages hold a role's quantities.

    Raises FormatError for a known type in an encoding that is not understood, SourceError for an
    unknown one that `columns` does not describe.
    """
    known = KNOWN.get((schema.replace("/msg/", "/"), encoding))
    if known is not None and known[0] == role:
        return known[1]
    if role_of(schema) == role:
        raise FormatError(
            f"the message encoding is '{encoding}'",
            where=where,
            expected=" or ".join(
                sorted(e for (n, e) in KNOWN if n == schema.replace("/msg/", "/"))
            ),
        )
    described = _described(role, columns)
    if described is None:
        raise SourceError(
            f"messages of '{schema or 'no schema'}' are not known as a {role}'s",
            where=where,
            remedy="say in [log.columns] which of their fields hold what",
        )
    return described


def _described(role: Role, columns: Columns | None) -> Binding | None:
    if columns is None:
        return None
    named = {
        "magnetometer": {
            "total": columns.field_total,
            "x": columns.field_x,
            "y": columns.field_y,
            "z": columns.field_z,
        },
        "fix": {
            "latitude": columns.latitude,
            "longitude": columns.longitude,
            "height": columns.height,
        },
    }.get(role, {})
    found = {name: path for name, path in named.items() if path is not None}
    stamp = () if columns.time is None else (columns.time,)
    complete = {"total"} <= found.keys() or {"x", "y", "z"} <= found.keys() or role == "fix"
    return Binding(found, stamp) if found and complete else None


def _header() -> list[tuple[str, str, int]]:
    return [
        (_ROS_STAMP[0], "int32", 1),
        (_ROS_STAMP[1], "uint32", 1),
        ("header.frame_id", "string", 1),
    ]


def _doubles(prefix: str, names: str = "xyz") -> list[tuple[str, str, int]]:
    return [(f"{prefix}.{axis}", "float64", 1) for axis in names]


def _covariance(path: str, size: int) -> list[tuple[str, str, int]]:
    return [(path, "float64", size)]


_LAYOUTS: Mapping[str, list[tuple[str, str, int]]] = {
    "sensor_msgs/MagneticField": [
        *_header(),
        *_doubles("magnetic_field"),
        *_covariance("magnetic_field_covariance", 9),
    ],
    "sensor_msgs/NavSatFix": [
        *_header(),
        ("status.status", "int8", 1),
        ("status.service", "uint16", 1),
        ("latitude", "float64", 1),
        ("longitude", "float64", 1),
        ("altitude", "float64", 1),
        *_covariance("position_covariance", 9),
        ("position_covariance_type", "uint8", 1),
    ],
    "sensor_msgs/Imu": [
        *_header(),
        *_doubles("orientation", "xyzw"),
        *_covariance("orientation_covariance", 9),
        *_doubles("angular_velocity"),
        *_covariance("angular_velocity_covariance", 9),
        *_doubles("linear_acceleration"),
        *_covariance("linear_acceleration_covariance", 9),
    ],
    "nav_msgs/Odometry": [
        *_header(),
        ("child_frame_id", "string", 1),
        *_doubles("pose.pose.position"),
        *_doubles("pose.pose.orientation", "xyzw"),
        *_covariance("pose.covariance", 36),
        *_doubles("twist.twist.linear"),
        *_doubles("twist.twist.angular"),
        *_covariance("twist.covariance", 36),
    ],
    "geometry_msgs/TwistStamped": [
        *_header(),
        *_doubles("twist.linear"),
        *_doubles("twist.angular"),
    ],
}


def check_layout(schema: str, layout: tuple[Leaf, ...], *, where: str) -> None:
    """Raise FormatError where a schema named as a known ROS type declares other fields than it."""
    true = _LAYOUTS.get(schema.replace("/msg/", "/"))
    if true is None:
        return
    expected = [str(Leaf(*leaf)) for leaf in true]
    found = [str(leaf) for leaf in layout]
    for row in range(max(len(expected), len(found))):
        has = found[row] if row < len(found) else "nothing"
        should = expected[row] if row < len(expected) else "nothing"
        if has != should:
            raise FormatError(
                f"schema '{schema}' declares '{has}' as its field {row + 1}",
                where=where,
                expected=f"'{should}', as that type is defined",
                remedy="it is another type under a known name: rename it, or convert the log",
            )
