"""From a map to the spectrum of its anomalous field, with an ambient direction that varies.

The observed anomaly is T = f(r).B(r). With f = f0 + df(r) the transform of T - df.B obeys the
relations of `spectral` for the constant direction f0, and B follows from it: a fixed point,
found by substitution from B = 0 on. Each round gains about the relative size of df.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from magtiles.stages.field.direction import AmbientSource
from magtiles.stages.field.padding import Padding, pad, plan_padding
from magtiles.stages.field.plane import STEP_M, Plane, on_lattice
from magtiles.stages.field.prepare import PlaneMap
from magtiles.stages.field.product import dense_spline_spectrum, product_spectrum
from magtiles.stages.field.spectral import (
    VECTOR,
    Complex,
    Inversion,
    Real,
    Wavenumbers,
    forward,
    inverse,
)

_log = logging.getLogger(__name__)

_TOLERANCE = 1e-3
_ROUNDS = 8

Direction = tuple[Real, Real, Real]


@dataclass(frozen=True)
class AnomalousField:
    """The anomalous field of a map, continued anywhere above it.

    Attributes
    ----------
    padding, wavenumbers : of the padded plane.
    inversion : for the map's mean ambient direction (y, x, d).
    total : spectrum of the anomaly along that mean direction, at the map's own surface (nT).
    noise_to_signal : power ratio, which bounds downward continuation.
    """

    padding: Padding
    wavenumbers: Wavenumbers
    inversion: Inversion
    total: Complex
    noise_to_signal: float

    def spectrum(self, product: str, height_gain: float) -> Complex:
        """Spectrum of a product ("total", "y", "yd", ...) `height_gain` m above the map."""
        return product_spectrum(
            self.total, self.inversion, product, height_gain, self.noise_to_signal
        )

    def spline(self, product: str, height_gain: float, rows: slice, factor: int) -> Real:
        """Cubic B-spline coefficients of a product, `factor` times denser than the map.

        Shape (rows, factor * nx); `rows` counts rows of the dense padded lattice.
        """
        dense = dense_spline_spectrum(
            self.total, self.inversion, product, height_gain, self.noise_to_signal, factor
        )
        shape = self.padding.shape[0] * factor, self.padding.shape[1] * factor
        return inverse(dense, shape, rows, slice(None))


def plane_direction(plane: Plane, ambient: AmbientSource) -> Callable[[Real, Real], Direction]:
    """Ambient unit vector (y, x, d) along the plane's axes, at plane coordinates y, x."""

    def direction(y: Real, x: Real) -> Direction:
        latitude, longitude = plane.geographic(x, y)
        field = ambient.at(latitude, longitude)
        north_x, north_y = plane.north(latitude, longitude)
        return (
            field.north * north_y - field.east * north_x,
            field.north * north_x + field.east * north_y,
            field.down,
        )

    return direction


def solve(plane_map: PlaneMap, ambient: AmbientSource, height_gain: float) -> AnomalousField:
    """The anomalous field of a map, ready to be continued by `height_gain` (m)."""
    spacing = plane_map.spacing
    padding = plan_padding(plane_map.values.shape, spacing, height_gain)
    wavenumbers = Wavenumbers(padding.shape, spacing)
    directions = on_lattice(
        plane_direction(plane_map.plane, ambient), plane_map.y, plane_map.x, STEP_M
    )
    mean = np.array([part.mean() for part in directions])
    mean /= np.linalg.norm(mean)
    inversion = Inversion(wavenumbers, (float(mean[0]), float(mean[1]), float(mean[2])))
    padded = pad(plane_map.values, padding)
    variation = [part - m for part, m in zip(directions, mean, strict=True)]
    total = _substitute(padded, padding, inversion, variation)
    signal = max(float(plane_map.values.var()), np.finfo(float).tiny)
    noise_to_signal = float(np.mean(plane_map.sigma**2)) / signal
    return AnomalousField(padding, wavenumbers, inversion, total, noise_to_signal)


def _substitute(
    padded: Real, padding: Padding, inversion: Inversion, variation: list[Real]
) -> Complex:
    """Spectrum of T - df.B, by substitution until a further round would change it by 0.1 %."""
    total = forward(padded)
    size = float(np.linalg.norm(padded - padded.mean()))
    if size == 0.0 or max(np.abs(part).max() for part in variation) < _TOLERANCE / 10:
        return total
    previous = np.zeros(padded.shape)
    change = first = np.inf
    for _ in range(_ROUNDS):
        correction = _varying_part(total, padding, inversion, variation)
        last, change = change, float(np.linalg.norm(correction - previous)) / size
        if change > last:
            _log.warning(
                "the ambient direction varies too much over this map to be followed exactly "
                "(last change %.1f %%): split the region",
                100 * change,
            )
            break
        total, previous, first = forward(padded - correction), correction, min(first, change)
        if change * first < _TOLERANCE:
            break
    return total


def _varying_part(
    total: Complex, padding: Padding, inversion: Inversion, variation: list[Real]
) -> Real:
    """df.B (nT) on the padded plane; df is held constant beyond the map's border."""
    out = np.zeros(padding.shape)
    everything = slice(None)
    for axis, part in zip(VECTOR, variation, strict=True):
        component = product_spectrum(total, inversion, axis, 0.0)
        values = inverse(component, padding.shape, everything, everything)
        add_product(out, values, part, padding.offset)
    return out


@njit(parallel=True, cache=True, nogil=True)
def add_product(out: Real, values: Real, factor: Real, offset: tuple[int, int]) -> None:
    """Add values * factor to `out`; factor covers it from `offset` on, and its edge extends."""
    rows, columns = factor.shape
    for i in prange(out.shape[0]):
        r = min(max(i - offset[0], 0), rows - 1)
        for j in range(out.shape[1]):
            c = min(max(j - offset[1], 0), columns - 1)
            out[i, j] += values[i, j] * factor[r, c]
