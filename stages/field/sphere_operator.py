"""From Gauss coefficients to the total-field anomaly on a grid around the globe, and back.

With f the unit vector of the ambient field at each node the anomaly is T = f . B, and B is linear
in the coefficients of its potential: T = A x. Each Cartesian component of B is itself a sum of
harmonics one degree higher (`magtiles.catalog.kernels.harmonics`), so that A is, in turn, a sparse
matrix on coefficients, Legendre functions of each parallel (a parallel of the ellipsoid has one
radius), a Fourier transform along it, and the product with f. The adjoint is the same backward.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from magtiles.catalog.kernels.dipole import geodetic_to_ecef
from magtiles.catalog.kernels.harmonics import count
from magtiles.catalog.models.model import REFERENCE_RADIUS_KM
from magtiles.stages.field.direction import Ambient

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]
Index = NDArray[np.intp]


class AnomalyOperator:
    """A and its transpose, for the coefficients of degrees 1 to `degree`, several sets at once.

    Parameters
    ----------
    latitude, longitude : (rows,) and (columns,) WGS84 degrees; longitudes divide the circle.
    height_m : above the ellipsoid.
    ambient : unit vector of the ambient field, each part (rows, columns).
    degree : the highest; coefficients are in nT for a radius of 6371.2 km.
    """

    def __init__(
        self, latitude: Real, longitude: Real, height_m: float, ambient: Ambient, degree: int
    ) -> None:
        self.degree, self.size = degree, count(degree)
        self.shape = latitude.size, longitude.size
        self._orders = np.arange(degree + 2)
        lengths = degree + 2 - self._orders
        self._starts = np.concatenate([[0], np.cumsum(lengths)])
        self._field = _field_matrix(degree, self._starts)
        places = geodetic_to_ecef(latitude, 0.0, height_m)[:, [0, 2]]
        self._legendre = legendre(places / (REFERENCE_RADIUS_KM * 1e3), degree + 1)
        self._turn = np.exp(1j * np.radians(np.mod(self._orders * longitude[0], 360.0)))
        self._direction = _earth_centred(ambient, latitude, longitude)

    def forward(self, x: Real) -> Real:
        """T (sets, rows, columns), nT, of coefficients (sets, k), nT."""
        sets, (rows, columns) = len(x), self.shape
        sums = (self._field @ x.T).reshape(3, 2, -1, sets)
        circle = np.zeros((rows, columns, 3, sets), np.complex128)
        for m in self._orders:
            part = sums[:, :, self._starts[m] : self._starts[m + 1]]
            along = self._legendre[m] @ np.moveaxis(part, 2, 0).reshape(part.shape[2], -1)
            re, im = np.moveaxis(along.reshape(rows, 3, 2, sets), 2, 0)
            circle[:, m % columns] += (re + 1j * im) * self._turn[m]
        field = np.fft.ifft(circle, axis=1, norm="forward").real
        return np.asarray(np.einsum("cij,ijcs->sij", self._direction, field))

    def adjoint(self, y: Real) -> Real:
        """A' y (sets, k) of values (sets, rows, columns)."""
        sets, (rows, columns) = len(y), self.shape
        field = np.einsum("cij,sij->ijcs", self._direction, y)
        circle = np.fft.fft(field, axis=1)
        sums = np.empty((3, 2, self._starts[-1], sets))
        for m in self._orders:
            along = circle[:, m % columns] * self._turn[m].conj()
            both = np.stack([along.real, along.imag], axis=2).reshape(rows, -1)
            part = (self._legendre[m].T @ both).reshape(-1, 3, 2, sets)
            sums[:, :, self._starts[m] : self._starts[m + 1]] = np.moveaxis(part, 0, 2)
        return np.asarray((self._field.T @ sums.reshape(-1, sets)).T)


def legendre(places: Real, degree: int) -> list[Real]:
    """q^(n+1) S_nm of parallels: for each order m (rows, degrees m to `degree`).

    S_nm are Schmidt's functions of the geocentric latitude and q = a / r; `places` (rows, 2) are
    distances from the axis and above the equator in units of a. What underflows at order m beside
    a pole is below 1e-150 of degree 720.
    """
    square = np.sum(places**2, axis=1)
    up, out = places[:, 1] / square, places[:, 0] / square
    sector, tables = 1.0 / np.sqrt(square), []
    for m in range(degree + 1):
        if m > 0:
            sector = sector * out * (1.0 if m == 1 else np.sqrt((2 * m - 1) / (2 * m)))
        table = np.zeros((len(places), degree + 1 - m))
        table[:, 0] = sector
        for n in range(m + 1, degree + 1):
            here, root = n - m, np.sqrt(n * n - m * m)
            table[:, here] = (2 * n - 1) / root * up * table[:, here - 1]
            if here > 1:
                before = np.sqrt((n - 1) ** 2 - m * m) / root / square
                table[:, here] -= before * table[:, here - 2]
        tables.append(table)
    return tables


def _field_matrix(degree: int, starts: Index) -> sparse.csr_array:
    """B_x, B_y, B_z from Gauss coefficients, as `harmonics.minus_gradient`, by Cunningham (1970).

    Rows are (component, real or imaginary part, term), with the term of degree n and order m at
    `starts[m]` + n - m; columns are Gauss coefficients in their own order.
    """
    n = np.repeat(np.arange(1, degree + 1), 2 * np.arange(1, degree + 1) + 1)
    within = np.arange(n.size) - (n * n - 1)
    m, sine = (within + 1) // 2, (within > 0) & (within % 2 == 0)
    own = np.where(sine, -1j, 1.0)
    up = np.sqrt((n + m + 2) * (n + m + 1) * np.where(m == 0, 0.5, 0.25)) * own
    down = np.sqrt((n - m + 2) * (n - m + 1) * np.where(m == 1, 0.5, 0.25)) * own
    level = np.sqrt((n + m + 1) * (n - m + 1)) * own
    everywhere, inner = np.ones(n.size, bool), m > 0
    terms = starts[-1]
    rows, columns, values = [], [], []
    for component, order, factor, used in (
        (0, m + 1, up, everywhere),
        (1, m + 1, -1j * up, everywhere),
        (0, m - 1, -down, inner),
        (1, m - 1, -1j * down, inner),
        (2, m, level, everywhere),
    ):
        term = starts[order] + n + 1 - order
        # The imaginary part of an order zero multiplies sin(0).
        for part, value in ((0, factor.real), (1, np.where(order > 0, factor.imag, 0.0))):
            kept = np.flatnonzero(used & (value != 0.0))
            rows.append((2 * component + part) * terms + term[kept])
            columns.append(kept)
            values.append(value[kept])
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return sparse.csr_array(entries, shape=(6 * terms, n.size))


def _earth_centred(ambient: Ambient, latitude: Real, longitude: Real) -> Real:
    """An ambient direction in Earth-centred x, y, z (3, rows, columns)."""
    phi, turn = np.radians(latitude)[:, None], np.radians(longitude)
    out = -np.sin(phi) * ambient.north - np.cos(phi) * ambient.down
    up = np.cos(phi) * ambient.north - np.sin(phi) * ambient.down
    return np.stack(
        [
            np.cos(turn) * out - np.sin(turn) * ambient.east,
            np.sin(turn) * out + np.cos(turn) * ambient.east,
            up,
        ]
    )
