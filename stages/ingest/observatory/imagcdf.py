"""ImagCDF 1.2, INTERMAGNET's use of NASA's Common Data Format: nT, degrees, TT2000 times."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cdflib
import numpy as np
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError
from magtiles.stages.ingest.observatory.record import Header, Real, Record, Times, check_times

_MAGIC = (b"\xcd\xf3\x00\x01", b"\xcd\xf2\x60\x02")
_LEVELS = {"1": "variation", "2": "adjusted", "3": "quasi-definitive", "4": "definitive"}
_ANGLES = ("D", "I")
_PREFIX = "GeomagneticField"


def is_imagcdf(content: bytes) -> bool:
    """Whether the first bytes are a CDF's."""
    return content.startswith(_MAGIC)


def read_imagcdf(content: bytes, path: Path) -> Record:
    """The samples of an ImagCDF file; a scalar of another cadence where its times are the vector's.

    Raises FormatError for a damaged file, another use of CDF, a missing variable, units other
    than nT and degrees, times that go backwards or change their spacing.
    """
    try:
        with np.errstate(all="ignore"):
            return _read(cdflib.CDF(path), path)
    except FormatError:
        raise
    except Exception as caught:  # a damaged file fails anywhere in the library
        raise FormatError(
            f"cannot be read as CDF: {type(caught).__name__}: {caught}",
            where=path,
            expected="an ImagCDF file, not packed",
            remedy="the file is truncated, damaged or gzipped: unpack it or fetch it again",
        ) from None


def _read(file: Any, path: Path) -> Record:
    said = {key: _first(value) for key, value in file.globalattsget().items()}
    if "ElementsRecorded" not in said:
        raise FormatError(
            "the global attribute 'ElementsRecorded' is missing",
            where=path,
            expected="an ImagCDF file",
            remedy="this is another use of CDF",
        )
    elements = tuple(str(said["ElementsRecorded"]).strip().upper())
    columns = {e: _column(file, e, path) for e in elements}
    time = columns[elements[0]][0]
    values = np.stack([_at(time, *columns[e]) for e in elements])
    header = Header(
        iaga_code=str(said.get("IagaCode", "")).strip().upper() or None,
        elements=elements,
        latitude=_number(said, "Latitude"),
        longitude=_wrapped(_number(said, "Longitude")),
        elevation=_number(said, "Elevation"),
        data_type=_LEVELS.get(str(said.get("PublicationLevel", "")).strip()),
    )
    marked = np.asarray(np.isnan(values[:3]).any(axis=0))
    cadence = check_times(time, str(path), 1 + np.arange(time.size))
    return Record(str(path), header, time, values, marked, cadence)


def _first(value: Any) -> Any:
    return value[0] if isinstance(value, list) and value else value


def _number(said: dict[str, Any], name: str) -> float | None:
    return float(said[name]) if name in said else None


def _wrapped(longitude: float | None) -> float | None:
    return None if longitude is None else (longitude + 180.0) % 360.0 - 180.0


def _column(file: Any, element: str, path: Path) -> tuple[Times, Real]:
    """Times (rows,) and values (rows,), nT or arcminutes, of one element."""
    name = _PREFIX + element
    known = file.cdf_info().zVariables
    if name not in known:
        raise FormatError(
            f"the variable '{name}' is missing",
            where=path,
            expected=f"one for each of the elements recorded; it has {', '.join(known)}",
        )
    attributes = file.varattsget(name)
    values = np.asarray(file.varget(name), np.float64).ravel()
    values[values == float(np.ravel(attributes.get("FILLVAL", np.nan))[0])] = np.nan
    unit = str(_first(attributes.get("UNITS", ""))).strip().lower()
    angle = element in _ANGLES
    if not unit.startswith("deg" if angle else "nt"):
        raise FormatError(
            f"the unit of '{name}' is '{unit}'",
            where=path,
            expected="degrees" if angle else "nT",
            remedy="correct the attribute UNITS",
        )
    stamps = file.varget(str(_first(attributes["DEPEND_0"])))
    time: Times = np.asarray(cdflib.cdfepoch.to_datetime(stamps)).astype("datetime64[ns]")
    if time.shape != values.shape:
        raise FormatError(f"'{name}' has {values.size} values at {time.size} times", where=path)
    return time, values * 60.0 if angle else values


def _at(wanted: Times, time: Times, values: Real) -> Real:
    """Values at the wanted times, NaN where there is none."""
    if wanted.shape == time.shape and (wanted == time).all():
        return values
    found: NDArray[np.intp] = np.searchsorted(time, wanted).clip(0, time.size - 1)
    return np.where(time[found] == wanted, values[found], np.nan)
