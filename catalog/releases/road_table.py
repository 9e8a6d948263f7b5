"""The variables of a release's roads/*.nc (road-map/1): one table for writer and reader.

Times are stored as nanoseconds since 1970; missing values of floats are NaN.
"""

from __future__ import annotations

from magtiles.catalog.releases.record_file import NANOSECONDS, RecordTable, RecordVariable

CONTRACT = "road-map/1.0.0"
PATH = r"roads/(?P<name>[A-Za-z0-9][A-Za-z0-9._-]{0,120})\.nc"
"""Of a road's file in a release; `name` is the road's."""

FLOATS = ("float32", "float64")
_INTEGER = ("int32",)
_TEXT = ("str",)
_POINT = ("point",)
_FIELD = ("point", "axis")
_VEHICLE = ("vehicle", "point", "axis")


def road_name(road: str, direction: str) -> str:
    """The name of a map in a release: that of its road, and its direction where backward."""
    return f"{road}-backward" if direction == "backward" else road


_MOST = {"point": 10_000_000, "axis": 3, "vehicle": 1000, "pass": 100_000, "feature": 1_000_000}
"""Largest size of each dimension."""


def _exact(units: str, long_name: str, dims: tuple[str, ...] = _POINT) -> RecordVariable:
    return RecordVariable(dims, ("float64",), units, long_name)


def _float(units: str, long_name: str, dims: tuple[str, ...] = _POINT) -> RecordVariable:
    return RecordVariable(dims, FLOATS, units, long_name)


ROAD_VARIABLES: dict[str, RecordVariable] = {
    "axis": RecordVariable(("axis",), _TEXT, None, "axis of the vehicle"),
    "distance": _exact("m", "distance along the road"),
    "latitude": _exact("degrees_north", "geodetic latitude"),
    "longitude": _exact("degrees_east", "geodetic longitude"),
    "height": _float("m", "height of the road"),
    "heading": _float("degree", "heading of the vehicle, clockwise from true north"),
    "speed": _float("m s-1", "mean speed of the passes"),
    "field_body": _float("nT", "magnetic field along the axes of the vehicle", _FIELD),
    "field_body_uncertainty": _float("nT", "1 sigma of field_body", _FIELD),
    "variation_same_vehicle": _float("nT", "standard deviation of one vehicle's passes", _FIELD),
    "variation_cross_vehicle": _float("nT", "standard deviation of different vehicles", _FIELD),
    "passes": RecordVariable(_POINT, _INTEGER, None, "number of passes"),
    "samples": RecordVariable(_POINT, _INTEGER, None, "number of samples"),
    "quality_flag": RecordVariable(
        _POINT, ("uint8", "uint16"), None, "why a value is filled or doubtful"
    ),
    "matchability": _float("1", "share of the expected likelihood that lies within reach"),
    "vehicle_name": RecordVariable(("vehicle",), _TEXT, None, "name of the vehicle"),
    "vehicle_passes": RecordVariable(
        ("vehicle", "point"), _INTEGER, None, "number of passes of each vehicle"
    ),
    "vehicle_mean": _float("nT", "mean field of each vehicle", _VEHICLE),
    "vehicle_square_sum": _float("nT2", "sum of squared deviations from vehicle_mean", _VEHICLE),
    "pass_name": RecordVariable(("pass",), _TEXT, None, "name of the pass"),
    "pass_digest": RecordVariable(("pass",), _TEXT, None, "SHA-256 of the samples of the pass"),
    "pass_vehicle": RecordVariable(("pass",), _TEXT, None, "vehicle of the pass"),
    "pass_start": RecordVariable(("pass",), ("int64",), NANOSECONDS, "start of the pass, UTC"),
    "feature_start": _exact("m", "where a feature begins", ("feature",)),
    "feature_end": _exact("m", "where a feature ends", ("feature",)),
    "feature_peak": _exact("m", "where a feature peaks", ("feature",)),
    "feature_axis": RecordVariable(("feature",), ("int8",), None, "axis of the peak: 0, 1 or 2"),
    "feature_amplitude": _float("nT", "height of the peak", ("feature",)),
}

ALWAYS = (
    "distance", "latitude", "longitude", "height", "heading", "field_body",
    "field_body_uncertainty", "passes", "samples", "quality_flag", "vehicle_name",
    "vehicle_passes", "vehicle_mean", "vehicle_square_sum", "pass_name", "pass_digest",
    "pass_vehicle",
)  # fmt: skip
FEATURES = (
    "feature_start", "feature_end", "feature_peak", "feature_axis", "feature_amplitude",
)  # fmt: skip
"""Variables that stand together."""

TABLE = RecordTable(
    "road map", "road.nc", CONTRACT, ROAD_VARIABLES, _MOST, 1 << 31, {"point": 2, "axis": 3}
)
