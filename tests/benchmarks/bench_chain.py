"""The whole chain, from a survey's file to a published release, against bare FFTs.

Both sides in one process (tiles are cut in two processes of its own): a 2048 x 2048 GeoTIFF
is ingested, filled, continued to two levels above the survey's, cut into tiles and published.
The bare FFTs are, for each of the three levels, one forward and nine inverse transforms at the
size the chain resamples with (padded, oversampled twofold).
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np
import rasterio
import scipy.fft

from magtiles.pipeline.build import build_product
from magtiles.stages.field.padding import plan_padding

SIZE, SPACING_M, HEIGHT_M = 2048, 250.0, 300.0
LEVELS_M = (800.0, 1300.0)
SOURCE = f"""
[source]
id = "benchmark"
kind = "anomaly-grid"
files = ["benchmark.tif"]
licence = "CC0-1.0"
[grid]
height_m = {HEIGHT_M}
height_reference = "ellipsoid"
reference_field = "IGRF-14"
reference_epoch = "2010-01-01"
uncertainty_nt = 1.0
"""
PRODUCT = f"""
[product]
name = "benchmark"
version = "1.0.0"
[anomaly]
source = "benchmark-source.toml"
heights_m = {list(LEVELS_M)}
height_reference = "ellipsoid"
"""


def write_inputs(folder: Path) -> Path:
    """A GeoTIFF of smoothed noise, with its source and product TOML."""
    rng = np.random.default_rng(1)
    k = np.hypot(*np.meshgrid(np.fft.fftfreq(SIZE), np.fft.rfftfreq(SIZE), indexing="ij"))
    spectrum = scipy.fft.rfft2(rng.standard_normal((SIZE, SIZE))) * np.exp(-18 * k)
    values = scipy.fft.irfft2(spectrum, s=(SIZE, SIZE))
    half = SPACING_M * SIZE / 2
    with rasterio.open(
        folder / "benchmark.tif",
        "w",
        driver="GTiff",
        width=SIZE,
        height=SIZE,
        count=1,
        dtype="float32",
        crs="+proj=tmerc +lat_0=46 +lon_0=-120 +datum=WGS84",
        transform=rasterio.Affine(SPACING_M, 0, -half, 0, -SPACING_M, half),
    ) as file:
        file.write((values * 70 / values.std()).astype(np.float32), 1)
    (folder / "benchmark-source.toml").write_text(SOURCE)
    product = folder / "benchmark.toml"
    product.write_text(PRODUCT)
    return product


def bare_ffts(shape: tuple[int, int], levels: int) -> float:
    """Seconds for one forward and nine inverse real transforms a level."""
    values = np.random.default_rng(2).standard_normal(shape)
    start = time.perf_counter()
    for _ in range(levels):
        spectrum = scipy.fft.rfft2(values, workers=-1)
        for _ in range(9):
            scipy.fft.irfft2(spectrum, s=shape, workers=-1)
    return time.perf_counter() - start


def main() -> None:
    """Time both sides and print the ratio."""
    levels = (HEIGHT_M, *LEVELS_M)
    gain = max(LEVELS_M) - HEIGHT_M
    padded = plan_padding((SIZE, SIZE), (SPACING_M, SPACING_M), gain).shape
    dense = (2 * padded[0], 2 * padded[1])
    steps: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        product = write_inputs(folder)
        before = bare_ffts(dense, len(levels))
        start = last = time.perf_counter()
        doing = "start"

        def progress(what: str, done: int, total: int) -> None:
            nonlocal last, doing
            now = time.perf_counter()
            steps[doing] = steps.get(doing, 0.0) + now - last
            last, doing = now, what

        result = build_product(
            product, store=folder / "store", work=folder / "work", progress=progress
        )
        chain = time.perf_counter() - start
        progress("end", 1, 1)
        size = sum(f.stat().st_size for f in (result.path / "tiles").iterdir())
        bare = (before + bare_ffts(dense, len(levels))) / 2
        # What was published is read-only, to the folder's own removal too.
        for part in [result.path, *result.path.rglob("*")]:
            part.chmod(0o755)
    print(f"map {SIZE} x {SIZE}, {len(levels)} levels; tiles of {size / 1e6:.0f} MB")
    for step, seconds in steps.items():
        print(f"  {step:20} {seconds:8.2f} s")
    print(f"chain, file to published release {chain:8.2f} s")
    print(f"bare FFTs at {dense}          {bare:8.2f} s")
    print(f"ratio {chain / bare:.2f} (asked: at most 4)")


if __name__ == "__main__":
    main()
