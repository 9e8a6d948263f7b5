"""Fourier-domain relations between a total-field anomaly and its potential, vector and tensor.

Axes are those of a plane: y (grid north), x (grid east) and d (down). Outside its sources the
anomalous field is the gradient of a harmonic potential, B = grad(phi), so that with wavenumbers
k_y, k_x and k = |k| every product is phi's spectrum times a factor (Mount 2018, eq. 90-98;
`product.fill_product` multiplies)::

    B_y, B_x, B_d   = i k_y, i k_x, k
    G_ij = d_i B_j  = the products of two of these,   G_dd = -(G_yy + G_xx)
    total T = f.B   = k f_d + i (k_y f_y + k_x f_x)   (the bracket of eq. 93-95)

with f the unit vector of the ambient field. Continuation upward by h multiplies by exp(-k h).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numba
import numpy as np
import scipy.fft
from numpy.typing import NDArray

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

VECTOR = ("y", "x", "d")
TENSOR = ("yy", "yx", "yd", "xx", "xd")

LOW_INCLINATION_SINE = np.sin(np.radians(20.0))
"""Below this |sin I| the components are recovered with damping (and flagged)."""
_DAMPING = 0.1
_PASS = 0.75

_MANY = 1 << 18
_STRIP = 1 << 20
"""Numbers that are transformed at a time along rows: what stays near the processor."""


def _workers(size: int) -> int:
    """Threads for a transform of so many numbers: starting them for a small one costs more.

    As many as compiled loops may have, so that one knob serves both.
    """
    return int(numba.get_num_threads()) if size > _MANY else 1


@dataclass(frozen=True)
class Wavenumbers:
    """Angular wavenumbers (rad/m) of the real transform of `shape` samples `spacing` (y, x) apart.

    Both sizes must be odd: a Nyquist term would make odd derivatives ambiguous.
    """

    shape: tuple[int, int]
    spacing: tuple[float, float]

    @cached_property
    def y(self) -> Real:
        """Along y, shape (ny, 1)."""
        return np.asarray(2 * np.pi * scipy.fft.fftfreq(self.shape[0], self.spacing[0])[:, None])

    @cached_property
    def x(self) -> Real:
        """Along x, shape (1, nx // 2 + 1)."""
        return np.asarray(2 * np.pi * scipy.fft.rfftfreq(self.shape[1], self.spacing[1])[None, :])

    @cached_property
    def k(self) -> Real:
        """Magnitude, shape (ny, nx // 2 + 1)."""
        return np.hypot(self.y, self.x)

    @cached_property
    def multiplicity(self) -> Real:
        """How many terms of the full transform each column stands for, shape (1, nx // 2 + 1)."""
        count = np.full(self.x.shape, 2.0)
        count[0, 0] = 1.0
        return count

    @property
    def windows(self) -> tuple[Real, Real]:
        """Factors along y (ny,) and x (nx // 2 + 1,): 1 up to three quarters of Nyquist, then less.

        A sharp cut there makes every spike or undersampled source ring along its whole row and
        column; faded over a quarter of the band, the ringing dies within some cells.
        """
        return fade(self.y[:, 0] * self.spacing[0] / np.pi), fade(
            self.x[0] * self.spacing[1] / np.pi
        )

    @property
    def window(self) -> Real:
        """Both windows, shape (ny, nx // 2 + 1)."""
        return np.multiply.outer(*self.windows)

    def continuation(self, height_gain: float, noise_to_signal: float = 0.0) -> Real:
        """exp(-k h), windowed; for h < 0 damped where it would amplify noise beyond signal."""
        factor = np.exp(-self.k * height_gain)
        if height_gain < 0:
            factor /= 1.0 + noise_to_signal * factor**2
        return np.asarray(factor * self.window)


def fade(fraction: Real) -> Real:
    """Pass, as a half cosine between three quarters and all of the Nyquist wavenumber."""
    return np.asarray(
        np.cos(np.pi / 2 * np.clip((np.abs(fraction) - _PASS) / (1 - _PASS), 0, 1)) ** 2
    )


@dataclass(frozen=True)
class Inversion:
    """From total-field anomaly to potential, for one ambient direction f = (f_y, f_x, f_d).

    Near zero inclination the factor k f_d + i k.f vanishes along a wedge of directions;
    there its inverse is damped (Tikhonov, `damping` relative to k).
    """

    wavenumbers: Wavenumbers
    direction: tuple[float, float, float]

    @property
    def damping(self) -> float:
        """Relative damping; 0 away from low inclination."""
        return _DAMPING if abs(self.direction[2]) < LOW_INCLINATION_SINE else 0.0

    @property
    def theta(self) -> Complex:
        """Total anomaly over potential, k f_d + i k.f (rad/m)."""
        w, (fy, fx, fd) = self.wavenumbers, self.direction
        theta = np.empty(w.k.shape, np.complex128)
        np.multiply(w.k, fd, out=theta.real)
        np.add(w.y * fy, w.x * fx, out=theta.imag)
        return theta

    @cached_property
    def potential(self) -> Complex:
        """Potential over total anomaly (m); 0 at the zero wavenumber."""
        theta = self.theta
        power = theta.real**2 + theta.imag**2
        if self.damping:
            power += (self.damping * self.wavenumbers.k) ** 2
        power[0, 0] = np.inf
        return np.asarray(np.conj(theta) / power)

    @property
    def mean_vector(self) -> tuple[float, float, float]:
        """Anomaly vector (y, x, d) per unit of mean total anomaly.

        The zero wavenumber of a map says nothing of the vector. Given is the least-squares
        estimate for sources without preferred strike: correlation of each component with the
        total, averaged over azimuth; its projection on f is the mean itself.
        """
        fy, fx, fd = self.direction
        power = (fy**2 + fx**2) / 2 + fd**2
        return fy / 2 / power, fx / 2 / power, fd / power


def forward(values: Real, shape: tuple[int, int] | None = None) -> Complex:
    """Real two-dimensional transform, of `values` extended by zeros to `shape`."""
    return np.asarray(scipy.fft.rfft2(values, s=shape, workers=_workers(values.size)))


def inverse(
    spectrum: NDArray[np.complexfloating[Any, Any]],
    shape: tuple[int, int],
    rows: slice,
    columns: slice,
    out: NDArray[np.floating[Any]] | None = None,
) -> NDArray[np.floating[Any]]:
    """The inverse transform, computed only for `rows`, returned for `columns`.

    In the spectrum's own precision; overwrites it. Into `out` where one is given: a large array
    that is new costs as much as half the transform, for the system clears it first.
    """
    workers = _workers(spectrum.size)
    partial = scipy.fft.ifft(spectrum, axis=0, overwrite_x=True, workers=workers)[rows]
    if out is None:
        width = len(range(*columns.indices(shape[1])))
        out = np.empty((partial.shape[0], width), partial.real.dtype)
    strip = max(1, _STRIP // shape[1])
    for first in range(0, partial.shape[0], strip):
        part = partial[first : first + strip]
        values = scipy.fft.irfft(part, n=shape[1], axis=1, workers=workers)
        out[first : first + strip] = values[:, columns]
    return out


def spline_prefilter(k: Real, spacing: float) -> Real:
    """From samples `spacing` apart to cubic B-spline coefficients, at wavenumbers k (rad/m).

    In the transform of a periodic field the prefilter of the spline is but a division.
    """
    return np.asarray(3.0 / (2.0 + np.cos(k * spacing)))


def odd_fast_length(minimum: int) -> int:
    """The smallest odd transform length, at least `minimum`, with small prime factors."""
    length = scipy.fft.next_fast_len(minimum)
    while length % 2 == 0:
        length = scipy.fft.next_fast_len(length + 1)
    return int(length)
