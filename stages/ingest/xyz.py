"""Regular grids written as text, one node a line: columns x, y, value (EMAG2 and others)."""

from __future__ import annotations

import re
from codecs import BOM_UTF8
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pyproj
from numpy.typing import NDArray
from pyproj.exceptions import CRSError

from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages.ingest.raw import RawGrid, mark_voids
from magtiles.stages.ingest.source import GridFileParams

_NUMBER = re.compile(rb"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|nan|\*", re.IGNORECASE)
_DUMMY = "*"  # Geosoft's, in text
_COMMENT = b"#>/"  # GMT's and Geosoft's
_OFF_NODE = 0.05  # of a step
_LARGEST, _LONGEST = 1 << 31, 1 << 22  # nodes of a grid, and along an axis
_PART_LINES = 1 << 20


def is_xyz(head: bytes) -> bool:
    """Whether text consists, after comments and at most one line of names, of rows of numbers."""
    return b"\x00" not in head and odd_line(head) is None


def odd_line(head: bytes) -> tuple[int, bytes] | None:
    """Number and text of the first line of 50 that should be a row of numbers and is none."""
    lines = [
        (number, line)
        for number, line in enumerate(head.splitlines(), start=1)
        if line.strip() and line.lstrip()[:1] not in _COMMENT
    ]
    complete = lines[:-1] or lines
    if len(complete) > 1 and not _numbers(complete[0][1]):
        complete = complete[1:]
    odd = [(number, line) for number, line in complete[:50] if _numbers(line) < 3]
    return odd[0] if odd else None if complete else (1, head[:50])


def _numbers(line: bytes) -> int:
    """How many columns a line has, if each is a number; else 0."""
    words = _words(line)
    return len(words) if all(_NUMBER.fullmatch(word) for word in words) else 0


def _words(line: bytes) -> list[bytes]:
    return [word for word in re.split(rb"[\s,;]+", line.removeprefix(BOM_UTF8).strip()) if word]


def read_xyz(path: Path, params: GridFileParams) -> RawGrid:
    """A regular grid from lines in any order; nodes without a line are voids.

    The text is read twice, for the axes and for the values: no more of it is in memory than a
    million lines.

    Raises FormatError naming the line for text that is no number, a node off the lattice or
    given twice; SourceError for columns that are not there.
    """
    _refuse_cut(path)
    lines = _Lines.of(path, params.all_columns)
    coordinates, count = _coordinates(lines, params.all_columns[:2])
    west = _western_end(coordinates[0]) if _geographic(params.crs) else -np.inf
    x = _Axis.through(_eastward(coordinates[0], west), path, "x")
    y = _Axis.through(coordinates[1], path, "y")
    if x.size * y.size > min(_LARGEST, 64 * count + 64):
        raise FormatError(
            f"{count} lines make a lattice of {x.size} x {y.size}",
            where=path,
            expected="a regular grid, most of its nodes present",
            remedy="grid the points first",
        )
    maps = [np.full((y.size, x.size), np.nan) for _ in params.all_columns[2:]]
    given = np.zeros(x.size * y.size, dtype=np.bool_)
    for first_line, part in lines.parts(params.all_columns):
        columns = x.places(_eastward(part[:, 0], west), path, first_line)
        node = y.places(part[:, 1], path, first_line) * x.size + columns
        _refuse_repeated(node, given, path, first_line)
        for values, column in zip(maps, part[:, 2:].T, strict=True):
            values.flat[node] = mark_voids(column, params.no_data)
    uncertainty = maps[1] if len(maps) > 1 else None
    return RawGrid(maps[0], x.nodes, y.nodes, None, uncertainty=uncertainty)


@dataclass(frozen=True)
class _Lines:
    """The lines of numbers of a text, of which the first comes after so many others."""

    path: Path
    skipped: int
    separator: str

    @classmethod
    def of(cls, path: Path, columns: Sequence[int]) -> _Lines:
        """Raises SourceError for columns (counted from 1) that are not there."""
        skipped, head = _leading(path)
        available = len(_words(head))
        if max(columns) > available:
            raise SourceError(
                f"column {max(columns)} is asked for, but line {skipped + 1} has {available}",
                where=path,
                remedy="correct the key 'columns' or 'uncertainty_column', counted from 1",
            )
        return cls(path, skipped, ";" if b";" in head else "," if b"," in head else r"\s+")

    def parts(self, columns: Sequence[int]) -> Iterator[tuple[int, NDArray[np.float64]]]:
        """Number of the first line of a part, and its columns (lines, columns)."""
        wanted = [column - 1 for column in columns]
        first_line = self.skipped + 1
        try:
            with pd.read_csv(
                self.path,
                sep=self.separator,
                header=None,
                skiprows=self.skipped,
                usecols=sorted(set(wanted)),
                comment="#",
                na_values=[_DUMMY],
                dtype=np.float64,
                skipinitialspace=True,
                encoding="utf-8-sig",
                encoding_errors="replace",
                chunksize=_PART_LINES,
            ) as frames:
                for frame in frames:
                    yield first_line, frame[wanted].to_numpy()
                    first_line += len(frame)
        except (ValueError, pd.errors.ParserError) as caught:
            raise FormatError(f"a line is not numbers: {caught}", where=self.path) from None


