"""How far off a map is where it rests on values that were not measured.

Voids are filled and the exterior is invented, and both spread through every kernel, the
component kernels' long tails above all. No closed form covers that, so it is measured: random
fields with the map's own spectrum, which are known everywhere, are blanked where the map has no
data, filled, padded and transformed by the same code, and compared with what they truly are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from magtiles.stages.field.interpolate import evaluate_linear
from magtiles.stages.field.padding import Padding, pad
from magtiles.stages.field.prepare import PlaneMap
from magtiles.stages.field.product import Level
from magtiles.stages.field.spectral import (
    TENSOR,
    VECTOR,
    Complex,
    Inversion,
    Real,
    Wavenumbers,
    forward,
    inverse,
    odd_fast_length,
)
from magtiles.stages.field.voids import distance_to, extend, exterior_taper

Mask = NDArray[np.bool_]

REALISATIONS = 16
_LARGEST = 256
_SEED = 20180322
_AMPLITUDE_LIMITS = (1 / 9, 9.0)
_ROUGH_CELLS = 4.0
_LOCAL_CELLS = 8.0


@dataclass(frozen=True)
class MissingData:
    """Standard deviation of each product for want of data, on a thinned copy of the map.

    `variance` holds "total", "vector" (nT^2) and "tensor" (nT^2/km^2), each (rows, columns),
    and the map's "roughness" there: typical local power of its short wavelengths over
    their mean. Node (i, j) of the map lies at ((i + 0.5) / thinning - 0.5, ...) of them.
    """

    variance: dict[str, Real]
    thinning: int

    def at(self, group: str, row: Real, column: Real) -> Real:
        """One of `variance` at fractional rows and columns of the map."""
        out = np.empty(row.shape)
        scale = 1.0 / self.thinning
        evaluate_linear(self.variance[group], row, column, scale, 0.5 * scale - 0.5, out)
        return out


@dataclass(frozen=True)
class ThinMap:
    """A map thinned by means over blocks of `thinning` nodes a side.

    `values` nT; `void` and `beyond`, what part of each block is filled and outside; `spacing`
    of the map itself, m; `noise_variance` of one of its nodes, nT^2.
    """

    values: Real
    void: Real
    beyond: Real
    thinning: int
    spacing: tuple[float, float]
    noise_variance: float


def thinning_of(shape: tuple[int, int]) -> int:
    """How many nodes of a map of that shape go into one of its thin copy, each way."""
    return int(np.ceil(max(shape) / _LARGEST))


def thin_map(plane_map: PlaneMap) -> ThinMap:
    """The thin copy of a map that `missing_data` is measured on."""
    thinning = thinning_of((plane_map.values.shape[0], plane_map.values.shape[1]))
    return ThinMap(
        values=_thin(plane_map.values, thinning),
        void=_thin(plane_map.void, thinning),
        beyond=_thin(plane_map.beyond, thinning),
        thinning=thinning,
        spacing=plane_map.spacing,
        noise_variance=float(np.mean(plane_map.sigma**2)),
    )


def missing_data(
    thin: ThinMap, padding: Padding, direction: tuple[float, float, float], height_gain: float
) -> MissingData:
    """Errors for want of data, `height_gain` m above a map, by Monte Carlo (fixed seed).

    `padding` is the map's own, `direction` (y, x, d) its mean ambient direction.
    """
    experiment = _Experiment.of(thin, padding, direction)
    random = np.random.Generator(np.random.PCG64(_SEED))
    totals: dict[str, Real] = {}
    for _ in range(REALISATIONS):
        for group, squares in experiment.squared_errors(random, height_gain).items():
            totals[group] = totals.get(group, 0.0) + squares / REALISATIONS
    width = [max(1.0, height_gain / 2 / d) for d in experiment.wavenumbers.spacing]
    gap_power, typical_power = experiment.local_power(height_gain)
    variance = {
        group: ndimage.gaussian_filter(total * gap_power, width, mode="nearest")
        for group, total in totals.items()
    }
    return MissingData({**variance, "roughness": typical_power}, thin.thinning)


@dataclass(frozen=True)
class _Experiment:
    """A thinned map to be imitated: its gaps, spectrum and transform."""

    values: Real
    gaps: Mask
    void: Mask
    beyond: Mask
    distance: Real
    taper_m: float
    padding: Padding
    inversion: Inversion
    amplitude: Real

    @property
    def wavenumbers(self) -> Wavenumbers:
        return self.inversion.wavenumbers

    @classmethod
    def of(
        cls, thin: ThinMap, map_padding: Padding, direction: tuple[float, float, float]
    ) -> _Experiment:
        void, beyond = thin.void > 0.5, thin.beyond > 0.5
        gaps = void | beyond
        values, thinning = thin.values, thin.thinning
        spacing = thin.spacing[0] * thinning, thin.spacing[1] * thinning
        before = [int(np.ceil(o / thinning)) for o in map_padding.offset]
        shape = [odd_fast_length(n + 2 * o) for n, o in zip(values.shape, before, strict=True)]
        padding = Padding(
            (before[0], before[1]), (values.shape[0], values.shape[1]), (shape[0], shape[1])
        )
        inversion = Inversion(Wavenumbers(padding.shape, spacing), direction)
        noise = thin.noise_variance / thinning**2
        return cls(
            values,
            gaps,
            void,
            beyond,
            distance_to(~gaps, spacing),
            exterior_taper(thin.spacing),
            padding,
            inversion,
            _amplitude(values, gaps, inversion, noise),
        )

    def squared_errors(self, random: np.random.Generator, height_gain: float) -> dict[str, Real]:
        """Squared error of one random field by product group, mean over its components."""
        w = self.wavenumbers
        truth = forward(random.standard_normal(self.padding.shape)) * self.amplitude
        observed = np.asarray(
            inverse(truth * self.inversion.theta, w.shape, *self.padding.interior), dtype=float
        )
        filled = extend(
            np.where(self.gaps, np.nan, observed), self.beyond, self.distance, self.taper_m
        )
        estimate = forward(pad(filled, self.padding))
        # As a total anomaly, so that one routine makes all products of the difference.
        potential = self.inversion.potential.copy()
        potential[0, 0] = np.inf
        misfit = estimate - truth / potential
        return {
            "total": self._mean_square(
                estimate - truth * self.inversion.theta, height_gain, ("total",)
            ),
            "vector": self._mean_square(misfit, height_gain, VECTOR),
            "tensor": self._mean_square(misfit, height_gain, TENSOR),
        }

    def local_power(self, height_gain: float) -> tuple[Real, Real]:
        """Local power of the anomaly's short wavelengths over their mean: for gaps, and typical.

        The random fields are alike everywhere; a real map is rough here and smooth there, and
        what a gap hides is most likely as rough as what surrounds it. Errors at the border come
        from afar: for them it is taken from mean squares. Elsewhere, and around voids, typical
        is what mean absolute values say, lest one sharp anomaly speak for its neighbourhood.
        """
        weight = (~self.gaps).astype(float)
        if np.ptp(self.values[~self.gaps]) == 0.0:
            return np.ones(self.values.shape), np.ones(self.values.shape)
        rough = self.values - self._smooth(self.values, weight, _ROUGH_CELLS)
        mean = np.average(rough**2, weights=weight)
        squares = self._smooth(rough**2, weight, _LOCAL_CELLS) / mean
        typical = np.pi / 2 * self._smooth(np.abs(rough), weight, _LOCAL_CELLS) ** 2 / mean
        reach = height_gain + 2 * max(self.wavenumbers.spacing)
        near_void = distance_to(self.void, self.wavenumbers.spacing) < reach
        gaps = np.where(near_void, typical, squares)
        return np.clip(gaps, *_AMPLITUDE_LIMITS), np.clip(typical, *_AMPLITUDE_LIMITS)

    @staticmethod
    def _smooth(values: Real, weight: Real, width: float) -> Real:
        """Gaussian mean of the weighted nodes around each."""
        total = ndimage.gaussian_filter(values * weight, width, mode="constant")
        return np.asarray(
            total / np.maximum(ndimage.gaussian_filter(weight, width, mode="constant"), 1e-12)
        )

    def _mean_square(self, total: Complex, height_gain: float, products: tuple[str, ...]) -> Real:
        level = Level(total, self.inversion, height_gain)
        squares = [
            level.values(product, *self.padding.interior).astype(float) ** 2 for product in products
        ]
        return np.asarray(np.mean(squares, axis=0))


def _amplitude(values: Real, gaps: Mask, inversion: Inversion, noise: float) -> Real:
    """Amplitude of the potential's spectrum per unit of white noise, isotropic, like the map's.

    The radial mean of the windowed map's power, less the survey's noise, scaled to the
    map's variance; the azimuthal mean of the projection takes it from the total to the potential.
    """
    w = inversion.wavenumbers
    # The fill is kept: to blank it would cut edges, whose spectrum is not the map's.
    weight = np.outer(*(np.hanning(n + 2)[1:-1] for n in values.shape))
    centred = (values - np.average(values, weights=weight)) * weight
    periodogram = np.abs(forward(centred, w.shape)) ** 2 / (weight**2).sum()
    counts = np.broadcast_to(w.multiplicity, w.k.shape).ravel()
    lowest = 2 * np.pi / max(n * d for n, d in zip(values.shape, w.spacing, strict=True))
    which = np.maximum(np.rint(w.k / lowest), 1.0).astype(int).ravel()
    total = np.bincount(which, counts)
    used = np.flatnonzero(total)
    power = np.bincount(which, periodogram.ravel() * counts)[used] / total[used]
    if power.max() == 0.0:
        return np.zeros(w.k.shape)
    power = np.maximum(power - noise, 1e-9 * power.max())
    smooth = np.exp(
        np.interp(np.log(np.maximum(w.k, lowest)), np.log(used * lowest), np.log(power))
    )
    smooth[0, 0] = 0.0
    variance = (smooth * w.multiplicity).sum() / (w.shape[0] * w.shape[1])
    signal = max(float(np.var(values[~gaps])) - noise, 0.0)
    fy, fx, fd = inversion.direction
    projection = fd**2 + (fy**2 + fx**2) / 2
    k = np.where(w.k == 0.0, np.inf, w.k)
    return np.asarray(np.sqrt(smooth * signal / variance / projection) / k)


def _thin(values: Real | Mask, thinning: int) -> Real:
    """Means over blocks of `thinning` nodes a side; the last blocks repeat the edge."""
    widths = [(0, -n % thinning) for n in values.shape]
    full = np.pad(np.asarray(values, dtype=float), widths, mode="edge")
    rows, columns = (n // thinning for n in full.shape)
    return np.asarray(full.reshape(rows, thinning, columns, thinning).mean(axis=(1, 3)))
