"""From a map to the spectrum of its anomalous field, with an ambient direction that varies.

The observed anomaly is T = f(r).B(r). With f = f0 + df(r) the transform of T - df.B obeys the
relations of `spectral` for the constant direction f0, and B follows from it: a fixed point,
found by substitution from B = 0 on. Each round gains about the relative size of df.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit, prange

from magtiles.schemas.errors import CoverageError
from magtiles.stages.field.direction import AmbientSource
from magtiles.stages.field.padding import Padding, pad
from magtiles.stages.field.plane import STEP_M, Plane, coarse_axis
from magtiles.stages.field.prepare import PlaneMap
from magtiles.stages.field.product import Level, Single
from magtiles.stages.field.spectral import (
    VECTOR,
    Complex,
    Inversion,
    Real,
    Wavenumbers,
    forward,
)

_log = logging.getLogger(__name__)

_TOLERANCE = 1e-3
_ROUNDS = 8
_UNSETTLED = 0.05

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

    def level(self, height_gain: float, density: int = 1) -> Level:
        """The field `height_gain` m above the map's surface, as samples or spline coefficients."""
        return Level(self.total, self.inversion, height_gain, self.noise_to_signal, density)


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


def solve(plane_map: PlaneMap, ambient: AmbientSource, padding: Padding) -> AnomalousField:
    """The anomalous field of a map, ready to be continued as far as `padding` was planned for."""
    wavenumbers = Wavenumbers(padding.shape, plane_map.spacing)
    directions = coarse_directions(plane_map.plane, plane_map.y, plane_map.x, ambient)
    mean, variation = split_direction(directions)
    inversion = Inversion(wavenumbers, mean)
    padded = pad(plane_map.values, padding)
    total = follow(padded, inversion, variation, padding.offset, padding.map_shape).total
    ratio = noise_to_signal(float(np.mean(plane_map.sigma**2)), float(plane_map.values.var()))
    return AnomalousField(padding, wavenumbers, inversion, total, ratio)


def noise_to_signal(noise: float, signal: float) -> float:
    """Ratio of two variances, at most 1."""
    return noise / signal if noise < signal else 1.0


def coarse_directions(plane: Plane, y: Real, x: Real, ambient: AmbientSource) -> Direction:
    """Ambient unit vector (y, x, d) at points some 25 km apart, from corner to corner of a map.

    Between them it is linear within 1e-5.
    """
    nodes = (coarse_axis(axis, STEP_M) for axis in (y, x))
    return plane_direction(plane, ambient)(*np.meshgrid(*nodes, indexing="ij"))


def split_direction(directions: Direction) -> tuple[tuple[float, float, float], list[Real]]:
    """The unit vector of their mean, and what each part differs from it."""
    mean = np.array([part.mean() for part in directions])
    mean /= np.linalg.norm(mean)
    variation = [part - m for part, m in zip(directions, mean, strict=True)]
    return (float(mean[0]), float(mean[1]), float(mean[2])), variation


class Followed(NamedTuple):
    """Spectrum of T - df.B, and after how many rounds of substitution."""

    total: Complex
    rounds: int


def follow(
    padded: Real,
    inversion: Inversion,
    variation: Sequence[Real],
    offset: tuple[float, float],
    shape: tuple[float, float],
    rounds: int | None = None,
) -> Followed:
    """Spectrum of T - df.B, by substitution until a further round would change it by 0.1 %.

    `variation` holds the parts of df on a coarse lattice that covers `shape` nodes of `padded`
    from `offset` on, from corner to corner; it goes on unchanged beyond them. With `rounds`, that
    many are made: the result is then linear in T, part by part the same as all at once.
    """
    total = forward(padded)
    size = float(np.linalg.norm(padded - padded.mean()))
    if size == 0.0 or max(np.abs(part).max() for part in variation) < _TOLERANCE / 10:
        return Followed(total, 0)
    if rounds is not None:
        for _ in range(rounds):
            correction = _varying_part(total, inversion, variation, offset, shape)
            total = forward(padded - correction)
        return Followed(total, rounds)
    previous = np.zeros(padded.shape)
    change = first = np.inf
    done = 0
    for _ in range(_ROUNDS):
        correction = _varying_part(total, inversion, variation, offset, shape)
        last, change = change, float(np.linalg.norm(correction - previous)) / size
        if change > last:
            _accept_or_refuse(last)
            break
        total, previous, first = forward(padded - correction), correction, min(first, change)
        done += 1
        if change * first < _TOLERANCE:
            break
    return Followed(total, done)


def _accept_or_refuse(change: float) -> None:
    """Warn of, or refuse, substitution that came no nearer than a relative `change`."""
    told = f"the ambient direction varies too much over this map (unsettled by {change:.1%})"
    if change > _UNSETTLED:
        raise CoverageError(
            told,
            expected=f"a region over which it settles within {_UNSETTLED:.0%}",
            remedy="choose a smaller region, above all one that keeps off the magnetic equator",
        )
    _log.warning("%s: split the region for more", told)


def _varying_part(
    total: Complex,
    inversion: Inversion,
    variation: Sequence[Real],
    offset: tuple[float, float],
    shape: tuple[float, float],
) -> Real:
    """df.B (nT) on the padded plane."""
    out = np.zeros(inversion.wavenumbers.shape)
    surface = Level(total, inversion, 0.0)
    values: Single | None = None
    for axis, part in zip(VECTOR, variation, strict=True):
        values = surface.values(axis, slice(None), slice(None), values)
        add_product(out, values, part, offset, shape)
    return out


@njit(parallel=True, cache=True, nogil=True)
def add_product(
    out: Real,
    values: Single,
    factor: Real,
    offset: tuple[float, float],
    shape: tuple[float, float],
) -> None:
    """Add values * factor to `out` (m, n).

    `factor`, on a coarse lattice, covers the part of `shape` from `offset` on, from corner to
    corner; it is taken linearly between its nodes, and its edge extends beyond them.
    """
    last_row, last_column = factor.shape[0] - 1, factor.shape[1] - 1
    for i in prange(out.shape[0]):
        r = (i - offset[0]) * last_row / (shape[0] - 1.0)
        r = min(max(r, 0.0), last_row)
        r0 = min(int(r), last_row - 1)
        t = r - r0
        for j in range(out.shape[1]):
            c = (j - offset[1]) * last_column / (shape[1] - 1.0)
            c = min(max(c, 0.0), last_column)
            c0 = min(int(c), last_column - 1)
            u = c - c0
            low = factor[r0, c0] + u * (factor[r0, c0 + 1] - factor[r0, c0])
            high = factor[r0 + 1, c0] + u * (factor[r0 + 1, c0 + 1] - factor[r0 + 1, c0])
            out[i, j] += values[i, j] * (low + t * (high - low))
