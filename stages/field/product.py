"""The spectrum of each product from that of the total anomaly, in one pass over the wavenumbers."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from magtiles.stages.field.spectral import Complex, Inversion, Real, spline_prefilter

_METRES_PER_KM = 1000.0
_AXES = {"y": 0, "x": 1, "d": 2}


def product_spectrum(
    total: Complex,
    inversion: Inversion,
    product: str,
    height_gain: float,
    noise_to_signal: float = 0.0,
) -> Complex:
    """Spectrum of "total", a vector component ("y") or a tensor component ("yd"), continued.

    `total`: spectrum of the total anomaly (nT) on the map's surface. The result, in nT or
    nT/km, is `height_gain` m higher and windowed.
    """
    w = inversion.wavenumbers
    out = np.empty_like(total)
    _fill(total, inversion, product, height_gain, noise_to_signal, w.windows, out)
    return out


def dense_spline_spectrum(
    total: Complex,
    inversion: Inversion,
    product: str,
    height_gain: float,
    noise_to_signal: float,
    factor: int,
) -> Complex:
    """As `product_spectrum`, for cubic B-spline coefficients `factor` times denser in space.

    Zero-padding a spectrum resamples a band-limited field without loss. Only rows are padded
    here; the inverse transform along x pads its own.
    """
    w = inversion.wavenumbers
    weights = [
        window * factor * spline_prefilter(k, step / factor)
        for window, k, step in zip(w.windows, (w.y[:, 0], w.x[0]), w.spacing, strict=True)
    ]
    out = np.zeros((total.shape[0] * factor, total.shape[1]), np.complex128)
    _fill(total, inversion, product, height_gain, noise_to_signal, (weights[0], weights[1]), out)
    return out


def _fill(
    total: Complex,
    inversion: Inversion,
    product: str,
    height_gain: float,
    noise_to_signal: float,
    weights: tuple[Real, Real],
    out: Complex,
) -> None:
    w = inversion.wavenumbers
    axes = [] if product == "total" else [_AXES[axis] for axis in product]
    scale = _METRES_PER_KM if len(axes) == 2 else 1.0
    fill_product(
        total,
        (w.y[:, 0], w.x[0]),
        (weights[0] * scale, weights[1]),
        inversion.direction,
        inversion.damping,
        height_gain,
        noise_to_signal,
        np.array(axes, dtype=np.int64),
        _rows(total.shape[0], out.shape[0]),
        out,
    )
    if len(axes) == 1:
        out[0, 0] = total[0, 0] * inversion.mean_vector[axes[0]] * weights[0][0] * weights[1][0]


def _rows(count: int, dense: int) -> NDArray[np.int64]:
    """Rows with the same wavenumbers in a transform of `dense` rows: negative ones at its end."""
    rows = np.arange(count)
    rows[(count + 1) // 2 :] += dense - count
    return rows


@njit(parallel=True, cache=True, nogil=True)
def fill_product(
    total: Complex,
    k: tuple[Real, Real],
    weights: tuple[Real, Real],
    direction: tuple[float, float, float],
    damping: float,
    height_gain: float,
    noise_to_signal: float,
    axes: NDArray[np.int64],
    rows: NDArray[np.int64],
    out: Complex,
) -> None:
    """Set out = total exp(-|k| h) weight [ theta* / (|theta|^2 + (damping |k|)^2) factor factor ].

    theta = |k| f_d + i (k_y f_y + k_x f_x) is total over potential, and a factor, one for each
    of `axes`, is i k_y (0), i k_x (1) or |k| (2). `rows` says where in `out` each row goes.
    """
    fy, fx, fd = direction
    for i in prange(total.shape[0]):
        ky = k[0][i]
        for j in range(total.shape[1]):
            kx = k[1][j]
            size = math.sqrt(ky * ky + kx * kx)
            lift = math.exp(-size * height_gain)
            if height_gain < 0.0:
                lift /= 1.0 + noise_to_signal * lift * lift
            value = total[i, j] * (lift * weights[0][i] * weights[1][j])
            if axes.size > 0:
                theta = complex(size * fd, ky * fy + kx * fx)
                power = theta.real**2 + theta.imag**2 + (damping * size) ** 2
                value *= theta.conjugate() / power if power > 0.0 else 0.0
            for axis in axes:
                if axis == 0:
                    value *= complex(0.0, ky)
                elif axis == 1:
                    value *= complex(0.0, kx)
                else:
                    value *= size
            out[rows[i], j] = value
