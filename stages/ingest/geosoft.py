"""Geosoft (Oasis montaj) binary grids, version 2, plain and compressed, through harmonica."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np

from magtiles.schemas.errors import FormatError
from magtiles.stages.ingest.raw import RawGrid
from magtiles.stages.ingest.source import GridFileParams

HEADER_BYTES = 512
_ELEMENT_BYTES = (1, 2, 4, 8, 1025, 1026, 1028, 1032)
_DEFLATE_LIMIT = 1032


def is_geosoft(head: bytes) -> bool:
    """Whether a file's first bytes are the header of a Geosoft grid, which has no magic number."""
    if len(head) < HEADER_BYTES:
        return False
    size, sign, elements, vectors, order = struct.unpack_from("<5i", head)
    steps = struct.unpack_from("<2d", head, 20)
    return (
        size in _ELEMENT_BYTES
        and 0 <= sign <= 3
        and min(elements, vectors) > 0
        and abs(order) <= 4
        and all(1e-9 < step < 1e9 for step in steps)
    )


def read_geosoft(path: Path, params: GridFileParams) -> RawGrid:
    """A Geosoft grid; values are at points, dummies NaN. Its header has no CRS that others know.

    Raises FormatError where the file is truncated, rotated, or of an ordering or colour form
    that harmonica does not read.
    """
    import harmonica  # heavy, and few grids are Geosoft's

    _check_size(path)
    try:
        grid = harmonica.load_oasis_montaj_grid(str(path))
    except (NotImplementedError, ValueError, struct.error, zlib.error) as caught:
        raise FormatError(
            f"is not a whole Geosoft grid: {caught}", where=path, remedy="fetch or export it again"
        ) from None
    if grid.dims != ("northing", "easting"):
        raise FormatError(
            f"the grid is rotated by {grid.attrs['rotation']:g} degrees",
            where=path,
            expected="rows along x and columns along y",
            remedy="export it without rotation",
        )
    return RawGrid(
        values=np.asarray(grid.values, dtype=np.float64),
        x=np.asarray(grid.easting.values, dtype=np.float64),
        y=np.asarray(grid.northing.values, dtype=np.float64),
        crs=None,
        says={"registration": "point"},
    )


def _check_size(path: Path) -> None:
    """Raise FormatError where the header declares more than the file can hold."""
    size = path.stat().st_size - HEADER_BYTES
    with path.open("rb") as file:
        element, _, elements, vectors, _ = struct.unpack("<5i", file.read(20))
    wanted = elements * vectors * (element % 1024)
    if size < wanted if element < 1024 else wanted > _DEFLATE_LIMIT * size:
        raise FormatError(
            f"holds {size} bytes after its header",
            where=path,
            expected=f"{elements} x {vectors} values of {element % 1024} bytes",
            remedy="the file is truncated: fetch it again",
        )
