"""Which gaps of a map the data surround, and which are open to its border."""

from __future__ import annotations

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
from numpy.typing import NDArray
from scipy import ndimage

Mask = NDArray[np.bool_]


class OpenGaps:
    """Tells which gaps are open to the border of a map that is seen strip by strip."""

    def __init__(self) -> None:
        self._counts = [1]  # the outside is the first gap
        self._links: list[NDArray[np.int64]] = []
        self._last: NDArray[np.int64] | None = None

    def add(self, missing: Mask) -> None:
        """The next strip of rows."""
        labels, count = ndimage.label(missing)
        gaps = np.where(missing, labels + (sum(self._counts) - 1), -1).astype(np.int64)
        self._link(0 if self._last is None else self._last, gaps[0])
        self._link(0, gaps[:, 0])
        self._link(0, gaps[:, -1])
        self._counts.append(count)
        self._last = gaps[-1]

    def found(self) -> list[Mask]:
        """For each strip, by label, whether that gap is open; label 0 is no gap."""
        if self._last is not None:
            self._link(0, self._last)
        links, size = np.concatenate(self._links, axis=1), sum(self._counts)
        graph = scipy.sparse.coo_array(
            (np.ones(links.shape[1]), (links[0], links[1])), (size, size)
        )
        group = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
        parts = np.split(group == group[0], np.cumsum(self._counts)[:-1])
        return [np.concatenate([[False], part]) for part in parts[1:]]

    def _link(self, one: NDArray[np.int64] | int, other: NDArray[np.int64]) -> None:
        both = np.stack(np.broadcast_arrays(one, other))
        self._links.append(np.unique(both[:, (both >= 0).all(axis=0)], axis=1))


def classify_gaps(missing: Mask) -> tuple[Mask, Mask]:
    """Split missing nodes into those the data surround (voids) and those open to the border."""
    gaps = OpenGaps()
    gaps.add(missing)
    beyond = gaps.found()[0][ndimage.label(missing)[0]]
    return missing & ~beyond, beyond
