"""Where queries fall: cell, tile, block, levels around, and whether the map covers them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtiles.catalog.flags import QualityFlag
from magtiles.catalog.kernels.bspline import HALO, NODE, Floats
from magtiles.catalog.kernels.geodesy import metres_per_degree
from magtiles.catalog.kernels.hermite import Bracket, bracket
from magtiles.catalog.releases.arguments import broadcast, check_positions, refuse
from magtiles.catalog.releases.manifest import Manifest
from magtiles.schemas.errors import QueryError

Indices = NDArray[np.intp]


class Nodes(Protocol):
    """Where node values come from: the tiles of a release, or a patch."""

    @property
    def block_cells(self) -> int:
        """Cells, each way, that one array of coefficients serves."""

    def spline(self, coefficients: Floats, y: Floats, x: Floats, *, slopes: bool) -> Floats:
        """As `bspline.evaluate`."""

    def coefficients(
        self, place: tuple[int, int], family: str, level: int, block: tuple[int, int]
    ) -> tuple[Floats, tuple[int, int]]:
        """As `Tile.coefficients`, of the tile at a place."""

    def plane(self, place: tuple[int, int], name: str, level: int = 0) -> NDArray[Any]:
        """As `Tile.plane`, of the tile at a place."""


@dataclass(frozen=True)
class Group:
    """Positions in one block of one tile: their indices, and place in nodes of the tile."""

    place: tuple[int, int]
    block: tuple[int, int]
    index: Indices
    y: Floats
    x: Floats


@dataclass(frozen=True)
class Positions:
    """Checked, located positions.

    Attributes
    ----------
    shape : of the answer.
    inside : (n,) within the lattice, and no coordinate NaN.
    groups : by tile and block, of the positions inside.
    relative : (n,) height above the reference surface, m; the lowest level where not inside.
    bracket : levels around `relative`.
    metres : (2, n) metres per cell northward and eastward.
    surface_slope : (2, n) rise of the reference surface per cell northward and eastward.
    """

    shape: tuple[int, ...]
    inside: NDArray[np.bool_]
    groups: list[Group]
    relative: Floats
    bracket: Bracket
    metres: Floats
    surface_slope: Floats


def locate(
    manifest: Manifest,
    nodes: Nodes,
    latitude: ArrayLike,
    longitude: ArrayLike,
    height: ArrayLike | None,
    height_above_reference: ArrayLike | None,
) -> Positions:
    """Check the arguments of a query and find where they fall. Raises QueryError."""
    name, given = choose_height(manifest, height, height_above_reference)
    shape, (lat, lon, h) = broadcast(latitude=latitude, longitude=longitude, **{name: given})
    check_positions(shape, lat, lon)
    refuse(np.isinf(h), shape, name, h, "finite metres, or NaN")
    whole = ~(np.isnan(lat) | np.isnan(lon) | np.isnan(h))
    lat, lon = np.where(whole, lat, 0.0), np.where(whole, lon, 0.0)
    lowest = manifest.heights_m[0]
    y, x, inside = manifest.lattice.locate(lat, lon)
    inside &= whole
    groups = list(_groups(manifest, nodes.block_cells, y, x, np.flatnonzero(inside)))
    surface = np.zeros((3, len(lat)))
    if manifest.height_reference != "ellipsoid" and manifest.has_reference_surface:
        for group in groups:
            surface[:, group.index] = evaluate(nodes, group, "surface", 0)[..., 0]
    relative = np.where(inside, h - surface[0], lowest)
    north, east = metres_per_degree(lat, np.where(whole, h, 0.0))
    spacing = manifest.lattice.latitude_spacing, manifest.lattice.longitude_spacing
    return Positions(
        shape=shape,
        inside=inside,
        groups=groups,
        relative=relative,
        bracket=bracket(np.array(manifest.heights_m), relative),
        metres=np.stack([north * spacing[0], east * spacing[1]]),
        surface_slope=surface[1:],
    )


def choose_height(
    manifest: Manifest, height: ArrayLike | None, height_above_reference: ArrayLike | None
) -> tuple[str, ArrayLike]:
    """The one height argument this release is queried with, by name. Raises QueryError."""
    right, wrong = "height", "height_above_reference"
    values = {right: height, wrong: height_above_reference}
    meaning = "metres above the WGS84 ellipsoid"
    if not manifest.takes_ellipsoidal_height:
        right, wrong = wrong, right
        surface = manifest.height_reference.replace("_", " ")
        meaning = f"metres above the {surface}: the ellipsoidal height of that is not known"
    given = values[right]
    if values[wrong] is not None or given is None:
        raise QueryError(
            f"{wrong} does not apply" if values[wrong] is not None else f"{right} is missing",
            where=f"release {manifest.product} {manifest.version}",
            expected=f"{right}, {meaning}",
            remedy=f"give {right}=",
        )
    return right, given


def refuse_below(manifest: Manifest, positions: Positions) -> None:
    """Raise QueryError at the first position below the lowest level (the survey itself)."""
    reference = manifest.height_reference
    refuse(
        positions.inside & positions.bracket.below,
        positions.shape,
        "height" if reference == "ellipsoid" else f"height above the {reference}",
        positions.relative,
        f"at least {manifest.heights_m[0]:g} m, the lowest level of the release",
        "query higher, or open the release with allow_extrapolated=True",
    )


def evaluate(nodes: Nodes, group: Group, family: str, level: int, *, slopes: bool = True) -> Floats:
    """Splines of a family on one level: (3 or 1, n, channels), derivatives per cell."""
    coefficients, origin = nodes.coefficients(group.place, family, level, group.block)
    return nodes.spline(coefficients, group.y - origin[0], group.x - origin[1], slopes=slopes)


def corners(y: Floats, x: Floats) -> Iterator[tuple[Indices, Indices]]:
    """The up to four nodes that contribute to each position, as arrays of row and column."""
    rows = np.floor(y + NODE).astype(np.intp), np.ceil(y - NODE).astype(np.intp)
    columns = np.floor(x + NODE).astype(np.intp), np.ceil(x - NODE).astype(np.intp)
    return ((i, j) for i in rows for j in columns)


def flags_at(nodes: Nodes, positions: Positions) -> NDArray[np.uint8]:
    """Flags of every contributing node joined; 0 where not inside."""
    flags = np.zeros(len(positions.inside), np.uint8)
    for group in positions.groups:
        for level, _, chosen in levels_of(positions.bracket, group):
            plane = nodes.plane(group.place, "quality_flag", level)
            for i, j in corners(group.y[chosen], group.x[chosen]):
                flags[group.index[chosen]] |= plane[i, j]
    return flags


def levels_of(around: Bracket, group: Group) -> Iterator[tuple[int, int, Indices]]:
    """Level, side (0 lower, 1 upper) and which of a group's positions it contributes to."""
    for side in (0, 1):
        level = around.level[group.index] + side
        uses = around.uses[side, group.index]
        for k in np.unique(level[uses]):
            yield int(k), side, np.flatnonzero(uses & (level == k))


