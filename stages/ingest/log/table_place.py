"""Where each row of a table was: WGS84 from degrees or from a projection."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyproj
from numpy.typing import NDArray
from pyproj.exceptions import CRSError

from magtiles.catalog.kernels.geodesy import wrap_longitude
from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages.crs import datum_operation, to_wgs84
from magtiles.stages.ingest.log.source import Columns, IngestLogParams
from magtiles.stages.ingest.log.table import DEGREES, METRES, Table, Units
from magtiles.stages.vehicle.positions import Real


def row_places(
    table: Table, columns: Columns, params: IngestLogParams
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Latitude, longitude (WGS84, degrees) and height (m) of each row, and notes for attributes.

    Nothing where no column says where the rows are. With `crs` the columns are in that system,
    and the notes say which operation led to WGS84.

    Raises SourceError where columns or CRS are not clear, FormatError naming the line of a place
    that is not on the Earth.
    """
    pairs = (columns.latitude, columns.longitude), (columns.easting, columns.northing)
    if all(name is None for pair in pairs for name in pair):
        return {}, {}
    whole = [pair for pair in pairs if None not in pair]
    if len(whole) != 1 or any((a is None) != (b is None) for a, b in pairs):
        raise SourceError(
            "[log.columns] must name latitude and longitude, or easting and northing",
            where=table.where,
        )
    units = Units(table, params)
    north, east = whole[0] if columns.latitude is not None else whole[0][::-1]
    assert north is not None
    assert east is not None
    scale, unit = (DEGREES, "deg") if columns.latitude is not None else (METRES, "m")
    x, y = units.scaled(east, scale, unit), units.scaled(north, scale, unit)
    longitude, latitude, notes = _wgs84(table, params, x, y, flat=columns.latitude is None)
    _check(table, latitude, longitude)
    place = {"latitude": latitude, "longitude": wrap_longitude(longitude)}
    return place | {"height": _height(units, columns)}, notes


def _check(table: Table, latitude: Real, longitude: Real) -> None:
    wrong = (abs(latitude) > 90) | (abs(longitude) > 360)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise FormatError(
            f"latitude {latitude[row]:g}, longitude {longitude[row]:g}",
            where=table.at(row),
            expected="degrees on the Earth",
        )


def _wgs84(
    table: Table, params: IngestLogParams, x: Real, y: Real, *, flat: bool
) -> tuple[Real, Real, dict[str, Any]]:
    """Longitude and latitude of coordinates in the stated CRS; NaN stays."""
    crs = _crs(table, params, flat=flat)
    known = np.isfinite(x) & np.isfinite(y)
    if crs is None or not known.any():
        return x, y, {}
    own = pyproj.Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True)
    east, north = own.transform(x[known], y[known])
    inside = np.isfinite(east) & np.isfinite(north)
    if not inside.all():
        row = int(np.flatnonzero(known)[np.argmin(inside)])
        raise FormatError(
            f"{x[row]:g}, {y[row]:g} lies outside '{crs.name}'",
            where=table.at(row),
            remedy="check the CRS and the columns",
        )
    region = (east.min(), north.min(), east.max(), north.max())
    operation = to_wgs84(crs, allow_ballpark=params.allow_ballpark_datum, region=region)
    longitude, latitude = np.full((2, x.size), np.nan)
    longitude[known], latitude[known] = operation.transform(x[known], y[known])
    used = datum_operation(operation)
    notes: dict[str, Any] = {"datum_operation": used.name}
    if used.accuracy_m is not None:
        notes["datum_accuracy_m"] = used.accuracy_m
    return longitude, latitude, notes


def _crs(table: Table, params: IngestLogParams, *, flat: bool) -> pyproj.CRS | None:
    if params.crs is None:
        if flat:
            raise SourceError(
                "key 'crs' is missing",
                where=table.where,
                expected="that of easting and northing, such as EPSG:28355",
            )
        return None
    try:
        crs = pyproj.CRS.from_user_input(params.crs)
    except CRSError as caught:
        raise SourceError(f"key 'crs' is '{params.crs}': {caught}", where=table.where) from None
    if crs.is_projected is not flat:
        raise SourceError(
            f"key 'crs' is '{crs.name}'",
            where=table.where,
            expected=f"a {'projected' if flat else 'geographic'} CRS for the columns named",
        )
    return crs


def _height(units: Units, columns: Columns) -> Real:
    table, constant = units.table, units.params.height_m
    if columns.height is not None and constant is not None:
        raise SourceError(
            f"key 'height_m' is set, but column '{columns.height}' holds the height",
            where=table.where,
            remedy="remove one of them",
        )
    if columns.height is not None:
        return units.scaled(columns.height, METRES, "m")
    if constant is None:
        raise SourceError(
            "no column holds the height",
            where=table.where,
            expected="columns.height, or the key 'height_m' where it is one for all",
        )
    return np.full(table.number.size, constant)
