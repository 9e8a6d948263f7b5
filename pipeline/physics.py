"""Physics that every tile must keep: its arrays are one harmonic field, not nine pictures.

Gradients are compared with differences of the vector by a compact scheme, which combines
neighbouring gradients as well (Lele 1992, J. Comput. Phys. 103, eq. 2.1.7):

    G[-1]/3 + G[0] + G[1]/3 = 14/9 (B[1] - B[-1]) / 2s + 1/9 (B[2] - B[-2]) / 4s

to 4/7! s^6 of the sixth derivative of G: 1 % at four nodes a wavelength, where plain fourth
order has 15 %.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.flags import QualityFlag
from magtiles.catalog.kernels.geodesy import metres_per_degree

Floats = NDArray[np.float64]

_REACH = 3
"""Nodes beyond the core that the widest stencil touches."""
_TRUNCATION = 8 * 4 / 5040
"""Times the sixth difference of G: bounds the scheme's error at every wavelength.

The factor 8 is for the shortest waves: at Nyquist the scheme loses 1/3 of G, whose sixth
difference is 64 G.
"""
WEAKEST_CORE_FIELD_NT = 22_000.0
"""Least intensity at the Earth's surface, in the South Atlantic anomaly."""
FASTEST_TURN_PER_KM = 2.2e-4
"""Radians that the core field turns by in a kilometre of height, at most (2.0e-4 in 2025)."""

# Component and direction to the tensor's names: derivative of B_i along north, then east.
_PAIRS = {
    ("north", "north"): "gradient_nn",
    ("east", "north"): "gradient_ne",
    ("down", "north"): "gradient_nd",
    ("north", "east"): "gradient_ne",
    ("east", "east"): "gradient_ee",
    ("down", "east"): "gradient_ed",
}


@dataclass
class GradientSums:
    """Sums over nodes of one level, added up tile by tile.

    `residual` and `truncation` are per (component, direction), `tensor` over the five stored
    components; all squared, (nT/km)^2.
    """

    residual: dict[tuple[str, str], float] = field(
        default_factory=lambda: dict.fromkeys(_PAIRS, 0.0)
    )
    truncation: dict[tuple[str, str], float] = field(
        default_factory=lambda: dict.fromkeys(_PAIRS, 0.0)
    )
    tensor: float = 0.0
    nodes: int = 0

    def worst(self) -> tuple[str, float, float]:
        """Derivative furthest beyond its truncation, its rms residual, its rms truncation.

        Both relative to the rms of a tensor component; NaN without nodes.
        """
        scale = np.sqrt(self.tensor / 5.0)
        if not scale > 0.0:
            return "none", float("nan"), float("nan")
        relative = {
            pair: (np.sqrt(self.residual[pair]) / scale, np.sqrt(self.truncation[pair]) / scale)
            for pair in _PAIRS
        }
        pair = max(relative, key=lambda p: float(relative[p][0] - relative[p][1]))
        residual, truncation = relative[pair]
        return f"anomaly_{pair[0]} toward {pair[1]}", float(residual), float(truncation)


def add_gradients(
    sums: GradientSums,
    level: Mapping[str, NDArray[Any]],
    latitude: Floats,
    longitude: Floats,
    height: float,
    halo: int,
) -> None:
    """Add the core nodes of one tile at one level, (rows, columns) each, halo included.

    Nodes whose stencil touches "beyond coverage" do not count. `height` above the ellipsoid
    is needed to 1 km only: it scales lengths by 1 / 6400 a kilometre.
    """
    trusted = _trusted(level["quality_flag"], halo)
    metres_north, metres_east = metres_per_degree(latitude[:, np.newaxis], np.float64(height))
    spacing = {
        "north": metres_north * (latitude[1] - latitude[0]) / 1000.0,
        "east": metres_east * (longitude[1] - longitude[0]) / 1000.0,
    }
    for pair, name in _PAIRS.items():
        axis = 0 if pair[1] == "north" else 1
        gradient = np.asarray(level[name], np.float64)
        apparent = gradient - _frame_terms(pair, level, latitude, metres_north, metres_east)
        values = np.asarray(level[f"anomaly_{pair[0]}"], np.float64)
        residual = _compact_residual(values, apparent, spacing[pair[1]], axis)
        sixth = _difference(_difference(_difference(gradient, axis), axis), axis)
        core = _core(residual, halo)[trusted]
        sums.residual[pair] += float(np.sum(core**2))
        sums.truncation[pair] += float(np.sum((_TRUNCATION * _core(sixth, halo)[trusted]) ** 2))
    for name in sorted(set(_PAIRS.values())):
        sums.tensor += float(np.sum(_core(level[name].astype(np.float64), halo)[trusted] ** 2))
    sums.nodes += int(np.count_nonzero(trusted))


