"""Grid eXchange Format (GXF revision 3, Geosoft 1999), text form.

Read here and not through GDAL: of GXF, GDAL 3.10 ignores ``#ROTATION`` and ``#TRANSFORM``,
reads a truncated file as if whole and misplaces values when rows do not start on a line.
"""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import rasterio
from numpy.typing import NDArray
from pyproj.exceptions import CRSError
from rasterio.errors import RasterioError

from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages.ingest.raw import RawGrid, mark_voids
from magtiles.stages.ingest.source import GridFileParams

_LOG = logging.getLogger(__name__)

_ONE_UNIT = 1e-6  # relative: US and international feet differ by twice that
_SAME_RADIUS_M = 0.01  # an eccentricity of few digits

_METRES = {
    "m": 1.0,
    "meter": 1.0,
    "meters": 1.0,
    "metre": 1.0,
    "metres": 1.0,
    "km": 1000.0,
    "kilometers": 1000.0,
    "kilometres": 1000.0,
    "feet": 0.3048,
    "us feet": 1200.0 / 3937.0,
    "us survey feet": 1200.0 / 3937.0,
}

# The USGS's non-standard projection keywords; both projections have two standard parallels.
_USGS_PROJECTIONS = {
    "lambert conformal conic": "lcc",
    "albers": "aea",
    "albers equal area": "aea",
    "albers equal area conic": "aea",
    "albers conical equal area": "aea",
}


def read_gxf(path: Path, params: GridFileParams) -> RawGrid:
    """A GXF grid; its values are at points, the first at the lower left.

    Raises FormatError where the file is truncated, compressed, rotated or malformed.
    """
    header, body = _split(path)
    shape = (int(_number(header, "ROWS", path)), int(_number(header, "POINTS", path)))
    _refuse_unusual(header, path)
    stored = _values(body, shape, path)
    dummy = _number(header, "DUMMY", path) if "DUMMY" in header else None
    values = mark_voids(stored, dummy if dummy is not None else params.no_data)
    scale, offset = _transform(header, path)
    x = _axis(header, "XORIGIN", "PTSEPARATION", shape[1], path)
    y = _axis(header, "YORIGIN", "RWSEPARATION", shape[0], path)
    says: dict[str, Any] = {"registration": "point"}
    if dummy is not None:
        says["no_data"] = dummy
    crs = _crs(header, path)
    if crs is None:
        _check_unit(header, params.crs, path)
    return RawGrid(values * scale + offset, x, y, crs, says=says)


def _split(path: Path) -> tuple[dict[str, list[str]], str]:
    """Keywords with the lines that follow each, and the text after #GRID."""
    text = path.read_text(encoding="latin-1")
    header: dict[str, list[str]] = {}
    keyword = None
    position = 0
    for line in text.splitlines(keepends=True):
        position += len(line)
        if line.startswith("#"):
            keyword = line[1:].split(maxsplit=1)[0].upper() if line[1:].strip() else ""
            if keyword == "GRID":
                return header, text[position:]
            header[keyword] = []
        elif keyword is not None and line.strip():
            header[keyword].append(line.strip())
    raise FormatError(
        "the keyword #GRID is missing",
        where=path,
        remedy="the file is truncated or not GXF: fetch it again",
    )


def _number(
    header: dict[str, list[str]], keyword: str, path: Path, default: float | None = None
) -> float:
    if keyword not in header:
        if default is not None:
            return default
        raise FormatError(f"the keyword #{keyword} is missing", where=path)
    try:
        value = float(header[keyword][0].split()[0])
    except (IndexError, ValueError):
        found = header[keyword][0] if header[keyword] else "nothing"
        raise FormatError(
            f"#{keyword} is followed by '{found}'", where=path, expected="a number"
        ) from None
    if not np.isfinite(value):
        raise FormatError(f"#{keyword} is {value}", where=path, expected="a finite number")
    return value


def _refuse_unusual(header: dict[str, list[str]], path: Path) -> None:
    unusual = {
        "ROTATION": (0.0, "resample the grid without rotation"),
        "SENSE": (1.0, "rewrite it with the first point at the lower left and rows along x"),
        "GTYPE": (0.0, "convert the compressed grid to GeoTIFF"),
    }
    for keyword, (usual, remedy) in unusual.items():
        value = _number(header, keyword, path, default=usual)
        if value != usual:
            raise FormatError(
                f"#{keyword} is {value:g}", where=path, expected=f"{usual:g}", remedy=remedy
            )


def _values(body: str, shape: tuple[int, int], path: Path) -> NDArray[np.float64]:
    words = body.split()
    expected = shape[0] * shape[1]
    if min(shape) < 1 or len(words) != expected:
        raise FormatError(
            f"{len(words)} values after #GRID",
            where=path,
            expected=f"#POINTS x #ROWS = {shape[1]} x {shape[0]} = {expected}",
            remedy="the file is truncated or damaged: fetch it again",
        )
    try:
        return np.array(words, dtype=np.float64).reshape(shape)
    except ValueError:
        index = next(i for i, word in enumerate(words) if not _is_number(word))
        raise FormatError(
            f"value {index} after #GRID is '{words[index]}'",
            where=f"{path} row {index // shape[1]}, point {index % shape[1]}",
            expected="a number",
        ) from None


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _transform(header: dict[str, list[str]], path: Path) -> tuple[float, float]:
    """Scale and offset from stored numbers to values."""
    words = " ".join(header.get("TRANSFORM", ["1 0"])).split()
    try:
        scale, offset = float(words[0]), float(words[1])
    except (IndexError, ValueError):
        raise FormatError(
            f"#TRANSFORM is '{' '.join(words)}'", where=path, expected="scale and offset"
        ) from None
    return scale, offset


