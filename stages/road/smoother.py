"""The most probable motion in a plane, given fixes, wheel speeds and standstills.

The state at each node is position and velocity; between nodes the acceleration is white, so
that the most probable path is the fixed-interval (Rauch-Tung-Striebel) smoother's. It is found
here as one banded system of normal equations, in which fixes weigh by a Cauchy function of
their misfit, wheel speed counts along the course found before, and the scale of the wheels is
one more unknown.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

Real = NDArray[np.float64]
Mask = NDArray[np.bool_]

ACCELERATION_DENSITY = 2.0
"""Spectral density of a road vehicle's acceleration, m2/s3: 1.4 m/s gained or lost in 1 s."""

_STATES = 4
_WIDTH = 2 * _STATES
_ROUNDS = 8
_CAUCHY = 3.0
"""Misfit, in standard deviations, at which a fix weighs half."""
_WHEEL_SIGMA = 0.05
"""Of wheel speed, m/s, beyond its scale."""
_SCALE_SIGMA = 0.02
_STANDSTILL_SIGMA = 0.01
_COURSE_SPEED = 1.0
"""Below it, m/s, the course is that of the faster nodes around."""


@dataclass(frozen=True)
class Observed:
    """What is known at the nodes of a path.

    Attributes
    ----------
    seconds : (n,) strictly ascending.
    place : (n, 2) metres; NaN where a node has no fix.
    sigma : (n,) standard deviation of each coordinate of a fix, m.
    wheel_speed : (n,) m/s; NaN where unknown.
    still : (n,) whether the vehicle stood.
    """

    seconds: Real
    place: Real
    sigma: Real
    wheel_speed: Real
    still: Mask


@dataclass(frozen=True)
class Path:
    """The most probable path: place (n, 2) m, velocity (n, 2) m/s.

    `weight` (n,) is how far each fix was believed, 0 to 1 (NaN without a fix), and
    `wheel_scale` the true distance per distance of the wheels (NaN without wheels).
    """

    place: Real
    velocity: Real
    weight: Real
    wheel_scale: float


def most_probable_path(seen: Observed) -> Path:
    """The path of a vehicle, by iterated least squares over all nodes at once.

    The first rounds hold the fixes alone, so that the course is known before the wheels,
    which measure speed along it, are used.
    """
    fixed: Mask = np.asarray(np.isfinite(seen.place).all(axis=1))
    weight = np.where(fixed, 1.0, 0.0)
    course: Real | None = None
    scale = np.nan
    for turn in range(_ROUNDS):
        state, scale = _solve(seen, weight, course)
        place, velocity = state[:, :2], state[:, 2:]
        misfit = np.linalg.norm(np.where(fixed[:, None], seen.place - place, 0.0), axis=1)
        weight = np.where(fixed, 1.0 / (1.0 + (misfit / (_CAUCHY * seen.sigma)) ** 2), 0.0)
        if turn >= 1:
            course = _course(seen.seconds, velocity)
    return Path(place, velocity, np.where(fixed, weight, np.nan), scale)


def _course(seconds: Real, velocity: Real) -> Real | None:
    """Unit vectors (n, 2) along the path; None where it hardly moves at all."""
    fast = np.linalg.norm(velocity, axis=1) > _COURSE_SPEED
    if fast.sum() < 2:
        return None
    angle = np.unwrap(np.arctan2(velocity[fast, 1], velocity[fast, 0]))
    full = np.interp(seconds, seconds[fast], angle)
    return np.column_stack([np.cos(full), np.sin(full)])


def _solve(seen: Observed, weight: Real, course: Real | None) -> tuple[Real, float]:
    """States (n, 4) and the wheels' scale, by which they depend linearly on one another.

    With wheels the states are a + scale b, from two right-hand sides of one matrix; the scale
    is where the cost's derivative by it vanishes.
    """
    n = len(seen.seconds)
    bands = np.zeros((_WIDTH, _STATES * n))
    right = np.zeros((n, _STATES, 2))
    _add_motion(bands, np.diff(seen.seconds))
    inverse = weight / seen.sigma**2
    _add(bands, 0, 0, inverse)
    _add(bands, 1, 1, inverse)
    right[:, :2, 0] = inverse[:, None] * np.nan_to_num(seen.place)
    still = np.where(seen.still, _STANDSTILL_SIGMA**-2, 0.0)
    _add(bands, 2, 2, still)
    _add(bands, 3, 3, still)
    wheel = np.zeros(n)
    if course is not None:
        wheel = np.where(np.isfinite(seen.wheel_speed) & ~seen.still, _WHEEL_SIGMA**-2, 0.0)
        east, north = course.T
        _add(bands, 2, 2, wheel * east**2)
        _add(bands, 3, 3, wheel * north**2)
        _add(bands, 2, 3, wheel * east * north)
        right[:, 2:, 1] = (wheel * np.nan_to_num(seen.wheel_speed))[:, None] * course
    _add(bands, 0, 0, np.full(n, 1e-10))  # a path without any fix still has a solution
    _add(bands, 1, 1, np.full(n, 1e-10))
    solved = solveh_banded(bands, right.reshape(-1, 2), overwrite_ab=True, check_finite=False)
    states = solved.reshape(n, _STATES, 2)
    if course is None or not wheel.any():
        return states[..., 0], np.nan
    scale = _scale(seen.wheel_speed, wheel, course, states)
    return states[..., 0] + scale * states[..., 1], scale


def _scale(speed: Real, wheel: Real, course: Real, states: Real) -> float:
    along = np.einsum("ni,nik->nk", course, states[:, 2:])
    w = np.nan_to_num(speed)
    prior = _SCALE_SIGMA**-2
    above = float(np.sum(wheel * w * along[:, 0])) + prior
    below = float(np.sum(wheel * w * (w - along[:, 1]))) + prior
    return above / below


def _add(bands: Real, row: int, column: int, values: Real) -> None:
    """Add to one element of every node's diagonal block, in LAPACK's upper banded form."""
    low, high = min(row, column), max(row, column)
    bands[_WIDTH - 1 - (high - low), high::_STATES] += values


def _add_motion(bands: Real, step: Real) -> None:
    """Information of each step: white acceleration over `step` (n - 1,) seconds.

    The misfit e = (p' - p - step v, v' - v) has the covariance q [[t3/3, t2/2], [t2/2, t]].
    """
    q = ACCELERATION_DENSITY
    place, cross, speed = 12.0 / (q * step**3), -6.0 / (q * step**2), 4.0 / (q * step)
    # Rows of the misfit's derivative by (p, v, p', v').
    by_place = (np.full_like(step, -1.0), -step, np.ones_like(step), np.zeros_like(step))
    by_speed = (
        np.zeros_like(step),
        np.full_like(step, -1.0),
        np.zeros_like(step),
        np.ones_like(step),
    )
    offsets = (0, 2, 4, 6)  # of the first coordinate: p, v of this node and p', v' of the next
    for i in range(4):
        for j in range(i, 4):
            value = (
                place * by_place[i] * by_place[j]
                + cross * (by_place[i] * by_speed[j] + by_speed[i] * by_place[j])
                + speed * by_speed[i] * by_speed[j]
            )
            for axis in (0, 1):
                row, column = offsets[i] + axis, offsets[j] + axis
                last = column + _STATES * (len(step) - 1) + 1
                bands[_WIDTH - 1 - (column - row), column:last:_STATES] += value
