"""Survey lines of a track: their numbers, and what can be said of each."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

Real = NDArray[np.float64]

_FOURTH = np.sqrt(70.0)
"""The fourth difference of white noise has sqrt(1 + 16 + 36 + 16 + 1) times its sigma."""
_MAD = 1.4826


def line_numbers(track: xr.Dataset) -> NDArray[np.int64]:
    """The line (time,) of each sample, counted from 0 in order of `line_names`; 0 without lines."""
    return _lines(track)[0]


def line_names(track: xr.Dataset) -> list[str]:
    """Names of the lines: ``flight/line``, or what there is of both; ``all`` without lines."""
    return _lines(track)[1]


def _lines(track: xr.Dataset) -> tuple[NDArray[np.int64], list[str]]:
    numbers = np.zeros(track.sizes["time"], dtype=np.int64)
    names = ["all"]
    for label in ("line", "flight"):
        if label in track:
            own, codes = np.unique(track[label].values, return_inverse=True)
            used, numbers = np.unique(codes * len(names) + numbers, return_inverse=True)
            names = [
                str(own[c]) if names == ["all"] else f"{own[c]}/{names[n]}"
                for c, n in (divmod(int(u), len(names)) for u in used)
            ]
    return numbers.astype(np.int64), names


@dataclass(frozen=True)
class LineStatistics:
    """A line: samples with an anomaly, their mean, standard deviation and noise, nT.

    `noise` is 1 sigma of white noise, by fourth differences; NaN where too few samples follow
    each other evenly.
    """

    line: str
    count: int
    mean: float
    standard_deviation: float
    noise: float


def line_statistics(track: xr.Dataset) -> list[LineStatistics]:
    """Statistics of `magnetic_anomaly` of each line of a track-anomaly/1."""
    numbers = line_numbers(track)
    anomaly = track["magnetic_anomaly"].values.astype(np.float64)
    seconds = (track["time"].values - track["time"].values[0]) / np.timedelta64(1, "s")
    found = []
    order = np.argsort(numbers, kind="stable")
    bounds = np.searchsorted(numbers[order], np.arange(numbers.max() + 2))
    for number, name in enumerate(line_names(track)):
        rows = order[bounds[number] : bounds[number + 1]]
        values = anomaly[rows]
        known = values[np.isfinite(values)]
        mean, spread = (known.mean(), known.std()) if known.size else (np.nan, np.nan)
        noise = fourth_difference_noise(seconds[rows], values)
        found.append(LineStatistics(name, known.size, float(mean), float(spread), noise))
    return found


def fourth_difference_noise(seconds: Real, values: Real) -> float:
    """1 sigma of the white noise of samples (n,) by the median size of their fourth differences.

    Only five samples that follow each other evenly, within half a step, make a difference. A
    smooth signal drops out: of a wave of N samples a (2 pi / N)^4th part remains.
    """
    if values.size < 5:
        return float("nan")
    steps = np.diff(seconds)
    usual = float(np.median(steps))
    even = np.abs(steps - usual) < 0.5 * usual
    whole = even[:-3] & even[1:-2] & even[2:-1] & even[3:]
    fourth = np.diff(values, 4)
    fourth = fourth[whole & np.isfinite(fourth)]
    return float(_MAD * np.median(np.abs(fourth)) / _FOURTH) if fourth.size else float("nan")


def plain(statistics: LineStatistics) -> dict[str, Any]:
    """As JSON has it: null for NaN, hundredths of a nanotesla suffice."""
    values = dataclasses.asdict(statistics)
    return {
        k: (None if np.isnan(v) else round(v, 3)) if isinstance(v, float) else v
        for k, v in values.items()
    }
