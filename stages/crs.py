"""Coordinate reference systems: the way to WGS84, metre axes, and whether two of them agree.

The PROJ network is off, so the operation found depends on nothing outside the machine. A
ballpark operation (one that ignores the datum, some 10-200 m) is refused unless allowed.
"""

from __future__ import annotations

import json
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyproj
import xarray as xr
from numpy.typing import NDArray
from pyproj import network
from pyproj.aoi import AreaOfInterest
from pyproj.transformer import TransformerGroup

from magtiles.schemas.errors import ContractError, SourceError

WGS84 = pyproj.CRS.from_epsg(4326)

_SAME_PLACE_DEG = 1e-7  # about 1 cm: projection parameters printed with few digits still agree


@dataclass(frozen=True)
class DatumOperation:
    """How coordinates become WGS84: name, accuracy in metres (None: not stated), PROJ pipeline."""

    name: str
    accuracy_m: float | None
    pipeline: str


def to_wgs84(
    crs: pyproj.CRS,
    *,
    allow_ballpark: bool = False,
    region: tuple[float, float, float, float] | None = None,
) -> pyproj.Transformer:
    """PROJ's best operation from `crs` (easting, northing) to WGS84 (longitude, latitude), degrees.

    Parameters
    ----------
    region : west, south, east, north in degrees. Old datums (NAD27) have one operation per
        region, so the best one is only found when the region is known.

    Raises SourceError when only a ballpark operation exists and `allow_ballpark` is False.
    """
    _offline()
    area: Any = None if region is None else AreaOfInterest(*region)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # better grids that are not installed
        group = TransformerGroup(
            crs, WGS84, always_xy=True, area_of_interest=area, allow_ballpark=allow_ballpark
        )
    if not group.transformers:
        datum = crs.datum.name if crs.datum is not None else "unknown"
        raise SourceError(
            f"how the datum '{datum}' relates to WGS84 is not known",
            where=f"crs '{crs.name}'",
            expected="a CRS whose datum is stated",
            remedy=f"state the whole CRS with its datum, as in crs = '{_with_datum(crs)}' in "
            "its source TOML, or accept an error of up to some 200 m with "
            "allow_ballpark_datum = true",
        )
    return group.transformers[0]


def _with_datum(crs: pyproj.CRS) -> str:
    """A CRS as a PROJ string with a datum, as an example, in place of its bare ellipsoid."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a PROJ string holds less than WKT
        words = crs.to_proj4().split()
    dropped = ("+ellps=", "+a=", "+b=", "+rf=", "+R=", "+no_defs", "+type=")
    return " ".join([*(w for w in words if not w.startswith(dropped)), "+datum=NAD27"])


def datum_operation(transformer: pyproj.Transformer) -> DatumOperation:
    """What to record of a `to_wgs84` operation."""
    accuracy = transformer.accuracy if transformer.accuracy >= 0 else None
    steps = [s for s in transformer.description.split(" + ") if "axis order" not in s]
    return DatumOperation(" + ".join(steps) or "none", accuracy, transformer.definition)


def dataset_crs(dataset: xr.Dataset) -> pyproj.CRS:
    """The CRS in a dataset's grid-mapping variable `crs`. Raises ContractError without one."""
    if "crs" not in dataset.variables:
        raise ContractError("the dataset has no variable 'crs'", expected="a CF grid mapping")
    return pyproj.CRS.from_cf(dataset["crs"].attrs)


def dataset_to_wgs84(dataset: xr.Dataset) -> pyproj.Transformer:
    """The operation to WGS84 of a dataset: the very one chosen at ingest, even after a crop.

    Input easting, northing (or longitude, latitude of its datum); output longitude, latitude
    in degrees. Raises SourceError as `to_wgs84`.
    """
    pipeline = dataset.attrs.get("datum_pipeline")
    if pipeline is not None:
        _offline()
        return pyproj.Transformer.from_pipeline(str(pipeline))
    allow = bool(dataset.attrs.get("allow_ballpark_datum", 0))
    return to_wgs84(dataset_crs(dataset), allow_ballpark=allow)


def horizontal(crs: pyproj.CRS) -> pyproj.CRS:
    """The two-dimensional part of a 3-D or compound CRS."""
    if crs.is_compound:
        crs = crs.sub_crs_list[0]
    return crs.to_2d() if len(crs.axis_info) == 3 else crs


