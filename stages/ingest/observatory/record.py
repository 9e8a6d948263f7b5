"""What every reader hands over: the samples of one file as reported, and what its header says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError

Real = NDArray[np.float64]
Times = NDArray[np.datetime64]

_SAME_SPACING = 8
"""So many rows spaced wider than the rest, and all alike, are no gaps but another cadence."""


@dataclass(frozen=True)
class Header:
    """What a file says of its station. None is what it does not say.

    Attributes
    ----------
    iaga_code : in capitals.
    elements : letter of each column, such as ``("H", "D", "Z", "F")``; ``NUL`` for none.
    latitude, longitude : geodetic degrees, longitude in [-180, 180).
    elevation : metres above mean sea level.
    data_type : variation, provisional, adjusted, quasi-definitive or definitive.
    declination_base : arcminutes east, to add to a reported declination, or the direction of the
        axis that H is along where H, E, Z are reported.
    position_step : degrees that the position is rounded to.
    """

    iaga_code: str | None
    elements: tuple[str, ...]
    latitude: float | None = None
    longitude: float | None = None
    elevation: float | None = None
    data_type: str | None = None
    declination_base: float | None = None
    position_step: float = 0.001


@dataclass(frozen=True)
class Record:
    """The samples of one file.

    Attributes
    ----------
    where : the file.
    header : what it says of its station.
    time : (rows,) ascending, the middle of what each value stands for.
    values : (elements, rows) nT, and arcminutes for D and I; NaN where missing.
    marked : (rows,) where a value is marked as missing, by 99999.
    cadence_s : seconds between samples; None for a single one.
    not_recorded : elements that the station does not record, all 88888.
    """

    where: str
    header: Header
    time: Times
    values: Real
    marked: NDArray[np.bool_]
    cadence_s: float | None
    not_recorded: tuple[str, ...] = ()


MISSING = 99999.0
NOT_RECORDED = 88888.0


def mark_missing(
    values: Real, elements: Sequence[str], missing: float = MISSING, absent: float = NOT_RECORDED
) -> tuple[Real, NDArray[np.bool_], tuple[str, ...]]:
    """Values with NaN for both marks, rows with a mark, and the elements not recorded at all.

    `values` is (elements, rows) as the file has it. An element that is `absent` (or missing, for
    NUL) throughout is no reason to mark a row.
    """
    marks = (values == absent) | (values == missing)
    rows = marks.any(axis=0)
    if not rows.any():
        return values, rows, ()
    always = marks.all(axis=1)
    is_nul = np.array([element == "NUL" for element in elements])
    never = is_nul | (always & (values[:, 0] == absent))
    values[marks] = np.nan
    values[is_nul] = np.nan
    names = tuple(e for e, gone in zip(elements, never, strict=True) if gone and e != "NUL")
    return values, marks[~never].any(axis=0), names


def check_times(time: Times, where: str, lines: NDArray[np.int64]) -> float | None:
    """Seconds between rows; None for a single row.

    `lines` are the numbers of the rows' lines, counted from 1. Raises FormatError, naming the
    line, where time stands still or goes backwards and where the spacing changes. A gap is a
    multiple of the usual spacing.
    """
    ticks: NDArray[np.int64] = time.astype("datetime64[ns]").view(np.int64)
    steps = ticks[1:] - ticks[:-1]
    if not steps.size:
        return None
    if steps[0] > 0 and (steps == steps[0]).all():
        return float(steps[0]) / 1e9
    if (steps <= 0).any():
        row = int(np.argmax(steps <= 0)) + 1
        again = "is repeated" if steps[row - 1] == 0 else f"follows {_shown(time[row - 1])}"
        raise FormatError(
            f"time goes backwards: {_shown(time[row])} {again}",
            where=f"{where} line {lines[row]}",
            expected="each row later than the one before",
            remedy="sort the rows, or split the file where the record starts again",
        )
    usual = _most_frequent(steps)
    odd = (steps % usual != 0) | _another_cadence(steps, usual)
    if odd.any():
        row = int(np.argmax(odd)) + 1
        raise FormatError(
            f"mixed cadence: {steps[row - 1] / 1e9:g} s after the row before",
            where=f"{where} line {lines[row]}",
            expected=f"{usual / 1e9:g} s, or a multiple for a gap",
            remedy="ingest each cadence from files of its own",
        )
    return usual / 1e9


def _most_frequent(steps: NDArray[np.int64]) -> int:
    found, counts = np.unique(steps, return_counts=True)
    return int(found[np.argmax(counts)])


def _another_cadence(steps: NDArray[np.int64], usual: int) -> NDArray[np.bool_]:
    """Where a run of equal steps that are not the usual one begins."""
    begins = np.flatnonzero(np.diff(steps, prepend=-1))
    lengths = np.diff(np.append(begins, steps.size))
    odd = np.zeros(steps.shape, np.bool_)
    odd[begins[(lengths >= _SAME_SPACING) & (steps[begins] != usual)]] = True
    return odd


def _shown(time: np.datetime64) -> str:
    return str(np.datetime_as_string(time, unit="ms")).removesuffix(".000")
