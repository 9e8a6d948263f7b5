"""SHC, the format of IGRF, CHAOS, LCS-1, MF7 and the Swarm models.

After comments: n_min n_max times spline_order steps [first and last year], the times, then rows
``n m value(s)`` where a negative m is the sine coefficient h.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray

from magtiles.catalog.kernels.harmonics import position
from magtiles.catalog.models.model import REFERENCE_RADIUS_KM, FieldModel
from magtiles.catalog.models.rows import Line, Table, numbers
from magtiles.schemas.errors import FormatError, QueryError

Floats = NDArray[np.float64]

_HEADER = "n_min n_max times spline_order steps, and maybe the first and last year"

_STRAIGHT_NT = 1e-3
"""What straight lines between the epochs may differ from a spline of higher order."""


def is_shc(lines: list[Line]) -> bool:
    """Whether the first line could be the header: five whole numbers, and maybe two years."""
    words = lines[0].words
    return len(words) in (5, 7) and all(w.lstrip("-").isdigit() for w in words[:5])


def read_shc(lines: list[Line]) -> FieldModel:
    """The model in the lines of an SHC file; FormatError names file and line.

    A file with one time is a static model. A spline of order above two is given by order - 1
    samples for each of its pieces (the last shared with the next piece): epochs are added until
    straight lines between them are within 0.001 nT of it in every coefficient.
    """
    n_min, n_max, count_, order, steps = _header(lines[0])
    times = _times(lines, count_)
    table = Table(count_, n_max)
    for line in lines[2:]:
        n, m, values = numbers(line, 2 + count_)
        if n < n_min:
            raise FormatError(f"degree {n}", where=line.where, expected=f"{n_min} or higher")
        table.put(line, n, m, values)
    table.require(lines[-1], n_min, n_max)
    if count_ == 1:
        valid = (-math.inf, math.inf)
    elif len(lines[0].words) == 7:
        valid = (float(lines[0].words[5]), float(lines[0].words[6]))
    else:
        valid = (float(times[0]), float(times[-1]))
    coefficients = table.values
    if order > 2 and count_ > 1:
        times, coefficients = _straighten(lines[0], times, coefficients, order, steps)
    return FieldModel(
        Path(lines[0].file).stem,
        n_min,
        n_max,
        REFERENCE_RADIUS_KM,
        times,
        coefficients,
        None,
        valid,
    )


def shc_text(model: FieldModel, *comments: str) -> str:
    """A model as an SHC file with all digits, one line of comment each before the header.

    Secular variation after the last epoch becomes one more epoch, at the end of the validity.
    Raises QueryError for a model of one epoch that is not valid always: the format takes a file
    with one time for static.
    """
    epochs, coefficients = model.epochs, model.coefficients
    if model.secular_variation is not None and model.valid[1] > epochs[-1]:
        later = coefficients[-1] + (model.valid[1] - epochs[-1]) * model.secular_variation
        epochs, coefficients = np.append(epochs, model.valid[1]), np.vstack([coefficients, later])
    span = "" if len(epochs) == 1 else f" {float(model.valid[0])!r} {float(model.valid[1])!r}"
    if len(epochs) == 1 and np.isfinite(model.valid).any():
        raise QueryError(
            f"is valid at {epochs[0]:g} only", where=model.name, expected="several epochs in SHC"
        )
    order, steps = (2, 1) if len(epochs) > 1 else (1, 1)
    lines = [f"# {comment}" for comment in comments]
    lines.append(f"{model.n_min} {model.n_max} {len(epochs)} {order} {steps}{span}")
    lines.append(" ".join(repr(float(epoch)) for epoch in epochs))
    for n in range(model.n_min, model.n_max + 1):
        for m in (0, *(sign * m for m in range(1, n + 1) for sign in (1, -1))):
            values = " ".join(repr(float(value)) for value in coefficients[:, position(n, m)])
            lines.append(f"{n} {m} {values}")
    return "\n".join(lines) + "\n"


def _header(line: Line) -> tuple[int, int, int, int, int]:
    n_min, n_max, times, order, steps = (int(word) for word in line.words[:5])
    good = 1 <= n_min <= n_max and times >= 1 and order >= 1
    try:
        years = [float(word) for word in line.words[5:]]
    except ValueError:
        good = False
    if not good or not np.all(np.diff(years) > 0):
        raise FormatError("no header of SHC", where=line.where, expected=_HEADER)
    if times > 1 and order < 2:
        raise FormatError(
            f"a spline of order {order} over {times} times",
            where=line.where,
            expected="order 2 (straight lines) or higher",
        )
    return n_min, n_max, times, order, steps


def _times(lines: list[Line], wanted: int) -> Floats:
    if len(lines) < 3:
        raise FormatError("ends after its header", where=lines[-1].where, expected="coefficients")
    line = lines[1]
    try:
        times = np.array([float(word) for word in line.words])
    except ValueError as caught:
        raise FormatError(str(caught), where=line.where, expected="decimal years") from None
    if len(times) != wanted or not np.isfinite(times).all() or np.any(np.diff(times) <= 0):
        raise FormatError(
            f"{len(times)} times", where=line.where, expected=f"{wanted} ascending decimal years"
        )
    return times


def _straighten(
    header: Line, times: Floats, values: Floats, order: int, steps: int
) -> tuple[Floats, Floats]:
    """Epochs and coefficients that stand for a piecewise polynomial of degree order - 1."""
    pieces, rest = divmod(len(times) - 1, order - 1)
    if steps != order - 1 or rest:
        raise FormatError(
            f"{len(times)} times in {steps} steps for a spline of order {order}",
            where=header.where,
            expected=f"{order - 1} steps a piece, and one time more than whole pieces",
        )
    bend = np.abs(np.diff(values, 2, axis=0)).max() / 8.0
    finer = max(1, math.ceil(math.sqrt(bend / _STRAIGHT_NT)))
    fine = np.arange(finer * steps) / (finer * steps)
    all_times, all_values = [], []
    for piece in range(pieces):
        part = slice(piece * steps, piece * steps + order)
        start, span = times[part][0], times[part][-1] - times[part][0]
        fitted = polynomial.polyfit((times[part] - start) / span, values[part], order - 1)
        all_times.append(start + span * fine)
        all_values.append(polynomial.polyval(fine, fitted).T)
    return (
        np.append(np.concatenate(all_times), times[-1]),
        np.concatenate([*all_values, values[-1:]]),
    )
