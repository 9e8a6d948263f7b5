"""Grid files of every format, written by another program or by their published description."""

from __future__ import annotations

import gzip
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import rasterio
import rasterio.shutil
from numpy.typing import NDArray

Floats = NDArray[np.float64]

Writer = Callable[..., list[Path]]
"""From a folder, and `Rows` if not the small ones, to the files written there."""


@dataclass(frozen=True)
class Rows:
    """Nodes 1 km apart, ascending, and their values (y, x), NaN where void."""

    x: Floats
    y: Floats
    values: Floats


def _small() -> Rows:
    values = np.arange(12.0).reshape(3, 4) - 5.25  # rows from the south
    values[1, 2] = np.nan
    values[0, 1] = 0.0  # a value
    return Rows(500_500.0 + 1000.0 * np.arange(4), 5_000_500.0 + 1000.0 * np.arange(3), values)


SMALL = _small()


def gdal(driver: str, mark: float) -> Writer:
    """A writer by GDAL, whose own the format is not."""

    def write(folder: Path, rows: Rows = SMALL) -> list[Path]:
        stored = np.where(np.isnan(rows.values), mark, rows.values)[::-1].astype(np.float32)
        profile: dict[str, Any] = {"width": rows.x.size, "height": rows.y.size, "count": 1}
        corner = rows.x[0] - 500, rows.y[-1] + 500
        profile |= {"transform": rasterio.Affine(1000, 0, corner[0], 0, -1000, corner[1])}
        profile |= {"dtype": "float32", "nodata": mark}
        suffix = {"ERS": ".ers", "AAIGrid": ".asc"}.get(driver, ".grd")
        made, path = folder / "made.tif", folder / f"grid{suffix}"
        with rasterio.open(made, "w", driver="GTiff", **profile) as dataset:
            dataset.write(stored, 1)
        rasterio.shutil.copy(made, path, driver=driver)
        return [path, path.with_suffix("")] if driver == "ERS" else [path]

    return write


def geosoft(
    *, compressed: bool = False, along_y: bool = False, rotation: float = 0.0, dtype: str = "<f4"
) -> Writer:
    """A grid by the published description of version 2 (512-byte header, dummies -1e32)."""

    def write(folder: Path, rows: Rows = SMALL) -> list[Path]:
        stored = np.where(np.isnan(rows.values), -1e32, rows.values)
        stored = (stored.T if along_y else stored).astype(dtype)
        size = stored.dtype.itemsize + (1024 if compressed else 0)
        vectors, elements = stored.shape
        head = struct.pack("<5i", size, 2, elements, vectors, -1 if along_y else 1)
        head += struct.pack("<7d", 1000, 1000, rows.x[0], rows.y[0], rotation, 0, 1)
        body = stored.tobytes()
        if compressed:
            packed = bytes(16) + zlib.compress(body)
            body = struct.pack("<4iqi", 0, 0, 1, vectors, 512 + 16 + 12, len(packed)) + packed
        path = folder / "grid.grd"
        path.write_bytes(head.ljust(512, b"\0") + body)
        return [path]

    return write


def old_gmt(*, cells: bool = False, count: int | None = None) -> Writer:
    def write(folder: Path, rows: Rows = SMALL) -> list[Path]:
        path = folder / "grid.grd"
        half = 500.0 if cells else 0.0
        with netCDF4.Dataset(path, "w", format="NETCDF3_CLASSIC") as dataset:
            dataset.createDimension("side", 2)
            size = rows.values.size if count is None else count
            dataset.createDimension("xysize", size)
            for name, axis in (("x_range", rows.x), ("y_range", rows.y)):
                dataset.createVariable(name, "f8", ("side",))[:] = axis[0] - half, axis[-1] + half
            dataset.createVariable("spacing", "f8", ("side",))[:] = 1000, 1000
            dataset.createVariable("dimension", "i4", ("side",))[:] = rows.x.size, rows.y.size
            z = dataset.createVariable("z", "f4", ("xysize",), fill_value=np.float32(np.nan))
            z.setncatts({"scale_factor": 2.0, "add_offset": 1.0, "node_offset": int(cells)})
            z.set_auto_scale(False)
            z[:] = ((rows.values[::-1].ravel() - 1) / 2)[:size]
        return [path]

    return write


def text(separator: str, head: str = "", tail: str = "") -> Writer:
    """Lines in no order, the void left out."""

    def write(folder: Path, rows: Rows = SMALL) -> list[Path]:
        lines = [
            separator.join(f"{v:.2f}" for v in (rows.x[i], rows.y[j], rows.values[j, i]))
            for j in range(rows.y.size)
            for i in range(rows.x.size)
            if not np.isnan(rows.values[j, i])
        ]
        path = folder / "grid.xyz"
        path.write_text(head + "\n".join(reversed(lines)) + "\n" + tail)
        return [path]

    return write


def in_gzip(write: Writer) -> Writer:
    def pack(folder: Path, rows: Rows = SMALL) -> list[Path]:
        (plain,) = write(folder, rows)
        packed = folder / f"{plain.name}.gz"
        packed.write_bytes(gzip.compress(plain.read_bytes()))
        return [packed]

    return pack


def in_zip(write: Writer, *others: str) -> Writer:
    def pack(folder: Path, rows: Rows = SMALL) -> list[Path]:
        packed = folder / "packed.zip"
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            for plain in write(folder, rows):
                archive.write(plain, f"inner/{plain.name}")
            for other in others:
                archive.writestr(other, "about it")
        return [packed]

    return pack