def in_metres(crs: pyproj.CRS) -> tuple[pyproj.CRS, float]:
    """The same projection with axes in metres, and the metres in one unit of `crs`.

    Raises SourceError for a CRS that is neither projected nor geographic in degrees, or whose
    axes point west.
    """
    directions = {axis.direction for axis in crs.axis_info}
    if not (crs.is_projected or crs.is_geographic) or "west" in directions:
        raise SourceError(
            f"crs '{crs.name}' is {crs.type_name} with axes toward {', '.join(directions)}",
            expected="a projected or geographic CRS with axes east and north",
        )
    unit = crs.axis_info[0]
    if crs.is_geographic:
        if not np.isclose(unit.unit_conversion_factor, np.pi / 180):
            raise SourceError(f"crs '{crs.name}' counts in {unit.unit_name}", expected="degrees")
        return crs, 1.0
    if unit.unit_conversion_factor == 1.0:
        return crs, 1.0
    document = json.loads(crs.to_json())
    for axis in document["coordinate_system"]["axis"]:
        axis["unit"] = "metre"
    document["name"] += " in metres"
    document.pop("id", None)  # it is no longer that authority's CRS
    return pyproj.CRS.from_json_dict(document), unit.unit_conversion_factor


def states_datum(crs: pyproj.CRS) -> bool:
    """Whether the CRS names a datum, not an ellipsoid alone."""
    name = crs.datum.name.lower() if crs.datum is not None else "unknown"
    return not any(
        word in name for word in ("unknown", "not specified", "not_specified", "unnamed")
    )


def agree(
    first: pyproj.CRS, second: pyproj.CRS, x: NDArray[np.float64], y: NDArray[np.float64]
) -> bool:
    """Whether two CRS put the points (x, y) at the same place, within about a centimetre.

    An unstated datum on the same ellipsoid agrees with any; two stated datums must be one.
    """
    if first.equals(second, ignore_axis_order=True):
        return True
    if first.is_geographic != second.is_geographic or not _one_ellipsoid(first, second):
        return False
    apart = _on_own_datum(first, x, y) - _on_own_datum(second, x, y)
    if not np.all(np.abs(apart) < _SAME_PLACE_DEG):
        return False
    if not (states_datum(first) and states_datum(second)):
        return True
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        group = TransformerGroup(first.geodetic_crs, second.geodetic_crs, allow_ballpark=False)
    return any(t.accuracy == 0.0 for t in group.transformers)


def geographic_bounds(
    crs: pyproj.CRS, x: NDArray[np.float64], y: NDArray[np.float64]
) -> tuple[float, float, float, float]:
    """West, south, east, north (degrees, on the CRS's own datum) around axes x and y.

    Raises SourceError when the coordinates lie outside what the projection can represent.
    """
    own = pyproj.Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True)
    bounds = own.transform_bounds(x[0], y[0], x[-1], y[-1], densify_pts=51)
    if not np.all(np.isfinite(bounds)):
        raise SourceError(
            f"coordinates x {x[0]:g}..{x[-1]:g}, y {y[0]:g}..{y[-1]:g} lie outside the projection",
            where=f"crs '{crs.name}'",
            remedy="check the CRS and the unit of the coordinates",
        )
    west, south, east, north = bounds
    wrapped = [(lon + 180.0) % 360.0 - 180.0 if abs(lon) > 180.0 else lon for lon in (west, east)]
    return wrapped[0], south, wrapped[1], north


def _offline() -> None:
    network.set_network_enabled(active=False)  # type: ignore[attr-defined]  # missing in its stub


def _one_ellipsoid(first: pyproj.CRS, second: pyproj.CRS) -> bool:
    a, b = first.ellipsoid, second.ellipsoid
    if a is None or b is None:
        return False
    radii = (a.semi_major_metre, a.semi_minor_metre), (b.semi_major_metre, b.semi_minor_metre)
    return bool(np.allclose(*radii, rtol=0.0, atol=0.1))


def _on_own_datum(
    crs: pyproj.CRS, x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.float64]:
    own = pyproj.Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True)
    return np.asarray(own.transform(x, y), dtype=np.float64)
