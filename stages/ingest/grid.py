"""Stage ``ingest-grid``: a foreign grid file and its source TOML become an anomaly-grid/1."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import xarray as xr
from numpy.typing import NDArray
from pyproj.exceptions import CRSError

from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages import crs as coordinates
from magtiles.stages.declare import FILES, Stage
from magtiles.stages.ingest.axes import regular_axis, wrapped_longitudes
from magtiles.stages.ingest.cf_netcdf import read_cf
from magtiles.stages.ingest.files import sniff
from magtiles.stages.ingest.geosoft import read_geosoft
from magtiles.stages.ingest.gxf import read_gxf
from magtiles.stages.ingest.raster import KINDS as RASTERS
from magtiles.stages.ingest.raster import read_raster
from magtiles.stages.ingest.raw import RawGrid, nanotesla_per, refuse_infinite
from magtiles.stages.ingest.source import (
    ANOMALY_GRID,
    TOTAL_FIELD_ANOMALY,
    IngestGridParams,
    Source,
    locate_all,
    merge,
)
from magtiles.stages.ingest.unpack import unpacked
from magtiles.stages.ingest.xyz import read_xyz

_LOG = logging.getLogger(__name__)

_READERS: dict[str, Callable[[Path, IngestGridParams], RawGrid]] = {
    "geosoft": read_geosoft,
    "gxf": read_gxf,
    "netcdf": read_cf,
    "xyz": read_xyz,
    **{kind: functools.partial(read_raster, kind) for kind in RASTERS},
}
_NECESSARY = ("height_m", "height_reference", "reference_field", "reference_epoch")
_CREDIBLE_NT = 1e5  # no crustal anomaly is larger; the whole field is about 25-65 thousand nT

_HEIGHT_NAMES = {
    "ellipsoid": "height_above_reference_ellipsoid",
    "mean_sea_level": "height_above_mean_sea_level",
    "terrain": "height",
}


def ingest_grid(files: Sequence[Path], *, params: IngestGridParams) -> xr.Dataset:
    """One grid file as an anomaly-grid/1: nT, ascending nodes in metres or degrees, voids NaN.

    Parameters
    ----------
    files : the grid file in a format of `files.sniff`, plain or in gzip or zip; its source
        TOML; or both. The data file of an ER Mapper header is named beside it.
    params : the [grid] keys of the TOML; either may state them.

    Raises
    ------
    FormatError : the file is missing, empty, truncated, irregular, rotated, all void.
    SourceError : a key is missing, unknown, or contradicts the file; the datum is not known.
    IntegrityError : the file's digest is not the one its source states.
    """
    found, source = locate_all([Path(f) for f in files], ANOMALY_GRID)
    path = _header_of(found)
    where = str(path) if source is None else f"{source.path} [grid]"
    params = merge(params, source)
    raw = _read(path, params)
    refuse_infinite(raw.values, where=path)
    facts = _Facts(_settle(raw, params, path, where), where, path.name)
    grid = _oriented(raw, facts)
    return _dataset(grid, facts, _name(path, source))


STAGE = Stage(
    name="ingest-grid",
    version=1,
    params=IngestGridParams,
    inputs={"files": FILES},
    output="anomaly-grid/1",
    run=ingest_grid,
)


def _header_of(files: Sequence[Path]) -> Path:
    """The one grid file, or the header of the two that an ER Mapper grid is."""
    headers = [p for p in files if p.suffix.lower() == ".ers"]
    if (
        len(files) == 2
        and headers
        and files[1 - files.index(headers[0])] == headers[0].with_suffix("")
    ):
        return headers[0]
    if len(files) != 1:
        raise SourceError(
            f"{len(files)} data files: {', '.join(sorted(p.name for p in files))}",
            where="files",
            expected="one grid file",
            remedy="ingest each grid alone",
        )
    if headers:
        raise SourceError(
            "its data file is not named",
            where=files[0],
            expected=f"'{files[0].with_suffix('').name}' among the files too",
        )
    return files[0]


def _read(path: Path, params: IngestGridParams) -> RawGrid:
    with unpacked(path, params.member) as file:
        try:
            return _READERS[sniff(file)](file, params)
        except (FormatError, SourceError) as caught:
            if file == path:
                raise
            # The unpacked copy is gone when someone reads this: name the archive instead.
            where = str(caught.where).replace(str(file), f"{path} ({file.name})")
            raise type(caught)(
                caught.what, where=where, expected=caught.expected, remedy=caught.remedy
            ) from None


@dataclass(frozen=True)
class _Facts:
    """The settled [grid] keys, where they come from, and the file's name."""

    params: IngestGridParams
    where: str
    file: str


@dataclass(frozen=True)
class _Grid:
    """A grid in the conventions of the house."""

    values: NDArray[np.float64]
    uncertainty: NDArray[np.float64]
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    crs: pyproj.CRS


def _name(path: Path, source: Source[IngestGridParams] | None) -> str:
    return path.name if source is None else source.source.id