def _coordinates(lines: _Lines, columns: Sequence[int]) -> tuple[list[NDArray[np.float64]], int]:
    """All different x and y, ascending, and how many lines there are."""
    distinct = [np.empty(0), np.empty(0)]
    count = 0
    for first_line, part in lines.parts(columns):
        finite = np.isfinite(part).all(axis=1)
        if not finite.all():
            raise FormatError(
                "a coordinate is missing",
                where=f"{lines.path} line {first_line + int(np.argmin(finite))}",
                remedy="the file is truncated or damaged: fetch it again",
            )
        distinct = [np.union1d(d, values) for d, values in zip(distinct, part.T, strict=True)]
        count += len(part)
        if max(d.size for d in distinct) > _LONGEST:
            raise FormatError(
                f"the first {count} lines have more than {_LONGEST} different x or y",
                where=lines.path,
                expected="a regular grid along x and y",
                remedy="grid the points first",
            )
    return distinct, count


def _leading(path: Path) -> tuple[int, bytes]:
    """How many lines come before the data (comments, names), and the first line of data."""
    with path.open("rb") as file:
        for number, line in enumerate(file):
            if _numbers(line):
                return number, line
    raise FormatError("no line of numbers", where=path)


def _refuse_cut(path: Path) -> None:
    """Raise FormatError where the last line has fewer columns than the first of the data."""
    _, first = _leading(path)
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 4 * len(first) - 4096))
        last = [line for line in file.read().splitlines() if line.strip()][-1]
    if len(_words(last)) < len(_words(first)) and not last.lstrip().startswith(b"#"):
        raise FormatError(
            f"the last line has {len(_words(last))} columns",
            where=path,
            expected=f"{len(_words(first))}, as the first has",
            remedy="the file is truncated: fetch it again",
        )


def _geographic(crs: str | None) -> bool:
    try:
        return crs is not None and pyproj.CRS.from_user_input(crs).is_geographic
    except CRSError:
        return False  # which is said where the CRS is used


def _western_end(longitudes: NDArray[np.float64]) -> float:
    """Where a region across the date line begins; -inf for what is in one piece, degrees."""
    turn = 360.0 - (longitudes[-1] - longitudes[0])
    steps = np.diff(longitudes)
    if steps.size == 0 or steps.max() <= max(turn, 180.0):
        return -np.inf
    return float(longitudes[np.argmax(steps) + 1])


def _eastward(x: NDArray[np.float64], west: float) -> NDArray[np.float64]:
    """Longitudes that count on above 180 east of the date line; anything else as it is."""
    return np.where(x < west, x + 360.0, x)


@dataclass(frozen=True)
class _Axis:
    """A regular axis, ascending."""

    name: str
    first: float
    step: float
    size: int

    @classmethod
    def through(cls, values: NDArray[np.float64], path: Path, name: str) -> _Axis:
        """The axis of nodes at values that are rounded; some may be absent."""
        distinct = np.unique(values)
        steps = np.diff(distinct)
        usual = float(steps.max(initial=0.0))
        if usual == 0.0:
            raise FormatError(f"only one {name}", where=path, expected="at least 2 nodes along it")
        # Rounded coordinates of one node may differ a little.
        step = float(np.median(steps[steps > 0.5 * np.median(steps[steps > 1e-3 * usual])]))
        length = float(distinct[-1] - distinct[0])
        cells = max(1, round(length / step))
        return cls(name, float(distinct[0]), length / cells, cells + 1)

    @property
    def nodes(self) -> NDArray[np.float64]:
        """Coordinates of the nodes."""
        return self.first + self.step * np.arange(self.size, dtype=np.float64)

    def places(self, values: NDArray[np.float64], path: Path, first_line: int) -> NDArray[np.int64]:
        """Which node each line is at. Raises FormatError naming the line that is at none."""
        place = (values - self.first) / self.step
        index = np.rint(place).astype(np.int64)
        off = np.abs(place - index)
        if off.max() > _OFF_NODE:
            line = int(np.argmax(off > _OFF_NODE))
            raise FormatError(
                f"{self.name} = {values[line]:.10g} is no node: {off[line]:.2f} of a step of "
                f"{self.step:g} away",
                where=f"{path} line {first_line + line}",
                expected="equal steps",
                remedy="grid the points first",
            )
        return index


def _refuse_repeated(
    node: NDArray[np.int64], given: NDArray[np.bool_], path: Path, first_line: int
) -> None:
    """Mark nodes as given. Raises FormatError naming the first line whose node was."""
    again = given[node]
    _, first = np.unique(node, return_index=True)
    if first.size < node.size:
        within = np.ones(node.size, dtype=np.bool_)
        within[first] = False
        again |= within
    if again.any():
        raise FormatError(
            "the node was given before",
            where=f"{path} line {first_line + int(np.argmax(again))}",
            expected="each node once",
        )
    given[node] = True
