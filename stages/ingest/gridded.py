"""Any grid file with its source TOML, made regular and ascending, in metres or degrees.

What every ingest of gridded values shares: choosing the reader, settling what the file and the
TOML's keys say, the axes, the CRS and its way to WGS84.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import pyproj
import xarray as xr
from numpy.typing import NDArray
from pyproj.exceptions import CRSError

from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages import crs as coordinates
from magtiles.stages.ingest.axes import regular_axis, unbroken_longitudes, wrapped_longitudes
from magtiles.stages.ingest.cf_netcdf import read_cf
from magtiles.stages.ingest.files import sniff
from magtiles.stages.ingest.geosoft import read_geosoft
from magtiles.stages.ingest.gxf import read_gxf
from magtiles.stages.ingest.raster import KINDS as RASTERS
from magtiles.stages.ingest.raster import read_raster
from magtiles.stages.ingest.raw import RawGrid, refuse_infinite
from magtiles.stages.ingest.source import GridFileParams, SourceKind, locate_all, merge
from magtiles.stages.ingest.unpack import unpacked
from magtiles.stages.ingest.xyz import read_xyz
from magtiles.stages.rows import Rows, in_strips

G = TypeVar("G", bound=GridFileParams)

_READERS: dict[str, Callable[[Path, GridFileParams], RawGrid]] = {
    "geosoft": read_geosoft,
    "gxf": read_gxf,
    "netcdf": read_cf,
    "xyz": read_xyz,
    **{kind: functools.partial(read_raster, kind) for kind in RASTERS},
}

_OTHERS_VOIDS = (9999.0, 88888.0, 99999.0)

_AXIS_ATTRS = {
    "x": {"units": "m", "standard_name": "projection_x_coordinate", "axis": "X"},
    "y": {"units": "m", "standard_name": "projection_y_coordinate", "axis": "Y"},
    "latitude": {"units": "degrees_north", "standard_name": "latitude", "axis": "Y"},
    "longitude": {"units": "degrees_east", "standard_name": "longitude", "axis": "X"},
}


@dataclass(frozen=True)
class GridFile(Generic[G]):
    """A grid file as read.

    Attributes
    ----------
    raw : its values and axes, and what it says itself.
    params : the keys of its source's table, or given directly.
    path : the file.
    name : the source's id, or the file's name.
    table : the source's table, such as grid.
    where : what keys are stated in, for messages.
    """

    raw: RawGrid
    params: G
    path: Path
    name: str
    table: str
    where: str


@dataclass(frozen=True)
class RegularGrid:
    """A grid in the conventions of the house: ascending, metres or degrees.

    `values` (rows, columns) and `uncertainty` (the same, or a number; None where there is none)
    in the unit of what is measured; `x`, `y` in the units of `crs`.
    """

    values: Rows
    uncertainty: Rows | float | None
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    crs: pyproj.CRS

    @property
    def dims(self) -> tuple[str, str]:
        """Names of its dimensions."""
        return ("latitude", "longitude") if self.crs.is_geographic else ("y", "x")

    def dataset(self, variables: dict[str, Any], attributes: dict[str, Any]) -> xr.Dataset:
        """A dataset on this grid, with its `crs`."""
        axes = dict(zip(self.dims, (self.y, self.x), strict=True))
        return xr.Dataset(
            variables | {"crs": ((), np.int32(0), _cf_attrs(self.crs))},
            coords={dim: (dim, axis, _AXIS_ATTRS[dim]) for dim, axis in axes.items()},
            attrs={"Conventions": "CF-1.11"} | attributes,
        )


def read_grid(files: Sequence[Path], kind: SourceKind[G], params: G) -> GridFile[G]:
    """Read the grid that `files` name.

    They are a data file in a format of `files.sniff`, plain or in gzip or zip; its source TOML;
    or both. The data file of an ER Mapper header is named beside it.

    Raises FormatError for files that are not there, damaged or infinite, SourceError for keys
    that are unknown or stated twice, IntegrityError for another digest than the one stated.
    """
    found, source = locate_all([Path(f) for f in files], kind)
    path = _header_of(found)
    params = merge(params, source)
    raw = _read(path, params)
    refuse_infinite(raw.values, where=path)
    name = path.name if source is None else source.source.id
    where = str(path) if source is None else f"{source.path} [{kind.table}]"
    return GridFile(raw, params, path, name, kind.table, where)


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


def _read(path: Path, params: GridFileParams) -> RawGrid:
    with unpacked(path, params.member) as file:
        try:
            grid = _READERS[sniff(file)](file, params)
            return grid if file == path else grid.in_memory()
        except (FormatError, SourceError) as caught:
            if file == path:
                raise
            # The unpacked copy is gone when someone reads this: name the archive instead.
            where = str(caught.where).replace(str(file), f"{path} ({file.name})")
            raise type(caught)(
                caught.what, where=where, expected=caught.expected, remedy=caught.remedy
            ) from None


def settle(grid: GridFile[G], necessary: Sequence[str]) -> GridFile[G]:
    """With the keys that the file itself states, and all that are necessary.

    Raises SourceError for a contradiction, and for a necessary key that neither states.
    """
    settled: dict[str, Any] = {}
    stated_keys = {k: v for k, v in grid.raw.says.items() if k in type(grid.params).model_fields}
    for key, stated in stated_keys.items():
        given = getattr(grid.params, key)
        if given is not None and not _same(key, stated, grid.params):
            raise SourceError(
                f"key '{key}' is {given!r}, but the file {grid.path.name} says {stated!r}",
                where=grid.where,
                remedy="remove the key, or correct the file",
            )
        settled[key] = stated
    params = grid.params.model_copy(update=settled)
    for key in necessary:
        if getattr(params, key) is None:
            meaning = type(params).model_fields[key].description
            raise SourceError(
                f"key '{key}' is missing and the file {grid.path.name} does not say ({meaning})",
                where=grid.where,
                remedy=f"add {key} = ... under [{grid.table}] of its source TOML, "
                "or as a parameter",
            )
    return replace(grid, params=params)


def _same(key: str, stated: object, params: GridFileParams) -> bool:
    given = getattr(params, key)
    if key == "units":
        of_file, of_key = (params.measures.per(str(u), where=key) for u in (stated, given))
        return of_file == of_key
    if key == "no_data":
        # A void mark is compared as it is stored, often in single precision.
        return bool(np.float32(stated) == np.float32(given))  # type: ignore[arg-type]
    return bool(stated == given)


def regular(grid: GridFile[G]) -> RegularGrid:
    """Its axes regular, ascending and in metres or degrees; values in the unit of the house.

    Raises FormatError for irregular axes, void grids and incredible values, SourceError for a
    CRS or a unit that is not known.
    """
    raw, file = grid.raw, grid.path.name
    _check_marks(grid)
    if raw.values.shape != (raw.y.size, raw.x.size):
        raise FormatError(
            f"the values are {raw.values.shape}",
            where=file,
            expected=f"{raw.y.size} rows x {raw.x.size} columns",
        )
    crs, metres = coordinates.in_metres(_settled_crs(grid))
    east = unbroken_longitudes(raw.x) if crs.is_geographic else raw.x
    x = regular_axis(east, raw.x_ulp, where=f"{file} axis x") * metres
    y = regular_axis(raw.y, raw.y_ulp, where=f"{file} axis y") * metres
    columns, rows = np.arange(x.size), np.arange(y.size)
    if x[0] > x[-1]:
        x, columns = x[::-1], columns[::-1]
    if y[0] > y[-1]:
        y, rows = y[::-1], rows[::-1]
    if crs.is_geographic:
        x, order = wrapped_longitudes(x, where=f"{file} axis x")
        columns = columns[order]
        _check_latitudes(y, file)
    measures = grid.params.measures
    factor = measures.per(grid.params.units or measures.unit, where=f"{grid.where} units")
    values, uncertainty = _Ordered(raw.values, rows, columns, factor), raw.uncertainty
    if isinstance(uncertainty, float):
        uncertainty *= factor
    elif uncertainty is not None:
        uncertainty = _Ordered(uncertainty, rows, columns, factor)
    _check_values(values, grid)
    return RegularGrid(values, uncertainty, np.ascontiguousarray(x), np.ascontiguousarray(y), crs)


@dataclass(frozen=True)
class _Ordered:
    """The values of a raw grid in other rows and columns, and in another unit."""

    raw: Rows
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    factor: float

    @property
    def shape(self) -> tuple[int, ...]:
        return self.rows.size, self.columns.size

    def __getitem__(self, rows: slice, /) -> NDArray[np.float64]:
        wanted = self.rows[rows]
        first = int(wanted.min())
        part = self.raw[first : int(wanted.max()) + 1]
        return part[np.ix_(wanted - first, self.columns)] * self.factor


def _settled_crs(grid: GridFile[G]) -> pyproj.CRS:
    """The file's CRS, or the key's; the key's too where it adds the datum the file leaves out."""
    raw, given = grid.raw, None
    if grid.params.crs is not None:
        try:
            given = coordinates.horizontal(pyproj.CRS.from_user_input(grid.params.crs))
        except CRSError as caught:
            raise SourceError(
                f"key 'crs' is {grid.params.crs!r}, which PROJ does not know ({caught})",
                where=grid.where,
                expected="an EPSG code such as EPSG:32610, a PROJ string or WKT",
            ) from None
    if raw.crs is None:
        if given is None:
            raise SourceError(
                f"key 'crs' is missing and the file {grid.path.name} does not say",
                where=grid.where,
                remedy=f"add crs = ... under [{grid.table}] of its source TOML, or as a parameter",
            )
        return given
    own = coordinates.horizontal(raw.crs)
    if given is None:
        return own
    corners = np.array([raw.x[0], raw.x[-1]]), np.array([raw.y[0], raw.y[-1]])
    if not coordinates.agree(own, given, *corners):
        raise SourceError(
            f"key 'crs' is '{grid.params.crs}', but the file {grid.path.name} says "
            f"'{own.to_string()}'",
            where=grid.where,
            remedy="remove the key, or correct the file",
        )
    return own if coordinates.states_datum(own) else given


