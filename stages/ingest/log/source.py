"""The [log] table of a source TOML: what a log does not say itself, or says of several sensors."""

from __future__ import annotations

import datetime
from typing import Annotated, Any, Literal

import numpy as np
import pydantic

from magtiles.stages.declare import IsoDate, Params, quantity
from magtiles.stages.ingest.source import SourceKind

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]

_WAYS = {
    "forward": (1.0, 0.0, 0.0),
    "back": (-1.0, 0.0, 0.0),
    "right": (0.0, 1.0, 0.0),
    "left": (0.0, -1.0, 0.0),
    "down": (0.0, 0.0, 1.0),
    "up": (0.0, 0.0, -1.0),
}
_AXES = "three of forward, back, right, left, down, up, such as 'forward,left,up'"


def _matrix(value: object) -> object:
    """Where the sensor's x, y and z point, in words, as the matrix sensor to body."""
    if not isinstance(value, str):
        return value
    words = [word.strip() for word in value.split(",")]
    if len(words) != 3 or any(word not in _WAYS for word in words):
        raise ValueError(_AXES)
    return tuple(zip(*(_WAYS[word] for word in words), strict=True))


def _orthogonal(matrix: Matrix) -> Matrix:
    if not np.allclose(np.array(matrix) @ np.array(matrix).T, np.eye(3), atol=1e-6):
        raise ValueError(f"an orthogonal 3 x 3 matrix, or {_AXES}")
    return matrix


Axes = Annotated[Matrix, pydantic.BeforeValidator(_matrix), pydantic.AfterValidator(_orthogonal)]
"""A matrix from a sensor's axes to the body's; TOML may say in words where x, y, z point."""


def _utc(value: object) -> object:
    # TOML has times of its own; JSON and the command line have only text.
    if isinstance(value, str):
        try:
            value = datetime.datetime.fromisoformat(value)
        except ValueError:
            raise ValueError("an ISO time such as 2021-04-21T06:30:58Z") from None
    if isinstance(value, datetime.datetime):
        zone = value.tzinfo or datetime.UTC
        return value.replace(tzinfo=zone).astimezone(datetime.UTC).isoformat()
    return value


UtcTime = Annotated[str, pydantic.BeforeValidator(_utc)]
"""A parameter that is an instant, kept as ISO text in UTC; without a zone it is UTC."""


class Columns(Params):
    """Which column, or which field of a message (``a.b.c``), holds what."""

    time: str | None = quantity(
        "1", default=None, doc="Time: text, or a number since 1970 or, with a date, since midnight."
    )
    date: str | None = quantity("1", default=None, doc="Date, as date_format.")
    year: str | None = quantity("1", default=None, doc="Year, with day_of_year.")
    day_of_year: str | None = quantity("1", default=None, doc="Day of the year, from 1.")
    field_total: str | None = quantity("1", default=None, doc="Total field.")
    field_x: str | None = quantity("1", default=None, doc="Field along the sensor's x.")
    field_y: str | None = quantity("1", default=None, doc="Field along the sensor's y.")
    field_z: str | None = quantity("1", default=None, doc="Field along the sensor's z.")
    latitude: str | None = quantity("1", default=None, doc="Latitude, degrees.")
    longitude: str | None = quantity("1", default=None, doc="Longitude, degrees.")
    easting: str | None = quantity("1", default=None, doc="Easting in crs.")
    northing: str | None = quantity("1", default=None, doc="Northing in crs.")
    height: str | None = quantity("1", default=None, doc="Height, m.")
    speed: str | None = quantity("1", default=None, doc="Speed over ground.")
    line: str | None = quantity("1", default=None, doc="Survey line.")
    flight: str | None = quantity("1", default=None, doc="Flight.")
    diurnal: str | None = quantity(
        "1", default=None, doc="Variation in time, or a base station's total field."
    )
    source: dict[str, str] = quantity(
        "1", default={}, doc="The survey's own columns to keep, each as source_<name>."
    )


