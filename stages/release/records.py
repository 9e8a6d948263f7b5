"""Records of a manifest: what is measured of each tile and file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.flags import QualityFlag
from magtiles.catalog.kernels.bspline import HALO
from magtiles.catalog.releases.digest import array_digest, sha256
from magtiles.catalog.releases.lattice import Lattice
from magtiles.catalog.releases.tile_table import CONTRACT, LEVELS, NODES
from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError, FormatError

IDENTITY_ATTRIBUTES = ("reference_field", "reference_epoch", "anomaly_definition")


@dataclass(frozen=True)
class MeasuredTile:
    """A tile file, checked and measured: its entry but for bounds, and what all must share."""

    source: Path
    entry: dict[str, Any]
    attributes: dict[str, Any]
    latitude: NDArray[np.float64]
    longitude: NDArray[np.float64]
    heights: tuple[float, ...]


def measure_tile(path: Path, written: xr.Dataset | None = None) -> MeasuredTile:
    """Digest a tile and measure what it holds. ContractError or FormatError.

    The file is read back and checked, unless its dataset is given as it was `written` by a
    caller who had checked it. Whether file and arrays agree is then for validation to see.
    """
    try:
        data = path.read_bytes()
        dataset = _read_back(path) if written is None else written
    except (OSError, ValueError) as caught:
        raise FormatError(f"is no readable tile: {caught}", where=path) from None
    attributes = dataset.attrs
    row, column = int(attributes["tile_row"]), int(attributes["tile_column"])
    arrays = {str(name): np.asarray(v.values) for name, v in dataset.variables.items()}
    return MeasuredTile(
        source=path,
        entry={
            "path": f"tiles/r{row:03d}c{column:03d}.nc",
            "role": "tile",
            "contract": CONTRACT,
            "size": len(data),
            "sha256": sha256(data),
            "array_digest": array_digest(arrays),
            "row": row,
            "column": column,
            "statistics": _statistics(dataset),
            "flag_fractions": _flag_fractions(_core(arrays["quality_flag"])),
        },
        attributes={str(k): v for k, v in attributes.items()},
        latitude=arrays["latitude"],
        longitude=arrays["longitude"],
        heights=tuple(arrays["height"].tolist()),
    )


def _read_back(path: Path) -> xr.Dataset:
    with xr.open_dataset(path, engine="netcdf4", decode_cf=False) as lazy:
        dataset = lazy.load()
    contracts.check(dataset, CONTRACT, where=path)
    return dataset


def _statistics(dataset: xr.Dataset) -> dict[str, dict[str, list[float]]]:
    found = {}
    for name, variable in dataset.variables.items():
        if variable.dtype.kind != "f" or variable.dims not in (NODES, LEVELS):
            continue
        core = _core(np.asarray(variable.values, np.float64))
        levels = core.reshape(-1, core.shape[-2] * core.shape[-1])
        found[str(name)] = {
            "minimum": _rounded(levels.min(axis=1)),
            "maximum": _rounded(levels.max(axis=1)),
            "mean": _rounded(levels.mean(axis=1)),
            "rms": _rounded(np.sqrt(np.mean(levels**2, axis=1))),
        }
    return found


def _rounded(values: NDArray[np.float64]) -> list[float]:
    return [float(f"{value:.6g}") for value in values]


def _flag_fractions(flags: NDArray[Any]) -> dict[str, float]:
    return {
        str(flag.name).lower(): float(f"{np.mean(flags & flag.value != 0):.6g}")
        for flag in QualityFlag
    }


def _core(values: NDArray[Any]) -> NDArray[Any]:
    return values[..., HALO:-HALO, HALO:-HALO]


def common_lattice(tiles: Sequence[MeasuredTile]) -> Lattice:
    """The lattice that all tiles are cut from. Raises ContractError when there is none."""
    places = {(t.entry["row"], t.entry["column"]): t for t in tiles}
    rows, columns = (max(place[k] for place in places) + 1 for k in (0, 1))
    wanted = {(r, c) for r in range(rows) for c in range(columns)}
    if set(places) != wanted or len(places) != len(tiles):
        missing = sorted(wanted - set(places)) or "none"
        raise ContractError(
            f"{len(tiles)} tiles at {len(places)} places, missing {missing}",
            where="tiles",
            expected=f"one tile for each of {rows} x {columns} places",
        )
    first, last = places[0, 0], places[rows - 1, columns - 1]
    south, dlat = _axis(first.latitude)
    west, dlon = _axis(first.longitude)
    tile_rows, tile_columns = _core_cells(first)
    last_rows, last_columns = _core_cells(last)
    lattice = Lattice(
        south=south,
        west=west,
        latitude_spacing=dlat,
        longitude_spacing=dlon,
        rows=(rows - 1) * tile_rows + last_rows,
        columns=(columns - 1) * tile_columns + last_columns,
        tile_rows=tile_rows,
        tile_columns=tile_columns,
    )
    for tile in tiles:
        _check_place(tile, lattice)
    return lattice


def _core_cells(tile: MeasuredTile) -> tuple[int, int]:
    return int(tile.attributes["core_rows"]), int(tile.attributes["core_columns"])


def _axis(nodes: NDArray[np.float64]) -> tuple[float, float]:
    """Start and spacing of a tile's axis, as the round numbers it was made from if it was."""
    start, spacing = float(nodes[HALO]), float((nodes[-1] - nodes[0]) / (len(nodes) - 1))
    round_start, round_spacing = float(f"{start:.12g}"), float(f"{spacing:.12g}")
    rounded = round_start + (np.arange(len(nodes)) - HALO) * round_spacing
    if np.abs(rounded - nodes).max() < 1e-12:
        return round_start, round_spacing
    return start, spacing


def _check_place(tile: MeasuredTile, lattice: Lattice) -> None:
    place = tile.entry["row"], tile.entry["column"]
    core = _core_cells(tile)
    wanted = lattice.tile_axes(*place)
    spacings = (lattice.latitude_spacing, lattice.longitude_spacing)
    if core != lattice.core(*place):
        raise ContractError(
            f"has {core} core cells", where=tile.source, expected=f"{lattice.core(*place)}"
        )
    for name, found, axis, spacing in zip(
        NODES, (tile.latitude, tile.longitude), wanted, spacings, strict=True
    ):
        if found.shape != axis.shape or np.abs(found - axis).max() > 1e-6 * spacing:
            raise ContractError(
                f"{name} is not on the lattice of the other tiles",
                where=tile.source,
                expected=f"{len(axis)} nodes from {axis[0]:.9g} by {spacing:.9g}",
            )