def _axis(
    header: dict[str, list[str]], origin: str, separation: str, count: int, path: Path
) -> NDArray[np.float64]:
    step = _number(header, separation, path, default=1.0)
    if step <= 0:
        raise FormatError(f"#{separation} is {step:g}", where=path, expected="above zero")
    return _number(header, origin, path, default=0.0) + step * np.arange(count, dtype=np.float64)


def _crs(header: dict[str, list[str]], path: Path) -> pyproj.CRS | None:
    if "MAP_PROJECTION" in header:
        return _standard_crs(path)
    return _usgs_crs(header, path) if "PRJTYPE" in header else None


def _check_unit(header: dict[str, list[str]], given: str | None, path: Path) -> None:
    """Raise SourceError where the key `crs` counts in another unit than the file says."""
    said = "".join(header.get("UNIT_LENGTH", [])).split(",")
    if given is None or len(said) < 2 or not _is_number(said[1]):
        return
    try:
        axis = pyproj.CRS.from_user_input(given).axis_info[0]
    except (CRSError, IndexError):
        return  # which is said where the CRS is used
    metres = axis.unit_conversion_factor
    if "degree" not in axis.unit_name and abs(float(said[1]) / metres - 1.0) > _ONE_UNIT:
        raise SourceError(
            f"key 'crs' is '{given}', which counts in {axis.unit_name} ({metres:g} m), but "
            f"#UNIT_LENGTH is {', '.join(said[:2])}",
            where=path,
            remedy="state the CRS in the unit of the file, such as +units=us-ft",
        )


def _standard_crs(path: Path) -> pyproj.CRS | None:
    try:
        with rasterio.open(path, driver="GXF") as dataset:
            # GDAL leaves the zero meridian nameless, and PROJ then does not know the datum.
            wkt = dataset.crs.to_wkt().replace('PRIMEM["unnamed",0]', 'PRIMEM["Greenwich",0]')
            return _on_known_datum(pyproj.CRS.from_wkt(wkt))
    except (RasterioError, CRSError, AttributeError) as caught:  # no CRS at all is None
        _LOG.warning("%s: #MAP_PROJECTION is not understood (%s)", path.name, caught)
        return None


def _on_known_datum(crs: pyproj.CRS) -> pyproj.CRS:
    """The same projection on the datum that PROJ knows by the name the file gives."""
    document = json.loads(crs.to_json())
    base = document["base_crs"] if crs.is_projected else document
    for name in (base["name"], base.get("datum", {}).get("name")):
        try:
            known = pyproj.CRS.from_user_input(str(name))
        except CRSError:
            continue
        if known.is_geographic and _one_ellipsoid(crs, known):
            found = json.loads(known.to_json())
            base.pop("datum", None)
            base |= {k: found[k] for k in ("datum", "datum_ensemble") if k in found}
            return pyproj.CRS.from_json_dict(document)
    return crs


def _one_ellipsoid(first: pyproj.CRS, second: pyproj.CRS) -> bool:
    one, other = first.ellipsoid, second.ellipsoid
    return (
        one is not None
        and other is not None
        and abs(one.semi_major_metre - other.semi_major_metre) < _SAME_RADIUS_M
        and abs(one.semi_minor_metre - other.semi_minor_metre) < _SAME_RADIUS_M
    )


def _usgs_crs(header: dict[str, list[str]], path: Path) -> pyproj.CRS | None:
    """The CRS of the USGS's keywords: an ellipsoid by its radii, the datum not stated."""
    name = " ".join(header["PRJTYPE"]).lower()
    projection = _USGS_PROJECTIONS.get(name)
    if projection is None:
        _LOG.warning("%s: #PRJTYPE '%s' is not known, [grid] crs is needed", path.name, name)
        return None
    unit = " ".join(header.get("PRJUNIT", ["meters"])).lower()
    if unit not in _METRES:
        raise SourceError(
            f"#PRJUNIT is '{unit}'", where=path, expected=f"one of {', '.join(_METRES)}"
        )
    terms = {
        "a": "A_AXIS_RADIUS",
        "b": "B_AXIS_RADIUS",
        "lon_0": "RFLONGITUDE",
        "lat_0": "RFLATITUDE",
        "lat_1": "FIRST_STANDARD_PARALLEL",
        "lat_2": "SECOND_STANDARD_PARALLEL",
    }
    values: dict[str, Any] = {term: _number(header, key, path) for term, key in terms.items()}
    metres = _METRES[unit]
    values["x_0"] = _number(header, "FLSEASTING", path, default=0.0) * metres
    values["y_0"] = _number(header, "FLSNORTHING", path, default=0.0) * metres
    return pyproj.CRS.from_dict({"proj": projection, **values, "to_meter": metres})
