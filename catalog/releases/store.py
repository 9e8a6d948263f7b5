"""Tiles of an open release: verified at first touch, kept in a bounded cache, thread-safe."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from magtiles.catalog.kernels.bspline import Floats, evaluate
from magtiles.catalog.releases.folder import read_verified
from magtiles.catalog.releases.manifest import Manifest, TileRecord
from magtiles.catalog.releases.tile import BLOCK, Tile, TileData

DEFAULT_CACHE_BYTES = 1 << 30


def read_tile(folder: Path, record: TileRecord, manifest: Manifest) -> TileData:
    """A whole tile, verified against size, sha256, contract and lattice.

    Raises IntegrityError naming the file.
    """
    tile = _open(folder, record, manifest)
    try:
        return TileData(record, *tile.everything())
    finally:
        tile.close()


def _open(folder: Path, record: TileRecord, manifest: Manifest) -> Tile:
    data = read_verified(folder / record.path, size=record.size, digest=record.sha256)
    return Tile(data, record, manifest)


class TileStore:
    """Least recently used tiles are dropped when the cache exceeds `cache_bytes`."""

    block_cells = BLOCK
    spline = staticmethod(evaluate)

    def __init__(self, folder: Path, manifest: Manifest, cache_bytes: int) -> None:
        self._folder = folder
        self._manifest = manifest
        self._cache_bytes = cache_bytes
        self._tiles: OrderedDict[tuple[int, int], Tile] = OrderedDict()
        self._lock = threading.RLock()

    def coefficients(
        self, place: tuple[int, int], family: str, level: int, block: tuple[int, int]
    ) -> tuple[Floats, tuple[int, int]]:
        """`Tile.coefficients` of the tile at `place`."""
        with self._lock:
            return self._tile(place).coefficients(family, level, block)

    def plane(self, place: tuple[int, int], name: str, level: int = 0) -> NDArray[Any]:
        """`Tile.plane` of the tile at `place`."""
        with self._lock:
            return self._tile(place).plane(name, level)

    def read_all(self) -> Iterator[TileData]:
        """Every tile, whole and verified, from the south-west by rows; none is cached."""
        for place in sorted(self._manifest.tiles):
            with self._lock:
                data = read_tile(self._folder, self._manifest.tiles[place], self._manifest)
            yield data

    def _tile(self, place: tuple[int, int]) -> Tile:
        if place not in self._tiles:
            record = self._manifest.tiles[place]
            self._tiles[place] = _open(self._folder, record, self._manifest)
        self._tiles.move_to_end(place)
        while len(self._tiles) > 1 and self._held() > self._cache_bytes:
            self._tiles.popitem(last=False)[1].close()
        return self._tiles[place]

    def _held(self) -> int:
        return sum(tile.nbytes for tile in self._tiles.values())
