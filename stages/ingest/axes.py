"""Axes of a grid: regular, ascending, longitudes in the house's range."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError

_TOLERANCE = 1e-3  # of a step: coordinates printed with few digits are still regular
_WORST = 0.05  # of a step, whatever the rounding of the file


def regular_axis(nodes: NDArray[np.float64], rounding: float, *, where: str) -> NDArray[np.float64]:
    """The axis with exactly equal steps that `nodes` are within rounding of, in their order.

    Raises FormatError naming the first index whose step differs, and by how much.
    """
    if nodes.size < 2:
        raise FormatError(f"has {nodes.size} node", where=where, expected="at least 2")
    if not np.all(np.isfinite(nodes)):
        index = int(np.argmin(np.isfinite(nodes)))
        raise FormatError(f"index {index} is {nodes[index]}", where=where, expected="numbers")
    exact = np.linspace(nodes[0], nodes[-1], nodes.size)
    step = (nodes[-1] - nodes[0]) / (nodes.size - 1)
    allowed = min(max(_TOLERANCE * abs(step), 4 * rounding), _WORST * abs(step))
    if step == 0.0 or np.any(np.abs(nodes - exact) > allowed):
        raise _irregular(nodes, allowed, where)
    return exact


def _irregular(nodes: NDArray[np.float64], allowed: float, where: str) -> FormatError:
    steps = np.diff(nodes)
    usual = float(np.median(steps))
    index = int(np.argmax(np.abs(steps - usual) > min(allowed, 0.5 * np.ptp(steps))))
    return FormatError(
        f"the axis is irregular: from index {index} to {index + 1} the step is {steps[index]:g}, "
        f"{steps[index] - usual:+g} from the usual",
        where=where,
        expected=f"equal steps of {usual:g}",
        remedy="resample it to a regular grid",
    )


def unbroken_longitudes(longitude: NDArray[np.float64]) -> NDArray[np.float64]:
    """Longitudes that jump by a turn at the date line, or at Greenwich, made to count on."""
    if not np.all(np.isfinite(longitude)):
        return longitude  # which `regular_axis` names
    return np.unwrap(longitude, period=360.0)


def wrapped_longitudes(
    longitude: NDArray[np.float64], *, where: str
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Ascending longitudes that start in [-180, 180), and the columns they come from.

    A global grid is cut open at -180 and loses a repeated meridian; a region across the date
    line runs on above 180. Raises FormatError for more than one turn.
    """
    step = longitude[1] - longitude[0]
    columns = np.arange(longitude.size)
    turn = longitude[-1] - longitude[0]
    if turn > 360.0 + 0.5 * step:
        raise FormatError(f"longitudes span {turn:g} degrees", where=where, expected="at most 360")
    if turn > 360.0 - 0.5 * step:
        longitude, columns = longitude[:-1], columns[:-1]
        turn -= step
    whole = turn + 1.5 * step > 360.0
    if not whole:
        start = _wrap(longitude[0])
        return longitude + (start - longitude[0]), columns
    order = np.argsort(_wrap(longitude), kind="stable")
    first = float(_wrap(longitude[order[0]]))
    return first + step * np.arange(longitude.size), columns[order]


def _wrap(longitude: NDArray[np.float64]) -> NDArray[np.float64]:
    wrapped = (longitude + 180.0) % 360.0 - 180.0
    # Do not let the modulo's rounding touch what already lies in range.
    return np.where((longitude >= -180.0) & (longitude < 180.0), longitude, wrapped)
