"""A survey flown at a constant height above an analytic terrain, over exactly known sources."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import rasterio
from numpy.typing import ArrayLike, NDArray

from magtiles.pipeline.sample import DEMO, Sample, synthesize, write_survey

Floats = NDArray[np.float64]

CLEARANCE = 500.0
GAINS = (1000.0, 2000.0)

_SPEC = replace(
    DEMO,
    name="draped",
    width_m=80e3,
    length_m=70e3,
    depth_m=(2500.0, 10_000.0),
    dipoles=200,
    noise_nt=0.0,
    line_spacing_m=None,
    void=False,
    coast=False,
    seed=2,
)


def terrain(latitude: ArrayLike, longitude: ArrayLike) -> Floats:
    """Ellipsoidal height, m, of hills 300 m high and some 40 km apart."""
    lat, lon = np.asarray(latitude, float), np.asarray(longitude, float)
    north, east = (lat - 46.0) * 111.0, (lon + 121.5) * 77.0
    hills = np.sin(2 * np.pi * north / 42.0) * np.cos(2 * np.pi * east / 38.0)
    return np.asarray(1000.0 + 200.0 * hills + 100.0 * np.cos(2 * np.pi * (north + east) / 50.0))


def geoid(latitude: ArrayLike, longitude: ArrayLike) -> Floats:
    """Height of a geoid that slopes and bends, m."""
    lat, lon = np.asarray(latitude, float), np.asarray(longitude, float)
    return np.asarray(-20.0 + 3.0 * (lat - 46.0) + 2.0 * (lon + 121.5) ** 2)


def survey() -> Sample:
    """The sources, and their exact anomaly `CLEARANCE` above the terrain at each node."""
    sample = synthesize(_SPEC)
    height = terrain(sample.latitude, sample.longitude) + CLEARANCE
    exact = sample.truth(sample.latitude, sample.longitude, height)[0]
    return replace(sample, anomaly=exact, exact=exact)


def write_draped(folder: Path, sample: Sample, *, anomaly: str = "", grid: str = "") -> Path:
    """The survey's files and a product over terrain, with more keys of [anomaly] and [grid]."""
    _, source, product = write_survey(folder, sample)
    stated = source.read_text().replace('"ellipsoid"', '"terrain"')
    stated = stated.replace(f"height_m = {sample.spec.height_m}", f"height_m = {CLEARANCE}")
    source.write_text(stated + grid)
    levels = [CLEARANCE + gain for gain in GAINS]
    product.write_text(
        f'[product]\nname = "draped"\nversion = "1.0.0"\n[anomaly]\nsource = "{source.name}"\n'
        f'heights_m = {levels}\nheight_reference = "terrain"\n{anomaly}'
    )
    return product


def write_heights(
    path: Path,
    height: Callable[[Floats, Floats], Floats],
    axes: tuple[Floats, Floats],
    crs: str = "EPSG:4326",
    **keys: Any,
) -> Path:
    """Heights on ascending x, y of a CRS as a float32 GeoTIFF, and its source TOML.

    Returns the TOML's path.
    """
    x, y = axes
    to_wgs84 = pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
    longitude, latitude = to_wgs84.transform(*np.meshgrid(x, y))
    values = height(np.asarray(latitude), np.asarray(longitude))[::-1].astype(np.float32)
    dx, dy = x[1] - x[0], y[1] - y[0]
    profile: dict[str, Any] = {"driver": "GTiff", "width": x.size, "height": y.size, "count": 1}
    profile |= {"dtype": "float32", "crs": crs, "nodata": -32768.0}
    profile |= {"transform": rasterio.Affine(dx, 0, x[0] - dx / 2, 0, -dy, y[-1] + dy / 2)}
    with rasterio.open(path.with_suffix(".tif"), "w", **profile) as dataset:
        dataset.write(values, 1)
    lines = [f"{k} = {v}" if isinstance(v, float) else f'{k} = "{v}"' for k, v in keys.items()]
    path.write_text(
        f'[source]\nid = "{path.stem}"\nkind = "surface-grid"\nfiles = ["{path.stem}.tif"]\n'
        'licence = "CC0-1.0"\n[surface]\n' + "\n".join(lines) + "\n"
    )
    return path
