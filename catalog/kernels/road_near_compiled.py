"""Loops of `road_near`, compiled by numba: import this only when particles come."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.kernels.jit import compiled as _compile
from magtiles.catalog.kernels.road_near import BLOCK, TILE_CELLS

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

_LOG_2PI = math.log(2.0 * math.pi)
_SLACK = 1e-4
"""Metres by which rounding and the change of scale within a tile may mislead."""


@_compile
def _slot(row: int, column: int, mask: int) -> int:
    # Knuth's multiplicative hash (TAOCP 3, 6.4).
    return ((row * 2654435761) ^ (column * 40503 * 65537)) & mask


@_compile
def hash_tiles(tiles: Integers) -> Integers:
    """Open hash table (m, 3) of tiles (t, 2): row, column, number or -1."""
    size = 4
    while size < 3 * tiles.shape[0]:
        size *= 2
    table = np.full((size, 3), -1, np.int64)
    for k in range(tiles.shape[0]):
        at = _slot(tiles[k, 0], tiles[k, 1], size - 1)
        while table[at, 2] >= 0:
            at = (at + 1) & (size - 1)
        table[at, 0], table[at, 1], table[at, 2] = tiles[k, 0], tiles[k, 1], k
    return table


@_compile
def _tile_of(table: Integers, row: int, column: int) -> int:
    mask = table.shape[0] - 1
    at = _slot(row, column, mask)
    while table[at, 2] >= 0:
        if table[at, 0] == row and table[at, 1] == column:
            return int(table[at, 2])
        at = (at + 1) & mask
    return -1


@_compile
def _nearest_of_all(nodes: Floats, blocks: Floats, y: float, x: float) -> tuple[int, float, float]:
    """The nearest point, passing over blocks that cannot hold it, and metres per degree there."""
    best, least = 0, math.inf
    for b in range(blocks.shape[0]):
        north, east = blocks[b, 3], blocks[b, 4]
        dy, dx = (y - blocks[b, 0]) * north, (x - blocks[b, 1]) * east
        reach = least + blocks[b, 2]
        if dy * dy + dx * dx > reach * reach:
            continue
        for j in range(b * BLOCK, min((b + 1) * BLOCK, nodes.shape[0])):
            dy, dx = (y - nodes[j, 0]) * north, (x - nodes[j, 1]) * east
            square = dy * dy + dx * dx
            if square < least * least:
                best, least = j, math.sqrt(square)
    return best, blocks[best // BLOCK, 3], blocks[best // BLOCK, 4]


@_compile
def _gather(
    nodes: Floats, blocks: Floats, y: float, x: float, north: float, east: float, within: float
) -> Integers:
    """All points within a distance of a place."""
    found = np.empty(nodes.shape[0], np.int64)
    count = 0
    for b in range(blocks.shape[0]):
        dy, dx = (y - blocks[b, 0]) * north, (x - blocks[b, 1]) * east
        if math.hypot(dy, dx) > within + blocks[b, 2]:
            continue
        for j in range(b * BLOCK, min((b + 1) * BLOCK, nodes.shape[0])):
            dy, dx = (y - nodes[j, 0]) * north, (x - nodes[j, 1]) * east
            if math.hypot(dy, dx) <= within:
                found[count] = j
                count += 1
    return found[:count].copy()


@_compile
def _keep(corner: Floats, kept: Integers) -> int:
    """Candidates that no other one beats at all four corners; how many, their places in `kept`.

    `corner` (candidates, 4) holds squared distances.
    """
    rivals = np.empty(4, np.int64)
    for c in range(4):
        rivals[c] = corner[:, c].argmin()
    count = 0
    for j in range(corner.shape[0]):
        beaten = False
        for rival in rivals:
            worst = math.inf
            for c in range(4):
                worst = min(worst, corner[j, c] - corner[rival, c])
            if worst > _SLACK:
                beaten = True
                break
        if not beaten:
            kept[count] = j
            count += 1
    return count


@_compile
def _filter(
    nodes: Floats, near: Integers, square: Floats, metres: Floats, corner: Floats, kept: Integers
) -> Integers:
    """Those of the points `near` that are nearest to some place in a rectangle.

    `square` is south, west, and extent in degrees; `corner` and `kept` are for work.
    """
    north, east = metres[0], metres[1]
    for c in range(near.size):
        node = nodes[near[c]]
        south, west = (square[0] - node[0]) * north, (square[1] - node[1]) * east
        top, right = south + square[2] * north, west + square[3] * east
        corner[c, 0] = south * south + west * west
        corner[c, 1] = south * south + right * right
        corner[c, 2] = top * top + west * west
        corner[c, 3] = top * top + right * right
    count = _keep(corner[: near.size], kept)
    return near[kept[:count]]


@_compile
def list_points(
    nodes: Floats, tiles: Integers, scale: Floats, metres: Floats, blocks: Floats
) -> tuple[Integers, NDArray[np.int32]]:
    """For every cell of every tile the points that are nearest to some place in it.

    A quarter of a tile's side is filtered first, and its cells among what that leaves.
    """
    per_tile, part = TILE_CELLS * TILE_CELLS, TILE_CELLS // 4
    cells = np.zeros(tiles.shape[0] * per_tile + 1, np.int64)
    points = np.empty(8 * cells.size, np.int32)
    quarter, cell = np.empty(4), np.empty(4)
    quarter[2:], cell[2:] = scale / 4, scale / TILE_CELLS
    end = 0
    for k in range(tiles.shape[0]):
        near = _near_tile(nodes, blocks, tiles[k] * scale, scale, metres[k])
        corner, kept = np.empty((near.size, 4)), np.empty(near.size, np.int64)
        held = [near] * 0
        for q in range(16):
            quarter[:2] = tiles[k] * scale + np.array([q // 4, q % 4]) * quarter[2:]
            held.append(_filter(nodes, near, quarter, metres[k], corner, kept))
        for c in range(per_tile):
            row, column = c // TILE_CELLS, c % TILE_CELLS
            cell[0] = tiles[k, 0] * scale[0] + row * cell[2]
            cell[1] = tiles[k, 1] * scale[1] + column * cell[3]
            among = held[row // part * 4 + column // part]
            found = _filter(nodes, among, cell, metres[k], corner, kept)
            if end + found.size > points.size:
                points = np.concatenate((points, np.empty_like(points)))
            points[end : end + found.size] = found
            end += found.size
            cells[k * per_tile + c + 1] = end
    return cells, points[:end].copy()


@_compile
def _near_tile(
    nodes: Floats, blocks: Floats, corner: Floats, scale: Floats, metres: Floats
) -> Integers:
    """Every point that may be nearest to some place in a tile, given by its south-west corner."""
    north, east = metres[0], metres[1]
    half = 0.5 * math.hypot(scale[0] * north, scale[1] * east)
    y, x = corner[0] + 0.5 * scale[0], corner[1] + 0.5 * scale[1]
    first, _, _ = _nearest_of_all(nodes, blocks, y, x)
    away = math.hypot((y - nodes[first, 0]) * north, (x - nodes[first, 1]) * east)
    return _gather(nodes, blocks, y, x, north, east, away + 2.0 * half + 1.0)


@_compile
def _nearest_of(
    nodes: Floats,
    points: NDArray[np.int32],
    begin: int,
    end: int,
    y: float,
    x: float,
    north: float,
    east: float,
) -> int:
    """The nearest of the points listed from `begin` to `end`."""
    # An unsigned index cannot count from the end, and what is chosen without a branch cannot be
    # mispredicted: together four times faster.
    best, least = 0, math.inf
    for k in range(np.uint64(begin), np.uint64(end)):
        node = points[k]
        j = np.uint64(node)
        dy, dx = (y - nodes[j, 0]) * north, (x - nodes[j, 1]) * east
        square = dy * dy + dx * dx
        best = node if square < least else best
        least = min(least, square)
    return best


@_compile
def _locate(
    nodes: Floats,
    origin: Floats,
    scale: Floats,
    table: Integers,
    metres: Floats,
    cells: Integers,
    points: NDArray[np.int32],
    blocks: Floats,
    latitude: Floats,
    longitude: Floats,
    found: Floats,
) -> int:
    """Fill `found` (n, 5): degrees from the origin, nearest point (-1: NaN), metres per degree.

    Returns the index of the first position that is none, or -1.
    """
    # All in one loop: a call with arrays, once for each position, would cost more than the search.
    per_degree = 1.0 / scale[0], 1.0 / scale[1]
    south, west, tile = np.int64(1) << 40, np.int64(0), -1
    for k in range(latitude.size):
        if abs(latitude[k]) > 90.0 or math.isinf(longitude[k]):
            return k
        found[k, 2] = -1.0
        if math.isnan(latitude[k]) or math.isnan(longitude[k]):
            continue
        y, x = latitude[k] - origin[0], longitude[k] - origin[1]
        x -= 360.0 * math.floor(x / 360.0 + 0.5)
        row, column = y * per_degree[0], x * per_degree[1]
        if not (0.0 <= row - south < 1.0 and 0.0 <= column - west < 1.0):
            south, west = math.floor(row), math.floor(column)
            tile = _tile_of(table, south, west)
        if tile < 0:
            far, north, east = _nearest_of_all(nodes, blocks, y, x)
            found[k, 0], found[k, 1], found[k, 2] = y, x, far
            found[k, 3], found[k, 4] = north, east
            continue
        north, east = metres[tile, 0], metres[tile, 1]
        i = min(int((row - south) * TILE_CELLS), TILE_CELLS - 1)
        j = min(int((column - west) * TILE_CELLS), TILE_CELLS - 1)
        cell = (tile * TILE_CELLS + i) * TILE_CELLS + j
        best = _nearest_of(nodes, points, cells[cell], cells[cell + 1], y, x, north, east)
        found[k, 0], found[k, 1], found[k, 2] = y, x, best
        found[k, 3], found[k, 4] = north, east
    return -1


@_compile
def _foot(
    nodes: Floats, best: int, y: float, x: float, north: float, east: float
) -> tuple[np.int64, float, float]:
    """Nearest place on the two lines at a point: start of the line, share, distance squared."""
    start, share, least = np.int64(best), 0.0, math.inf
    for j in range(np.uint64(max(best - 1, 0)), np.uint64(min(best + 1, nodes.shape[0] - 1))):
        k = j + np.uint64(1)
        dy, dx = (y - nodes[j, 0]) * north, (x - nodes[j, 1]) * east
        uy = (nodes[k, 0] - nodes[j, 0]) * north
        ux = (nodes[k, 1] - nodes[j, 1]) * east
        square = uy * uy + ux * ux
        t = (dy * uy + dx * ux) / square if square > 0.0 else 0.0
        t = min(max(t, 0.0), 1.0)
        dy -= t * uy
        dx -= t * ux
        away = dy * dy + dx * dx
        if away < least:
            start, share, least = np.int64(j), t, away
    return start, share, least


@_compile
def nearest(
    nodes: Floats,
    origin: Floats,
    scale: Floats,
    table: Integers,
    metres: Floats,
    cells: Integers,
    points: NDArray[np.int32],
    blocks: Floats,
    latitude: Floats,
    longitude: Floats,
    place: Floats,
    offset: Floats,
) -> int:
    """Fill the nearest place on the road, in points from the first, and how far it is, m.

    Returns the index of the first position that is none, or -1; NaN gives NaN.
    """
    found = np.empty((latitude.size, 5))
    bad = _locate(
        nodes, origin, scale, table, metres, cells, points, blocks, latitude, longitude, found
    )
    if bad >= 0:
        return bad
    for k in range(latitude.size):
        node = int(found[k, 2])
        if node < 0:
            place[k] = offset[k] = math.nan
            continue
        start, share, square = _foot(
            nodes, node, found[k, 0], found[k, 1], found[k, 3], found[k, 4]
        )
        place[k], offset[k] = start + share, math.sqrt(square)
    return -1


@_compile
def log_likelihood(
    nodes: Floats,
    origin: Floats,
    scale: Floats,
    table: Integers,
    metres: Floats,
    cells: Integers,
    points: NDArray[np.int32],
    blocks: Floats,
    latitude: Floats,
    longitude: Floats,
    values: Floats,
    section: Floats,
    lateral: float,
    out: Floats,
) -> int:
    """Log-likelihood of a section (K, 3) whose last sample each position is next to.

    `values` is as of `road_near.gaussian`; `lateral` is one over the variance of the distance from
    the road, m-2. NaN where a section would begin before the road. Returns as `nearest`.
    """
    found = np.empty((latitude.size, 5))
    bad = _locate(
        nodes, origin, scale, table, metres, cells, points, blocks, latitude, longitude, found
    )
    if bad >= 0:
        return bad
    last = section.shape[0] - 1
    constant = _LOG_2PI * section.size
    for k in range(latitude.size):
        out[k] = math.nan
        node = int(found[k, 2])
        if node < 0:
            continue
        start, share, square = _foot(
            nodes, node, found[k, 0], found[k, 1], found[k, 3], found[k, 4]
        )
        if start < last:
            continue
        total = constant + square * lateral
        for i in range(last + 1):
            total += _misfit(values, start - last + i, share, section, i)
        out[k] = -0.5 * total
    return -1


@_compile
def _misfit(values: Floats, j: int, share: float, section: Floats, i: int) -> Any:
    """Weighted squared errors of sample i, and the logarithm of the variances' product."""
    k = j + 1
    d0 = section[i, 0] - (values[j, 0] + share * (values[k, 0] - values[j, 0]))
    d1 = section[i, 1] - (values[j, 1] + share * (values[k, 1] - values[j, 1]))
    d2 = section[i, 2] - (values[j, 2] + share * (values[k, 2] - values[j, 2]))
    w0 = values[j, 3] + share * (values[k, 3] - values[j, 3])
    w1 = values[j, 4] + share * (values[k, 4] - values[j, 4])
    w2 = values[j, 5] + share * (values[k, 5] - values[j, 5])
    logarithm = values[j, 6] + share * (values[k, 6] - values[j, 6])
    return logarithm + d0 * d0 * w0 + d1 * d1 * w1 + d2 * d2 * w2
