"""Rows of degree, order and numbers, as every text format of coefficients has them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.kernels.harmonics import MAX_DEGREE, count, position
from magtiles.schemas.errors import FormatError

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Line:
    """A line of a text file that is neither empty nor a comment."""

    file: str
    number: int
    words: list[str]

    @property
    def where(self) -> str:
        """The place, for messages."""
        return f"{self.file} line {self.number}"


def significant_lines(file: str, text: str) -> list[Line]:
    """Lines of a file without empty ones and comments (#)."""
    numbered = ((i, line.split("#", 1)[0].split()) for i, line in enumerate(text.splitlines(), 1))
    return [Line(file, i, words) for i, words in numbered if words]


def numbers(line: Line, columns: int) -> tuple[int, int, list[float]]:
    """Degree, order and the finite numbers after them; FormatError naming the line."""
    if len(line.words) != columns:
        raise FormatError(
            f"{len(line.words)} columns",
            where=line.where,
            expected=f"degree, order and {columns - 2} coefficients",
            remedy="the file may be truncated: fetch it again",
        )
    try:
        n, m = int(line.words[0]), int(line.words[1])
        values = [float(word) for word in line.words[2:]]
    except ValueError as caught:
        raise FormatError(str(caught), where=line.where, expected="numbers") from None
    if not all(map(math.isfinite, values)):
        raise FormatError("a coefficient is not finite", where=line.where)
    if not (1 <= n <= MAX_DEGREE and abs(m) <= n):
        raise FormatError(
            f"degree {n}, order {m}",
            where=line.where,
            expected=f"degree 1 to {MAX_DEGREE} and an order up to the degree",
        )
    return n, m, values


class Table:
    """Coefficients as they are read, (sets, k); none may come twice."""

    def __init__(self, sets: int, n_max: int) -> None:
        self.n_max = n_max
        self.values = np.zeros((sets, count(n_max)))
        self.seen = np.zeros(count(n_max), dtype=bool)

    def put(self, line: Line, n: int, m: int, values: list[float]) -> None:
        """Take the values of g_nm, or for a negative order of h_n|m|."""
        place = position(n, m)
        if n > self.n_max:
            raise FormatError(
                f"degree {n}", where=line.where, expected=f"no degree above {self.n_max}"
            )
        if self.seen[place]:
            raise FormatError(f"degree {n}, order {m} comes twice", where=line.where)
        self.seen[place] = True
        self.values[:, place] = values

    def require(self, last: Line, n_min: int, order: int) -> None:
        """Raise FormatError, at the last line, unless all orders up to `order` are there."""
        for n in range(n_min, self.n_max + 1):
            top = min(n, order)
            wanted = slice(n * n - 1, n * n + 2 * top)
            if self.seen[wanted].all():
                continue
            missing = int(np.flatnonzero(~self.seen[wanted])[0])
            m = (missing + 1) // 2 * (1 if missing % 2 else -1)
            raise FormatError(
                f"degree {n}, order {m} is missing",
                where=last.where,
                expected=f"degrees {n_min} to {self.n_max} with orders up to {order}",
                remedy="the file may be truncated: fetch it again",
            )
