"""The format of GeographicLib: a text of metadata, ``.wmm``, beside binary ``.wmm.cof``.

See the documentation of GeographicLib, "Magnetic models". The binary file has an eight-letter
id, then sets of coefficients: degree N and order M (int32), the cosine coefficients for
m = 0 to M, n = m to N, and the sine ones from m = 1 (float64), all little-endian.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.kernels.harmonics import MAX_DEGREE, count
from magtiles.catalog.models.model import REFERENCE_RADIUS_KM, FieldModel
from magtiles.catalog.models.rows import Line
from magtiles.schemas.errors import FormatError

Floats = NDArray[np.float64]

_AGAIN = "the file may be truncated: fetch it again"
_ID_BYTES = 8


def read_geographiclib(path: Path, lines: list[Line]) -> FieldModel:
    """The model that the lines of a .wmm file describe; FormatError names file and place.

    Yearly (or otherwise even) models are epochs, the set after them the secular variation, and
    a constant set, where there is one, is added to all.
    """
    if lines[0].words != ["WMMF-1"] and lines[0].words != ["WMMF-2"]:
        raise FormatError(
            f"version {lines[0].words[0]}", where=lines[0].where, expected="WMMF-1 or WMMF-2"
        )
    meta = _Metadata({line.words[0]: line for line in lines[1:]}, path)
    if meta.text("Type", "linear") != "linear":
        raise meta.error("Type", "linear")
    models, constants = meta.whole("NumModels", 1), meta.whole("NumConstants", 0)
    sets = _read_sets(path.with_name(path.name + ".cof"), meta, models + 1 + constants)
    n_max = max(degree for degree, _ in sets)
    padded = np.zeros((len(sets), count(n_max)))
    for row, (degree, values) in zip(padded, sets, strict=True):
        row[: count(degree)] = values
    coefficients = padded[:models] + padded[models + 1 :].sum(axis=0)
    epoch, step = meta.number("Epoch"), meta.number("DeltaEpoch", 1.0)
    n_min = int(math.sqrt(np.flatnonzero(coefficients.any(axis=0))[0] + 1))
    return FieldModel(
        meta.text("Name", path.stem),
        n_min,
        n_max,
        meta.number("Radius", REFERENCE_RADIUS_KM * 1000.0) / 1000.0,
        np.array([epoch + step * i for i in range(models)]),
        coefficients,
        padded[models],
        (meta.number("MinTime", -math.inf), meta.number("MaxTime", math.inf)),
    )


@dataclass(frozen=True)
class _Metadata:
    lines: dict[str, Line]
    path: Path

    def error(self, key: str, expected: str) -> FormatError:
        line = self.lines.get(key)
        if line is None:
            return FormatError(f"no {key}", where=self.path, expected=expected)
        value = " ".join(line.words[1:])
        return FormatError(f"{key} is {value!r}", where=line.where, expected=expected)

    def text(self, key: str, default: str | None = None) -> str:
        line = self.lines.get(key)
        words = [default] if line is None and default is not None else line and line.words[1:]
        if not words:
            raise self.error(key, "a word")
        return str(words[0])

    def number(self, key: str, default: float | None = None) -> float:
        if key not in self.lines and default is not None:
            return default
        try:
            value = float(self.text(key))
        except ValueError:
            raise self.error(key, "a number") from None
        if not math.isfinite(value):
            raise self.error(key, "a finite number")
        return value

    def whole(self, key: str, default: int) -> int:
        value = self.number(key, float(default))
        if value != int(value) or not default <= value <= 1000:
            raise self.error(key, f"a whole number, {default} or more")
        return int(value)


def _read_sets(path: Path, meta: _Metadata, wanted: int) -> list[tuple[int, Floats]]:
    if not path.is_file():
        raise FormatError("is missing", where=path, expected=f"the coefficients of {meta.path}")
    data = path.read_bytes()
    name = meta.text("ID")
    if data[:_ID_BYTES] != name.encode():
        raise FormatError(f"id is {data[:_ID_BYTES]!r}", where=f"{path} byte 0", expected=name)
    normalization = meta.text("Normalization", "schmidt").lower()
    if normalization not in ("schmidt", "full"):
        raise meta.error("Normalization", "schmidt or full")
    if meta.text("ByteOrder", "little").lower() != "little":
        raise meta.error("ByteOrder", "little")
    sets, at = [], _ID_BYTES
    for _ in range(wanted):
        degree, values, at = _read_set(path, data, at, full=normalization == "full")
        sets.append((degree, values))
    if at != len(data):
        raise FormatError(
            f"{len(data) - at} bytes too many", where=f"{path} byte {at}", expected=f"{wanted} sets"
        )
    return sets


def _read_set(path: Path, data: bytes, at: int, *, full: bool) -> tuple[int, Floats, int]:
    """Degree and Gauss coefficients of the set that starts at a byte, and the byte after it."""
    where = f"{path} byte {at}"
    if at + 8 > len(data):
        raise FormatError("ends before a set of coefficients", where=where, remedy=_AGAIN)
    degree, order = (int(i) for i in np.frombuffer(data, "<i4", 2, at))
    if degree == order == -1:
        return 0, np.empty(0), at + 8
    if not 0 <= order <= degree <= MAX_DEGREE:
        raise FormatError(
            f"degree {degree}, order {order}", where=where, expected=f"up to {MAX_DEGREE}"
        )
    m, n = np.nonzero(np.tri(degree + 1, dtype=bool).T[: order + 1])  # by order, then degree
    cosines, sines = len(m), len(m) - degree - 1
    if at + 8 + 8 * (cosines + sines) > len(data):
        raise FormatError(
            f"ends within a set of degree {degree}, order {order}", where=where, remedy=_AGAIN
        )
    read = np.frombuffer(data, "<f8", cosines + sines, at + 8)
    if not np.isfinite(read).all() or read[0] != 0.0:
        raise FormatError(
            "coefficients are not finite, or degree 0 is not zero", where=where, remedy=_AGAIN
        )
    values = np.zeros(count(degree) + 1)  # degree 0 in front
    values[n * n + np.maximum(2 * m - 1, 0)] = read[:cosines]
    values[(n * n + 2 * m)[degree + 1 :]] = read[cosines:]
    if full:
        values *= np.sqrt(2 * np.floor(np.sqrt(np.arange(len(values)))) + 1)
    return degree, values[1:], at + 8 + 8 * (cosines + sines)
