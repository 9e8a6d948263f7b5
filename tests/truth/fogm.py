"""How well sigma and tau are recovered from simulated Gauss-Markov processes: the tables of docs.

Three-hour segments of one-minute samples. Run by itself: prints every table of docs/fogm.md
from 10,000 segments of each kind.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtiles.stages.temporal.fogm import (
    Fit,
    fit_autocorrelation,
    fit_pooled,
    fit_segments,
)

Floats = NDArray[np.float64]

STEP_S, SAMPLES = 60.0, 180
SEGMENT_S = STEP_S * SAMPLES
SIGMAS = (5.0, 20.0, 60.0)
TAUS = (300.0, 600.0, 1200.0, 1800.0, 2700.0, 3600.0, 5400.0, 7200.0)


def simulate(
    segments: int, sigma: float, tau: float, rng: np.random.Generator, gaps: float = 0.0
) -> Floats:
    """Independent segments (segment, sample) of the exact sampled process; a share is NaN."""
    phi = np.exp(-STEP_S / tau)
    x = rng.standard_normal((segments, SAMPLES))
    for i in range(1, SAMPLES):
        x[:, i] = phi * x[:, i - 1] + np.sqrt(1.0 - phi**2) * x[:, i]
    x[rng.random(x.shape) < gaps] = np.nan
    return sigma * x


@dataclass(frozen=True)
class Found:
    """All fits of one set of segments, and what was simulated."""

    sigma: float
    tau: float
    zero: Fit
    about_mean: tuple[Floats, Floats]
    autocorrelation: tuple[Floats, Floats]
    pooled: Fit

    def covered(self, name: str) -> float:
        """Share of 95 % profile intervals that hold the truth."""
        low, high = (getattr(self.zero, f"{name}_{end}") for end in ("low", "high"))
        truth = getattr(self, name)
        return float(np.mean((low <= truth) & (truth <= high)))

    def biases(self, values: Floats, name: str) -> tuple[float, float]:
        """Relative bias of mean and median."""
        truth = float(getattr(self, name))
        return float(np.mean(values) / truth - 1.0), float(np.median(values) / truth - 1.0)


def recover(
    segments: int, sigma: float, tau: float, rng: np.random.Generator, gaps: float = 0.0
) -> Found:
    """Simulate and fit in every way."""
    x = simulate(segments, sigma, tau, rng, gaps)
    zero, *about_mean = fit_segments(x, STEP_S)
    together = fit_pooled(x, STEP_S, np.ones((1, segments), np.bool_))
    by_lags = fit_autocorrelation(x, STEP_S)
    return Found(sigma, tau, zero, (about_mean[0], about_mean[1]), by_lags, together)


def _percent(*values: float) -> str:
    return " | ".join(f"{100.0 * v:+.1f} %" for v in values)


def main(segments: int = 10_000) -> None:
    """Print the tables."""
    rng = np.random.default_rng(5)
    rows = [
        recover(segments, sigma, tau, rng, gaps)
        for gaps in (0.0, 0.2)
        for sigma in SIGMAS
        for tau in TAUS
    ]
    whole, broken = rows[: len(rows) // 2], rows[len(rows) // 2 :]
    middle = [f for f in whole if f.sigma == SIGMAS[1]]
    for name, at in (("tau", 1), ("sigma", 0)):
        print(f"\nBias of {name}, mean and median: about zero, about the mean, autocorrelation")
        for f in middle:
            every = getattr(f.zero, name), f.about_mean[at], f.autocorrelation[at]
            print(f"| {f.tau:g} s |", _percent(*sum((f.biases(v, name) for v in every), ())), "|")
    print("\nCoverage of 95 % intervals of tau and sigma, whole and with 20 % gaps; unidentified")
    for f, g in zip(middle, (f for f in broken if f.sigma == SIGMAS[1]), strict=True):
        shares = [h.covered(name) for h in (f, g) for name in ("tau", "sigma")]
        long = np.mean(f.zero.unidentified(SEGMENT_S))
        print(f"| {f.tau:g} s |", " | ".join(f"{100.0 * s:.1f} %" for s in (*shares, long)), "|")
    worst = max(abs(f.biases(f.zero.tau, "tau")[0]) for f in rows if f.tau <= SEGMENT_S / 4)
    print(f"\nworst bias of the mean of tau about zero up to a quarter of a segment {worst:.3f}")
    everything = [f.covered(n) for f in rows for n in ("tau", "sigma")]
    print(f"coverage, all sigma, tau and gaps: {min(everything):.3f} to {max(everything):.3f}")
    pooled = [abs(f.biases(getattr(f.pooled, n), n)[0]) for f in rows for n in ("tau", "sigma")]
    print(f"worst error of a pooled fit of {segments} segments: {max(pooled):.4f}")


if __name__ == "__main__":
    main()
