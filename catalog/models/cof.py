"""COF, the format of NOAA's models: WMM, WMMHR and the files of the EMM sets.

A header (epoch, name, date), then rows ``n m g h`` and, in WMM and WMMHR, their secular
variation; a line of nines ends it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.kernels.harmonics import count, position
from magtiles.catalog.models.model import REFERENCE_RADIUS_KM, FieldModel
from magtiles.catalog.models.rows import Line, Table, numbers, significant_lines
from magtiles.schemas.errors import FormatError, QueryError

Floats = NDArray[np.float64]

YEARS_VALID = 5.0
"""How long NOAA's models hold after their last epoch."""

CRUST = 16
"""The lowest degree of a model of the crust alone, which does not change."""

_AGAIN = "the file may be truncated: fetch it again"
_YEARLY = re.compile(r"EMM(\d{4})(SV)?\.COF", re.IGNORECASE)


@dataclass(frozen=True)
class CofFile:
    """What one file holds: coefficients (k,) nT and maybe their rates, nT/yr."""

    name: str
    epoch: float
    n_min: int
    n_max: int
    coefficients: Floats
    rates: Floats | None


def is_cof(lines: list[Line]) -> bool:
    """Whether the first line could be the header: a year, then a name."""
    words = lines[0].words
    try:
        return 1900.0 <= float(words[0]) < 2200.0 and not _is_row(words)
    except ValueError:
        return False


def _is_row(words: Sequence[str]) -> bool:
    return len(words) in (4, 6) and words[0].isdigit() and words[1].isdigit()


def read_cof(lines: list[Line]) -> FieldModel:
    """The model in the lines of one COF file; FormatError names file and line.

    With secular variation it holds for five years. Without, a model of the crust (lowest degree
    16 or more) is static, and any other holds at its epoch only.
    """
    file = _read(lines)
    if file.rates is not None:
        valid = (file.epoch, file.epoch + YEARS_VALID)
    elif file.n_min >= CRUST:
        valid = (-math.inf, math.inf)
    else:
        valid = (file.epoch, file.epoch)
    return FieldModel(
        file.name,
        file.n_min,
        file.n_max,
        REFERENCE_RADIUS_KM,
        np.array([file.epoch]),
        file.coefficients[None],
        file.rates,
        valid,
    )


def _read(lines: list[Line]) -> CofFile:
    header, rows = lines[0], lines[1:]
    if not rows:
        raise FormatError("ends after its header", where=header.where, remedy=_AGAIN)
    columns = len(rows[0].words)
    if columns not in (4, 6):
        raise FormatError(
            f"{columns} columns", where=rows[0].where, expected="n m g h, or n m g h dg dh"
        )
    n_min, n_max, values = _coefficients(rows, columns)
    name = header.words[1] if len(header.words) > 1 else Path(header.file).stem
    rates = values[1] if columns == 6 else None
    return CofFile(name, float(header.words[0]), n_min, n_max, values[0], rates)


