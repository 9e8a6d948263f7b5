"""Where the records of a decompressed chunk lie, compiled by numba."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

_MESSAGE = 5
_HEAD = 9  # opcode u1, length u8
_FIXED = 22  # channel u2, sequence u4, log time u8, publish time u8


@njit(cache=True, nogil=True, inline="always")
def _number(data: NDArray[np.uint8], at: int, size: int) -> Any:
    """The little-endian unsigned number of `size` bytes."""
    value = np.uint64(0)
    for byte in range(size):
        value |= np.uint64(data[at + byte]) << np.uint64(8 * byte)
    return value


@njit(cache=True, nogil=True)
def count_records(data: NDArray[np.uint8]) -> tuple[int, int, int]:
    """How many messages and other records, and where the first one that overruns starts (or -1)."""
    messages, others, at, end = 0, 0, 0, data.size
    while at < end:
        if end - at < _HEAD:
            return messages, others, at
        length = _number(data, at + 1, 8)
        if length > np.uint64(end - at - _HEAD):
            return messages, others, at
        if data[at] == _MESSAGE:
            if length < np.uint64(_FIXED):
                return messages, others, at
            messages += 1
        else:
            others += 1
        at += _HEAD + int(length)
    return messages, others, -1


@njit(cache=True, nogil=True)
def walk_messages(data: NDArray[np.uint8], messages: int, others: int) -> tuple[Any, ...]:
    """Channel, log time, start and stop of each message's payload, as `count_records` counted.

    The last answer is (others, 3): start, opcode and length of each other record's content.
    """
    channel = np.empty(messages, np.uint16)
    log_time = np.empty(messages, np.int64)
    start = np.empty(messages, np.int64)
    stop = np.empty(messages, np.int64)
    other = np.empty((others, 3), np.int64)
    at, row, rest = 0, 0, 0
    while at < data.size:
        length = np.int64(_number(data, at + 1, 8))
        content = at + _HEAD
        if data[at] == _MESSAGE:
            channel[row] = _number(data, content, 2)
            log_time[row] = np.int64(_number(data, content + 6, 8))
            start[row] = content + _FIXED
            stop[row] = content + length
            row += 1
        else:
            other[rest, 0], other[rest, 1], other[rest, 2] = content, data[at], length
            rest += 1
        at = int(content + length)
    return channel, log_time, start, stop, other
