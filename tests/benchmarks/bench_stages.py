"""Memory of the stages before the transform, by size of the map, each in a process of its own.

A GeoTIFF of 4096 and of 8192 nodes a side, with voids and a ragged border, and the same as
netCDF, are ingested; the map is re-referenced, freed of a core field, cropped and filled.
`bench_stages.py 4096` does one size only.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pyproj
import rasterio
from bench_blocks import Watch
from rasterio.windows import Window

from magtiles.pipeline.runner import run_stage
from magtiles.stages.field import core_field, crop, rereference, voids
from magtiles.stages.ingest import grid as ingest

SIZES = (4096, 8192)
SPACING_M, ROWS = 250.0, 512
CRS = pyproj.CRS("+proj=tmerc +lat_0=46 +lon_0=-120 +datum=WGS84")
SAID = {
    "height_m": 300.0,
    "height_reference": "ellipsoid",
    "reference_epoch": "2010-01-01",
    "uncertainty_nt": 1.0,
    "line_spacing_m": 500.0,
    "source_distance_m": 1000.0,
}
ANOMALY, TOTAL = SAID | {"reference_field": "IGRF-14"}, SAID | {"reference_field": "none"}
REGION = {"latitude": [45.8, 46.2], "longitude": [-120.3, -119.7], "margin_m": 1e6}

STAGES: dict[str, tuple[Any, str, str, dict[str, Any]]] = {
    "ingest-grid, GeoTIFF": (ingest.STAGE, "map.tif", "map.nc", ANOMALY),
    "ingest-grid, netCDF": (ingest.STAGE, "foreign.nc", "other.nc", ANOMALY),
    "crop-grid": (crop.STAGE, "map.nc", "cropped.nc", REGION),
    "fill-voids": (voids.STAGE, "map.nc", "filled.nc", {}),
    "re-reference": (rereference.STAGE, "map.nc", "newer.nc", {"reference_field": "IGRF-13"}),
    "ingest-grid, total field": (ingest.STAGE, "total.tif", "total.nc", TOTAL),
    "remove-core-field": (core_field.GRID_STAGE, "total.nc", "anomaly.nc", {}),
}
"""Stage, its input, its output, and its parameters."""


def strip(first: int, size: int) -> np.ndarray:
    """Some rows, from the north, nT."""
    i, j = np.arange(first, first + ROWS)[:, None], np.arange(size)
    values = 50.0 * np.sin(i / 19.0) * np.cos(j / 23.0) + 10.0 * np.cos(i / 5.0 + j / 4.0)
    values[(i - 0.3 * size) ** 2 + (j - 0.4 * size) ** 2 / 2 < 60**2] = np.nan
    values[(i % 700 - 350) ** 2 + (j % 900 - 450) ** 2 < 6**2] = np.nan
    values[j < 40 + 30 * np.sin(i / 50)] = np.nan
    return values.astype(np.float32)


def write_inputs(folder: Path, size: int) -> None:
    """The map as GeoTIFF and netCDF, and a total field."""
    place = rasterio.Affine(SPACING_M, 0, 0, 0, -SPACING_M, 0)
    profile = {"driver": "GTiff", "width": size, "height": size, "count": 1, "dtype": "float32"}
    for name, level in ("map.tif", 0.0), ("total.tif", 53_000.0):
        with rasterio.open(
            folder / name, "w", crs=CRS, transform=place, nodata=np.nan, **profile
        ) as file:
            for first in range(0, size, ROWS):
                file.write(level + strip(first, size), 1, window=Window(0, first, size, ROWS))
    with netCDF4.Dataset(folder / "foreign.nc", "w") as file:
        for name in ("y", "x"):
            file.createDimension(name, size)
            axis = file.createVariable(name, "f8", (name,))
            axis[:] = SPACING_M * np.arange(size)
            axis.setncatts({"units": "m", "standard_name": f"projection_{name}_coordinate"})
        cf = {k: list(v) if isinstance(v, tuple) else v for k, v in CRS.to_cf().items()}
        file.createVariable("crs", "i4", ()).setncatts(cf)
        values = file.createVariable("t", "f4", ("y", "x"), fill_value=np.float32(np.nan))
        values.setncatts({"units": "nT", "grid_mapping": "crs"})
        for first in range(0, size, ROWS):
            values[first : first + ROWS] = strip(first, size)


def measure(name: str, folder: Path) -> None:
    """Run a stage and print, as JSON, what it took."""
    stage, given, out, params = STAGES[name]
    role = "files" if stage is ingest.STAGE else "grid"
    with Watch() as memory:
        start = time.perf_counter()
        run_stage(stage, {role: folder / given}, folder / out, params)
        seconds = time.perf_counter() - start
    print(json.dumps({"seconds": seconds, **memory.gigabytes}))


def in_process(name: str, folder: Path) -> dict[str, Any]:
    """What `measure` prints, in a process of its own."""
    command = [sys.executable, __file__, "measure", name, str(folder)]
    printed = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    made: dict[str, Any] = json.loads(printed.splitlines()[-1])
    return made


def main() -> None:
    """Do all sizes and stages, or those named."""
    if sys.argv[1:2] == ["measure"]:
        measure(sys.argv[2], Path(sys.argv[3]))
        return
    for size in [int(a) for a in sys.argv[1:2]] or SIZES:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            write_inputs(folder, size)
            for stage in STAGES:
                made = in_process(stage, folder)
                print(
                    f"{size:5} a side, {stage:24}: at most {made['whole_gb']:.2f} GB, "
                    f"{made['worker_gb']:.2f} of it in a child; {made['seconds']:.1f} s",
                    flush=True,
                )


if __name__ == "__main__":
    main()
