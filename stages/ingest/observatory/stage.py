"""Stage ``ingest-observatory``: files of an observatory become one observatory-series/1."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic
import xarray as xr

from magtiles.catalog.flags import RecordFlag, flag_attributes
from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages.declare import FILES, Params, Stage, quantity
from magtiles.stages.ingest.observatory.content import read_content
from magtiles.stages.ingest.observatory.elements import Field, Station, reported, to_field
from magtiles.stages.ingest.observatory.iaga2002 import is_iaga2002, read_iaga2002
from magtiles.stages.ingest.observatory.imagcdf import is_imagcdf, read_imagcdf
from magtiles.stages.ingest.observatory.imf import is_imf, read_imf
from magtiles.stages.ingest.observatory.record import Record
from magtiles.stages.ingest.observatory.series import Combined, combine
from magtiles.stages.ingest.observatory.wdc_hourly import is_wdc_hourly, read_wdc_hourly
from magtiles.stages.ingest.source import SourceKind, locate_all, merge
from magtiles.stages.temporal.cadence import reduce_cadence

_LOG = logging.getLogger(__name__)

_READERS: dict[Callable[[bytes], bool], Callable[[bytes, Path], Record]] = {
    is_iaga2002: read_iaga2002,
    is_imf: read_imf,
    is_imagcdf: read_imagcdf,
    is_wdc_hourly: read_wdc_hourly,
}

_SAME_DEGREES, _SAME_METRES = 0.05, 200.0
"""What headers of one station may differ by: positions are revised and rounded."""


def _square(axes: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
    if len(axes) != 3 or any(len(row) != 3 for row in axes):
        raise ValueError("three rows of three numbers")
    return axes


Axes = Annotated[tuple[tuple[float, ...], ...], pydantic.AfterValidator(_square)]


class IngestObservatoryParams(Params):
    """The [series] keys of a source: what an observatory's files do not say themselves."""

    iaga_code: str | None = quantity(
        "1", default=None, pattern="^[A-Z0-9]{3,4}$", doc="Code of the station."
    )
    latitude: float | None = quantity(
        "degrees_north", default=None, ge=-90, le=90, doc="Geodetic latitude of the station."
    )
    longitude: float | None = quantity(
        "degrees_east", default=None, ge=-180, le=360, doc="Longitude of the station."
    )
    elevation_m: float | None = quantity(
        "m", default=None, ge=-500, le=9000, doc="Height of the station above mean sea level."
    )
    data_type: str | None = quantity(
        "1", default=None, min_length=1, doc="Level of processing, such as definitive."
    )
    declination_base_arcmin: float | None = quantity(
        "arcmin",
        default=None,
        doc="Declination that a reported D counts from, or of the axis that H lies along.",
    )
    sensor_axes: Axes | None = quantity(
        "1", default=None, doc="North, east, down (rows) of sensor axes U, V, W (columns)."
    )
    cadence: Literal["minute", "hour"] | None = quantity(
        "1", default=None, doc="Reduce to minute or hourly values; default: as recorded."
    )
    minute_filter: Literal["intermagnet", "usgs"] = quantity(
        "1",
        default="intermagnet",
        doc="Filter from seconds to minutes: INTERMAGNET's, or the USGS's, half a second later.",
    )


OBSERVATORY_SERIES = SourceKind("observatory-series", "series", IngestObservatoryParams)


def ingest_observatory(files: Sequence[Path], *, params: IngestObservatoryParams) -> xr.Dataset:
    """The files of one observatory as an observatory-series/1: nT in true north, east, down.

    Parameters
    ----------
    files : IAGA-2002, WDC hourly, IMFV1.23 or ImagCDF, each plain or (text) gzipped; or their
        source TOML, or both.
    params : the [series] keys of the TOML; either may state them.

    Raises
    ------
    FormatError : a file is missing, truncated, HTML, of another format; time goes backwards;
        the cadence is mixed; the elements do not fix the vector.
    SourceError : files of several stations; a key is missing, unknown or contradicts a file.
    IntegrityError : a file's digest is not the one its source states.
    """
    paths, source = locate_all([Path(f) for f in files], OBSERVATORY_SERIES)
    where = "parameters" if source is None else f"{source.path} [series]"
    params = merge(params, source)
    with ThreadPoolExecutor() as pool:  # reading and parsing hold no interpreter lock
        records = list(pool.map(_read, paths))
    station = _station(records, params, where)
    fields = [to_field(record, station) for record in records]
    combined = combine(records, fields)
    name = paths[0].name if source is None else source.source.id
    series = _dataset(combined, _attrs(records, fields, station, params, name))
    if params.cadence is None:
        return series
    return reduce_cadence(series, params.cadence, params.minute_filter)


STAGE = Stage(
    name="ingest-observatory",
    version=1,
    params=IngestObservatoryParams,
    inputs={"files": FILES},
    output="observatory-series/1",
    run=ingest_observatory,
)


