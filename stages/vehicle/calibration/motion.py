"""How far a vehicle turns, and where in a drive it drives circles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]

_STEPS = 240
"""Steps in time, in the slowest revolution, at which turning is looked at."""
_STRAIGHT = 0.05 * 2.0 * np.pi
"""Turn, radians, below which the ends of a stretch are no part of its circles."""


def tangent_angle(points: Real, step: float) -> Real:
    """Direction (n,) of travel along a noisy path of points (n, 2), radians, unwrapped.

    The path is followed in chords of at least `step`, so that noise well below it does not
    turn them. Counted from the first axis toward the second; zero where the path never gets
    that far. A path in the horizontal field's plane turns once with each revolution of the
    vehicle, wherever the bias puts its centre.
    """
    corners, angles = [0], [0.0]
    last, reach = points[0], step**2
    for i, (x, y) in enumerate((points - points[0]).tolist()):
        dx, dy = x - last[0] + points[0][0], y - last[1] + points[0][1]
        if dx * dx + dy * dy >= reach:
            corners.append(i)
            angles.append(np.arctan2(dy, dx))
            last = points[i]
    if len(corners) == 1:
        return np.zeros(len(points))
    # A chord's direction is that of the path half-way along it.
    middle = 0.5 * (np.array(corners[1:]) + np.array(corners[:-1]))
    return np.interp(np.arange(len(points)), middle, np.unwrap(angles[1:]))


def revolutions_of(angle: Real) -> float:
    """Revolutions between the extremes of an unwrapped angle (n,), radians."""
    return float(np.ptp(angle)) / (2.0 * np.pi)


def find_circles(seconds: Real, angle: Real, slowest_s: float) -> tuple[slice, float]:
    """The stretch of a drive with the most turning in circles.

    Parameters
    ----------
    seconds : (n,) ascending.
    angle : (n,) heading, or any angle that turns with it, unwrapped, radians.
    slowest_s : a whole revolution within this time is part of a circle.

    Returns
    -------
    The samples of the stretch, and the revolutions driven in it (either way); where there is
    no whole revolution, all samples and the revolutions between the extremes of `angle`.
    """
    step = slowest_s / _STEPS
    clock = np.arange(seconds[0], seconds[-1] + step, step)
    turned = np.interp(clock, seconds, angle)
    circling = _in_tight_revolutions(turned)
    if not circling.any():
        return slice(0, len(seconds)), revolutions_of(angle)
    change = np.diff(np.concatenate([[0], circling.astype(np.int8), [0]]))
    stretches = zip(np.flatnonzero(change == 1), np.flatnonzero(change == -1) - 1, strict=True)
    driven = [
        (np.abs(np.diff(turned[a : b + 1])).sum() / (2.0 * np.pi), a, b) for a, b in stretches
    ]
    most, first, last = max(driven)
    ends = _without_straight_ends(turned, int(first), int(last))
    start, stop = np.searchsorted(seconds, clock[list(ends)], side="left")
    return slice(int(start), int(stop) + 1), float(most)


def _without_straight_ends(turned: Real, first: int, last: int) -> tuple[int, int]:
    """The stretch less what is nearly straight before and after its circles."""
    part = turned[first : last + 1]
    from_first = np.abs(part - part[0]) >= _STRAIGHT
    from_last = np.abs(part - part[-1])[::-1] >= _STRAIGHT
    return first + int(np.argmax(from_first)) - 1, last - int(np.argmax(from_last)) + 1


def _in_tight_revolutions(turned: Real) -> NDArray[np.bool_]:
    """Which steps (n,) lie in a whole revolution that takes at most `_STEPS` of them."""
    count = len(turned)
    never = count + _STEPS
    ends = np.full(count, never)
    open_starts = np.arange(count)
    for later in range(1, min(_STEPS, count - 1) + 1):
        open_starts = open_starts[open_starts + later < count]
        whole = np.abs(turned[open_starts + later] - turned[open_starts]) >= 2.0 * np.pi
        ends[open_starts[whole]] = open_starts[whole] + later
        open_starts = open_starts[~whole]
    # Where the next start ends no later, this start only adds what lies before the circle.
    tight = np.flatnonzero((ends < never) & (np.append(ends[1:], never) > ends))
    edges = np.zeros(count + 1, np.int64)
    np.add.at(edges, tight, 1)
    np.add.at(edges, ends[tight] + 1, -1)
    return np.asarray(np.cumsum(edges[:-1]) > 0)
