"""Pictures of a release, from its tiles or from the arrays of a level."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog import open_release
from magtiles.catalog.kernels.bspline import HALO
from magtiles.catalog.releases.lattice import Lattice
from magtiles.catalog.releases.tile import TileData
from magtiles.pipeline.plotting import QUANTITIES, preview_figure, save_png
from magtiles.schemas.errors import UsageError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SURFACES = {
    "ellipsoid": "the WGS84 ellipsoid",
    "mean_sea_level": "mean sea level",
    "terrain": "terrain",
}

_PICTURE_NODES = 2048
"""Nodes a side above which every second, third... will do for a picture."""


def release_figure(folder: Path, *, height: float | None, quantity: str) -> Figure:
    """Draw one quantity of a release at one of its levels; None is the lowest.

    Raises UsageError for a height that is no level, IntegrityError for a damaged release.
    """
    release = open_release(folder)
    manifest = release.manifest
    level = _level(manifest.heights_m, height)
    kind = QUANTITIES[quantity]
    names = (kind.variable, kind.uncertainty, "quality_flag")
    values, uncertainty, flags = assemble_level(release.tiles(), manifest.lattice, level, names)
    return preview_figure(
        manifest.lattice.latitudes(np.arange(manifest.lattice.rows + 1)),
        manifest.lattice.longitudes(np.arange(manifest.lattice.columns + 1)),
        values,
        uncertainty,
        flags,
        quantity=quantity,
        title=figure_title(
            manifest.product,
            manifest.version,
            quantity,
            manifest.heights_m[level],
            manifest.height_reference,
        ),
        note=figure_note(manifest.identity),
    )


def write_preview(level: xr.Dataset, path: Path, product: str, version: str) -> None:
    """Draw the total-field anomaly of a component grid (without its halo) to a PNG."""
    thin = max(1, max(level.sizes["latitude"], level.sizes["longitude"]) // _PICTURE_NODES)
    inner = level.isel(latitude=slice(HALO, -HALO, thin), longitude=slice(HALO, -HALO, thin))
    height, reference = float(level["height"]), str(level.attrs["height_reference"])
    figure = preview_figure(
        inner["latitude"].values,
        inner["longitude"].values,
        inner["magnetic_anomaly"].values,
        inner["magnetic_anomaly_uncertainty"].values,
        inner["quality_flag"].values,
        quantity="total",
        title=figure_title(product, version, "total", height, reference),
        note=figure_note({"datum": "WGS84", **level.attrs}),
    )
    save_png(figure, path)


def assemble_level(
    tiles: Iterable[TileData],
    lattice: Lattice,
    level: int,
    names: Sequence[str],
    *,
    halo: int = 0,
) -> list[NDArray[Any]]:
    """Variables at one level on all core nodes and `halo` more on each side.

    (rows + 1 + 2 halo, columns + 1 + 2 halo) each; there are `HALO` such nodes.
    """
    whole: list[NDArray[Any]] = []
    for tile in tiles:
        # Of the halo only what lies outside the map: inside it, nodes are some tile's own.
        rows, i = _own(tile.record.row, lattice.shape[0], lattice.tile_rows, halo)
        columns, j = _own(tile.record.column, lattice.shape[1], lattice.tile_columns, halo)
        parts = [tile.variables[name][level, rows, columns] for name in names]
        if not whole:
            shape = (lattice.rows + 1 + 2 * halo, lattice.columns + 1 + 2 * halo)
            whole = [np.empty(shape, part.dtype) for part in parts]
        for array, part in zip(whole, parts, strict=True):
            array[i : i + part.shape[0], j : j + part.shape[1]] = part
    return whole


def _own(place: int, tiles: int, cells: int, halo: int) -> tuple[slice, int]:
    """Which nodes of a tile's axis to take, and where they begin on the map with its halo."""
    first = HALO - halo if place == 0 else HALO
    last = halo - HALO if place == tiles - 1 else -HALO
    return slice(first, last or None), place * cells + halo + first - HALO


def figure_title(
    product: str, version: str, quantity: str, height: float, height_reference: str
) -> str:
    """Product, version, what is drawn and at which level."""
    label = QUANTITIES[quantity].label
    return f"{product} {version}: {label} {height:g} m above {_SURFACES[height_reference]}"


def figure_note(identity: Mapping[str, Any]) -> str:
    """The small print: datum, reference field and epoch, and what the anomaly is."""
    return (
        f"{identity['datum']}. Reference field {identity['reference_field']} at "
        f"{identity['reference_epoch']}. Anomaly: {identity['anomaly_definition']}."
    )


def _level(heights: Sequence[float], wanted: float | None) -> int:
    if wanted is None:
        return 0
    nearest = int(np.argmin(np.abs(np.array(heights) - wanted)))
    if not abs(heights[nearest] - wanted) < 0.5:
        raise UsageError(
            f"no level at {wanted:g} m",
            where="--level",
            expected=f"one of {', '.join(f'{h:g}' for h in heights)}",
        )
    return nearest
