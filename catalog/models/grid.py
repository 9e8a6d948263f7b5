"""The field of a model on grids of latitude and longitude, at several heights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtiles.catalog.kernels.dipole import geodetic_to_ecef
from magtiles.catalog.kernels.harmonics import Harmonics, field_harmonics, in_threads
from magtiles.catalog.models.dates import Date
from magtiles.catalog.models.evaluate import check_positions, cosine_and_sine
from magtiles.catalog.models.model import FieldModel
from magtiles.schemas.errors import QueryError

Floats = NDArray[np.float64]

_ROWS_AT_ONCE = 24
"""Latitudes, with their mirror images, that are summed together."""

_SAME = 11
"""Decimals of a degree to which a northern and a southern latitude count as mirror images."""

_EVEN = 1e-10
"""Degrees by which longitudes may miss the nodes of an evenly divided circle."""


@overload
def evaluate_grid(
    model: FieldModel,
    latitudes: ArrayLike,
    longitudes: ArrayLike,
    heights: ArrayLike,
    date: Date,
    *,
    gradient: Literal[False] = False,
    allow_extrapolated: bool = False,
) -> Floats: ...
@overload
def evaluate_grid(
    model: FieldModel,
    latitudes: ArrayLike,
    longitudes: ArrayLike,
    heights: ArrayLike,
    date: Date,
    *,
    gradient: Literal[True],
    allow_extrapolated: bool = False,
) -> tuple[Floats, Floats]: ...
def evaluate_grid(
    model: FieldModel,
    latitudes: ArrayLike,
    longitudes: ArrayLike,
    heights: ArrayLike,
    date: Date,
    *,
    gradient: bool = False,
    allow_extrapolated: bool = False,
) -> Floats | tuple[Floats, Floats]:
    """The field of `model` on a grid, as `evaluate` gives it at the nodes.

    A parallel of the ellipsoid has one radius: the sums over degree are made once for each
    latitude, those over order for all its longitudes together. A latitude and its mirror image
    share the sums over degree. Longitudes that divide the circle evenly and cover an eighth of
    it or more take a Fourier transform; any others take a matrix of cosines and sines.

    Parameters
    ----------
    latitudes, longitudes, heights : (lat,) and (lon,) degrees, (h,) or one, metres above the
        ellipsoid.
    date : one.

    Returns
    -------
    field (h, lat, lon, 3) in nT and, with `gradient`, tensor (h, lat, lon, 3, 3) in nT/km.

    Raises
    ------
    QueryError : a position or date that is none, or outside the model.
    """
    lat, lon = _axis("latitudes", latitudes), _axis("longitudes", longitudes)
    h = _axis("heights", np.atleast_1d(np.asarray(heights, dtype=np.float64)))
    check_positions(lat, lon, h)
    gauss = model.at(date, allow_extrapolated=allow_extrapolated)
    shape = (len(h), len(lat), len(lon))
    field = np.zeros((*shape, 3))
    tensor = np.zeros((*(shape if gradient else (len(h), len(lat), 0)), 3, 3))
    harmonics = field_harmonics(gauss, model.reference_radius_km, gradient=gradient)
    if harmonics is not None:
        grid = _Grid(harmonics, lat, lon, field, tensor)
        in_threads(grid.fill, grid.parts(h))
    return (field, tensor) if gradient else field


def _axis(name: str, values: ArrayLike) -> Floats:
    axis = np.asarray(values, dtype=np.float64)
    if axis.ndim != 1 or not len(axis):
        raise QueryError(f"{name} of shape {axis.shape}", expected="one dimension, not empty")
    return axis


@dataclass(frozen=True)
class _Part:
    """Rows of the grid at one height, and their distinct absolute latitudes."""

    level: int
    height: float
    absolute: Floats
    rows: NDArray[np.intp]
    of_row: NDArray[np.intp]


class _Grid:
    def __init__(
        self, harmonics: Harmonics, lat: Floats, lon: Floats, field: Floats, tensor: Floats
    ) -> None:
        self.harmonics, self.lat, self.field, self.tensor = harmonics, lat, field, tensor
        self.circle = _Circle(lon, len(harmonics.seeds))
        self.turn_lat, self.turn_lon = cosine_and_sine(lat), cosine_and_sine(lon)

    def parts(self, heights: Floats) -> list[_Part]:
        absolute: Floats
        absolute, of_row = np.unique(np.round(np.abs(self.lat), _SAME), return_inverse=True)
        parts = []
        for level, height in enumerate(heights):
            for start in range(0, len(absolute), _ROWS_AT_ONCE):
                end = min(start + _ROWS_AT_ONCE, len(absolute))
                rows = np.flatnonzero((of_row >= start) & (of_row < end))
                part = absolute[start:end]
                parts.append(_Part(level, float(height), part, rows, of_row[rows] - start))
        return parts

    def fill(self, part: _Part) -> None:
        from magtiles.catalog.kernels.harmonics_compiled import along_parallels, turn_to_ned

        places = geodetic_to_ecef(part.absolute, 0.0, part.height)[:, [0, 2]]
        functions = self.harmonics.coefficients.shape[1] // 2
        orders = len(self.harmonics.seeds)
        north = np.empty((len(places), functions, orders), dtype=np.complex128)
        south = np.empty_like(north)
        along_parallels(*self.harmonics.tables(), places / self.harmonics.radius_m, north, south)
        for row, i in zip(part.rows, part.of_row, strict=True):
            values = self.circle.sum_orders(south[i] if self.lat[row] < 0.0 else north[i])
            turn_to_ned(
                values.T,
                np.broadcast_to(self.turn_lat[row], (values.shape[1], 2)),
                self.turn_lon,
                self.field[part.level, row],
                self.tensor[part.level, row],
            )


class _Circle:
    """Sums over order at given longitudes (degrees), one way or the other."""

    def __init__(self, longitudes: Floats, orders: int) -> None:
        m = np.arange(orders)
        self.nodes = _nodes_of_circle(longitudes, orders)
        if self.nodes:
            self.turn = np.exp(1j * np.radians(np.mod(m * longitudes[0], 360.0)))
            self.turn[1:] *= 0.5
            self.index = np.arange(len(longitudes)) % self.nodes
            return
        angle = np.radians(np.mod(m[:, None] * longitudes, 360.0))
        self.cosine, self.sine = np.cos(angle), np.sin(angle)

    def sum_orders(self, c: NDArray[np.complex128]) -> Floats:
        """sum_m Re[c_m e^(i m longitude)] of c (k, orders), as (k, lon)."""
        if not self.nodes:
            return np.asarray(c.real @ self.cosine - c.imag @ self.sine)
        values = np.fft.irfft(c * self.turn, n=self.nodes, norm="forward")
        return values if len(self.index) == self.nodes else values[:, self.index]


def _nodes_of_circle(longitudes: Floats, orders: int) -> int:
    """Nodes of the circle that evenly spaced longitudes are some of; 0 where a matrix serves."""
    if len(longitudes) < 2:
        return 0
    step = (longitudes[-1] - longitudes[0]) / (len(longitudes) - 1)
    even = longitudes[0] + step * np.arange(len(longitudes))
    if step <= 0.0 or np.abs(longitudes - even).max() > _EVEN:
        return 0
    nodes = round(360.0 / step)
    enough = nodes >= 2 * orders and 8 * len(longitudes) >= nodes
    return nodes if enough and abs(nodes * step - 360.0) <= _EVEN else 0
