"""Field models against ppigrf and pyshtools, in one process; both sides use what they can.

1. 100,000 scattered points of the IGRF against ppigrf: at least 20 times as fast is asked.
2. A global vector grid at degree 790 on the ellipsoid, at 0.1 degrees, against pyshtools'
   `SHMagCoeffs.expand` on its nearest grid (0.114 degrees): at least 4 times.
3. 100,000 scattered points at degree 790 against pyshtools' evaluation point by point (timed on
   fewer): at least 10 times, 100 aimed at.

pyshtools (BSD) is no dependency, since its wheels carry the GPL's FFTW: where it is not
installed, only our own times are shown.
"""

from __future__ import annotations

import importlib
import resource
import sys
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import numba
import numpy as np
import ppigrf

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "truth"))

from gauss import RADIUS_KM, random_crust, static

from magtiles.catalog.kernels.geodesy import FLATTENING, SEMI_MAJOR_AXIS_M
from magtiles.catalog.models import FieldModel, evaluate, evaluate_grid, load_igrf

POINTS = 100_000
THEIR_POINTS = 200
DEGREE = 790


def timed(work: Callable[[], object], repeats: int = 1) -> float:
    """Shortest of several runs, seconds."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def places(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scattered evenly over the globe, 0 to 600 km."""
    rng = np.random.default_rng(1)
    lat = np.degrees(np.arcsin(rng.uniform(-1.0, 1.0, count)))
    return lat, rng.uniform(-180.0, 180.0, count), rng.uniform(0.0, 600e3, count)


def bench_igrf() -> None:
    model, date = load_igrf(), datetime(2020, 1, 1)  # noqa: DTZ001
    lat, lon, h = places(POINTS)
    evaluate(model, lat, lon, h, date)  # compiles
    ours = timed(lambda: evaluate(model, lat, lon, h, date), 5)
    with_tensor = timed(lambda: evaluate(model, lat, lon, h, date, gradient=True), 2)
    dates = np.datetime64("2015-06-01") + np.arange(POINTS).astype("m8[h]")
    varying = timed(lambda: evaluate(model, lat, lon, h, dates), 2)
    theirs = timed(lambda: ppigrf.igrf(lon, lat, h / 1e3, date), 2)
    print(f"IGRF, {POINTS} points: {ours:.3f} s, ppigrf {theirs:.2f} s")
    print(f"ratio {theirs / ours:.0f} (asked: 20)")
    print(f"with tensor {with_tensor:.3f} s; a date for each point {varying:.3f} s")


def pyshtools_model(model: FieldModel) -> Any:
    """The same coefficients for pyshtools, None where it is not installed."""
    try:
        pyshtools = importlib.import_module("pyshtools")
    except ImportError:
        print("pyshtools is not installed: no ratios at degree 790")
        return None
    c = np.zeros((2, DEGREE + 1, DEGREE + 1))
    for n in range(1, DEGREE + 1):
        row = model.coefficients[0][n * n - 1 : n * n + 2 * n]
        c[0, n, 0], c[0, n, 1 : n + 1], c[1, n, 1 : n + 1] = row[0], row[1::2], row[2::2]
    return pyshtools.SHMagCoeffs.from_array(
        c, r0=RADIUS_KM * 1e3, normalization="schmidt", csphase=1
    )


def bench_grid(model: FieldModel, other: Any) -> None:
    lat, lon = np.linspace(-90.0, 90.0, 1801), np.linspace(-180.0, 180.0, 3601)[:-1]
    ours = timed(lambda: evaluate_grid(model, lat, lon, 0.0, 2020.0), 3)
    print(f"grid of {lat.size} x {lon.size}, degree {DEGREE}: {ours:.2f} s")
    if other is not None:
        theirs = timed(lambda: other.expand(a=SEMI_MAJOR_AXIS_M, f=FLATTENING), 2)
        print(f"pyshtools, 1583 x 3165: {theirs:.2f} s; ratio {theirs / ours:.1f} (asked: 4)")
    tensor = timed(lambda: evaluate_grid(model, lat, lon, 0.0, 2020.0, gradient=True))
    print(f"with tensor {tensor:.2f} s")


def bench_points(model: FieldModel, other: Any) -> None:
    lat, lon, h = places(POINTS)
    evaluate(model, lat[:10], lon[:10], h[:10], 2020.0)  # prepares the coefficients
    ours = timed(lambda: evaluate(model, lat, lon, h, 2020.0))
    print(f"{POINTS} points, degree {DEGREE}: {ours:.1f} s, {ours / POINTS * 1e6:.0f} us each")
    if other is not None:
        few = slice(0, THEIR_POINTS)
        radius = 6371e3 + h[few]
        theirs = timed(lambda: other.expand(lat=lat[few], lon=lon[few], r=radius)) / THEIR_POINTS
        print(f"pyshtools {theirs * 1e6:.0f} us each; ratio {theirs * POINTS / ours:.0f} "
              "(asked: 10, aim: 100)")  # fmt: skip


def main() -> None:
    print(f"{numba.get_num_threads()} threads")
    bench_igrf()
    model = static(random_crust(1, DEGREE, 200.0))
    other = pyshtools_model(model)
    bench_grid(model, other)
    bench_points(model, other)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f"largest memory of the process: {peak:.2f} GB (asked: at most 2)")


if __name__ == "__main__":
    main()
