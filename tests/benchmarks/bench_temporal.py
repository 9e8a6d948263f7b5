"""A year of one-minute data against ``pandas.read_csv`` of the same numbers, in one process.

Fitted (``fit-fogm``: quiet-day curve out, 2,920 segments, four elements, both methods, bounds,
60 classes): asked is at most five times that, and less than 1 GB in all.
"""

from __future__ import annotations

import resource
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from magtiles.stages.temporal.fit_fogm import FitFogmParams, fit_fogm

ROUNDS = 5
ELEMENTS = ("north", "east", "down", "total")


def seconds(work: Callable[[], object]) -> float:
    """Wall time of one run."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def alternating(ours: Callable[[], object], theirs: Callable[[], object]) -> tuple[float, float]:
    """Median wall times of several runs in turn, after one of each to warm up."""
    ours(), theirs()
    pairs = [(seconds(ours), seconds(theirs)) for _ in range(ROUNDS)]
    return statistics.median(p[0] for p in pairs), statistics.median(p[1] for p in pairs)


def year() -> tuple[NDArray[np.datetime64], NDArray[np.float64]]:
    """Minutes of 2015 and four elements (element, time), nT: level, noon swing, slow noise."""
    rng = np.random.default_rng(1)
    time_ = np.arange("2015-01-01", "2016-01-01", dtype="datetime64[m]").astype("datetime64[ns]")
    noise = rng.standard_normal((4, time_.size)).cumsum(axis=1)
    noise -= pd.DataFrame(noise.T).rolling(1440, min_periods=1).mean().to_numpy().T
    values = np.array([20_537.0, 3_147.0, 47_919.0, 52_236.0])[:, None] + 0.5 * noise
    values[:, rng.random(time_.size) < 0.002] = np.nan
    return time_, np.round(values, 2)


def datasets() -> tuple[xr.Dataset, xr.Dataset, xr.Dataset]:
    """The year as observatory-series/1, flat quiet-day curves, and Kp."""
    time_, values = year()
    place = {"latitude": 40.137, "longitude": -105.236, "elevation": 1682.0}
    series = xr.Dataset(
        {f"field_{e}": ("time", values[i]) for i, e in enumerate(ELEMENTS)}
        | {"quality_flag": ("time", np.zeros(time_.size, np.uint8))},
        coords={"time": time_},
        attrs=place | {"iaga_code": "BOU", "cadence_s": 60.0, "source": "benchmark"},
    )
    months = np.arange("2015-01", "2016-01", dtype="datetime64[M]").astype("datetime64[ns]")
    curve = ("observatory", "element", "month", "minute")
    level = np.repeat(np.nanmean(values, axis=1)[None, :, None], 12, axis=2)
    baseline = xr.Dataset(
        {name: ("observatory", [value]) for name, value in place.items()}
        | {
            "iaga_code": ("observatory", ["BOU"]),
            "dip_latitude": ("observatory", [49.1]),
            "baseline": (curve, np.zeros((1, 4, 12, 1440))),
            "level": (curve[:3], level),
        },
        coords={"month": months},
    )
    threes = time_[::180]
    kp = np.random.default_rng(2).integers(0, 19, threes.size) / 3.0
    index = xr.Dataset({"kp": ("time", kp)}, {"time": threes}, attrs={"cadence_s": 10_800.0})
    return series, baseline, index


def fit_ratio() -> float:
    """Time to fit a year over the time that pandas takes to read it; prints both."""
    series, baseline, index = datasets()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "year.csv"
        columns = {e: series[f"field_{e}"].values for e in ELEMENTS}
        pd.DataFrame(columns).to_csv(file, index=False, float_format="%.2f")
        ours, theirs = alternating(
            lambda: fit_fogm(series, baseline, params=FitFogmParams(), index=index),
            lambda: pd.read_csv(file),
        )
    print(f"fit-fogm of {series.sizes['time']} minutes {ours:.2f} s, read_csv {theirs:.2f} s")
    print(f"  ratio {ours / theirs:.2f} (asked: at most 5)")
    return ours / theirs


def peak_gigabytes() -> float:
    """Largest memory that this process has held."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e9 if sys.platform == "darwin" else 1e6 / 1.024)


def main() -> None:
    """Print the ratios and the memory."""
    fit_ratio()
    print(f"peak memory {peak_gigabytes():.2f} GB (asked: below 1)")


if __name__ == "__main__":
    main()
