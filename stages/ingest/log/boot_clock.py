"""UTC from a clock that counts since boot, by fixes that know both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from magtiles.stages.vehicle.positions import Real, Times

_CRYSTAL = 50e-6
"""Rates of uncompensated quartz clocks spread so; fixes of a short log say less than this."""
_FINEST_S = 1e-3
_ROUNDS = 3
"""The spread of the fixes, which says what is an outlier, is known once the drift is."""


@dataclass(frozen=True)
class BootClock:
    """utc = boot + offset + drift (boot - middle), seconds.

    Attributes
    ----------
    offset_s, drift, middle_s : the line; `offset_s` since 1970.
    residual_s : robust 1 sigma of the fixes about it.
    fixes : how many it rests on.
    """

    offset_s: float
    drift: float
    middle_s: float
    residual_s: float
    fixes: int

    def utc(self, boot_us: NDArray[np.integer]) -> Times:
        """UTC of times in microseconds since boot."""
        boot = boot_us.astype(np.int64)
        whole = int(np.floor(self.offset_s))
        ahead = self.offset_s - whole + self.drift * (boot * 1e-6 - self.middle_s)
        return np.asarray(
            (boot * 1000 + whole * 10**9 + np.round(ahead * 1e9).astype(np.int64)).astype(
                "datetime64[ns]"
            )
        )


def fit_boot_clock(boot_us: NDArray[np.integer], utc_us: NDArray[np.integer]) -> BootClock:
    """The line through fixes, robust (Huber) against late ones and leap-second jumps.

    The drift is held to some 50 ppm a priori, so that a short log does not extrapolate its noise.
    """
    boot = boot_us.astype(np.int64)
    ahead_us = utc_us.astype(np.int64) - boot
    reference = int(np.median(ahead_us))
    middle = float(boot.mean() * 1e-6)
    apart = np.asarray((ahead_us - reference) * 1e-6, dtype=np.float64)
    since = np.asarray(boot * 1e-6 - middle, dtype=np.float64)
    line, left = np.zeros(2), _robust_sigma(apart)
    for _ in range(_ROUNDS):
        line = _fitted(line, since, apart, max(left, _FINEST_S))
        left = _robust_sigma(apart - line[0] - line[1] * since)
    return BootClock(reference * 1e-6 + float(line[0]), float(line[1]), middle, left, boot.size)


def _fitted(first: Real, since: Real, apart: Real, spread: float) -> Real:
    def misfit(line: Real) -> Real:
        about = (line[0] + line[1] * since - apart) / spread
        return np.append(about, line[1] / _CRYSTAL)

    found = least_squares(misfit, first, loss="huber", x_scale=(spread, _CRYSTAL)).x
    return np.asarray(found, dtype=np.float64)


def _robust_sigma(values: Real) -> float:
    return float(1.4826 * np.median(np.abs(values - np.median(values))))