def _coefficients(rows: list[Line], columns: int) -> tuple[int, int, Floats]:
    """First and last degree, and sets of coefficients, of the rows up to the line of nines."""
    end = next((i for i, line in enumerate(rows) if line.words[0].startswith("9999")), None)
    if end is None and columns == 6:
        raise FormatError("no line of nines at the end", where=rows[-1].where, remedy=_AGAIN)
    rows = rows[:end]
    read = [numbers(line, columns) for line in rows]
    n_min, n_max = read[0][0], max(n for n, _, _ in read)
    table = Table((columns - 2) // 2, n_max)
    for line, (n, m, values) in zip(rows, read, strict=True):
        if m < 0 or n < n_min:
            raise FormatError(
                f"degree {n}, order {m}",
                where=line.where,
                expected=f"degree {n_min} or higher, and no negative order",
            )
        table.put(line, n, m, values[0::2])
        if m > 0:
            table.put(line, n, -m, values[1::2])
    order = max(m for _, m, _ in read)
    # Some models stop at a lower order; one less than the degree is a lost last line.
    table.require(rows[-1], n_min, order if order < n_max - 1 else n_max)
    return n_min, n_max, table.values


def cof_text(model: FieldModel, *, made: str = "") -> str:
    """A model as a COF file, to any degree, in the columns of the WMM: see `read_cof`.

    ``n m g h`` and, where the model has secular variation, ``dg dh``; six decimals of a nT (nT/yr).
    `made` is the date of the file in its header. Raises QueryError for a model of several epochs,
    which the format does not know, and for a name that is not one word.
    """
    if len(model.epochs) != 1 or len(model.name.split()) != 1:
        raise QueryError(
            f"{len(model.epochs)} epochs under the name {model.name!r}",
            where="COF",
            expected="one epoch, and a name of one word",
        )
    sets = [model.coefficients[0]]
    if model.secular_variation is not None:
        sets.append(model.secular_variation)
    lines = [f"{float(model.epochs[0]):>10}            {model.name:<16} {made}".rstrip()]
    for n in range(model.n_min, model.n_max + 1):
        for m in range(n + 1):
            pairs = ((c[position(n, m)], c[position(n, -m)] if m else 0.0) for c in sets)
            values = "".join(f"{value:15.6f}" for pair in pairs for value in pair)
            lines.append(f"{n:4d} {m:4d}{values}")
    return "\n".join([*lines, *["9" * 48] * 2]) + "\n"


def read_emm(paths: Sequence[Path], where: Path) -> FieldModel:
    """The EMM in files EMM2000.COF, EMM2001.COF ... with EMM2000SV.COF ...; `where` names the set.

    The yearly files hold the lowest degrees, the last of them all; the higher degrees do not
    change. Between yearly epochs coefficients are linear, and after the last one its secular
    variation holds for five years. (NOAA's own program starts from each year with that year's
    secular variation, and so has small steps at the turn of the year.)
    """
    found = {match[0].upper(): path for path in sorted(paths)
             if (match := _YEARLY.fullmatch(path.name))}  # fmt: skip
    years = sorted(int(name[3:7]) for name in found if "SV" not in name)
    if not years:
        raise FormatError("no files of the EMM", where=where, expected="EMM2000.COF and on")
    wanted = [f"EMM{y}.COF" for y in range(years[0], years[-1] + 1)] + [f"EMM{years[-1]}SV.COF"]
    for name in wanted:
        if name not in found:
            raise FormatError(f"{name} is missing", where=where, remedy="fetch the whole set")
    files = [_yearly(found[f"EMM{y}.COF"], y) for y in years]
    full = files[-1]
    coefficients = np.repeat(full.coefficients[None], len(files), axis=0)
    for file, path, row in zip(files, wanted, coefficients, strict=False):
        if file.n_max > full.n_max or file.n_min > full.n_min:
            raise FormatError(
                f"degrees {file.n_min} to {file.n_max}",
                where=found[path],
                expected=f"degrees from {full.n_min}, and none above {full.n_max}",
            )
        row[: len(file.coefficients)] = file.coefficients
    rates = np.zeros(count(full.n_max))
    variation = _secular_variation(found[wanted[-1]], full.n_max)
    rates[: len(variation)] = variation
    return FieldModel(
        f"EMM{years[-1]}",
        full.n_min,
        full.n_max,
        REFERENCE_RADIUS_KM,
        np.array(years, dtype=np.float64),
        coefficients,
        rates,
        (float(years[0]), years[-1] + YEARS_VALID),
    )


def _lines(path: Path) -> list[Line]:
    lines = significant_lines(str(path), path.read_text(encoding="utf-8", errors="replace"))
    if not lines:
        raise FormatError("is empty", where=path, remedy="fetch it again")
    return lines


def _yearly(path: Path, year: int) -> CofFile:
    lines = _lines(path)
    if not is_cof(lines):
        raise FormatError("no header of COF", where=lines[0].where, expected="epoch and name")
    file = _read(lines)
    if file.epoch != year:
        raise FormatError(
            f"epoch {file.epoch:g}", where=lines[0].where, expected=f"{year}, as its name says"
        )
    return file


def _secular_variation(path: Path, n_max: int) -> Floats:
    """Rates (k,), nT/yr, of a file of them alone, with or without lines of text before."""
    lines = _lines(path)
    first = next((i for i, line in enumerate(lines) if _is_row(line.words)), None)
    if first is None:
        raise FormatError("no coefficients", where=path, expected="rows n m dg dh")
    _, highest, values = _coefficients(lines[first:], 4)
    if highest > n_max:
        raise FormatError(
            f"degree {highest}", where=path, expected=f"none above the model's {n_max}"
        )
    return np.asarray(values[0])
