"""The reader against its references, in one process and one thread.

1. A thousand positions from a patch, value and gradient, against SciPy's spline for the value
   and two derivatives: at least 25 times faster is asked, 50 aimed at.
2. Opening a release and a first query between levels, against reading and hashing the same
   bytes: at most 3 times as long is asked.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import hashlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.interpolate import RectBivariateSpline

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "truth"))

from synthetic_release import World, small_lattice

from magtiles.catalog import open_release

HEIGHT = 2700.0


def best(work: Callable[[], object], repeats: int) -> float:
    """Shortest of several runs, seconds."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def bench_patch(world: World, folder: Path) -> None:
    lattice = world.lattice
    release = open_release(folder)
    bounds = {"latitude": (lattice.south, lattice.north), "longitude": (lattice.west, lattice.east)}
    start = time.perf_counter()
    patch = release.anomaly.patch(bounds, height=HEIGHT)
    made = time.perf_counter() - start
    lat = lattice.south + np.arange(lattice.rows + 1) * lattice.latitude_spacing
    lon = lattice.west + np.arange(lattice.columns + 1) * lattice.longitude_spacing
    spline = RectBivariateSpline(lat, lon, patch.total(lat[:, None], lon[None, :]))
    rng = np.random.default_rng(1)
    y = rng.uniform(lat[12], lat[-12], 1000)
    x = rng.uniform(lon[12], lon[-12], 1000)
    apart = np.abs(patch.total(y, x) - spline.ev(y, x)).max()

    ours = best(lambda: patch.total_with_gradient(y, x), 500)
    theirs = best(lambda: (spline.ev(y, x), spline.ev(y, x, dx=1), spline.ev(y, x, dy=1)), 100)
    print(f"patch of {lat.size} x {lon.size} nodes made in {made:.2f} s; {apart:.1e} nT from SciPy")
    print(f"1,000 positions, value and gradient: {ours * 1e6:.1f} us, SciPy {theirs * 1e6:.1f} us")
    print(f"ratio {theirs / ours:.1f} (asked: 25, aim: 50)")
    vector = best(lambda: patch.vector_with_gradient(y, x), 50)
    direct = best(lambda: release.anomaly.total_with_gradient(y, x, HEIGHT), 20)
    print(
        f"vector with gradient {vector * 1e6:.0f} us; total without a patch {direct * 1e6:.0f} us"
    )


def bench_opening(world: World, folder: Path) -> None:
    lattice = world.lattice
    lat, lon = lattice.south + 0.011, lattice.west + 0.013
    files = [folder / "manifest.json", folder / "tiles" / "r000c000.nc"]

    def first_query() -> object:
        return open_release(folder).anomaly.total_with_gradient(lat, lon, HEIGHT)

    def read_and_hash() -> object:
        return [hashlib.sha256(file.read_bytes()).digest() for file in files]

    first_query()
    ours, theirs = best(first_query, 20), best(read_and_hash, 20)
    size = sum(file.stat().st_size for file in files) / 1e6
    print(f"open and first query: {ours * 1e3:.1f} ms, read and hash {theirs * 1e3:.1f} ms")
    print(f"ratio {ours / theirs:.2f} (asked: at most 3) for {size:.1f} MB")


def main() -> None:
    # One tile of some 350 nodes each way, five levels: what a quarter of a degree at 80 m holds.
    lattice = replace(
        small_lattice(), rows=330, columns=330, tile_rows=330, tile_columns=330,
        latitude_spacing=0.0045, longitude_spacing=0.00625,
    )  # fmt: skip
    world = World(lattice=lattice)
    with tempfile.TemporaryDirectory() as store:
        folder = world.publish(Path(store)).path
        bench_patch(world, folder)
        bench_opening(world, folder)
        subprocess.run(["chmod", "-R", "u+w", store], check=True)


if __name__ == "__main__":
    main()
