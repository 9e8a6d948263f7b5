"""Columns from many CDR messages of one type at once (OMG CDR, as ROS 2 writes it).

The layout of a message depends on its strings and sequences, so every field is stepped over for
all messages together: an array of offsets, one for each, moves on from field to field.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError
from magtiles.stages.ingest.log.rosmsg import PRIMITIVES, Leaf

_HEADER_BYTES = 4
_ORDERS = {0: ">", 1: "<"}  # big- and little-endian plain CDR
_PADDING = 3
"""Writers may fill a payload up to a multiple of four bytes."""

Offsets = NDArray[np.int64]


class CdrDecoder:
    """Decodes named fields of one message type.

    Parameters
    ----------
    layout : the type's fields in order.
    paths : the fields wanted; arrays of fixed length give (n, length).
    where : what messages begin with, such as the file and topic.

    Raises
    ------
    FormatError : a path is not in the layout, or not of numbers, or beyond a sequence of messages.
    """

    def __init__(self, layout: tuple[Leaf, ...], paths: Collection[str], where: str) -> None:
        self._layout, self._wanted, self._where = layout, set(paths), where
        known = {leaf.path: leaf for leaf in layout}
        for path in paths:
            leaf = known.get(path)
            if leaf is None or leaf.type not in PRIMITIVES or leaf.count is None:
                numbers = [p for p, f in known.items() if f.type in PRIMITIVES and f.count]
                raise FormatError(
                    f"messages have no numeric field '{path}'",
                    where=where,
                    expected=f"one of {', '.join(numbers) or 'none'}",
                )

    def __call__(
        self, data: NDArray[np.uint8], start: Offsets, stop: Offsets
    ) -> Mapping[str, NDArray[Any]]:
        """Columns of the messages that lie at [start, stop) of `data`.

        Raises FormatError naming the first message that is shorter or longer than its type.
        """
        order = self._order(data, start, stop)
        base = start + _HEADER_BYTES
        at = base.copy()
        columns: dict[str, NDArray[Any]] = {}
        for leaf in self._layout:
            if leaf.sequence_of_messages or leaf.type == "wstring":
                self._refuse_rest(leaf, columns)
                return columns
            at = self._step(leaf, _View(data, order, stop, self._where), base, at, columns)
        wrong = (at > stop) | (at + _PADDING < stop)
        if wrong.any():
            first = int(np.argmax(wrong))
            raise FormatError(
                f"a message has {stop[first] - start[first]} bytes",
                where=f"{self._where} message {first} of its chunk",
                expected=f"{at[first] - start[first]} by its schema",
                remedy="the schema does not describe what was recorded",
            )
        return columns

    def _order(self, data: NDArray[np.uint8], start: Offsets, stop: Offsets) -> str:
        if (stop - start < _HEADER_BYTES).any():
            raise FormatError("a message is shorter than a CDR header", where=self._where)
        kinds = np.unique(data[start].astype(np.int64) << 8 | data[start + 1])
        if kinds.size > 1 or int(kinds[0]) not in _ORDERS:
            raise FormatError(
                f"messages have the CDR encapsulation {', '.join(f'{k:#06x}' for k in kinds)}",
                where=self._where,
                expected="plain CDR, 0x0000 or 0x0001, for all",
            )
        return _ORDERS[int(kinds[0])]

    def _step(
        self, leaf: Leaf, view: _View, base: Offsets, at: Offsets, columns: dict[str, NDArray[Any]]
    ) -> Offsets:
        """Past one field; where it is wanted, its column is taken on the way."""
        number = "u4" if leaf.type == "string" else PRIMITIVES[leaf.type]
        count = leaf.count
        length: Offsets | int = 1 if count is None else count
        if count is None:
            at = _aligned(at, base, 4)
            length = view.gather(at, "u4", 1).astype(np.int64)
            at = at + 4
        if leaf.type == "string":
            if count != 1:
                return self._past_strings(view, base, at, length)
            at = _aligned(at, base, 4)
            return at + 4 + view.gather(at, "u4", 1).astype(np.int64)
        size = np.dtype(number).itemsize
        if count is not None or np.any(length):  # an empty sequence is not aligned
            at = np.where(np.asarray(length) > 0, _aligned(at, base, size), at)
        if leaf.path in self._wanted and count is not None:
            columns[leaf.path] = view.gather(at, number, count)
        return at + size * length

    def _past_strings(
        self, view: _View, base: Offsets, at: Offsets, length: Offsets | int
    ) -> Offsets:
        left = np.broadcast_to(np.asarray(length), at.shape).copy()
        at = at.copy()
        while (some := np.flatnonzero(left > 0)).size:
            here = _aligned(at[some], base[some], 4)
            at[some] = here + 4 + view.of(some).gather(here, "u4", 1)
            left[some] -= 1
        return at

    def _refuse_rest(self, leaf: Leaf, columns: Mapping[str, NDArray[Any]]) -> None:
        missing = sorted(self._wanted - columns.keys())
        if missing:
            raise FormatError(
                f"the field '{missing[0]}' stands behind '{leaf.path}', whose size varies",
                where=self._where,
                expected="fields before any sequence of messages or wide string",
            )


def _aligned(at: Offsets, base: Offsets, size: int) -> Offsets:
    # Alignment counts from the end of the encapsulation header.
    return at + (base - at) % size


class _View:
    """The bytes of all messages, with the end of each."""

    def __init__(self, data: NDArray[np.uint8], order: str, stop: Offsets, where: str) -> None:
        self._data, self._order, self._stop, self._where = data, order, stop, where

    def of(self, rows: NDArray[np.intp]) -> _View:
        return _View(self._data, self._order, self._stop[rows], self._where)

    def gather(self, at: Offsets, number: str, count: int) -> NDArray[Any]:
        """`count` numbers at each offset: (n,) for one, else (n, count)."""
        dtype = np.dtype(self._order + number)
        size = dtype.itemsize * count
        short = at + size > self._stop
        if short.any():
            first = int(np.argmax(short))
            raise FormatError(
                f"a message ends {int(at[first] + size - self._stop[first])} bytes before a field",
                where=f"{self._where} message {first} of its chunk",
                remedy="the schema does not describe what was recorded",
            )
        if not size or not at.size:
            return np.zeros((at.size, count), dtype.newbyteorder("="))
        step = np.diff(at)
        if at.size > 1 and (step == step[0]).all():  # evenly laid out: no gathering
            rows = as_strided(self._data[at[0] :], (at.size, size), (int(step[0]), 1))
        else:
            every = as_strided(self._data, (self._data.size - size + 1, size), (1, 1))
            rows = every[at]
        values = np.ascontiguousarray(rows).view(dtype).astype(dtype.newbyteorder("="))
        return values[:, 0] if count == 1 else values
