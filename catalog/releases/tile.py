"""One tile: opened from verified bytes, checked, and read level by level."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import netCDF4
import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.kernels.bspline import HALO, Floats, prefilter
from magtiles.catalog.kernels.geodesy import metres_per_degree
from magtiles.catalog.kernels.vertical import AMBIENT, hermite_planes, required_variables
from magtiles.catalog.releases.hdf5 import LOCK
from magtiles.catalog.releases.manifest import Manifest, TileRecord
from magtiles.catalog.releases.tile_table import CONTRACT, NODES, TILE_VARIABLES
from magtiles.schemas.errors import IntegrityError

SURFACE = "reference_surface_height"
BLOCK = 96
"""Cells, each way, whose spline coefficients are made at a time: a first query pays for one
block, not for a tile. A block has its own halo, so blocks are as seamless as tiles."""

Window = tuple[slice, slice]

_ALL: Window = (slice(None), slice(None))

_COORDINATE_TOLERANCE = 1e-6
"""Cells by which a tile's coordinates may differ from the lattice."""


class Tile:
    """A verified tile in memory; `nbytes` is what it holds, caches included.

    Its caches are not thread-safe: the store holds a lock. Raises IntegrityError when the bytes
    are no tile of this release.
    """

    def __init__(self, data: bytes, record: TileRecord, manifest: Manifest) -> None:
        self.record = record
        self._manifest = manifest
        self.nbytes = len(data)
        self._planes: dict[tuple[str, int], NDArray[Any]] = {}
        self._coefficients: dict[tuple[str, int, int, int], Floats] = {}
        self._core = manifest.lattice.core(record.row, record.column)
        self._file: Any = None
        try:
            with LOCK:
                # Without cycles in it, the file is closed here and not by whichever thread
                # collects garbage while another one is inside HDF5.
                self._file = netCDF4.Dataset("tile.nc", memory=data, keepweakref=True)
                self._file.set_auto_maskandscale(False)
                self._check()
        except (OSError, RuntimeError, AttributeError, ValueError) as caught:
            raise self._problem(f"is no readable tile: {caught}", "netCDF-4") from None

    def close(self) -> None:
        """Give the file's memory back; arrays already handed out stay valid."""
        with LOCK:
            file, self._file = self._file, None
            if file is not None:
                file.close()

    __del__ = close

    def plane(self, name: str, level: int = 0) -> NDArray[Any]:
        """One variable at one level (or the whole of a two-dimensional one), halo included."""
        key = (name, level)
        if key not in self._planes:
            self._planes[key] = self._read(name, level, _ALL)
            self.nbytes += self._planes[key].nbytes
        return self._planes[key]

    def _read(self, name: str, level: int, window: Window) -> NDArray[Any]:
        try:
            with LOCK:
                variable = self._variable(name)
                place = (level, *window) if len(variable.dimensions) == 3 else window
                values = np.asarray(variable[place])
        except (OSError, RuntimeError) as caught:
            raise self._problem(f"{name} cannot be read: {caught}", "whole data") from None
        return self._finite(name, values)

    def everything(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """All arrays by name, and the global attributes."""
        with LOCK:
            arrays = {
                name: self._finite(name, np.asarray(variable[...]))
                for name, variable in self._file.variables.items()
            }
            return arrays, {name: self._file.getncattr(name) for name in self._file.ncattrs()}

    def coefficients(
        self, family: str, level: int, block: tuple[int, int]
    ) -> tuple[Floats, tuple[int, int]]:
        """Spline coefficients of a block, and the tile node its first node is.

        `family` is "total", "vector" or "tensor" with (rows, columns, 3 * components), the
        orders of `hermite_planes` first, or "surface" with one channel.
        """
        window, origin = self._window(block)
        key = (family, level, *block)
        if key not in self._coefficients:
            if family == "surface":
                nodes = self._read(SURFACE, 0, window)[..., None].astype(np.float64)
            else:
                nodes = self._hermite(family, level, window)
            self._coefficients[key] = prefilter(nodes)
            self.nbytes += self._coefficients[key].nbytes
        return self._coefficients[key], origin

    def _window(self, block: tuple[int, int]) -> tuple[Window, tuple[int, int]]:
        first = (block[0] * BLOCK, block[1] * BLOCK)
        last = [min(f + BLOCK, n) + 2 * HALO + 1 for f, n in zip(first, self._core, strict=True)]
        return (slice(first[0], last[0]), slice(first[1], last[1])), first

    def _hermite(self, family: str, level: int, window: Window) -> Floats:
        names = required_variables(family) + (AMBIENT if family == "total" else ())
        planes = {name: self._read(name, level, window) for name in names}
        with_surface = self._manifest.has_reference_surface
        surface = self._read(SURFACE, 0, window) if with_surface else 0.0
        lattice = self._manifest.lattice
        latitude = lattice.tile_axes(self.record.row, self.record.column)[0][window[0], None]
        nodes = hermite_planes(
            family, planes, *node_spacing(self._manifest, latitude, level, surface)
        )
        return nodes.reshape(*nodes.shape[:2], -1)

    def _variable(self, name: str) -> Any:
        if name not in self._file.variables:
            raise self._problem(f"has no variable {name}", "all of " + ", ".join(TILE_VARIABLES))
        return self._file.variables[name]

    def _finite(self, name: str, values: NDArray[Any]) -> NDArray[Any]:
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise self._problem(f"{name} holds values that are not finite", "finite values")
        return values

    def _check(self) -> None:
        """The contract field by field, without reading any data but the coordinates."""
        wanted = {
            "contract": CONTRACT,
            "tile_row": self.record.row,
            "tile_column": self.record.column,
            "halo_cells": HALO,
            "core_rows": self._core[0],
            "core_columns": self._core[1],
            "height_reference": self._manifest.height_reference,
        }
        for key, value in wanted.items():
            found = self._file.getncattr(key) if key in self._file.ncattrs() else None
            if found != value:
                raise self._problem(f"attribute {key} is {found!r}", f"{value!r}")
        sizes = {
            "height": len(self._manifest.heights_m),
            "latitude": self._core[0] + 2 * HALO + 1,
            "longitude": self._core[1] + 2 * HALO + 1,
        }
        for name, rule in TILE_VARIABLES.items():
            if rule.required or (name == SURFACE and self._manifest.has_reference_surface):
                self._check_variable(name, tuple(sizes[d] for d in rule.dims))
        unknown = sorted(set(self._file.variables) - set(TILE_VARIABLES))
        if unknown or self._file.groups:
            raise self._problem(f"holds {unknown or 'groups'}", "only the tile's variables")
        self._check_coordinates()

    def _check_variable(self, name: str, shape: tuple[int, ...]) -> None:
        rule, variable = TILE_VARIABLES[name], self._variable(name)
        found = (variable.dimensions, variable.shape, variable.dtype.name)
        if found != (rule.dims, shape, rule.dtype):
            raise self._problem(
                f"{name} has dims, shape and dtype {found}", f"{(rule.dims, shape, rule.dtype)}"
            )
        units = variable.getncattr("units") if "units" in variable.ncattrs() else None
        if units != rule.units:
            raise self._problem(f"{name} has units {units!r}", f"{rule.units!r}")
        # Values of HDF5 data that is not chunked may lie in another file of the machine.
        if shape and not isinstance(variable.chunking(), list):
            raise self._problem(f"{name} is stored contiguously", "chunked data")

    def _check_coordinates(self) -> None:
        lattice = self._manifest.lattice
        heights = np.asarray(self._variable("height")[:])
        if not np.array_equal(heights, np.array(self._manifest.heights_m)):
            raise self._problem(f"height is {heights}", f"{self._manifest.heights_m}")
        axes = lattice.tile_axes(self.record.row, self.record.column)
        spacings = (lattice.latitude_spacing, lattice.longitude_spacing)
        for name, axis, spacing in zip(NODES, axes, spacings, strict=True):
            error = np.abs(np.asarray(self._variable(name)[:]) - axis).max() / spacing
            if not error <= _COORDINATE_TOLERANCE:
                raise self._problem(f"{name} is {error:.3g} cells off", "the manifest's lattice")

    def _problem(self, what: str, expected: str) -> IntegrityError:
        return IntegrityError(
            what, where=self.record.path, expected=expected, remedy="build the release again"
        )


def node_spacing(
    manifest: Manifest, latitude: Floats, level: int, surface: NDArray[Any] | float
) -> tuple[Floats, Floats]:
    """Metres between neighbouring nodes northward and eastward, on one level."""
    height = manifest.heights_m[level] + np.asarray(surface, np.float64)
    north, east = metres_per_degree(latitude, height)
    return north * manifest.lattice.latitude_spacing, east * manifest.lattice.longitude_spacing


@dataclass(frozen=True)
class TileData:
    """A whole verified tile: its record, its arrays by name (read-only), its attributes."""

    record: TileRecord
    variables: dict[str, NDArray[Any]]
    attributes: dict[str, Any] = field(default_factory=dict)
