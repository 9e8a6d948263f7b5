"""Lines of a text file as bytes: where they begin and end, and whether each is whole."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError

_LOG = logging.getLogger(__name__)

_NEWLINE, _RETURN, _QUOTE = b"\n"[0], b"\r"[0], b'"'[0]
_BLANKS = np.frombuffer(b" \t\r\x1a", dtype=np.uint8)


@dataclass(frozen=True)
class Lines:
    """The lines of a file that are not blank.

    Attributes
    ----------
    data : (bytes,) of the file.
    start, stop : (n,) where each line begins and ends, without its line break.
    number : (n,) counted from 1, blank lines included.
    where : the file's name.
    ended : whether the last line has a line break.
    """

    data: NDArray[np.uint8]
    start: NDArray[np.int64]
    stop: NDArray[np.int64]
    number: NDArray[np.int64]
    where: str
    ended: bool

    @property
    def length(self) -> NDArray[np.int64]:
        """Bytes of each line (n,)."""
        return self.stop - self.start

    def text(self, row: int) -> str:
        """One line."""
        return self.data[self.start[row] : self.stop[row]].tobytes().decode("latin-1")

    def select(self, rows: slice | NDArray[np.bool_]) -> Lines:
        """Some of the lines."""
        return Lines(
            self.data, self.start[rows], self.stop[rows], self.number[rows], self.where, self.ended
        )

    def joined(self) -> bytes:
        """All lines as one text."""
        if self.number[-1] - self.number[0] + 1 == self.number.size:
            return self.data[self.start[0] : self.stop[-1]].tobytes()
        pairs = zip(self.start, self.stop, strict=True)
        return b"\n".join(self.data[a:b].tobytes() for a, b in pairs)

    def count(self, byte: int) -> NDArray[np.int64]:
        """How often a byte occurs in each line (n,)."""
        places = np.flatnonzero(self.data == byte)
        begin, end = (np.searchsorted(places, at) for at in (self.start, self.stop))
        return np.asarray(end - begin, dtype=np.int64)

    @property
    def quoted(self) -> bool:
        """Whether any quotation mark occurs, so that separators may be part of a value."""
        return bool((self.data == _QUOTE).any())

    def block(self, width: int) -> NDArray[np.uint8]:
        """The first `width` bytes of every line (n, width), blanks where it is shorter."""
        at = self.start[:, None] + np.arange(width)
        inside = at < self.stop[:, None]
        return np.where(inside, self.data[np.where(inside, at, 0)], b" "[0]).astype(np.uint8)


def read_lines(path: Path, where: str) -> Lines:
    """The lines of a file. Raises FormatError for one without any, or of binary data."""
    data = np.fromfile(path, dtype=np.uint8)
    if not data.size:
        raise FormatError("the file is empty", where=where, remedy="fetch it again")
    if (data == 0).any():
        raise FormatError(
            "holds binary data", where=f"{where} byte {int(np.argmax(data == 0))}", expected="text"
        )
    breaks = np.flatnonzero(data == _NEWLINE)
    ended = bool(data.size and data[-1] == _NEWLINE)
    ends = breaks if ended else np.append(breaks, data.size)
    start = np.concatenate([[0], ends[:-1] + 1]) if ends.size else np.zeros(0, np.int64)
    stop = np.asarray(ends, dtype=np.int64).copy()
    returned = (stop > start) & (data[np.maximum(stop - 1, 0)] == _RETURN)
    stop[returned] -= 1
    filled = stop > start
    blank = np.isin(data[np.minimum(start, data.size - 1)], _BLANKS) & filled
    for row in np.flatnonzero(blank):
        filled[row] = bool(data[start[row] : stop[row]].tobytes().strip(b" \t\r\x1a"))
    lines = Lines(data, start, stop, np.arange(1, stop.size + 1), where, ended).select(filled)
    if not lines.number.size:
        raise FormatError("holds no lines", where=where, remedy="fetch it again")
    return lines


def whole(lines: Lines, short: NDArray[np.bool_], found: NDArray[np.int64], expected: str) -> Lines:
    """The lines without a truncated last one.

    Parameters
    ----------
    short : (n,) which lines are truncated.
    found : (n,) what each has, in the words of `expected`, such as ``12 fields``.

    Raises FormatError naming the first short line that is not the last.
    """
    if not short.any():
        return lines
    row = int(np.argmax(short))
    noun = expected.split()[-1]
    if row < short.size - 1:
        raise FormatError(
            f"the line is truncated: {found[row]} {noun}",
            where=f"{lines.where} line {lines.number[row]}",
            expected=expected,
            remedy="fetch the file again, or remove the line",
        )
    _LOG.warning(
        "%s: truncated: line %d has %d %s of %s; kept %d lines before it",
        lines.where, lines.number[row], found[row], noun, expected, row,
    )  # fmt: skip
    return lines.select(~short)
