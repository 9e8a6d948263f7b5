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

from magtiles.stages.field.at_nodes import evaluate_products, quality_flags
from magtiles.stages.field.decimation import spline_matrix
from magtiles.stages.field.direction import AmbientSource
from magtiles.stages.field.interpolate import evaluate_spline
from magtiles.stages.field.level import PRODUCTS
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


def solve_block(
    windows: MapWindows, whole: xr.Dataset, ambient: AmbientSource, nodes: Nodes, height_gain: float
) -> BlockSolution:
    """A block's part of a level, at `nodes` of the map, `height_gain` m above it.

    `whole` is what `survey_whole` gave for that height.
    """
    padding = plan_padding(windows.shape, windows.spacing, height_gain)
    inner = [
        _within(index, n, o)
        for index, n, o in zip(
            (nodes.row, nodes.column), padding.shape, padding.offset, strict=True
        )
    ]
    short = _short_field(windows, whole, ambient, padding, inner)
    products = evaluate_products(short, nodes, height_gain)
    products += _long_products(whole, padding, nodes)
    rows, columns = (
        _grown(span, abs(height_gain), d) for span, d in zip(inner, windows.spacing, strict=True)
    )
    around = windows.extended(rows, columns, padding)
    row, column = nodes.row - rows[0], nodes.column - columns[0]
    placed = Nodes(row, column, nodes.north, nodes.ambient)
    survey = survey_variance(around, row, column)
    sigmas = budget_of(whole).sigma(survey, nodes.row, nodes.column)
    return BlockSolution(products, sigmas, quality_flags(around, placed, height_gain))


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
    coefficients, (row, column) = _coefficients(whole["long_map"], padding, places)
    down, across = (
        spline_matrix(at, n) for at, n in zip((row, column), coefficients.shape, strict=True)
    )
    return np.asarray((across @ (down @ coefficients).T).T)


def _long_products(whole: xr.Dataset, padding: Padding, nodes: Nodes) -> Single:
    """The long wavelengths' nine products (9, m, n) in NED at nodes of the map."""
    out = np.empty((len(PRODUCTS), *nodes.row.shape), np.float32)
    for name, values in zip(NINE, out, strict=True):
        places = [nodes.row, nodes.column]
        coefficients, (row, column) = _coefficients(whole[f"long_{name}"], padding, places)
        evaluate_spline(coefficients, row, column, 1.0, np.zeros(2), values)
    rotate_to_ned(out, nodes.north, nodes.ambient, np.array(whole.attrs["direction"]))
    return out


def _coefficients(
    variable: xr.DataArray, padding: Padding, places: Sequence[Real]
) -> tuple[Single, list[Real]]:
    """The coefficients around places of the map, and those places among them."""
    parts, found = [], []
    for at, count, size, offset in zip(
        places, variable.shape, padding.shape, padding.offset, strict=True
    ):
        scaled = (at + offset) * (count / size)
        first, last = int(np.floor(scaled.min())) - 1, int(np.floor(scaled.max())) + 3
        whole_axis = first < 0 or last > count
        parts.append(slice(None) if whole_axis else slice(first, last))
        found.append(scaled if whole_axis else scaled - first)
    return np.ascontiguousarray(variable[tuple(parts)].values), found
