"""GeoTIFF grids through rasterio (GDAL)."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import rasterio
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning, RasterioError

from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages.ingest.files import check_tiff_directories
from magtiles.stages.ingest.raw import RawGrid
from magtiles.stages.ingest.source import IngestGridParams


def read_geotiff(path: Path, params: IngestGridParams) -> RawGrid:
    """One band of a GeoTIFF with its cell centres.

    GDAL gives cell corners for either registration, so nodes are always the cells' centres.
    Raises FormatError for truncated, rotated or unplaced rasters, SourceError where the band
    is not clear.
    """
    check_tiff_directories(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path, driver="GTiff") as dataset:
                return _read(dataset, path, params)
    except RasterioError as caught:
        detail = caught.__cause__ or caught
        raise FormatError(
            f"is not a whole GeoTIFF: {str(detail).replace(str(path), path.name)}",
            where=path,
            remedy="fetch it again",
        ) from None


def _read(dataset: Any, path: Path, params: IngestGridParams) -> RawGrid:
    band = _choose_band(dataset, path, params.band)
    x, y = _nodes(dataset, path)
    stored = dataset.read(band, masked=True)
    values = _scaled(stored, dataset.scales[band - 1], dataset.offsets[band - 1])
    says: dict[str, Any] = {
        "registration": "point" if dataset.tags().get("AREA_OR_POINT") == "Point" else "pixel"
    }
    if dataset.units[band - 1]:
        says["units"] = dataset.units[band - 1]
    if dataset.nodatavals[band - 1] is not None and np.isfinite(dataset.nodatavals[band - 1]):
        says["no_data"] = float(dataset.nodatavals[band - 1])
    elif params.no_data is not None:
        values[stored.data == stored.dtype.type(params.no_data)] = np.nan
    crs = pyproj.CRS.from_user_input(dataset.crs) if dataset.crs else None
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
            expected="a GeoTIFF with a pixel scale and tie point",
        )
    if transform.b or transform.d:
        raise FormatError(
            f"the raster is rotated or sheared (b = {transform.b:g}, d = {transform.d:g})",
            where=path,
            expected="rows along x and columns along y",
            remedy="resample it to an unrotated grid of its projection",
        )
    x = transform.c + transform.a * (np.arange(dataset.width) + 0.5)
    y = transform.f + transform.e * (np.arange(dataset.height) + 0.5)
    return x, y


def _scaled(stored: Any, scale: float, offset: float) -> NDArray[np.float64]:
    values: NDArray[np.float64] = stored.data.astype(np.float64) * scale + offset
    values[np.ma.getmaskarray(stored)] = np.nan
    return values
