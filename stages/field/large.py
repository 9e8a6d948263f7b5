"""Levels of a map that is too large for one transform, or for memory, block by block."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.stages.field.blocks import (
    OVERLAP_CELLS,
    Block,
    MapBlock,
    plan_blocks,
)
from magtiles.stages.field.direction import AmbientSource
from magtiles.stages.field.level import PRODUCTS
from magtiles.stages.field.target import Nodes, Target, locate
from magtiles.stages.field.whole import survey_whole
from magtiles.stages.field.windows import MapWindows, Span
from magtiles.stages.rows import strips as row_strips

Real = NDArray[np.float64]

LARGEST = 3072 * 3072
"""Nodes of a map that is still transformed at once, and half those of a level made at once."""
BLOCK_NODES = 2560
"""Most nodes of a block a side. The fewer they are, the more of its work is for its margins."""
_METRES_PER_DEGREE = 111_195.0
_STRIP = 512
"""Rows of a level that are put together at a time: of whole chunks of its file."""


def is_large(shape: tuple[int, int], target: tuple[int, int]) -> bool:
    """Whether a map of that shape is made block by block for a target of that shape."""
    return shape[0] * shape[1] > LARGEST or target[0] * target[1] > 2 * LARGEST


@dataclass(frozen=True)
class LargeMap:
    """A map whose levels are made block by block.

    Attributes
    ----------
    windows, ambient : the map and its ambient direction.
    target : the nodes of every level.
    blocks : rows of blocks.
    """

    windows: MapWindows
    ambient: AmbientSource
    target: Target
    blocks: list[list[Block]]

    @classmethod
    def plan(
        cls,
        windows: MapWindows,
        ambient: AmbientSource,
        target: Target,
        block_nodes: int | None,
    ) -> LargeMap:
        """Blocks of at most `block_nodes` nodes of the map a side, and of the target as well."""
        wide = block_nodes or BLOCK_NODES
        ratio = [max(windows.spacing) / d for d in _spacing(target)]
        most, overlap = (
            (int(wide * min(r, 1.0)) for r in ratio),
            (int(np.ceil(OVERLAP_CELLS * r)) for r in ratio),
        )
        shape = target.rows.size, target.columns.size
        blocks = plan_blocks(shape, tuple(most), tuple(overlap))
        return cls(windows, ambient, target, blocks)

    def survey(self, height_gain: float) -> xr.Dataset:
        """What every block of a level needs to know of the whole map."""
        return survey_whole(self.windows, self.ambient, height_gain)

    def part(self, block: Block) -> tuple[Target, Nodes, MapBlock]:
        """The nodes of a block, overlaps included, and the map there."""
        part = self.target.part(block.outer_rows, block.outer_columns)
        nodes = locate(part, self.windows, self.ambient)
        return part, nodes, MapBlock(self.windows, self.ambient, nodes)


def strips(
    blocks: Sequence[Sequence[Block]],
    name: str,
    read: Callable[[Block, slice, slice], NDArray[Any]],
) -> Iterator[tuple[Span, NDArray[Any]]]:
    """A variable of a level, in strips of rows from south to north, from that of its blocks.

    `read` gives some rows and columns of a block's values on its outer nodes. Products are blended
    where blocks overlap; all else, which no transform makes, is the block's that owns the node.
    """
    shape = blocks[-1][-1].rows[1], blocks[-1][-1].columns[1]
    for span in row_strips(shape, _STRIP * shape[1]):
        strip: NDArray[Any] | None = None
        for block in itertools.chain.from_iterable(blocks):
            rows = block.outer_rows if name in PRODUCTS else block.rows
            first, last = max(span[0], rows[0]), min(span[1], rows[1])
            if first >= last:
                continue
            part, columns = _part(block, name, (first, last), read)
            if strip is None:
                strip = np.zeros((span[1] - span[0], shape[1]), part.dtype)
            strip[first - span[0] : last - span[0], slice(*columns)] += part
        assert strip is not None
        yield span, strip


def _part(
    block: Block, name: str, rows: Span, read: Callable[[Block, slice, slice], NDArray[Any]]
) -> tuple[NDArray[Any], Span]:
    """What a block adds to some rows of a level, and to which columns."""
    columns = block.outer_columns if name in PRODUCTS else block.columns
    down, across = (
        slice(span[0] - outer[0], span[1] - outer[0])
        for span, outer in zip(
            (rows, columns), (block.outer_rows, block.outer_columns), strict=True
        )
    )
    if name not in PRODUCTS:
        return read(block, down, across), columns
    values = np.array(read(block, down, across))
    below, beside = _ramp(block.rows, block.outer_rows)[down], _ramp(block.columns, columns)
    values[below < 1.0] *= below[below < 1.0, None]
    values[:, beside < 1.0] *= beside[beside < 1.0]
    return values, columns


def _ramp(own: Span, outer: Span) -> Real:
    """By how much a block counts along one axis of its outer nodes; all blocks sum to 1."""
    places = np.arange(*outer) + 0.5
    weight = np.ones(places.size)
    if outer[0] < own[0]:
        reach = own[0] - outer[0]
        weight *= _rise((places - own[0]) / reach)
    if outer[1] > own[1]:
        reach = outer[1] - own[1]
        weight *= 1.0 - _rise((places - own[1]) / reach)
    return weight


def _rise(t: Real) -> Real:
    """From 0 at -1 to 1 at 1, as half a cosine."""
    return np.asarray(0.5 + 0.5 * np.sin(np.pi / 2 * np.clip(t, -1.0, 1.0)))


def _spacing(target: Target) -> tuple[float, float]:
    """Mean node spacing of a target along its rows and columns, metres."""
    down, across = (float(a[-1] - a[0]) / max(a.size - 1, 1) for a in (target.rows, target.columns))
    if target.dims[0] == "y":
        return down, across
    middle = np.radians((target.rows[0] + target.rows[-1]) / 2)
    return _METRES_PER_DEGREE * down, _METRES_PER_DEGREE * across * float(np.cos(middle))