def uncovered(positions: Positions, flags: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Where the answer is NaN unless extrapolation was allowed."""
    beyond = np.bitwise_and(flags, np.uint8(QualityFlag.BEYOND_COVERAGE)).astype(np.bool_)
    return np.logical_or(beyond, positions.bracket.above)


def _groups(
    manifest: Manifest, block: int, y: Floats, x: Floats, index: Indices
) -> Iterator[Group]:
    lattice = manifest.lattice
    cell_row, cell_column = lattice.cells(y[index], x[index])
    row, in_row = np.divmod(cell_row, lattice.tile_rows)
    column, in_column = np.divmod(cell_column, lattice.tile_columns)
    blocks = (lattice.tile_rows - 1) // block + 1, (lattice.tile_columns - 1) // block + 1
    shape = (*lattice.shape, *blocks)
    keys = np.ravel_multi_index((row, column, in_row // block, in_column // block), shape)
    found, member = np.unique(keys, return_inverse=True)
    order = np.argsort(member, kind="stable")
    ends = np.cumsum(np.bincount(member, minlength=len(found)))
    for key, end, count in zip(found, ends, np.diff(ends, prepend=0), strict=True):
        part = index[order[end - count : end]]
        r, c, block_row, block_column = (int(k) for k in np.unravel_index(key, shape))
        yield Group(
            (r, c),
            (block_row, block_column),
            part,
            y[part] - r * lattice.tile_rows + HALO,
            x[part] - c * lattice.tile_columns + HALO,
        )
