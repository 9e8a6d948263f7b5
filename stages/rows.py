"""Grids larger than memory: rows that are made when they are wanted, a strip at a time.

An array of one strip is simply made. A larger one is a dask array, of which the machine holds one
strip at a time while it writes them to a file.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import numpy as np
import xarray as xr
from numpy.typing import DTypeLike, NDArray

Span = tuple[int, int]

STRIP_NODES = 1 << 21


class Rows(Protocol):
    """Values (rows, columns) of which slices of rows can be had: an array, or one in a file."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns."""

    def __getitem__(self, rows: slice, /) -> NDArray[np.float64]:
        """Some of the rows."""


def strips(shape: tuple[int, ...], nodes: int | None = None) -> list[Span]:
    """First row, and the one behind the last, of strips of at most so many nodes (or one row)."""
    rows = max(1, (nodes or STRIP_NODES) // shape[1])
    return list(itertools.pairwise([*range(0, shape[0], rows), shape[0]]))


def in_strips(values: Rows) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """The first row of each strip, and the strip."""
    for first, last in strips(values.shape):
        yield first, values[first:last]


def by_rows(
    shape: tuple[int, ...],
    dtype: DTypeLike,
    make: Callable[[int, int], NDArray[Any]],
    nodes: int | None = None,
) -> Any:
    """An array (rows, columns) of which `make(first, last)` makes the rows, `nodes` at a time."""
    spans = strips(shape, nodes)
    if len(spans) == 1:
        return make(0, shape[0])
    import dask
    import dask.array

    late = dask.delayed(make, pure=False)
    parts = [
        dask.array.from_delayed(late(*span), (span[1] - span[0], shape[1]), dtype) for span in spans
    ]
    return dask.array.concatenate(parts)


def rows_of(grid: xr.Dataset, first: int, last: int) -> xr.Dataset:
    """Some of the rows of a grid."""
    return grid.isel({grid["magnetic_anomaly"].dims[0]: slice(first, last)})