class IngestLogParams(Params):
    """The [log] keys of a source: what a log does not say itself."""

    magnetometer_topic: str | None = quantity(
        "1", default=None, doc="Which magnetometer, where there are several."
    )
    fix_topic: str | None = quantity(
        "1", default=None, doc="Which receiver's fixes, where there are several."
    )
    attitude_topic: str | None = quantity(
        "1", default=None, doc="Which attitude, where there are several."
    )
    speed_topic: str | None = quantity(
        "1", default=None, doc="Which speed, where there are several."
    )
    units: str | None = quantity(
        "1", default=None, doc="Unit of the field; default what the format says."
    )
    sensor_to_body: Axes | None = quantity(
        "1",
        default=None,
        doc="Where the magnetometer's x, y, z point, such as 'forward,left,up', or the matrix "
        "from its axes to forward, right, down; default as written.",
    )
    imu_to_body: Axes | None = quantity(
        "1",
        default=None,
        doc="The same of the attitude's sensor; default forward,left,up in ROS messages, "
        "forward,right,down in ULog.",
    )
    lever_arm_m: Vector | None = quantity(
        "m", default=None, doc="From antenna to magnetometer: forward, right, down."
    )
    height_reference: Literal["ellipsoid", "mean_sea_level", "terrain"] | None = quantity(
        "1", default=None, doc="What heights count from; default what the format says."
    )
    undulation_m: float | None = quantity(
        "m",
        default=None,
        doc="Geoid height above the ellipsoid, where heights are above sea level.",
    )
    time_source: Literal["header", "log"] = quantity(
        "1", default="header", doc="Times of the messages' own headers, or of their recording."
    )
    start_time: UtcTime | None = quantity(
        "1", default=None, doc="UTC of the first sample of the field, where no clock is UTC."
    )
    time_unit: Literal["ns", "us", "ms", "s", "min", "h", "day"] = quantity(
        "1", default="s", doc="Unit of a numeric column of times."
    )
    time_format: str | None = quantity(
        "1", default=None, doc="Layout of a column of times, such as %H%M%S; default ISO."
    )
    date_format: str = quantity("1", default="%Y%m%d", doc="Layout of a column of dates.")
    date: IsoDate | None = quantity(
        "1", default=None, doc="Date of all rows, where times count from its midnight."
    )
    utc_offset_h: float | None = quantity(
        "h", default=None, ge=-14, le=14, doc="How much a table's local time is ahead of UTC."
    )
    max_gap_s: float = quantity(
        "s", default=2.0, gt=0, doc="Longest gap between fixes to interpolate over."
    )
    crs: str | None = quantity(
        "1", default=None, doc="CRS of a table's coordinates: EPSG code, PROJ string or WKT."
    )
    allow_ballpark_datum: bool = quantity(
        "1", default=False, doc="Accept a datum whose relation to WGS84 is not known."
    )
    height_m: float | None = quantity(
        "m", default=None, doc="Height of all rows, where no column holds it."
    )
    diurnal_datum_nt: float | None = quantity(
        "nT", default=None, doc="Quiet level that comes off a base station's total field."
    )
    column_units: dict[str, str] | None = quantity(
        "1", default=None, doc="Units of columns whose file does not say."
    )
    no_data: float | None = quantity(
        "1", default=None, doc="Number that marks a missing value in a table."
    )
    member: str | None = quantity(
        "1", default=None, doc="File of a zip archive that holds several."
    )
    columns: Columns | None = quantity(
        "1", default=None, doc="Where a table or a message of no known schema holds what."
    )


TRACK: SourceKind[IngestLogParams] = SourceKind("track", "log", IngestLogParams)


def rotation(axes: Matrix | None) -> Any:
    """The matrix (3, 3), or None where the axes stay as written."""
    return None if axes is None else np.array(axes, dtype=np.float64)