def _settle(raw: RawGrid, params: IngestGridParams, path: Path, where: str) -> IngestGridParams:
    """The keys with what the file itself states. Raises SourceError for a contradiction."""
    settled: dict[str, Any] = {}
    for key, stated in raw.says.items():
        given = getattr(params, key)
        if given is not None and not _same(key, stated, given):
            raise SourceError(
                f"key '{key}' is {given!r}, but the file {path.name} says {stated!r}",
                where=where,
                remedy="remove the key, or correct the file",
            )
        settled[key] = stated
    if raw.uncertainty is not None and params.uncertainty_nt is not None:
        raise SourceError(
            f"key 'uncertainty_nt' is {params.uncertainty_nt}, but the file {path.name} has its "
            "own uncertainty",
            where=where,
            remedy="remove the key",
        )
    params = params.model_copy(update=settled)
    required = _NECESSARY if raw.uncertainty is not None else (*_NECESSARY, "uncertainty_nt")
    for key in required:
        if getattr(params, key) is None:
            meaning = IngestGridParams.model_fields[key].description
            raise SourceError(
                f"key '{key}' is missing and the file {path.name} does not say ({meaning})",
                where=where,
                remedy=f"add {key} = ... under [grid] of its source TOML, or as a parameter",
            )
    return params


def _same(key: str, stated: object, given: object) -> bool:
    if key == "units":
        return nanotesla_per(str(stated), where=key) == nanotesla_per(str(given), where=key)
    if key == "no_data":
        # A void mark is compared as it is stored, often in single precision.
        return bool(np.float32(stated) == np.float32(given))  # type: ignore[arg-type]
    return stated == given


def _oriented(raw: RawGrid, facts: _Facts) -> _Grid:
    """Axes regular, ascending and in metres or degrees; values in nT."""
    if raw.values.shape != (raw.y.size, raw.x.size):
        raise FormatError(
            f"the values are {raw.values.shape}",
            where=facts.file,
            expected=f"{raw.y.size} rows x {raw.x.size} columns",
        )
    crs, metres = coordinates.in_metres(_settled_crs(raw, facts))
    x = regular_axis(raw.x, raw.x_ulp, where=f"{facts.file} axis x") * metres
    y = regular_axis(raw.y, raw.y_ulp, where=f"{facts.file} axis y") * metres
    columns, rows = np.arange(x.size), np.arange(y.size)
    if x[0] > x[-1]:
        x, columns = x[::-1], columns[::-1]
    if y[0] > y[-1]:
        y, rows = y[::-1], rows[::-1]
    if crs.is_geographic:
        x, order = wrapped_longitudes(x, where=f"{facts.file} axis x")
        columns = columns[order]
        _check_latitudes(y, facts)
    unit = facts.params.units or "nT"
    factor = nanotesla_per(unit, where=f"{facts.where} units")
    pick = np.ix_(rows, columns)
    if raw.uncertainty is None:
        uncertainty = np.asarray(facts.params.uncertainty_nt, dtype=np.float64)
    else:
        spread = raw.uncertainty if raw.uncertainty.ndim == 0 else raw.uncertainty[pick]
        uncertainty = spread * factor
    values = raw.values[pick] * factor
    _check_values(values, facts)
    return _Grid(values, uncertainty, np.ascontiguousarray(x), np.ascontiguousarray(y), crs)


def _settled_crs(raw: RawGrid, facts: _Facts) -> pyproj.CRS:
    """The file's CRS, or the key's; the key's too where it adds the datum the file leaves out."""
    given = None
    if facts.params.crs is not None:
        try:
            given = coordinates.horizontal(pyproj.CRS.from_user_input(facts.params.crs))
        except CRSError as caught:
            raise SourceError(
                f"key 'crs' is {facts.params.crs!r}, which PROJ does not know ({caught})",
                where=facts.where,
                expected="an EPSG code such as EPSG:32610, a PROJ string or WKT",
            ) from None
    if raw.crs is None:
        if given is None:
            raise SourceError(
                f"key 'crs' is missing and the file {facts.file} does not say",
                where=facts.where,
                remedy="add crs = ... under [grid] of its source TOML, or as a parameter",
            )
        return given
    own = coordinates.horizontal(raw.crs)
    if given is None:
        return own
    corners = np.array([raw.x[0], raw.x[-1]]), np.array([raw.y[0], raw.y[-1]])
    if not coordinates.agree(own, given, *corners):
        raise SourceError(
            f"key 'crs' is '{facts.params.crs}', but the file {facts.file} says "
            f"'{own.to_string()}'",
            where=facts.where,
            remedy="remove the key, or correct the file",
        )
    return own if coordinates.states_datum(own) else given


def _check_latitudes(y: NDArray[np.float64], facts: _Facts) -> None:
    if abs(y).max() > 90.0 + 1e-9:
        raise FormatError(
            f"latitude {y[np.argmax(abs(y))]:g}",
            where=f"{facts.file} axis y",
            expected="-90 to 90",
            remedy="check the CRS and the order of the axes",
        )