def _check_latitudes(y: NDArray[np.float64], file: str) -> None:
    if abs(y).max() > 90.0 + 1e-9:
        raise FormatError(
            f"latitude {y[np.argmax(abs(y))]:g}",
            where=f"{file} axis y",
            expected="-90 to 90",
            remedy="check the CRS and the order of the axes",
        )


def _check_marks(grid: GridFile[G]) -> None:
    """Refuse what others mark voids with, where nobody says whether it does here."""
    if grid.params.no_data is not None:
        return
    count, mark = 0, 0.0
    for _, part in in_strips(grid.raw.values):
        marks = part[np.isin(np.abs(part), _OTHERS_VOIDS)]
        if marks.size:
            count, mark = count + marks.size, mark or float(marks[0])
    if count:
        raise FormatError(
            f"{count} values are {mark:g}, as in other files where there is no value",
            where=grid.path.name,
            expected="voids marked by the file, or by the key 'no_data'",
            remedy=f"set no_data = {mark:g}.0, or, if they are values, to a number that none is",
        )


def _check_values(values: Rows, grid: GridFile[G]) -> None:
    measures, void = grid.params.measures, True
    worst, place = 0.0, (0, 0)
    for first, part in in_strips(values):
        if np.isnan(part).all():
            continue
        void = False
        row, column = np.unravel_index(int(np.nanargmax(np.abs(part))), part.shape)
        if abs(part[row, column]) > abs(worst):
            worst, place = float(part[row, column]), (first + int(row), int(column))
    if void:
        raise FormatError(
            "every value is void",
            where=grid.path.name,
            remedy="check the key 'no_data' and the file's own void mark",
        )
    if abs(worst) > measures.largest:
        raise FormatError(
            f"the value at row {place[0]}, column {place[1]} (from the south-west) is "
            f"{worst:g} {measures.unit}",
            where=grid.path.name,
            expected=f"at most {measures.largest:g} in magnitude",
            remedy="if it marks a void, state it with the key 'no_data'; else check 'units'",
        )


def _cf_attrs(crs: pyproj.CRS) -> dict[str, Any]:
    # netCDF attributes hold numbers and text, not tuples of them by name.
    return {k: list(v) if isinstance(v, tuple) else v for k, v in crs.to_cf().items()}


def datum_attributes(grid: RegularGrid, file: GridFile[G]) -> dict[str, Any]:
    """The operation to WGS84 over this grid's region, recorded so that later stages use it."""
    allow = file.params.allow_ballpark_datum
    try:
        transformer = coordinates.to_wgs84(
            grid.crs,
            allow_ballpark=allow,
            region=coordinates.geographic_bounds(grid.crs, grid.x, grid.y),
        )
    except SourceError as caught:
        raise SourceError(
            caught.what,
            where=f"{file.where} {caught.where}",
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
