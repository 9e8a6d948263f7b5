"""Node arrays of a patch: levels put together from tiles, or combined at one height."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.kernels import compiled
from magtiles.catalog.kernels.bspline import HALO, Floats, prefilter
from magtiles.catalog.kernels.hermite import bracket
from magtiles.catalog.kernels.vertical import AMBIENT, hermite_planes, required_variables
from magtiles.catalog.releases.arguments import numbers
from magtiles.catalog.releases.lattice import Lattice
from magtiles.catalog.releases.manifest import Manifest
from magtiles.catalog.releases.positions import Nodes
from magtiles.catalog.releases.tile import SURFACE, node_spacing
from magtiles.schemas.errors import QueryError

Bounds = Mapping[str, Sequence[float]]


@dataclass(frozen=True)
class Window:
    """A rectangle of cells: the first row and column, and one past the last."""

    rows: tuple[int, int]
    columns: tuple[int, int]

    def lattice(self, whole: Lattice) -> Lattice:
        """The window as a lattice of one tile."""
        rows, columns = (stop - start for start, stop in (self.rows, self.columns))
        return Lattice(
            south=whole.south + self.rows[0] * whole.latitude_spacing,
            west=whole.west + self.columns[0] * whole.longitude_spacing,
            latitude_spacing=whole.latitude_spacing,
            longitude_spacing=whole.longitude_spacing,
            rows=rows,
            columns=columns,
            tile_rows=rows,
            tile_columns=columns,
        )


class PatchNodes:
    """Node arrays of a window, put together from tiles at first use. Thread-safe."""

    def __init__(self, manifest: Manifest, source: Nodes, window: Window) -> None:
        self.manifest = dataclasses.replace(manifest, lattice=window.lattice(manifest.lattice))
        self.block_cells = 1 << 62
        self._whole = manifest.lattice
        self._source = source
        self._window = window
        self._coefficients: dict[tuple[str, int], Floats] = {}
        self._planes: dict[tuple[str, int], NDArray[Any]] = {}
        self._lock = threading.RLock()

    def spline(self, coefficients: Floats, y: Floats, x: Floats, *, slopes: bool) -> Floats:
        """As `bspline.evaluate`, compiled."""
        out = np.empty((3 if slopes else 1, len(y), coefficients.shape[2]))
        compiled.spline(coefficients, y, x, out)
        return out

    def plane(self, place: tuple[int, int], name: str, level: int = 0) -> NDArray[Any]:
        """One variable at one level over the window and its halo."""
        with self._lock:
            key = (name, level)
            if key not in self._planes:
                self._planes[key] = self._assemble(name, level)
            return self._planes[key]

    def coefficients(
        self, place: tuple[int, int], family: str, level: int, block: tuple[int, int]
    ) -> tuple[Floats, tuple[int, int]]:
        """Spline coefficients of a family on a level, over the window and its halo."""
        with self._lock:
            key = (family, level)
            if key not in self._coefficients:
                if family == "surface":
                    nodes = self._assemble(SURFACE, 0)[..., None]
                else:
                    nodes = self.hermite(family, level)
                self._coefficients[key] = prefilter(nodes.reshape(*nodes.shape[:2], -1))
            return self._coefficients[key], (0, 0)

    def hermite(self, family: str, level: int) -> Floats:
        """Node values and vertical derivatives on a level, as `hermite_planes`."""
        names = required_variables(family) + (AMBIENT if family == "total" else ())
        planes = {n: self._assemble(n, 0 if n in AMBIENT else level) for n in names}
        manifest = self.manifest
        surface = self._assemble(SURFACE, 0) if manifest.has_reference_surface else 0.0
        latitude = manifest.lattice.tile_axes(0, 0)[0][:, None]
        return hermite_planes(family, planes, *node_spacing(manifest, latitude, level, surface))

    def _assemble(self, name: str, level: int) -> NDArray[Any]:
        whole, (rows, columns) = self._whole, (self._window.rows, self._window.columns)
        low, left = rows[0] - HALO, columns[0] - HALO
        parts = [
            [
                self._source.plane((r, c), name, level)[
                    _slice(r, whole.tile_rows, whole.rows, rows),
                    _slice(c, whole.tile_columns, whole.columns, columns),
                ]
                for c in _tiles(left, columns[1] + HALO, whole.tile_columns, whole.shape[1])
            ]
            for r in _tiles(low, rows[1] + HALO, whole.tile_rows, whole.shape[0])
        ]
        return np.block(parts)


def _tiles(first: int, last: int, size: int, count: int) -> range:
    """The tiles that nodes `first` to `last` come from."""
    return range(max(first // size, 0), min(last // size, count - 1) + 1)


def _slice(tile: int, size: int, cells: int, window: tuple[int, int]) -> slice:
    """Which nodes of a tile a window and its halo take: its own, at the rim its halo too."""
    first, last = tile * size, (tile + 1) * size - 1
    if tile == 0:
        first = -HALO
    if last >= cells - 1:
        last = cells + HALO
    start = max(first, window[0] - HALO) - tile * size + HALO
    stop = min(last, window[1] + HALO) - tile * size + HALO + 1
    return slice(start, stop)


class FlatNodes:
    """Nodes of a patch at one height above the ellipsoid: one level, value and slope."""

    def __init__(self, nodes: PatchNodes, height: float) -> None:
        levels = np.array(nodes.manifest.heights_m)
        self.manifest = dataclasses.replace(nodes.manifest, heights_m=(height,))
        self.block_cells = nodes.block_cells
        self.spline = nodes.spline
        self._nodes = nodes
        self._around = bracket(levels, np.array([height]))
        self._coefficients: dict[str, Floats] = {}
        self._lock = threading.RLock()

    def plane(self, place: tuple[int, int], name: str, level: int = 0) -> NDArray[Any]:
        """Flags of the levels that contribute, joined (the one variable asked for)."""
        planes = [self._nodes.plane(place, name, k) for _, k in self._levels()]
        joined: NDArray[Any] = np.bitwise_or.reduce(planes)
        return joined

    def coefficients(
        self, place: tuple[int, int], family: str, level: int, block: tuple[int, int]
    ) -> tuple[Floats, tuple[int, int]]:
        """Spline coefficients, (rows, columns, 2 * components): value, then slope per metre."""
        with self._lock:
            if family not in self._coefficients:
                self._coefficients[family] = prefilter(self._combine(family))
            return self._coefficients[family], (0, 0)

    def _combine(self, family: str) -> Floats:
        value: Any = 0.0
        slope: Any = 0.0
        for side, level in self._levels():
            nodes = self._nodes.hermite(family, level)
            value = value + np.einsum("o,yxoc->yxc", self._around.value[side, 0], nodes)
            slope = slope + np.einsum("o,yxoc->yxc", self._around.slope[side, 0], nodes)
        return np.concatenate([value, slope], axis=-1)

    def _levels(self) -> list[tuple[int, int]]:
        lower = int(self._around.level[0])
        return [(side, lower + side) for side in (0, 1) if self._around.uses[side, 0]]


def window_of(lattice: Lattice, bounds: Bounds) -> Window:
    """The cells that bounds meet. Raises QueryError when there are none."""
    (south, north), (west, east) = _checked(bounds)
    width = east - west if 0 <= east - west <= 360 else (east - west) % 360
    start = (west - lattice.west) % 360.0
    # A rectangle that begins west of the release may still reach into it from behind.
    if start > lattice.east - lattice.west:
        start -= 360.0
    low, high = south - lattice.south, north - lattice.south
    rows = _cells(low, high, lattice.latitude_spacing, lattice.rows)
    columns = _cells(start, start + width, lattice.longitude_spacing, lattice.columns)
    if rows is None or columns is None:
        raise QueryError(
            "do not meet the release",
            where="bounds",
            expected=f"latitude {lattice.south:g} to {lattice.north:g}, "
            f"longitude {lattice.west:g} to {lattice.east:g}",
        )
    return Window(rows, columns)


def _cells(low: float, high: float, spacing: float, count: int) -> tuple[int, int] | None:
    first = max(int(np.floor(low / spacing)), 0)
    last = min(int(np.ceil(high / spacing)), count)
    if low / spacing > count or high < 0:
        return None
    first = min(first, count - 1)
    return first, max(last, first + 1)


def _checked(bounds: Bounds) -> tuple[tuple[float, float], tuple[float, float]]:
    if set(bounds) != {"latitude", "longitude"}:
        raise QueryError(
            f"are {bounds!r:.80}",
            where="bounds",
            expected='{"latitude": (south, north), "longitude": (west, east)}',
        )
    for name, pair in bounds.items():
        if numbers(f"bounds {name}", pair).shape != (2,) or not np.isfinite(pair).all():
            raise QueryError(f"is {pair!r:.80}", where=f"bounds {name}", expected="two numbers")
    (south, north), (west, east) = bounds["latitude"], bounds["longitude"]
    if south > north:
        raise QueryError("south is above north", where="bounds latitude", expected="south first")
    return (float(south), float(north)), (float(west), float(east))