def _check_values(values: NDArray[np.float64], facts: _Facts) -> None:
    if np.isnan(values).all():
        raise FormatError(
            "every value is void",
            where=facts.file,
            remedy="check the key 'no_data' and the file's own void mark",
        )
    worst = int(np.nanargmax(np.abs(values)))
    if abs(values.flat[worst]) > _CREDIBLE_NT:
        row, column = np.unravel_index(worst, values.shape)
        raise FormatError(
            f"the value at row {row}, column {column} (from the south-west) is "
            f"{values.flat[worst]:g} nT",
            where=facts.file,
            expected=f"at most {_CREDIBLE_NT:g} in magnitude",
            remedy="if it marks a void, state it with the key 'no_data'; else check 'units'",
        )


def _dataset(grid: _Grid, facts: _Facts, name: str) -> xr.Dataset:
    params = facts.params
    dims = ("latitude", "longitude") if grid.crs.is_geographic else ("y", "x")
    dataset = xr.Dataset(
        {
            "magnetic_anomaly": (
                dims,
                grid.values,
                {"units": "nT", "long_name": "magnetic anomaly", "grid_mapping": "crs"},
            ),
            "magnetic_anomaly_uncertainty": (
                dims[: grid.uncertainty.ndim],
                grid.uncertainty,
                {"units": "nT", "long_name": "1 sigma of the magnetic anomaly"},
            ),
            "height": ((), np.float64(params.height_m), _height_attrs(params)),
            "crs": ((), np.int32(0), _cf_attrs(grid.crs)),
        },
        coords={
            dims[0]: (dims[0], grid.y, _AXIS_ATTRS[dims[0]]),
            dims[1]: (dims[1], grid.x, _AXIS_ATTRS[dims[1]]),
        },
        attrs=_attrs(params, name, facts.where) | _datum_attrs(grid, facts),
    )
    if params.undulation_m is not None:
        dataset["reference_surface_height"] = _reference_surface(params, facts.where)
    return dataset


_AXIS_ATTRS = {
    "x": {"units": "m", "standard_name": "projection_x_coordinate", "axis": "X"},
    "y": {"units": "m", "standard_name": "projection_y_coordinate", "axis": "Y"},
    "latitude": {"units": "degrees_north", "standard_name": "latitude", "axis": "Y"},
    "longitude": {"units": "degrees_east", "standard_name": "longitude", "axis": "X"},
}


def _cf_attrs(crs: pyproj.CRS) -> dict[str, Any]:
    # netCDF attributes hold numbers and text, not tuples of them by name.
    return {k: list(v) if isinstance(v, tuple) else v for k, v in crs.to_cf().items()}


def _height_attrs(params: IngestGridParams) -> dict[str, str]:
    return {
        "units": "m",
        "positive": "up",
        "standard_name": _HEIGHT_NAMES[str(params.height_reference)],
        "long_name": "height of the survey surface",
    }


def _reference_surface(params: IngestGridParams, where: str) -> xr.Variable:
    if params.height_reference != "mean_sea_level":
        raise SourceError(
            f"key 'undulation_m' with height_reference = '{params.height_reference}'",
            where=where,
            expected="only where heights are above mean sea level",
        )
    attrs = {"units": "m", "positive": "up", "long_name": "geoid height above the ellipsoid"}
    return xr.Variable((), np.float64(params.undulation_m), attrs)


def _attrs(params: IngestGridParams, name: str, where: str) -> dict[str, Any]:
    attrs: dict[str, Any] = {
        "Conventions": "CF-1.11",
        "anomaly_definition": params.anomaly_definition or TOTAL_FIELD_ANOMALY,
        "height_reference": params.height_reference,
        "reference_epoch": params.reference_epoch,
        "reference_field": params.reference_field,
        "source": name,
    }
    distance = params.source_distance_m
    if distance is None and params.height_reference == "terrain" and (params.height_m or 0.0) > 0:
        distance = params.height_m
    if params.line_spacing_m is None or distance is None:
        missing = "line_spacing_m" if params.line_spacing_m is None else "source_distance_m"
        _LOG.warning("%s: no %s, so the uncertainty has no aliasing term", where, missing)
    optional = {
        "line_spacing_m": params.line_spacing_m,
        "source_distance_m": distance,
        "wavelength_band_km": params.wavelength_band_km and list(params.wavelength_band_km),
    }
    return attrs | {k: v for k, v in optional.items() if v is not None}


def _datum_attrs(grid: _Grid, facts: _Facts) -> dict[str, Any]:
    """The operation to WGS84 over this grid's region, recorded so that later stages use it."""
    allow = facts.params.allow_ballpark_datum
    try:
        transformer = coordinates.to_wgs84(
            grid.crs,
            allow_ballpark=allow,
            region=coordinates.geographic_bounds(grid.crs, grid.x, grid.y),
        )
    except SourceError as caught:
        raise SourceError(
            caught.what,
            where=f"{facts.where} {caught.where}",
            expected=caught.expected,
            remedy=caught.remedy,
        ) from None
    operation = coordinates.datum_operation(transformer)
    attrs: dict[str, Any] = {
        "datum_operation": operation.name,
        "datum_pipeline": operation.pipeline,
    }
    if operation.accuracy_m is not None:
        attrs["datum_accuracy_m"] = operation.accuracy_m
    return attrs | ({"allow_ballpark_datum": 1} if allow else {})
