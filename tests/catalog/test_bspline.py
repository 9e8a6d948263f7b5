from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage
from scipy.interpolate import make_interp_spline

from magtiles.catalog.kernels import bspline, compiled
from magtiles.catalog.kernels.bspline import HALO
from magtiles.catalog.kernels.vertical import node_derivative


def random_nodes(*shape: int) -> np.ndarray:
    return np.random.default_rng(4).normal(size=shape)


def smooth_nodes(offset: float = 0.0, cells: int = 60) -> np.ndarray:
    """Waves of 9 nodes, 500 nT in amplitude: rougher than a well-sampled anomaly."""
    y = offset + np.arange(cells)
    return 500.0 * np.sin(0.7 * y + 0.4)[:, None] * np.cos(0.7 * np.arange(cells))


def test_equals_the_natural_spline_of_scipy_on_random_nodes() -> None:
    nodes = random_nodes(30, 41)
    rng = np.random.default_rng(5)
    y, x = rng.uniform(1, 28, 300), rng.uniform(1, 39, 300)
    across = make_interp_spline(np.arange(41), nodes, k=3, axis=1, bc_type="natural")

    def scipy(dy: int, dx: int) -> np.ndarray:
        columns = across(x, nu=dx)
        along = make_interp_spline(np.arange(30), columns, k=3, axis=0, bc_type="natural")
        return np.diagonal(along(y, nu=dy))

    found = bspline.evaluate(bspline.prefilter(nodes)[..., None], y, x)[..., 0]
    for got, wanted in zip(found, (scipy(0, 0), scipy(1, 0), scipy(0, 1)), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=0, atol=2e-13)


def test_inside_the_halo_the_kind_of_end_does_not_matter() -> None:
    nodes = smooth_nodes()
    rng = np.random.default_rng(6)
    y, x = rng.uniform(HALO, 59 - HALO, (2, 500))
    ours = bspline.evaluate(bspline.prefilter(nodes)[..., None], y, x, slopes=False)[0, :, 0]
    coefficients = ndimage.spline_filter(nodes, order=3, mode="mirror")
    mirrored = ndimage.map_coordinates(coefficients, [y, x], order=3, prefilter=False)
    # 500 nT at 9 nodes a wave: natural and mirrored ends differ by 6e-6 nT, 12 nodes away.
    np.testing.assert_allclose(ours, mirrored, rtol=0, atol=2e-5)


@pytest.mark.parametrize("phase", np.linspace(0.0, 8.0, 5))
def test_arrays_that_overlap_by_two_halos_meet_without_a_seam(phase: float) -> None:
    south, north = smooth_nodes(phase), smooth_nodes(phase + 59 - 2 * HALO)
    x = np.linspace(HALO, 59 - HALO, 200)
    seam = np.full_like(x, 59.0 - HALO)
    one = bspline.evaluate(bspline.prefilter(south)[..., None], seam, x)
    two = bspline.evaluate(bspline.prefilter(north)[..., None], seam - (59 - 2 * HALO), x)
    np.testing.assert_allclose(one[0], two[0], rtol=0, atol=1e-12)
    # The slope of up to 350 nT a node jumps by 1.0e-5; by 8e-5 were the ends mirrored.
    np.testing.assert_allclose(one[1:], two[1:], rtol=0, atol=2e-5)


@pytest.mark.parametrize("channels", [1, 6])
@pytest.mark.parametrize("slopes", [True, False])
def test_the_compiled_spline_is_the_same(channels: int, slopes: bool) -> None:
    nodes = random_nodes(40, 30, channels)
    y, x = np.random.default_rng(7).uniform(1, 27, (2, 200))
    wanted = bspline.evaluate(nodes, y, x, slopes=slopes)
    found = np.empty_like(wanted)
    compiled.spline(nodes, y, x, found)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-13)


def test_evaluation_in_several_parts_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    nodes = random_nodes(20, 20, 2)
    y, x = np.random.default_rng(8).uniform(1, 17, (2, 100))
    whole = bspline.evaluate(nodes, y, x)
    monkeypatch.setattr(bspline, "_POINTS_AT_ONCE", 7)
    np.testing.assert_array_equal(bspline.evaluate(nodes, y, x), whole)


@pytest.mark.parametrize("axis", [0, 1])
def test_node_derivative_is_exact_for_sixth_degree_polynomials(axis: int) -> None:
    t = np.linspace(-1, 1, 15)
    p = np.polynomial.Polynomial([1.0, -2, 0.5, 3, -1, 2, 0.7])
    values = np.moveaxis(np.stack([p(t), 2 * p(t)], axis=1), 0, axis)
    wanted = np.moveaxis(np.stack([p.deriv()(t), 2 * p.deriv()(t)], axis=1), 0, axis)
    found = node_derivative(values, axis) / (t[1] - t[0])
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12)
