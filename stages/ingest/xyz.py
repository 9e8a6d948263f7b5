"""Regular grids written as text, one node a line: columns x, y, value (EMAG2 and others)."""

from __future__ import annotations

import re
from codecs import BOM_UTF8
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
_LARGEST = 1 << 31  # nodes


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

    Raises FormatError naming the line for text that is no number, a node off the lattice or
    given twice; SourceError for columns that are not there.
    """
    _refuse_cut(path)
    table, first_line = _table(path, list(params.all_columns))
    if _geographic(params.crs):
        table[:, 0] = _in_one_piece(table[:, 0])
    x, columns_of = _axis(table[:, 0], path, first_line, "x")
    y, rows_of = _axis(table[:, 1], path, first_line, "y")
    if x.size * y.size > _LARGEST or x.size * y.size > 64 * len(table) + 64:
        raise FormatError(
            f"{len(table)} lines make a lattice of {x.size} x {y.size}",
            where=path,
            expected="a regular grid, most of its nodes present",
            remedy="grid the points first",
        )
    node = rows_of * x.size + columns_of
    _refuse_repeated(node, path, first_line)
    shape = y.size, x.size
    maps = []
    for column in table[:, 2:].T:
        values = np.full(shape, np.nan)
        values.flat[node] = mark_voids(column, params.no_data)
        maps.append(values)
    return RawGrid(maps[0], x, y, None, uncertainty=maps[1] if len(maps) > 1 else None)


def _table(path: Path, columns: list[int]) -> tuple[NDArray[np.float64], int]:
    """The wanted columns (lines, columns), and the number of the first line of data."""
    skipped, head = _leading(path)
    separator = ";" if b";" in head else "," if b"," in head else r"\s+"
    available = len(_words(head))
    if max(columns) > available:
        raise SourceError(
            f"column {max(columns)} is asked for, but line {skipped + 1} has {available}",
            where=path,
            remedy="correct the key 'columns' or 'uncertainty_column', counted from 1",
        )
    try:
        frame = pd.read_csv(
            path,
            sep=separator,
            header=None,
            skiprows=skipped,
            usecols=sorted({c - 1 for c in columns}),
            comment="#",
            na_values=[_DUMMY],
            dtype=np.float64,
            skipinitialspace=True,
            encoding="utf-8-sig",
            encoding_errors="replace",
        )
    except (ValueError, pd.errors.ParserError) as caught:
        raise FormatError(f"a line is not numbers: {caught}", where=path) from None
    table = frame[[c - 1 for c in columns]].to_numpy()
    if not np.isfinite(table[:, :2]).all():
        line = int(np.argmin(np.isfinite(table[:, :2]).all(axis=1)))
        raise FormatError(
            "a coordinate is missing",
            where=f"{path} line {skipped + 1 + line}",
            remedy="the file is truncated or damaged: fetch it again",
        )
    return table, skipped + 1


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


def _in_one_piece(longitude: NDArray[np.float64]) -> NDArray[np.float64]:
    """Longitudes of a region across the date line count on above 180, degrees."""
    distinct = np.unique(longitude)
    turn = 360.0 - (distinct[-1] - distinct[0])
    steps = np.diff(distinct)
    if steps.size == 0 or steps.max() <= max(turn, 180.0):
        return longitude
    east = distinct[np.argmax(steps) + 1]
    return np.where(longitude < east, longitude + 360.0, longitude)


def _axis(
    values: NDArray[np.float64], path: Path, first_line: int, name: str
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Nodes of a regular axis, ascending, and which of them each line is at."""
    distinct = np.unique(values)
    steps = np.diff(distinct)
    usual = float(steps.max(initial=0.0))
    if usual == 0.0:
        raise FormatError(f"only one {name}", where=path, expected="at least 2 nodes along it")
    # Rounded coordinates of one node may differ a little, and some nodes may be absent.
    step = float(np.median(steps[steps > 0.5 * np.median(steps[steps > 1e-3 * usual])]))
    step = (distinct[-1] - distinct[0]) / max(1, round((distinct[-1] - distinct[0]) / step))
    place = (values - distinct[0]) / step
    index = np.rint(place).astype(np.int64)
    off = np.abs(place - index)
    if off.max() > _OFF_NODE:
        line = int(np.argmax(off > _OFF_NODE))
        raise FormatError(
            f"{name} = {values[line]:.10g} is no node: {off[line]:.2f} of a step of {step:g} away",
            where=f"{path} line {first_line + line}",
            expected="equal steps",
            remedy="grid the points first",
        )
    return distinct[0] + step * np.arange(index.max() + 1), index


def _refuse_repeated(node: NDArray[np.int64], path: Path, first_line: int) -> None:
    order = np.argsort(node, kind="stable")
    repeated = np.flatnonzero(np.diff(node[order]) == 0)
    if repeated.size:
        line = int(order[repeated[0] + 1])
        raise FormatError(
            "the node was given before", where=f"{path} line {first_line + line}",
            expected="each node once",
        )  # fmt: skip
