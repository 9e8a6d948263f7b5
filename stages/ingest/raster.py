"""Raster grids through rasterio (GDAL): GeoTIFF, Surfer 6 and 7, ER Mapper, ESRI ASCII.

GDAL also reads what lies beside a file (world files, ``.prj``, ``.aux.xml``). Here it does not:
what a grid is must not depend on files that no receipt knows of.
"""

from __future__ import annotations

import contextlib
import re
import struct
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import rasterio
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.io import MemoryFile
from rasterio.windows import Window

from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages.ingest.files import check_tiff_directories
from magtiles.stages.ingest.raw import RawGrid
from magtiles.stages.ingest.source import GridFileParams

_ALONE = {"GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR", "GDAL_PAM_ENABLED": "NO"}


def _check_ers_data(path: Path) -> None:
    """Raise FormatError unless an ER Mapper header's data file holds what the header says.

    GDAL fills what a truncated data file lacks with zeros, and zero is a value.
    """
    header = path.read_text(encoding="latin-1")
    data = path.with_suffix("")
    if not data.is_file():
        raise FormatError(
            "its data file is missing",
            where=path,
            expected=f"'{data.name}' beside it",
            remedy='name both in the source TOML: files = ["NAME.ers", "NAME"]',
        )
    cells = [_ers_number(header, key, path) for key in ("NrOfLines", "NrOfCellsPerLine")]
    kind = re.search(r"CellType\s*=\s*(?:IEEE(\d)Byte|(?:Signed|Unsigned)(\d+)Bit)", header)
    if kind is None:
        raise FormatError("CellType is missing", where=path, expected="such as IEEE4ByteReal")
    value_bytes = int(kind[1]) if kind[1] else int(kind[2]) // 8
    turned = re.search(r"\bRotation\s*=\s*([-+\d:.]+)", header)
    if turned and turned[1].strip("-+0:."):
        raise _rotated(path, f"by {turned[1]} degrees")  # GDAL does not look at it
    offset = _ers_number(header, "HeaderOffset", path, 0)
    bands = _ers_number(header, "NrOfBands", path, 1)
    wanted = offset + cells[0] * cells[1] * bands * value_bytes
    if data.stat().st_size < wanted:
        raise FormatError(
            f"holds {data.stat().st_size} bytes",
            where=data,
            expected=f"{wanted}, as {path.name} says",
            remedy="the file is truncated: fetch it again",
        )


def _check_surfer_7(path: Path) -> None:
    """Raise FormatError where a Surfer 7 grid is rotated, which GDAL does not look at."""
    with path.open("rb") as file:
        head = file.read(1 << 16)
    place = head.find(b"GRID") + 8  # tag and size, then rows, columns and eight doubles
    if place >= 8 and place + 72 <= len(head):
        (angle,) = struct.unpack_from("<d", head, place + 56)
        if angle != 0.0:
            raise _rotated(path, f"by {angle:g} degrees")


def _rotated(path: Path, how: str) -> FormatError:
    return FormatError(
        f"the raster is rotated {how}",
        where=path,
        expected="rows along x and columns along y",
        remedy="resample it to an unrotated grid of its projection",
    )


def _ers_number(header: str, key: str, path: Path, default: int | None = None) -> int:
    found = re.search(rf"\b{key}\s*=\s*(\d+)", header)
    if found is None and default is None:
        raise FormatError(f"{key} is missing", where=path, expected=f"{key} = a whole number")
    return int(found[1]) if found else int(default or 0)


@dataclass(frozen=True)
class _Format:
    """GDAL's driver, the name people know, and what to check before GDAL reads.

    `from_memory`: the driver looks for sidecars whatever it is told. `text` is read from its
    start, whichever rows are wanted.
    """

    driver: str
    name: str
    check: Callable[[Path], None] | None = None
    from_memory: bool = False
    text: bool = False


_FORMATS = {
    "geotiff": _Format("GTiff", "GeoTIFF", check_tiff_directories),
    "surfer-6-text": _Format("GSAG", "Surfer 6 text grid", text=True),
    "surfer-6": _Format("GSBG", "Surfer 6 grid"),
    "surfer-7": _Format("GS7BG", "Surfer 7 grid", _check_surfer_7),
    "er-mapper": _Format("ERS", "ER Mapper grid", _check_ers_data),
    "esri-ascii": _Format("AAIGrid", "ESRI ASCII grid", from_memory=True, text=True),
}
KINDS = tuple(_FORMATS)
"""What `files.sniff` calls the formats read here."""


