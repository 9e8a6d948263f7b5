"""roads/*.nc: opened from verified bytes, checked field by field, and read whole."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.releases.record_file import Record, check_range, problem, read_record
from magtiles.catalog.releases.road_table import ALWAYS, FEATURES, TABLE

_DIGEST = r"[0-9a-f]{64}"
_ATTRIBUTES: dict[str, str] = {
    "road": r"[A-Za-z0-9][A-Za-z0-9._-]*",
    "frame": "body: forward, right, down",
    "calibrated": "true|false",
    "direction": "forward|backward",
    "height_reference": "ellipsoid|mean_sea_level|terrain",
}
_RANGES: dict[str, tuple[float, float, bool]] = {
    "distance": (0.0, 1e9, False),
    "latitude": (-90.0, 90.0, False),
    "longitude": (-180.0, 180.0, False),
    "height": (-12_000.0, 1e6, True),
    "heading": (0.0, 360.0, True),
    "speed": (0.0, 1e3, True),
    "field_body": (-1e6, 1e6, False),
    "field_body_uncertainty": (1e-6, 1e6, False),
    "passes": (1, 2**31, False),
    "samples": (0, 2**31, False),
    "matchability": (0.0, 1.0, True),
    "feature_start": (0.0, 1e9, False),
    "feature_end": (0.0, 1e9, False),
    "feature_peak": (0.0, 1e9, False),
    "feature_axis": (0, 2, False),
}
"""What a query relies on: least, most, and whether NaN passes."""
_SPACING_TOLERANCE = 1e-6
"""Of the spacing, by which points may miss equal distances."""


class RoadData(Record):
    """A whole verified road file; times are as stored (see `road_table`)."""


def read_road(data: bytes, where: object) -> RoadData:
    """Parse the verified bytes of a road file; every breach raises IntegrityError."""
    record = read_record(data, where, TABLE, _wanted)
    _check_attributes(record.attributes, where)
    _check_values(record.variables, float(record.attributes["spacing_m"]), where)
    return RoadData(record.variables, record.attributes)


def _wanted(present: set[str]) -> tuple[str, ...]:
    return (*ALWAYS, *(FEATURES if present & set(FEATURES) else ()))


def _check_attributes(attributes: Mapping[str, Any], where: object) -> None:
    """Those that queries rely on."""
    for name, pattern in _ATTRIBUTES.items():
        value = attributes.get(name)
        if not (isinstance(value, str) and re.fullmatch(pattern, value)):
            raise problem(where, f"attribute {name} is {value!r}", pattern)
    for name, low, high in (("spacing_m", 1e-3, 1e6), ("matchability", 0.0, 1.0)):
        value = attributes.get(name, high if name == "matchability" else None)
        number = isinstance(value, (int, float, np.number))
        if not (number and low <= float(value) <= high):
            raise problem(where, f"attribute {name} is {value!r}", f"{low:g} to {high:g}")


def _check_values(variables: Mapping[str, NDArray[Any]], spacing: float, where: object) -> None:
    """What queries rely on: ranges, equal distances, digests."""
    for name, (low, high, missing) in _RANGES.items():
        if name in variables:
            check_range(where, name, variables[name], low, high, missing)
    distance = variables["distance"]
    even = distance[0] + spacing * np.arange(distance.size)
    if not (np.abs(distance - even) <= _SPACING_TOLERANCE * spacing).all():
        raise problem(where, "distance is uneven", f"steps of spacing_m = {spacing:g}")
    digests = variables["pass_digest"].tolist()
    for digest in digests:
        if not re.fullmatch(_DIGEST, digest):
            raise problem(where, f"pass_digest holds {digest!r}", "SHA-256 digests")
    if len(set(digests)) < len(digests):
        raise problem(where, "pass_digest holds a pass twice", "each pass once")
