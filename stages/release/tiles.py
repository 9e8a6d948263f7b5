"""Cutting one tile, all levels, from level-wide component grids."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import xarray as xr

from magtiles.catalog.kernels.bspline import HALO
from magtiles.catalog.releases.lattice import Lattice
from magtiles.catalog.releases.tile_table import CONTRACT, LEVELS, NODES, TILE_VARIABLES
from magtiles.schemas.errors import ContractError, CoverageError
from magtiles.stages.declare import Many, OptionalInput, Params, Stage, quantity

_COORDINATES = ("height", "latitude", "longitude", "crs")
_SURFACE = "reference_surface_height"
_NODE_TOLERANCE = 1e-6
"""Of a cell: how far a grid's node may lie from the lattice's, for rounding."""


class CutTilesParams(Params):
    """Parameters of cut-tiles: the lattice of all tiles, and which tile of it."""

    south: float = quantity("degrees_north", doc="Latitude of the lattice's corner.")
    west: float = quantity("degrees_east", doc="Longitude of the lattice's corner.")
    latitude_spacing: float = quantity("degree", gt=0, doc="Node spacing northward.")
    longitude_spacing: float = quantity("degree", gt=0, doc="Node spacing eastward.")
    rows: int = quantity("1", gt=0, doc="Cells of the lattice, south to north.")
    columns: int = quantity("1", gt=0, doc="Cells of the lattice, west to east.")
    tile_rows: int = quantity("1", gt=0, doc="Cells of a whole tile, south to north.")
    tile_columns: int = quantity("1", gt=0, doc="Cells of a whole tile, west to east.")
    row: int = quantity("1", ge=0, doc="The tile's row, from the south.")
    column: int = quantity("1", ge=0, doc="The tile's column, from the west.")


def tile_params(lattice: Lattice, row: int, column: int) -> dict[str, Any]:
    """Parameters that cut the tile at (row, column) of a lattice."""
    return {**asdict(lattice), "row": row, "column": column}


def cut_tiles(
    grid: Sequence[xr.Dataset], *, params: CutTilesParams, surface: xr.Dataset | None = None
) -> xr.Dataset:
    """One tile (height, latitude, longitude) with its halo, from a component grid per level.

    The grids lie on the same nodes of the lattice, halo included, and differ in height; so does
    the `surface` that their heights count from, if it is given. Nothing is resampled, so that
    what neighbours share is identical to the last bit.
    Raises ContractError for grids off the lattice and for a surface that is not theirs,
    CoverageError where they end short of the tile.
    """
    lattice = Lattice(**{name: getattr(params, name) for name in Lattice.__dataclass_fields__})
    levels = sorted(grid, key=lambda level: float(level["height"]))
    latitude, longitude = lattice.tile_axes(params.row, params.column)
    windows = [_window(level, latitude, longitude, lattice) for level in levels]
    variables: dict[str, Any] = {}
    for name, rule in TILE_VARIABLES.items():
        if name in _COORDINATES or name == _SURFACE:
            continue
        attributes = {"units": rule.units} if rule.units else dict(windows[0][name].attrs)
        if rule.dims == LEVELS:
            values = np.stack([w[name].values for w in windows])
        else:
            values = windows[0][name].values
        variables[name] = (rule.dims, values.astype(rule.dtype, copy=False), attributes)
    if (heights := _surface(windows, surface, latitude, longitude, lattice)) is not None:
        rule = TILE_VARIABLES[_SURFACE]
        variables[_SURFACE] = (rule.dims, heights.astype(rule.dtype), {"units": rule.units})
    variables["crs"] = levels[0]["crs"].variable
    heights = np.array([float(level["height"]) for level in levels])
    coordinates = {
        "height": ("height", heights, {"units": "m"}),
        NODES[0]: (NODES[0], latitude, {"units": "degrees_north"}),
        NODES[1]: (NODES[1], longitude, {"units": "degrees_east"}),
    }
    return xr.Dataset(variables, coordinates, _attributes(levels[0], lattice, params))


def _surface(
    windows: Sequence[xr.Dataset],
    surface: xr.Dataset | None,
    latitude: np.ndarray[Any, Any],
    longitude: np.ndarray[Any, Any],
    lattice: Lattice,
) -> np.ndarray[Any, Any] | None:
    """Ellipsoidal height of the surface at a tile's nodes: of its own grid, or of the levels'."""
    stated = [w[_SURFACE].values for w in windows if _SURFACE in w]
    if surface is None and not stated:
        return None
    if surface is not None:
        _check_surface(surface, windows[0], stated)
        return np.asarray(_window(surface, latitude, longitude, lattice)["surface_height"].values)
    if len(stated) < len(windows) or any(not np.array_equal(stated[0], s) for s in stated):
        raise ContractError(
            "the levels count from different surfaces", where=_SURFACE, expected="one of all"
        )
    return np.broadcast_to(stated[0], (latitude.size, longitude.size))


def _check_surface(surface: xr.Dataset, level: xr.Dataset, stated: Sequence[Any]) -> None:
    counts_from = level.attrs["height_reference"]
    found = surface.attrs["surface"], surface.attrs["height_reference"]
    if found != (counts_from, "ellipsoid") or stated:
        raise ContractError(
            "the levels state their surface themselves"
            if stated
            else f"is the height of {found[0]} above {found[1]}",
            where=f"surface {surface.attrs['source']}",
            expected=f"the height of {counts_from} above the ellipsoid, stated once",
            remedy="run sample-surface" if not stated else "leave one out",
        )


def _attributes(level: xr.Dataset, lattice: Lattice, params: CutTilesParams) -> dict[str, Any]:
    rows, columns = lattice.core(params.row, params.column)
    return {
        **level.attrs,
        "Conventions": "CF-1.11",
        "contract": CONTRACT,
        "tile_row": params.row,
        "tile_column": params.column,
        "core_rows": rows,
        "core_columns": columns,
        "halo_cells": HALO,
    }


def _window(
    level: xr.Dataset,
    latitude: np.ndarray[Any, Any],
    longitude: np.ndarray[Any, Any],
    lattice: Lattice,
) -> xr.Dataset:
    """The nodes of a level that a tile holds."""
    span = {}
    for name, axis, step in (
        ("latitude", latitude, lattice.latitude_spacing),
        ("longitude", longitude, lattice.longitude_spacing),
    ):
        if name not in level.dims:
            raise ContractError(
                f"the grid has dims {', '.join(map(str, level.dims))}",
                expected="dims latitude and longitude, on the nodes of the lattice",
                remedy="give derive-components its latitude and longitude parameters",
            )
        nodes = level[name].values
        first = round(float((axis[0] - nodes[0]) / step))
        if first < 0 or first + axis.size > nodes.size:
            raise CoverageError(
                f"{name} {nodes[0]:.6f} to {nodes[-1]:.6f}{_level(level)}",
                expected=f"{axis[0]:.6f} to {axis[-1]:.6f}, halo included",
            )
        if np.abs(nodes[first : first + axis.size] - axis).max() > _NODE_TOLERANCE * step:
            raise ContractError(
                f"nodes of {name} are not those of the lattice", expected=f"spacing {step:.9f}"
            )
        span[name] = slice(first, first + axis.size)
    return level.isel(span)


def _level(grid: xr.Dataset) -> str:
    return f" at height {float(grid['height']):g} m" if "height" in grid else " of the surface"


STAGE = Stage(
    name="cut-tiles",
    version=2,
    params=CutTilesParams,
    inputs={"grid": Many("component-grid/1"), "surface": OptionalInput("surface-grid/1")},
    output="anomaly-tile/1",
    run=cut_tiles,
)
