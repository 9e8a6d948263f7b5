"""Which rows of a log break the order of time."""

from __future__ import annotations

import bisect
import itertools

import numpy as np
from numpy.typing import NDArray

from magtiles.stages.vehicle.positions import Times


def out_of_order(recorded: Times, run: NDArray[np.int64] | None) -> NDArray[np.bool_]:
    """Rows (n,) whose time is doubtful: without them time strictly ascends.

    Parameters
    ----------
    recorded : (n,) times in the order of recording.
    run : (n,) changes where rows do not follow those before them, as at a survey's next line;
        in each run the fewest rows are taken that break its order, and of two runs with one time
        the later row. None where a clock ran along: all that an earlier row had overtaken.
    """
    late = np.zeros(recorded.size, dtype=bool)
    if run is None:
        latest = np.maximum.accumulate(recorded)
        late[1:] = recorded[1:] <= latest[:-1]
        return late
    for begin, end in itertools.pairwise([0, *(np.flatnonzero(np.diff(run)) + 1), recorded.size]):
        late[begin:end] = ~longest_ascent(recorded[begin:end].astype(np.int64))
    rows = np.flatnonzero(~late)
    rows = rows[np.argsort(recorded[rows], kind="stable")]
    late[rows[1:][recorded[rows[1:]] == recorded[rows[:-1]]]] = True
    return late


def longest_ascent(values: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Members (n,) of a longest strictly ascending subsequence (Schensted 1961)."""
    member = np.ones(values.size, dtype=bool)
    if (np.diff(values) > 0).all():
        return member
    ends: list[int] = []  # the least value that ends an ascent of each length,
    rows: list[int] = []  # and where it stands
    before = np.full(values.size, -1, dtype=np.int64)
    for row, value in enumerate(values.tolist()):
        length = bisect.bisect_left(ends, value)
        before[row] = rows[length - 1] if length else -1
        ends[length : length + 1] = [value]
        rows[length : length + 1] = [row]
    member[:] = False
    row = rows[-1]
    while row >= 0:
        member[row] = True
        row = int(before[row])
    return member
