"""Faults of a magnetometer in a series of samples: spikes, steps, values that are stuck.

A magnetic storm moves the field by hundreds of nT, but from sample to sample; a fault leaves and
returns, or stays, within one. Sizes are therefore judged by how far neighbouring samples differ
at the time, not by how far the field is from its level.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]
Bools = NDArray[np.bool_]

_BLOCK = 60  # samples that a local scale is taken from
_WIDEST_SPIKE = 3  # samples
_SIDE = 10  # samples on either side of a step
_PERSISTS = 0.7
_OTHERS = 0.25
_MOVES = 10.0


def local_scale(values: Real) -> Real:
    """How much neighbouring samples differ around each sample (n,): robust, of one sigma.

    The largest of three neighbouring blocks' median of |first difference|: large throughout a
    storm, and not moved by single faults.
    """
    differences = np.abs(np.diff(values, append=np.nan))
    count = -(-values.size // _BLOCK)
    padded = np.full(count * _BLOCK, np.nan)
    padded[: values.size] = differences
    blocks = padded.reshape(count, _BLOCK)
    known = np.isfinite(blocks).any(axis=1)
    scale = np.zeros(count)
    scale[known] = 1.4826 * np.nanmedian(blocks[known], axis=1)
    wide = np.pad(scale, 1)
    scale = np.maximum(scale, np.maximum(wide[:-2], wide[2:]))
    return np.repeat(scale, _BLOCK)[: values.size]


def find_spikes(values: Real, threshold: float, floor: float) -> Bools:
    """Samples (n,) of excursions of up to three that leave and return at once.

    All samples of an excursion lie beyond both neighbours by `threshold` local scales and by
    `floor` in the unit of the values.
    """
    least = np.maximum(threshold * local_scale(values), floor)
    found = np.zeros(values.shape, np.bool_)
    for width in range(1, _WIDEST_SPIKE + 1):
        if values.size < width + 2:
            break
        runs = np.lib.stride_tricks.sliding_window_view(values, width)[1:-1]
        before, after = values[: -width - 1], values[width + 1 :]
        with np.errstate(invalid="ignore"):
            above = runs.min(axis=1) - np.maximum(before, after)
            below = np.minimum(before, after) - runs.max(axis=1)
            hits = np.flatnonzero(np.maximum(above, below) > least[1:-width])
        for offset in range(1, width + 1):
            found[hits + offset] = True
    return found


def find_steps(
    values: Real, others: Sequence[Real], threshold: float, floor: float
) -> tuple[NDArray[np.int64], Real]:
    """First samples of new levels, and their heights.

    From one sample to the next the values move by `threshold` local scales and by `floor`, at
    least 70 % of it stays (medians of ten samples on either side), and none of the `others` moves
    by a quarter as much: a sudden commencement builds up over minutes, and in all elements.
    """
    jumps = np.diff(values, prepend=np.nan)
    least = np.maximum(threshold * local_scale(values), floor)
    with np.errstate(invalid="ignore"):
        candidates = np.flatnonzero(np.abs(jumps) > least)
    at, heights = [], []
    for i in candidates:
        before, after = values[max(0, i - _SIDE) : i], values[i : i + _SIDE]
        if min(np.isfinite(before).sum(), np.isfinite(after).sum()) < _SIDE // 2:
            continue
        height = float(np.nanmedian(after) - np.nanmedian(before))
        size = abs(jumps[i])
        stays = height * np.sign(jumps[i]) > _PERSISTS * size and size > _PERSISTS * abs(height)
        if stays and not any(abs(o[i] - o[i - 1]) > _OTHERS * size for o in others):
            at.append(int(i))
            heights.append(height)
    return np.array(at, np.int64), np.array(heights)


def find_stuck(values: Real, others: Sequence[Real], shortest: int) -> Bools:
    """Samples (n,) that repeat one value `shortest` times or more while the field moves.

    It moves where another element changes by more than ten times this one's resolution; where all
    are constant, all are stuck.
    """
    found = np.zeros(values.shape, np.bool_)
    steps = np.abs(np.diff(values))
    moved = steps[steps > 0]
    resolution = float(moved.min()) if moved.size else 0.0
    begins = np.flatnonzero(np.append(True, steps != 0.0))  # a NaN difference ends a run, too
    lengths = np.diff(np.append(begins, values.size))
    for begin, length in zip(
        begins[lengths >= shortest], lengths[lengths >= shortest], strict=True
    ):
        run = slice(begin, begin + length)
        ranges = [
            np.nanmax(o[run]) - np.nanmin(o[run]) for o in others if np.isfinite(o[run]).any()
        ]
        if np.isfinite(values[begin]) and (
            any(r > _MOVES * resolution for r in ranges) or all(r == 0.0 for r in ranges)
        ):
            found[run] = True
    return found
