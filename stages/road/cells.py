"""Equal cells of distance: what the samples of a pass say of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Cells:
    """Cells of `spacing` m about the distances first * spacing, (first + 1) * spacing, ...

    `cell` (n,) is the cell of each sample, counted from the first.
    """

    spacing: float
    first: int
    count: int
    cell: NDArray[np.intp]

    @property
    def distance(self) -> Real:
        """Of the middle of each cell (count,), m."""
        return self.spacing * (self.first + np.arange(self.count, dtype=np.float64))

    @property
    def samples(self) -> NDArray[np.int32]:
        """How many samples each cell has (count,)."""
        return np.bincount(self.cell, minlength=self.count).astype(np.int32)

    def mean(self, values: Real) -> Real:
        """Mean (count, ...) of the samples' finite values (n, ...); NaN in empty cells."""
        columns = values.reshape(len(values), -1)
        out = np.full((self.count, columns.shape[1]), np.nan)
        for i, column in enumerate(columns.T):
            good = np.isfinite(column)
            number = np.bincount(self.cell[good], minlength=self.count)
            total = np.bincount(self.cell[good], column[good], minlength=self.count)
            np.divide(total, number, out=out[:, i], where=number > 0)
        return out.reshape(self.count, *values.shape[1:])

    def any(self, mask: Mask) -> Mask:
        """Whether a cell has a sample of which `mask` (n,) is true."""
        return np.asarray(np.bincount(self.cell[mask], minlength=self.count) > 0)


def cells_of(distance: Real, spacing: float, *, low: float, high: float) -> tuple[Cells, Mask]:
    """The cells that samples at `distance` (n,) m fill, and which samples lie in them.

    Samples further than half a cell outside `low` to `high` are left out. The cells go from
    the first that has a sample to the last.
    """
    number = np.floor(distance / spacing + 0.5)
    ends = np.floor(low / spacing + 0.5), np.floor(high / spacing + 0.5)
    inside = np.isfinite(number) & (number >= ends[0]) & (number <= ends[1])
    kept = number[inside].astype(np.intp)
    first = int(kept.min()) if kept.size else 0
    count = int(kept.max()) - first + 1 if kept.size else 0
    return Cells(spacing, first, count, kept - first), inside


def filled(distance: Real, values: Real) -> Real:
    """`values` (m, k) with its NaN rows linear between their neighbours."""
    good = np.isfinite(values).all(axis=1)
    columns = [np.interp(distance, distance[good], column[good]) for column in values.T]
    return np.column_stack(columns)


def between_sparse_samples(cells: Cells, distance: Real, limit_m: float) -> Mask:
    """Cells (count,) between successive samples (n,) more than `limit_m` apart along the road.

    Shockley (2012, 4.2.4): a feature some 10 m long needs a sample at least every 3 m, so
    that the rate must follow the speed.
    """
    wide = np.flatnonzero(np.abs(np.diff(distance)) > limit_m)
    ends = np.sort(np.stack([cells.cell[wide], cells.cell[wide + 1]]), axis=0)
    change = np.zeros(cells.count + 1, dtype=np.intp)
    np.add.at(change, ends[0], 1)
    np.add.at(change, ends[1] + 1, -1)
    return np.asarray(np.cumsum(change)[:-1] > 0)
