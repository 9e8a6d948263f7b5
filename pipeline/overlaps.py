"""Neighbouring tiles hold the same nodes twice: they must be the same to the bit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.kernels.bspline import HALO

Arrays = Mapping[str, NDArray[Any]]

_SHARED = 2 * HALO + 1
_FIRST, _LAST = slice(None, _SHARED), slice(-_SHARED, None)


class Overlaps:
    """Compares every tile with its neighbours to the west, south-west, south and south-east.

    Tiles come row by row from the south-west; only the strips that later ones share are kept.
    """

    def __init__(self) -> None:
        self.different = 0
        self.compared = 0
        self.where = ""
        self._strips: dict[tuple[int, int], tuple[Arrays, Arrays]] = {}

    def add(self, row: int, column: int, arrays: Arrays) -> None:
        """Compare a tile's arrays (..., latitude, longitude) and keep what it shares."""
        fields = {name: values for name, values in arrays.items() if values.ndim >= 2}
        for name, values in fields.items():
            for (r, c), theirs, ours in (
                ((row, column - 1), (slice(None), _LAST), (slice(None), _FIRST)),
                ((row - 1, column - 1), (_LAST, _LAST), (_FIRST, _FIRST)),
                ((row - 1, column), (_LAST, slice(None)), (_FIRST, slice(None))),
                ((row - 1, column + 1), (_LAST, _FIRST), (_FIRST, _LAST)),
            ):
                if (r, c) in self._strips:
                    east, north = self._strips[r, c]
                    strip = east if r == row else north
                    self._compare(strip[name][..., *theirs], values[..., *ours], name,
                                  f"tiles ({r}, {c}) and ({row}, {column})")  # fmt: skip
        self._strips[row, column] = (
            {name: values[..., _LAST].copy() for name, values in fields.items()},
            {name: values[..., _LAST, :].copy() for name, values in fields.items()},
        )
        for place in [p for p in self._strips if p[0] < row - 1]:
            del self._strips[place]

    def _compare(self, theirs: NDArray[Any], ours: NDArray[Any], name: str, where: str) -> None:
        self.compared += ours.size
        if theirs.shape != ours.shape or theirs.dtype != ours.dtype:
            self.different += ours.size
            self.where = self.where or f"{name} of {where} differs in shape or dtype"
            return
        bits = f"u{ours.dtype.itemsize}"
        same = np.ascontiguousarray(theirs).view(bits) == np.ascontiguousarray(ours).view(bits)
        if not same.all():
            self.different += int(np.count_nonzero(~same))
            self.where = self.where or f"{name} of {where}"
