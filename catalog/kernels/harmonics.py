"""The magnetic field of a spherical-harmonic potential, in Earth-centred Cartesian axes.

Each Cartesian derivative of a solid harmonic is a sum of at most two solid harmonics one degree
higher (Cunningham 1970, Celestial Mechanics 2:207-216). So each component of the field, and of
its gradient tensor, is itself a sum of harmonics whose coefficients are made once per model.
Places enter as x, y, z only: no derivative of a Legendre function, no division by the cosine
of latitude, no turning between geocentric and geodetic axes.

Gauss coefficients are Schmidt semi-normalised, in the order g10 g11 h11 g20 g21 h21 g22 h22 ...
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

MAX_DEGREE = 2700
"""Beyond it the scaled Legendre functions could leave the range of a double."""

_POINTS_AT_ONCE = 1024
"""Places that share one passage through the coefficients."""

_SORTED_FROM = 40
"""Degree above which leaving out negligible orders is worth sorting the points."""


def count(degree: int) -> int:
    """Number of Gauss coefficients of the degrees 1 to `degree`."""
    return degree * (degree + 2)


def position(n: int, m: int) -> int:
    """Where g_nm (m >= 0) or h_n|m| (m < 0) stands among the Gauss coefficients."""
    return n * n - 1 + (2 * m - 1 if m > 0 else -2 * m)


@dataclass(frozen=True, eq=False)
class Harmonics:
    """Harmonic functions sum_nm (a/r)^(n+1) Re[c_nm e^(i m longitude)] S_nm, ready for sums.

    Attributes
    ----------
    radius_m : a.
    degree : the highest.
    coefficients : (rows, 2 k) real and imaginary parts of c_nm of k functions, by order and
        then degree, each order filled up to a multiple of eight rows.
    recursion, starts, seeds : see `harmonics_compiled.column` and `at_points`.
    """

    radius_m: float
    degree: int
    coefficients: Floats
    recursion: Floats
    starts: NDArray[np.int64]
    seeds: Floats

    def tables(self) -> tuple[Floats, Floats, NDArray[np.int64], Floats, int]:
        """What the compiled sums take first."""
        return (self.recursion, self.coefficients, self.starts, self.seeds, self.degree)


def field_harmonics(gauss: Floats, radius_km: float, *, gradient: bool) -> Harmonics | None:
    """The field of Gauss coefficients (k,), None where all are zero.

    Its functions are B_x, B_y, B_z in nT and, with `gradient`, dB_x/dx, dB_x/dy, dB_x/dz,
    dB_y/dy, dB_y/dz in nT/km.
    """
    nonzero = np.flatnonzero(gauss)
    if not len(nonzero):
        return None
    degree = int(np.sqrt(nonzero[-1] + 1))
    field = minus_gradient(_matrix(gauss, degree))
    if not gradient:
        return _pack(field, degree + 1, radius_km)
    x, y = minus_gradient(field[0]), minus_gradient(field[1])
    field = [np.pad(c, (0, 1)) for c in field]
    tensor = [c / -radius_km for c in (*x, y[1], y[2])]
    return _pack([*field, *tensor], degree + 2, radius_km)


def _matrix(gauss: Floats, degree: int) -> Complex:
    """c_nm = g_nm - i h_nm, (degree + 1, degree + 1)."""
    c = np.zeros((degree + 1, degree + 1), dtype=np.complex128)
    for n in range(1, degree + 1):
        row = gauss[n * n - 1 : n * n + 2 * n]
        c[n, 0] = row[0]
        c[n, 1 : n + 1] = row[1::2] - 1j * row[2::2]
    return c


def minus_gradient(c: Complex) -> list[Complex]:
    """Coefficients of -a df/dx, -a df/dy, -a df/dz of the harmonic function f with `c`.

    Cunningham's relations, for Schmidt's normalisation: of V_nm = S_nm e^(i m longitude) / r^(n+1)

        -dV_nm/dz       = sqrt((n+m+1) (n-m+1)) V_(n+1)m
        -dV_nm/d(x,y)   = (1,-i) up V_(n+1)(m+1) + (-1,-i) down V_(n+1)(m-1)
    """
    size = len(c)
    n, m = np.arange(size)[:, None], np.arange(size)[None, :]
    inside = m <= n
    up = np.sqrt((n + m + 2) * (n + m + 1) * np.where(m == 0, 0.5, 0.25)) * c
    down = np.sqrt(np.where(inside, (n - m + 2) * (n - m + 1), 0) * np.where(m == 1, 0.5, 0.25)) * c
    x, y, z = (np.zeros((size + 1, size + 1), dtype=np.complex128) for _ in range(3))
    z[1:, :-1] = np.sqrt(np.where(inside, (n + m + 1) * (n - m + 1), 0)) * c
    x[1:, 1:], y[1:, 1:] = up, -1j * up
    x[1:, : size - 1] -= down[:, 1:]
    y[1:, : size - 1] -= 1j * down[:, 1:]
    for part in (x, y):
        part[:, 0] = part[:, 0].real  # V_n0 is real, and so is what counts of its coefficient
    return [x, y, z]


def _pack(functions: list[Complex], degree: int, radius_km: float) -> Harmonics:
    used = np.any([np.any(c, axis=0) for c in functions], axis=0)
    order = int(np.flatnonzero(used)[-1])
    recursion, starts, seeds, n, m = _tables(degree, order)
    inside = n <= degree
    coefficients = np.zeros((len(n), 2 * len(functions)))
    for k, c in enumerate(functions):
        values = c[n[inside], m[inside]]
        coefficients[inside, 2 * k], coefficients[inside, 2 * k + 1] = values.real, values.imag
    return Harmonics(radius_km * 1000.0, degree, coefficients, recursion, starts, seeds)


@functools.lru_cache(maxsize=4)
def _tables(degree: int, order: int) -> tuple[Any, ...]:
    """Recursion, first rows, seeds, and degree and order of every row."""
    from magtiles.catalog.kernels.harmonics_compiled import SCALE

    orders = np.arange(order + 1)
    rows = -(-(degree + 1 - orders) // 8) * 8
    starts = np.concatenate([[0], np.cumsum(rows)]).astype(np.int64)
    m = np.repeat(orders, rows)
    n = m + np.arange(starts[-1]) - starts[m]
    follows = (n > m) & (n <= degree)
    root = np.sqrt(np.where(follows, n * n - m * m, 1))
    recursion = np.zeros((len(n), 2))
    recursion[:, 0] = np.where(follows, (2 * n - 1) / root, 0.0)
    recursion[:, 1] = np.where(follows, np.sqrt(np.maximum((n - 1) ** 2 - m * m, 0)) / root, 0.0)
    ratios = np.sqrt((2 * orders[2:] - 1) / (2 * orders[2:]))
    seeds = np.concatenate([[1.0, 1.0], np.cumprod(ratios)])[: order + 1] * SCALE**2
    return recursion, starts, seeds, n, m


def at_points(harmonics: Harmonics, places: Floats) -> Floats:
    """The functions (n, k) at Earth-centred places (n, 3), metres."""
    from magtiles.catalog.kernels import harmonics_compiled

    places = places / harmonics.radius_m
    out = np.empty((len(places), harmonics.coefficients.shape[1] // 2))
    if len(places) <= _POINTS_AT_ONCE:
        harmonics_compiled.at_points(*harmonics.tables(), places, out)
        return out
    order = None
    if harmonics.degree > _SORTED_FROM:
        # Near a pole few orders count: places of like latitude go together.
        order = np.argsort(-np.abs(places[:, 2]) / np.linalg.norm(places, axis=1))
        places = places[order]

    def work(start: int) -> None:
        part = slice(start, start + _POINTS_AT_ONCE)
        harmonics_compiled.at_points(*harmonics.tables(), places[part], out[part])

    in_threads(work, range(0, len(places), _POINTS_AT_ONCE))
    if order is None:
        return out
    given = np.empty_like(out)
    given[order] = out
    return given


def in_threads(work: Callable[[Any], None], parts: Iterable[Any]) -> None:
    """Do the parts side by side; as many as numba may use (NUMBA_NUM_THREADS)."""
    import numba

    with ThreadPoolExecutor(numba.get_num_threads()) as pool:
        list(pool.map(work, parts))