def read_raster(kind: str, path: Path, params: GridFileParams) -> RawGrid:
    """One band of a raster of one of `KINDS`, with its cell centres.

    GDAL gives cell corners for either registration, so nodes are always the cells' centres.
    Raises FormatError for truncated, rotated or unplaced rasters, SourceError where the band
    is not clear.
    """
    form = _FORMATS[kind]
    if form.check is not None:
        form.check(path)
    with _opened(path, form) as dataset:
        grid = _read(dataset, path, form, params)
    return grid.in_memory() if form.text else grid


@contextlib.contextmanager
def _opened(path: Path, form: _Format) -> Iterator[Any]:
    try:
        with warnings.catch_warnings(), rasterio.Env(**_ALONE), contextlib.ExitStack() as opened:
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            if form.from_memory:
                file = opened.enter_context(MemoryFile(path.read_bytes()))
                yield opened.enter_context(file.open(driver=form.driver))
            else:
                yield opened.enter_context(rasterio.open(path, driver=form.driver))
    except RasterioError as caught:
        raise FormatError(
            f"is not a whole {form.name}: {_detail(caught, path)}",
            where=path,
            remedy="fetch it again",
        ) from None


def _detail(caught: RasterioError, path: Path) -> str:
    """What GDAL says, in one line, by the file's own name and not that of its copy in memory."""
    said = " ".join(str(caught.__cause__ or caught).split()).rstrip(".")
    return re.sub(r"[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12}\.\w+", path.name, said).replace(
        str(path), path.name
    )


@dataclass(frozen=True)
class _Band:
    """The values of a band, float64 with voids NaN, of which rows are read when wanted."""

    path: Path
    form: _Format
    band: int
    shape: tuple[int, int]
    mark: float | None

    def __getitem__(self, rows: slice, /) -> NDArray[np.float64]:
        first, last, _ = rows.indices(self.shape[0])
        window = Window(0, first, self.shape[1], last - first)
        with _opened(self.path, self.form) as dataset:
            stored = dataset.read(self.band, masked=True, window=window)
            scale, offset = dataset.scales[self.band - 1], dataset.offsets[self.band - 1]
        values: NDArray[np.float64] = stored.data.astype(np.float64) * scale + offset
        values[np.ma.getmaskarray(stored)] = np.nan
        if self.mark is not None:
            values[stored.data == stored.dtype.type(self.mark)] = np.nan
        return values


def _read(dataset: Any, path: Path, form: _Format, params: GridFileParams) -> RawGrid:
    band = _choose_band(dataset, path, params.band)
    x, y = _nodes(dataset, path)
    says: dict[str, Any] = {}
    if dataset.driver == "GTiff":
        point = dataset.tags().get("AREA_OR_POINT") == "Point"
        says["registration"] = "point" if point else "pixel"
    if dataset.units[band - 1]:
        says["units"] = dataset.units[band - 1]
    mark = params.no_data
    if dataset.nodatavals[band - 1] is not None and np.isfinite(dataset.nodatavals[band - 1]):
        says["no_data"], mark = float(dataset.nodatavals[band - 1]), None
    crs = pyproj.CRS.from_user_input(dataset.crs) if dataset.crs else None
    values = _Band(path, form, band, (dataset.height, dataset.width), mark)
    return RawGrid(values=values, x=x, y=y, crs=crs, says=says)


def _choose_band(dataset: Any, path: Path, band: int | None) -> int:
    if band is None and dataset.count > 1:
        names = ", ".join(
            f"{i} {d or ''}".strip() for i, d in enumerate(dataset.descriptions, start=1)
        )
        raise SourceError(
            f"the file has {dataset.count} bands ({names})",
            where=path,
            remedy="choose one with the key 'band'",
        )
    if band is not None and band > dataset.count:
        raise SourceError(f"key 'band' is {band}, but the file has {dataset.count}", where=path)
    return band or 1


def _nodes(dataset: Any, path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    transform = dataset.transform
    if transform.is_identity:
        raise FormatError(
            "the raster has no position (geotransform)",
            where=path,
            expected="one that states a corner and the size of its cells",
        )
    if transform.b or transform.d:
        raise _rotated(path, f"or sheared (b = {transform.b:g}, d = {transform.d:g})")
    x = transform.c + transform.a * (np.arange(dataset.width) + 0.5)
    y = transform.f + transform.e * (np.arange(dataset.height) + 0.5)
    return x, y
