"""From the elements that an observatory reports to north, east, down and total.

X, Y, Z are north, east, down. H is the horizontal intensity and D, I are declination and
inclination, but where H, E, Z are reported, H and E lie along and across a fixed direction, that
of the baseline declination. G is the vector's magnitude less the scalar's (INTERMAGNET Technical
Manual, component codes).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from magtiles.catalog.models import evaluate
from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages.ingest.field_model import igrf
from magtiles.stages.ingest.observatory.record import Real, Record

_LOG = logging.getLogger(__name__)

_SCALARS = ("F", "S", "G")
_RADIANS_PER_ARCMINUTE = np.pi / 10800.0


@dataclass(frozen=True)
class Station:
    """What is known of a station from its files and parameters.

    `sensor_axes` holds north, east, down (rows) of the sensor's axes U, V, W (columns).
    """

    iaga_code: str
    latitude: float
    longitude: float
    elevation: float
    declination_base: float | None = None
    sensor_axes: tuple[tuple[float, ...], ...] | None = None


@dataclass(frozen=True)
class Field:
    """North, east, down, total (4, rows) nT, and how they follow from what was reported.

    `total` says where the total is from: ``scalar``, ``vector minus G`` or ``vector``.
    """

    values: Real
    conversion: str
    total: str


def to_field(record: Record, station: Station) -> Field:
    """The field of a record in the navigation frame.

    Where no scalar is recorded the total is the vector's magnitude, and is said to be. Raises
    FormatError for a set of elements that does not fix the vector; SourceError for U, V, W
    without `sensor_axes`.
    """
    elements = record.header.elements
    has_scalar = elements[-1] in _SCALARS and (len(elements) > 3 or elements[-1] != "F")
    count = len(elements) - has_scalar
    vector = dict(zip(elements[:count], record.values[:count], strict=True))
    for needed, convert in _CONVERSIONS.items():
        if set(needed) <= set(vector):
            north, east, down, how = convert(vector, record, station)
            break
    else:
        raise _unusable(record)
    magnitude = np.sqrt(north**2 + east**2 + down**2)
    total, origin = _total(magnitude, record, elements[-1] if has_scalar else None)
    return Field(np.stack([north, east, down, total]), how, origin)


_Converted = tuple[Real, Real, Real, str]


def _total(magnitude: Real, record: Record, scalar: str | None) -> tuple[Real, str]:
    if scalar is None or np.isnan(record.values[-1]).all():
        return magnitude, "vector"
    if scalar == "G":
        return magnitude - record.values[-1], "vector minus G"
    return record.values[-1], "scalar"


def _from_xyz(vector: Mapping[str, Real], _: Record, __: Station) -> _Converted:
    return vector["X"], vector["Y"], vector["Z"], "X, Y, Z as reported"


def _from_hdz(vector: Mapping[str, Real], record: Record, station: Station) -> _Converted:
    d, note = _declination(vector, record, station)
    h = vector["H"]
    return h * np.cos(d), h * np.sin(d), vector["Z"], f"X = H cos D, Y = H sin D{note}"


def _from_dif(vector: Mapping[str, Real], record: Record, station: Station) -> _Converted:
    d, note = _declination(vector, record, station)
    i, f = vector["I"] * _RADIANS_PER_ARCMINUTE, vector["F"]
    h = f * np.cos(i)
    how = f"X = F cos I cos D, Y = F cos I sin D, Z = F sin I{note}"
    return h * np.cos(d), h * np.sin(d), f * np.sin(i), how


def _from_dhi(vector: Mapping[str, Real], record: Record, station: Station) -> _Converted:
    d, note = _declination(vector, record, station)
    h, i = vector["H"], vector["I"] * _RADIANS_PER_ARCMINUTE
    how = f"X = H cos D, Y = H sin D, Z = H tan I{note}"
    return h * np.cos(d), h * np.sin(d), h * np.tan(i), how


def _from_hez(vector: Mapping[str, Real], record: Record, station: Station) -> _Converted:
    base, note = _base(record, station), ""
    if base is None:
        base = _core_declination(record, station)
        note = ", the core field's for want of a baseline declination: approximate"
        _LOG.warning(
            "%s: H, E, Z without a baseline declination: the core field's, %.1f', stands in",
            record.where,
            base,
        )
    d, h, e = base * _RADIANS_PER_ARCMINUTE, vector["H"], vector["E"]
    how = f"X = H cos d - E sin d, Y = H sin d + E cos d, d = {base:.1f} arcmin{note}"
    return h * np.cos(d) - e * np.sin(d), h * np.sin(d) + e * np.cos(d), vector["Z"], how


def _from_uvw(vector: Mapping[str, Real], record: Record, station: Station) -> _Converted:
    if station.sensor_axes is None:
        raise SourceError(
            "wrong element set: U, V, W are axes of the sensor, whose directions it does not say",
            where=record.where,
            expected="X, Y, Z or another set that is tied to north",
            remedy="state them with the key 'sensor_axes'",
        )
    axes = np.array(station.sensor_axes)
    north, east, down = axes @ np.stack([vector[e] for e in "UVW"])
    how = f"sensor axes U, V, W by the matrix {axes.tolist()}"
    return north, east, down, how


_CONVERSIONS: dict[str, Callable[[Mapping[str, Real], Record, Station], _Converted]] = {
    "XYZ": _from_xyz,
    "HDZ": _from_hdz,
    "DIF": _from_dif,
    "DHI": _from_dhi,
    "HEZ": _from_hez,
    "UVW": _from_uvw,
}


def _unusable(record: Record) -> FormatError:
    return FormatError(
        f"wrong element set: {' '.join(record.header.elements)} does not fix the vector",
        where=record.where,
        expected=f"one of {', '.join(_CONVERSIONS)}, with or without a scalar F, S or G",
    )


def _base(record: Record, station: Station) -> float | None:
    if station.declination_base is not None:
        return station.declination_base
    return record.header.declination_base


def _declination(vector: Mapping[str, Real], record: Record, station: Station) -> tuple[Real, str]:
    base = _base(record, station) or 0.0
    note = f", D counted from {base:.1f} arcmin" if base else ""
    return (vector["D"] + base) * _RADIANS_PER_ARCMINUTE, note


def _core_declination(record: Record, station: Station) -> float:
    """Declination of the IGRF at the middle of a record, arcminutes."""
    date = record.time[record.time.size // 2]
    place = station.latitude, station.longitude, station.elevation
    north, east, _ = evaluate(igrf(), *place, date, allow_extrapolated=True)
    return float(np.arctan2(east, north) / _RADIANS_PER_ARCMINUTE)


def reported(records: Sequence[Record]) -> str:
    """The element sets of records, each once, such as ``HDZF, XYZF``."""
    return ", ".join(sorted({"".join(r.header.elements) for r in records}))
