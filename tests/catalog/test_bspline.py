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
    """A wave of 8 nodes, 500 in amplitude: rougher than any well-sampled anomaly."""
    y = offset + np.arange(cells)
    return 500.0 * np.sin(2.0 * np.pi * y / 8.0)[:, None] * np.cos(0.7 * np.arange(cells))


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
    # 500 nT at 8 nodes a wave: mirrored ends are 9e-5 nT off, 12 nodes away.
    np.testing.assert_allclose(ours, mirrored, rtol=0, atol=2e-4)


def test_two_overlapping_arrays_agree_on_their_seam_to_a_millionth_of_the_amplitude() -> None:
    west, east = smooth_nodes(), smooth_nodes(offset=60 - 2 * HALO - 1)
    x = np.linspace(HALO, 59 - HALO, 200)
    seam = np.full_like(x, 59.0 - HALO)
    one = bspline.evaluate(bspline.prefilter(west)[..., None], seam, x)
    two = bspline.evaluate(bspline.prefilter(east)[..., None], seam - (59 - 2 * HALO), x)
    # Measured 2.5e-5 of 500 nT; half that wavelength again would alias in the survey itself.
    assert np.abs(one - two).max() < 5e-5


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