def _read(path: Path) -> Record:
    content = read_content(path)
    for knows, read in _READERS.items():
        if knows(content):
            return read(content, path)
    start = content[:60].decode("latin-1").splitlines()[0]
    raise FormatError(
        f"is of an unknown format: it begins with '{start}'",
        where=f"{path} line 1",
        expected="IAGA-2002, WDC hourly means, IMFV1.23 or ImagCDF",
    )


def _station(records: Sequence[Record], params: IngestObservatoryParams, where: str) -> Station:
    """What files and parameters say together. Raises SourceError for a contradiction."""
    longitude = params.longitude
    if longitude is not None:
        longitude = (longitude + 180.0) % 360.0 - 180.0
    return Station(
        iaga_code=_code(records, params.iaga_code, where),
        latitude=_agreed(records, "latitude", params.latitude, where),
        longitude=_agreed(records, "longitude", longitude, where),
        elevation=_agreed(records, "elevation", params.elevation_m, where),
        declination_base=params.declination_base_arcmin,
        sensor_axes=params.sensor_axes,
    )


def _code(records: Sequence[Record], given: str | None, where: str) -> str:
    found, origin = given, where
    for record in records:
        code = record.header.iaga_code
        if code is None:
            continue
        if found is not None and code != found:
            raise SourceError(
                f"station code clash: {code}, but {origin} says {found}",
                where=record.where,
                expected="one station",
                remedy="ingest each station on its own",
            )
        found, origin = code, record.where
    if found is None:
        raise _missing("iaga_code", records[0].where, where)
    return found


def _agreed(records: Sequence[Record], name: str, given: float | None, where: str) -> float:
    """The given value, else the last file's. Raises SourceError where two disagree."""
    value, origin = given, where
    key = "elevation_m" if name == "elevation" else name
    for record in records:
        stated = getattr(record.header, name)
        if stated is None:
            continue
        same = _SAME_METRES if name == "elevation" else _SAME_DEGREES
        allowed = max(same, record.header.position_step)
        difference = 0.0 if value is None else abs(stated - value)
        if name == "longitude":
            difference = min(difference, 360.0 - difference)
        if difference > allowed:
            raise SourceError(
                f"the header's {name} is {stated:g}, but {origin} says {value:g}",
                where=record.where,
                expected=f"one {name}, within {allowed:g}",
                remedy=f"correct the header or the key '{key}'",
            )
        if given is None:
            value, origin = stated, record.where
    if value is None:
        raise _missing(key, records[0].where, where)
    return value


def _missing(key: str, file: str, where: str) -> SourceError:
    meaning = IngestObservatoryParams.model_fields[key].description
    return SourceError(
        f"key '{key}' is missing and the file {file} does not say ({meaning})",
        where=where,
        remedy=f"add {key} = ... under [series] of its source TOML, or as a parameter",
    )


def _attrs(
    records: Sequence[Record],
    fields: Sequence[Field],
    station: Station,
    params: IngestObservatoryParams,
    name: str,
) -> dict[str, Any]:
    types = sorted(
        {params.data_type or record.header.data_type or "unstated" for record in records}
    )
    origins = sorted({field.total for field in fields})
    if len(origins) > 1 and "vector" in origins:
        origins.remove("vector")  # there the total is left out
    absent = sorted({element for record in records for element in record.not_recorded})
    attrs: dict[str, Any] = {
        "Conventions": "CF-1.11",
        "iaga_code": station.iaga_code,
        "latitude": station.latitude,
        "longitude": station.longitude,
        "elevation": station.elevation,
        "data_type": ", ".join(types),
        "reported_elements": reported(records),
        "conversion": "; ".join(sorted({field.conversion for field in fields})),
        "total_field_from": ", ".join(origins),
        "source": name,
    }
    return attrs | ({"elements_not_recorded": ", ".join(absent)} if absent else {})


_LONG_NAMES = {
    "field_north": "magnetic field toward true north",
    "field_east": "magnetic field toward true east",
    "field_down": "magnetic field downward",
    "field_total": "magnitude of the magnetic field",
}


def _dataset(combined: Combined, attrs: dict[str, Any]) -> xr.Dataset:
    marked = int(((combined.flags & RecordFlag.MISSING_MARK) != 0).sum())
    counts = {
        "samples_without_row": combined.gaps,
        "samples_marked_missing": marked,
        "duplicate_rows": combined.duplicates,
        "overlaps_resolved": combined.resolved,
    }
    _LOG.info("%s: %s", attrs["iaga_code"], ", ".join(f"{v} {k}" for k, v in counts.items()))
    data: dict[str, Any] = {
        name: ("time", values, {"units": "nT", "long_name": long_name})
        for (name, long_name), values in zip(_LONG_NAMES.items(), combined.values, strict=True)
    }
    data["quality_flag"] = ("time", combined.flags, flag_attributes(RecordFlag))
    time = {"standard_name": "time", "long_name": "middle of what a value stands for, UTC"}
    return xr.Dataset(
        data,
        coords={"time": ("time", combined.time.astype("datetime64[ns]"), time)},
        attrs={**attrs, "cadence_s": combined.cadence_s, **counts},
    )
