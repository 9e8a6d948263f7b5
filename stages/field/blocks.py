"""Short wavelengths of a map too large for one transform, block by block, on top of its long ones.

The anomaly T is split: T_long, of wavelengths of many cells, is solved once on a thinned copy
of the whole map (`whole`), and T_short = T - T_long, with T_long evaluated at the map's own nodes,
so that nothing is lost and nothing counted twice. A block takes T_short of its surroundings,
faded out over its margin, and transforms that. What the fading keeps from it is far away and
oscillates with short wavelengths: kernels as smooth as theirs are there sum it to next to nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.stages.field.at_nodes import evaluate_on_plane, quality_flags
from magtiles.stages.field.decimation import spline_matrix
from magtiles.stages.field.direction import AmbientSource
from magtiles.stages.field.interpolate import add_splines
from magtiles.stages.field.padding import Padding, plan_padding
from magtiles.stages.field.plane import STEP_M, coarse_axis
from magtiles.stages.field.prepare import PlaneMap
from magtiles.stages.field.rotation import rotate_to_ned
from magtiles.stages.field.solve import (
    AnomalousField,
    Direction,
    follow,
    plane_direction,
    split_direction,
)
from magtiles.stages.field.spectral import (
    LOW_INCLINATION_SINE,
    VECTOR,
    Inversion,
    Wavenumbers,
    odd_fast_length,
)
from magtiles.stages.field.target import Nodes
from magtiles.stages.field.uncertainty import survey_variance
from magtiles.stages.field.whole import NINE, budget_of
from magtiles.stages.field.windows import MapWindows, Span, local, spans

Real = NDArray[np.float64]
Single = NDArray[np.float32]

_MARGIN_CELLS, _LOW_MARGIN_CELLS = 192.0, 288.0
_FADE = 0.5
"""How far around its nodes a block looks, in cells, and over which part of that it fades.

Farther at low inclination, where kernels reach far along the wedge that is damped.
"""
OVERLAP_CELLS = 24.0
"""How far blocks reach into each other, in cells: there their products are blended."""

_LITTLE_TURN = 0.2


@dataclass(frozen=True)
class Block:
    """Part of a lattice of output nodes: what it owns, and with what it overlaps its neighbours."""

    rows: Span
    columns: Span
    outer_rows: Span
    outer_columns: Span


def plan_blocks(
    shape: tuple[int, ...], most: tuple[int, ...], overlap: tuple[int, ...]
) -> list[list[Block]]:
    """Rows of blocks that cover a lattice, each with at most so many nodes of its own a side.

    Unless that is less than two overlaps, which a block must hold.
    """
    parts = []
    for count, size, reach in zip(shape, most, overlap, strict=True):
        own = spans(count, max(size, 4 * reach))
        parts.append([(o, (max(o[0] - reach, 0), min(o[1] + reach, count))) for o in own])
    rows, columns = parts
    return [[Block(r, c, outer_r, outer_c) for c, outer_c in columns] for r, outer_r in rows]


@dataclass(frozen=True)
class BlockSolution:
    """Products (9, m, n), sigma by group, and flags of a block's nodes, as of a whole level."""

    products: Single
    sigmas: dict[str, Single]
    flags: NDArray[np.uint8]


class MapBlock:
    """A block of a map: its field, continued to one level after another.

    `nodes` are those of every level. What levels have in common is done once where they follow
    one another.
    """

    def __init__(self, windows: MapWindows, ambient: AmbientSource, nodes: Nodes) -> None:
        self._windows, self._ambient, self._nodes = windows, ambient, nodes
        self._solved: tuple[Padding, AnomalousField] | None = None

    def solve(self, height_gain: float, whole: xr.Dataset) -> BlockSolution:
        """Its part of a level `height_gain` m above the map, which `survey_whole` gave `whole`."""
        windows, nodes = self._windows, self._nodes
        padding = plan_padding(windows.shape, windows.spacing, height_gain)
        inner = [
            _within(index, n, o)
            for index, n, o in zip(
                (nodes.row, nodes.column), padding.shape, padding.offset, strict=True
            )
        ]
        field = self._short_field(whole, padding, inner)
        products = evaluate_on_plane(field, nodes, height_gain)
        direction = np.array(field.inversion.direction)
        _add_long_products(products, whole, padding, nodes, direction)
        rotate_to_ned(products, nodes.north, nodes.ambient, direction)
        around, placed = _around(windows, padding, inner, nodes, height_gain)
        survey = survey_variance(around, placed.row, placed.column)
        sigmas = budget_of(whole).sigma(survey, nodes.row, nodes.column)
        return BlockSolution(products, sigmas, quality_flags(around, placed, height_gain))

    def _short_field(
        self, whole: xr.Dataset, padding: Padding, inner: Sequence[Span]
    ) -> AnomalousField:
        """The same for all levels with the same padding."""
        if self._solved is None or self._solved[0] != padding:
            self._solved = None  # that two are never in memory
            self._solved = (
                padding,
                _short_field(self._windows, whole, self._ambient, padding, inner),
            )
        return self._solved[1]


def _around(
    windows: MapWindows, padding: Padding, inner: Sequence[Span], nodes: Nodes, height_gain: float
) -> tuple[PlaneMap, Nodes]:
    """The map as far around nodes as its gaps reach up to a level, and where nodes lie in it."""
    rows, columns = (
        _grown(span, abs(height_gain), d) for span, d in zip(inner, windows.spacing, strict=True)
    )
    row, column = nodes.row - rows[0], nodes.column - columns[0]
    return windows.extended(rows, columns, padding), Nodes(row, column, nodes.north, nodes.ambient)


