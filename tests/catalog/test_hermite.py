from __future__ import annotations

import numpy as np
import pytest

from magtiles.catalog.kernels.hermite import bracket

LEVELS = np.array([0.0, 1000.0, 2000.0, 4000.0])


def interpolate(p: np.polynomial.Polynomial, heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    around = bracket(LEVELS, heights)
    orders = np.stack([p(LEVELS), p.deriv()(LEVELS), p.deriv(2)(LEVELS)], axis=-1)
    sides = np.stack([around.level, np.minimum(around.level + 1, len(LEVELS) - 1)])
    nodes = orders[sides]
    return np.sum(around.value * nodes, axis=(0, 2)), np.sum(around.slope * nodes, axis=(0, 2))


def test_reproduces_polynomials_of_the_fifth_degree() -> None:
    p = np.polynomial.Polynomial([3.0, -2e-3, 1e-6, 5e-10, -2e-13, 3e-17])
    heights = np.linspace(0.0, 4000.0, 1001)
    value, slope = interpolate(p, heights)
    np.testing.assert_allclose(value, p(heights), rtol=0, atol=1e-12)
    np.testing.assert_allclose(slope, p.deriv()(heights), rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("height", "level"),
    [(0.0, 0), (1000.0, 1), (2000.0 + 9e-7, 2), (2000.0 - 1e-6, 2), (4000.0, 3)],
)
def test_on_a_level_only_that_level_counts(height: float, level: int) -> None:
    around = bracket(LEVELS, np.array([height]))
    assert around.level[0] == level
    np.testing.assert_array_equal(around.uses[:, 0], [True, False])
    np.testing.assert_array_equal(around.value[:, 0], [[1, 0, 0], [0, 0, 0]])
    np.testing.assert_array_equal(around.slope[:, 0], [[0, 1, 0], [0, 0, 0]])
    assert not around.above[0]
    assert not around.below[0]


def test_beyond_the_levels_it_goes_on_as_a_straight_line() -> None:
    p = np.polynomial.Polynomial([1.0, 2.0, 3.0])
    value, slope = interpolate(p, np.array([-10.0, 4010.0]))
    np.testing.assert_allclose(value, [p(0) - 10 * 2.0, p(4000) + 10 * p.deriv()(4000)])
    np.testing.assert_allclose(slope, [2.0, p.deriv()(4000)])
    around = bracket(LEVELS, np.array([-10.0, 4010.0]))
    np.testing.assert_array_equal(around.below, [True, False])
    np.testing.assert_array_equal(around.above, [False, True])


def test_a_single_level_serves_its_own_height_only() -> None:
    around = bracket(np.array([150.0]), np.array([149.9, 150.0, 150.1]))
    np.testing.assert_array_equal(around.below, [True, False, False])
    np.testing.assert_array_equal(around.above, [False, False, True])
