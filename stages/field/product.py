"""The products of one level: spectra from that of the total anomaly, and their inverses.

The inverse transforms and what leads to them are in single precision: their rounding, a
millionth of the field, is far below any survey's noise, and they take half the time and memory.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from magtiles.stages.field.spectral import Complex, Inversion, Real, inverse, spline_prefilter

Single = NDArray[np.float32]
SingleComplex = NDArray[np.complex64]

_METRES_PER_KM = 1000.0
_AXES = {"y": 0, "x": 1, "d": 2}


@dataclass(frozen=True)
class Level:
    """A map's field at one height, from which every product is had.

    Products are "total", "y", "x", "d" (nT) and "yy", "yx", "yd", "xx", "xd" (nT/km).

    Attributes
    ----------
    surface : spectrum of the total anomaly (nT) on the map's surface.
    inversion : wavenumbers and ambient direction.
    height_gain : of the level above the map's surface, m.
    noise_to_signal : power ratio, which bounds downward continuation.
    density : 1 for samples on the map's nodes; more for cubic B-spline coefficients on nodes so
        many times denser. Zero-padding a spectrum resamples a band-limited field without loss.
    """

    surface: Complex
    inversion: Inversion
    height_gain: float
    noise_to_signal: float = 0.0
    density: int = 1

    def values(
        self, product: str, rows: slice, columns: slice, out: Single | None = None
    ) -> Single:
        """A product on `rows` and `columns` of the padded, `density` times denser, lattice.

        In `out` where one of their shape is given.
        """
        shape = self.inversion.wavenumbers.shape
        dense = shape[0] * self.density, shape[1] * self.density
        spectrum = self.spectrum(product)
        return np.asarray(inverse(spectrum, dense, rows, columns, out), np.float32)

    def spectrum(self, product: str) -> SingleComplex:
        """Spectrum of a product; only its rows are padded, the inverse pads its columns."""
        ny, nk = self.surface.shape
        out = np.zeros((ny * self.density, nk), np.complex64)
        rows = _rows(ny, out.shape[0])
        if product == "total":
            out[rows] = self._total
            return out
        w = self.inversion.wavenumbers
        scale = _METRES_PER_KM if len(product) == 2 else 1.0
        axes = np.array([_AXES[axis] for axis in product])
        _kernel(_DIFFERENTIATE, ny * nk)(
            self._potential, (w.y[:, 0], w.x[0]), axes, scale, rows, out
        )
        if len(product) == 1:
            out[0, 0] = self._total[0, 0] * self.inversion.mean_vector[_AXES[product]]
        return out

    @cached_property
    def _total(self) -> SingleComplex:
        return self._lifted(potential=False)

    @cached_property
    def _potential(self) -> SingleComplex:
        return self._lifted(potential=True)

    def _lifted(self, *, potential: bool) -> SingleComplex:
        w = self.inversion.wavenumbers
        out = np.empty(self.surface.shape, np.complex64)
        _kernel(_LIFT, self.surface.size)(
            self.surface,
            (w.y[:, 0], w.x[0]),
            self._weights(),
            self.inversion.direction,
            self.inversion.damping,
            self.height_gain,
            self.noise_to_signal,
            potential,
            out,
        )
        return out

    def _weights(self) -> tuple[Real, Real]:
        """Factors along y and x: the window, and the prefilter of the spline if it is one."""
        w = self.inversion.wavenumbers
        window_y, window_x = w.windows
        if self.density == 1:
            return window_y, window_x
        return (
            window_y * self.density * spline_prefilter(w.y[:, 0], w.spacing[0] / self.density),
            window_x * self.density * spline_prefilter(w.x[0], w.spacing[1] / self.density),
        )


def _rows(count: int, dense: int) -> NDArray[np.int64]:
    """Rows with the same wavenumbers in a transform of `dense` rows: negative ones at its end."""
    rows = np.arange(count)
    rows[(count + 1) // 2 :] += dense - count
    return rows


def lift(
    surface: Complex,
    k: tuple[Real, Real],
    weights: tuple[Real, Real],
    direction: tuple[float, float, float],
    damping: float,
    height_gain: float,
    noise_to_signal: float,
    potential: bool,
    out: SingleComplex,
) -> None:
    """Set out = surface exp(-|k| h) weight, times theta* / (|theta|^2 + (damping |k|)^2).

    theta = |k| f_d + i (k_y f_y + k_x f_x) is total anomaly over potential; the second factor
    is left out unless `potential`. For h < 0 the lift is bounded by 1 / noise_to_signal.
    """
    fy, fx, fd = direction
    for i in prange(surface.shape[0]):
        ky = k[0][i]
        for j in range(surface.shape[1]):
            kx = k[1][j]
            size = math.sqrt(ky * ky + kx * kx)
            factor = math.exp(-size * height_gain)
            if height_gain < 0.0:
                factor /= 1.0 + noise_to_signal * factor * factor
            value = surface[i, j] * (factor * weights[0][i] * weights[1][j])
            if potential:
                theta = complex(size * fd, ky * fy + kx * fx)
                power = theta.real**2 + theta.imag**2 + (damping * size) ** 2
                value *= theta.conjugate() * (1.0 / power if power > 0.0 else 0.0)
            out[i, j] = value


def differentiate(
    potential: SingleComplex,
    k: tuple[Real, Real],
    axes: NDArray[np.int64],
    scale: float,
    rows: NDArray[np.int64],
    out: SingleComplex,
) -> None:
    """Set out[rows] = scale * potential, times i k_y (0), i k_x (1) or |k| (2) for each of axes."""
    turns = 0
    for axis in axes:
        turns += axis < 2
    # i once is a turn, twice a change of sign: what remains to multiply is real.
    sign = -scale if turns == 2 else scale
    for i in prange(potential.shape[0]):
        ky = k[0][i]
        for j in range(potential.shape[1]):
            kx = k[1][j]
            factor = sign
            for axis in axes:
                if axis == 0:
                    factor *= ky
                elif axis == 1:
                    factor *= kx
                else:
                    factor *= math.sqrt(ky * ky + kx * kx)
            value = potential[i, j] * np.float32(factor)
            out[rows[i], j] = complex(-value.imag, value.real) if turns == 1 else value


_Kernel = Callable[..., None]
_MANY = 1 << 17


def _compiled(function: _Kernel) -> tuple[_Kernel, _Kernel]:
    """A kernel for one thread and one for all."""
    return (
        njit(cache=True, nogil=True)(function),
        njit(parallel=True, cache=True, nogil=True)(function),
    )


_LIFT, _DIFFERENTIATE = _compiled(lift), _compiled(differentiate)


def _kernel(versions: tuple[_Kernel, _Kernel], size: int) -> _Kernel:
    """All threads for large arrays; to wake them for a small one takes longer than its work."""
    return versions[size > _MANY]