def _within(index: Real, size: int, offset: int) -> Span:
    """The nodes of the padded map around fractional places."""
    first = int(np.clip(np.floor(index.min()) - 1, -offset, size - offset - 2))
    last = int(np.clip(np.ceil(index.max()) + 2, first + 2, size - offset))
    return first, last


def _grown(span: Span, reach: float, spacing: float) -> Span:
    cells = int(np.ceil(reach / spacing)) + 3
    return span[0] - cells, span[1] + cells


def _short_field(
    windows: MapWindows,
    whole: xr.Dataset,
    ambient: AmbientSource,
    padding: Padding,
    inner: Sequence[Span],
) -> AnomalousField:
    """The field of the short wavelengths in and around a window of the map."""
    low = abs(float(whole.attrs["direction"][2])) < LOW_INCLINATION_SINE
    reach = (_LOW_MARGIN_CELLS if low else _MARGIN_CELLS) * max(windows.spacing)
    margins = [int(np.ceil(reach / d)) for d in windows.spacing]
    rows, columns = (
        (first - m, first - m + odd_fast_length(last - first + 2 * m))
        for (first, last), m in zip(inner, margins, strict=True)
    )
    around = local(windows.extended(rows, columns, padding))
    directions = _directions(windows, around, ambient)
    values = around.values - _long_map(whole, padding, rows, columns)
    fades = [
        _fade(span, own, m, n - o, o)
        for span, own, m, n, o in zip(
            (rows, columns), inner, margins, padding.shape, padding.offset, strict=True
        )
    ]
    values *= np.multiply.outer(*fades)
    direction, variation, rounds = _split(directions, whole)
    shape = values.shape[0], values.shape[1]
    inversion = Inversion(Wavenumbers(shape, around.spacing), direction)
    total = follow(values, inversion, variation, (0, 0), shape, rounds).total
    place = Padding((-rows[0], -columns[0]), shape, shape)
    ratio = float(whole.attrs["noise_to_signal"])
    return AnomalousField(place, inversion.wavenumbers, inversion, total, ratio)


def _split(
    directions: Direction, whole: xr.Dataset
) -> tuple[tuple[float, float, float], list[Real], int | None]:
    """The direction to solve a block for, what that of its nodes differs from it, and the rounds.

    Where they differ little from the map's direction it is that one, in as many rounds as the
    long wavelengths took: what blocks sum to is then what one transform gives. Elsewhere it is the
    block's own mean, which is sooner followed.
    """
    first, second, third = (float(part) for part in whole.attrs["direction"])
    of_map = first, second, third
    variation = [part - m for part, m in zip(directions, of_map, strict=True)]
    if max(np.abs(part).max() for part in variation) < _LITTLE_TURN:
        return of_map, variation, int(whole.attrs["rounds"])
    return *split_direction(directions), None


def _fade(span: Span, own: Span, margin: int, size: int, offset: int) -> Real:
    """1 over a block's own nodes and some way on, then down as a cosine; 0 beyond the padding."""
    places = np.arange(*span)
    distance = np.maximum(np.maximum(own[0] - places, places - own[1] + 1), 0)
    t = np.clip((distance / margin - 1.0 + _FADE) / _FADE, 0.0, 1.0)
    fade = 0.5 + 0.5 * np.cos(np.pi * t)
    fade[(places < -offset) | (places >= size)] = 0.0
    return np.asarray(fade)


def _directions(windows: MapWindows, around: PlaneMap, ambient: AmbientSource) -> Direction:
    """Ambient unit vector (y, x, d) over a window, held at the map's border beyond it."""
    y, x = (
        np.clip(coarse_axis(axis, STEP_M), whole[0], whole[-1])
        for axis, whole in zip((around.y, around.x), (windows.y, windows.x), strict=True)
    )
    return plane_direction(windows.plane, ambient)(*np.meshgrid(y, x, indexing="ij"))


def _long_map(whole: xr.Dataset, padding: Padding, rows: Span, columns: Span) -> Real:
    """The long wavelengths of the mapped anomaly (nT) at the nodes of a window."""
    places = [np.arange(*span, dtype=float) for span in (rows, columns)]
    part, (row, column) = _coefficients_around(whole, padding, places)
    coefficients = whole["long_map"][part].values
    down, across = (
        spline_matrix(at, n) for at, n in zip((row, column), coefficients.shape, strict=True)
    )
    return np.asarray((across @ (down @ coefficients).T).T)


def _add_long_products(
    products: Single, whole: xr.Dataset, padding: Padding, nodes: Nodes, direction: Real
) -> None:
    """Add those of the long wavelengths to products (9, m, n) along the plane's axes.

    The total is that along `direction` (y, x, d).
    """
    part, (row, column) = _coefficients_around(whole, padding, [nodes.row, nodes.column])
    long = {name: whole[f"long_{name}"][part].values for name in NINE}
    for axis, turn in zip(VECTOR, direction - whole.attrs["direction"], strict=True):
        long["total"] = long["total"] + np.float32(turn) * long[axis]
    add_splines(np.stack(list(long.values()), axis=-1), row, column, products)


def _coefficients_around(
    whole: xr.Dataset, padding: Padding, places: Sequence[Real]
) -> tuple[tuple[slice, ...], list[Real]]:
    """Which coefficients of the long wavelengths are around places of the map, and those there."""
    parts, found = [], []
    counts = (whole.sizes[name] for name in ("long_row", "long_column"))
    for at, count, size, offset in zip(places, counts, padding.shape, padding.offset, strict=True):
        scaled = (at + offset) * (count / size)
        first, last = int(np.floor(scaled.min())) - 1, int(np.floor(scaled.max())) + 3
        whole_axis = first < 0 or last > count
        parts.append(slice(None) if whole_axis else slice(first, last))
        found.append(scaled if whole_axis else scaled - first)
    return tuple(parts), found