def _compact_residual(values: Floats, gradient: Floats, spacing: Floats, axis: int) -> Floats:
    def at(array: Floats, step: int) -> Floats:
        return np.roll(array, -step, axis)  # what wraps around stays within the halo

    differences = (14.0 / 9.0) * (at(values, 1) - at(values, -1)) / 2.0
    differences += (1.0 / 9.0) * (at(values, 2) - at(values, -2)) / 4.0
    smoothed = gradient + (at(gradient, 1) + at(gradient, -1)) / 3.0
    # The left side weighs gradients by 5/3 in all.
    return (differences / spacing - smoothed) * 0.6


def _difference(values: Floats, axis: int) -> Floats:
    second: Floats = np.roll(values, 1, axis) - 2.0 * values + np.roll(values, -1, axis)
    return second


def _frame_terms(
    pair: tuple[str, str],
    level: Mapping[str, NDArray[Any]],
    latitude: Floats,
    metres_north: Floats,
    metres_east: Floats,
) -> Floats | float:
    """What the turning of north, east, down along the way adds to a component's derivative.

    With radii of curvature M + h and N + h: moving north, n turns by d / (M + h); moving
    east, e turns by (d + n tan(latitude)) / (N + h).
    """
    meridian = metres_north * np.degrees(1.0) / 1000.0
    phi = np.radians(latitude)[:, np.newaxis]
    prime_vertical = metres_east * np.degrees(1.0) / np.cos(phi) / 1000.0
    north, east, down = (level[f"anomaly_{axis}"] for axis in ("north", "east", "down"))
    terms: dict[tuple[str, str], Floats | float] = {
        ("north", "north"): -down / meridian,
        ("east", "north"): 0.0,
        ("down", "north"): north / meridian,
        ("north", "east"): east * np.tan(phi) / prime_vertical,
        ("east", "east"): -(down + north * np.tan(phi)) / prime_vertical,
        ("down", "east"): east / prime_vertical,
    }
    return terms[pair]


def _trusted(flags: NDArray[np.uint8], halo: int) -> NDArray[np.bool_]:
    beyond = (flags & QualityFlag.BEYOND_COVERAGE) != 0
    reached = beyond.copy()
    for axis in (0, 1):
        for step in range(-_REACH, _REACH + 1):
            reached |= np.roll(beyond, step, axis)
    return ~_core(reached, halo)


def _core(values: NDArray[Any], halo: int) -> NDArray[Any]:
    return values[halo:-halo, halo:-halo]


def projection_excess(
    level: Mapping[str, NDArray[Any]],
    ambient: Mapping[str, NDArray[Any]],
    halo: int,
    rise_km: float,
) -> Floats:
    """By how much the vector along the ambient field misses the total beyond its bound, nT.

    Core nodes without any flag, of a level `rise_km` above the lowest. The total may be the
    projection f . B itself, as a survey's transform gives it, or the magnitude's own change
    |C + B| - |C|, as a field model's: with a the part of B across the core field C, they differ by
    a^2 / (|C + B| + |C| + f . B) exactly, less than a^2 / 2 (F + f . B) with F the weakest field.
    `ambient` is the direction at the lowest level, from which the core field turns upward.
    """
    north, east, down = (
        np.asarray(level[f"anomaly_{a}"], np.float64) for a in ("north", "east", "down")
    )
    along = (
        ambient["ambient_north"] * north
        + ambient["ambient_east"] * east
        + ambient["ambient_down"] * down
    )
    across2 = np.maximum(north**2 + east**2 + down**2 - along**2, 0.0)
    bent = across2 / (2.0 * (WEAKEST_CORE_FIELD_NT + np.minimum(along, 0.0)))
    turned = FASTEST_TURN_PER_KM * rise_km * np.sqrt(across2)
    miss = np.abs(along - level["magnetic_anomaly"]) - bent - turned
    clean: NDArray[np.bool_] = _core(level["quality_flag"], halo) == 0
    excess: Floats = _core(miss, halo)[clean]
    return excess
