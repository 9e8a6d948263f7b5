"""Stage ``ingest-grid``: a foreign grid file and its source TOML become an anomaly-grid/1."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages.declare import FILES, Stage
from magtiles.stages.ingest.gridded import (
    GridFile,
    RegularGrid,
    datum_attributes,
    read_grid,
    regular,
    settle,
)
from magtiles.stages.ingest.source import ANOMALY_GRID, TOTAL_FIELD_ANOMALY, IngestGridParams
from magtiles.stages.rows import Rows, by_rows, strips

_LOG = logging.getLogger(__name__)

_NECESSARY = ("height_m", "height_reference", "reference_field", "reference_epoch")

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
    file = read_grid(files, ANOMALY_GRID, params)
    own_sigma = file.raw.uncertainty is not None
    file = settle(file, _NECESSARY if own_sigma else (*_NECESSARY, "uncertainty_nt"))
    grid = regular(file)
    return _dataset(grid, _sigma(grid, file), file)


STAGE = Stage(
    name="ingest-grid",
    version=1,
    params=IngestGridParams,
    inputs={"files": FILES},
    output="anomaly-grid/1",
    run=ingest_grid,
)


def _sigma(grid: RegularGrid, file: GridFile[IngestGridParams]) -> Any:
    """1 sigma in nT: the file's own, and where it states none the key `uncertainty_nt`.

    A value that is not above zero, such as EMAG2's -888, is none; at voids it becomes NaN.
    """
    own, given = grid.uncertainty, file.params.uncertainty_nt
    if own is None:
        return np.asarray(given, dtype=np.float64)
    sigma = _StatedSigma(own, grid.values, given)
    lacking, marks, mark = sigma.lacking()
    if given is not None and not lacking:
        raise SourceError(
            f"key 'uncertainty_nt' is {given}, but the file {file.path.name} has its own "
            "uncertainty everywhere",
            where=file.where,
            remedy="remove the key",
        )
    if given is None and marks:
        raise FormatError(
            f"{marks} values of its uncertainty are {mark:g} or otherwise not above zero",
            where=file.path,
            remedy="set uncertainty_nt, which is then taken where the file states none",
        )
    if given is None and isinstance(own, float):
        return np.where(own > 0.0, own, np.nan)
    return by_rows(grid.values.shape, np.float64, sigma.rows)


@dataclass(frozen=True)
class _StatedSigma:
    """Sigma that a file states, beside its values, and what stands in for it."""

    own: Rows | float
    values: Rows
    given: float | None

    def rows(self, first: int, last: int) -> NDArray[np.float64]:
        """Rows of it."""
        own, lacks = self._read(first, last)
        stated = np.where(own > 0.0, own, np.nan)
        return stated if self.given is None else np.where(lacks, self.given, stated)

    def lacking(self) -> tuple[bool, int, float]:
        """Whether any value has none; how many marks stand in its place, and the first."""
        some, marks, mark = False, 0, 0.0
        for first, last in strips(self.values.shape):
            own, lacks = self._read(first, last)
            found = own[lacks & ~np.isnan(own)]
            mark = float(found[0]) if found.size and not marks else mark
            some, marks = some or bool(lacks.any()), marks + found.size
        return some, marks, mark

    def _read(self, first: int, last: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        values = self.values[first:last]
        own = self.own if isinstance(self.own, float) else self.own[first:last]
        full = np.broadcast_to(np.asarray(own), values.shape)
        return full, ~(full > 0.0) & ~np.isnan(values)


def _dataset(grid: RegularGrid, sigma: Any, file: GridFile[IngestGridParams]) -> xr.Dataset:
    params = file.params
    values = by_rows(grid.values.shape, np.float64, lambda a, b: grid.values[a:b])
    variables: dict[str, Any] = {
        "magnetic_anomaly": (
            grid.dims,
            values,
            {"units": "nT", "long_name": "magnetic anomaly", "grid_mapping": "crs"},
        ),
        "magnetic_anomaly_uncertainty": (
            grid.dims[: sigma.ndim],
            sigma,
            {"units": "nT", "long_name": "1 sigma of the magnetic anomaly"},
        ),
        "height": ((), np.float64(params.height_m), _height_attrs(params)),
    }
    if params.undulation_m is not None:
        variables["reference_surface_height"] = _reference_surface(params, file.where)
    attributes = _attrs(params, file.name, file.where)
    return grid.dataset(variables, attributes | datum_attributes(grid, file))


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
