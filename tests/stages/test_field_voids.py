"""Filling: what is a void and what is beyond, and a surface that a direct solver confirms."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg
from grids import geographic_grid, projected_grid

from magtiles.schemas import contracts
from magtiles.schemas.errors import SourceError
from magtiles.stages.field.voids import (
    FillVoidsParams,
    classify_gaps,
    fill_voids,
    minimum_curvature,
)

Y, X = np.meshgrid(np.arange(40.0), np.arange(56.0), indexing="ij")
ELLIPSE = ((X - 30) / 9) ** 2 + ((Y - 18) / 6) ** 2 < 1


def fill(values: np.ndarray):
    y, x = 5.1e6 + 1000.0 * np.arange(values.shape[0]), 5e5 + 1000.0 * np.arange(values.shape[1])
    return fill_voids(projected_grid(values, y, x), params=FillVoidsParams())


@pytest.mark.parametrize(
    ("picture", "voids", "beyond"),
    [
        ([".....", ".##..", ".....", "....."], 2, 0),
        (["##...", "#....", ".....", "....."], 0, 3),
        (["#....", ".#...", ".....", "....."], 1, 1),  # corners do not connect
        ([".#...", ".#...", ".###.", "....."], 0, 5),  # a bay
        (["#####", "#...#", "#.#.#", "#...#", "#####"], 1, 16),
    ],
    ids=["enclosed", "corner", "touching a corner", "bay", "island with a lake"],
)
def test_voids_are_what_data_surround(picture, voids, beyond):
    missing = np.array([list(row) for row in picture]) == "#"
    void, outside = classify_gaps(missing)
    assert (int(void.sum()), int(outside.sum())) == (voids, beyond)
    assert np.array_equal(void | outside, missing)


@pytest.mark.parametrize(
    "surface", [3.0 + 0.2 * X - 0.5 * Y, 0.05 * (X - 25) ** 2 + 0.03 * (Y - 20) ** 2 - 0.02 * X * Y]
)
def test_a_plane_and_a_well_are_bridged(surface):
    """Both satisfy the biharmonic equation, on the lattice too; relaxation stops short of it."""
    found = minimum_curvature(np.where(ELLIPSE, np.nan, surface), ELLIPSE)
    assert np.array_equal(found[~ELLIPSE], surface[~ELLIPSE])
    # Measured: 0.8 and 1.5 % of the range, over a third of it that is missing.
    assert np.abs(found - surface).max() < 0.02 * np.ptp(surface)


def test_against_a_direct_solver():
    """The biharmonic equation on the void, as a sparse linear system."""
    rng = np.random.default_rng(0)
    waves = sum(
        rng.normal() * np.cos(a * X + b * Y + c) for a, b, c in rng.uniform(0.05, 0.6, (20, 3))
    )
    stencil = {(0, 0): 20, (2, 0): 1, (-2, 0): 1, (0, 2): 1, (0, -2): 1}
    stencil |= {(1, 0): -8, (-1, 0): -8, (0, 1): -8, (0, -1): -8}
    stencil |= {(1, 1): 2, (1, -1): 2, (-1, 1): 2, (-1, -1): 2}
    nodes = np.argwhere(ELLIPSE)
    number = {tuple(n): k for k, n in enumerate(nodes)}
    matrix, right = scipy.sparse.lil_matrix((len(nodes), len(nodes))), np.zeros(len(nodes))
    for k, (i, j) in enumerate(nodes):
        for (di, dj), factor in stencil.items():
            at = (i + di, j + dj)
            if at in number:
                matrix[k, number[at]] = factor
            else:
                right[k] -= factor * waves[at]
    exact = scipy.sparse.linalg.spsolve(matrix.tocsr(), right)
    found = minimum_curvature(np.where(ELLIPSE, np.nan, waves), ELLIPSE)[ELLIPSE]
    assert np.abs(found - exact).max() < 0.5 * np.std(waves)  # measured: 0.37
    assert np.corrcoef(found, exact)[0, 1] > 0.97


def test_the_outside_fades_to_the_mean_and_keeps_no_gap():
    """A coast: continuous where data end, at the mean some 20 cells out, flagged and measured."""
    rng = np.random.default_rng(1)
    land = 50.0 + 0.1 * rng.normal(size=(60, 120)) + np.linspace(-20, 20, 60)[:, None]
    values = np.where(np.arange(120) < 45, np.nan, land)
    values[30, 80] = np.nan
    filled = fill(values)
    found, flags = filled["magnetic_anomaly"].values, filled["quality_flag"].values
    contracts.check(filled, "anomaly-grid/1")
    known = np.isfinite(values)
    assert np.array_equal(found[known], values[known])
    assert flags[30, 80] == 1
    assert np.all(flags[:, :45] == 2)
    assert not flags[known].any()
    assert found[:, :24] == pytest.approx(np.nanmean(values), abs=1e-9)
    assert np.abs(found[:, 44] - values[:, 45]).max() < 3.0
    distance = filled["distance_to_data"].values
    assert distance[:, :45] == pytest.approx(1000.0 * np.broadcast_to(45 - np.arange(45), (60, 45)))
    assert distance[30, 80] == 1000.0
    assert not distance[known].any()


def test_distance_is_in_true_metres_on_a_geographic_grid():
    """At 60 degrees a degree of longitude is half one of latitude."""
    values = np.ones((41, 41))
    values[16:25, 10:31] = np.nan
    latitude, longitude = 60.0 + 0.01 * np.arange(-20, 21), 10.0 + 0.01 * np.arange(41)
    filled = fill_voids(geographic_grid(values, latitude, longitude), params=FillVoidsParams())
    # Five nodes to the south or north, 5.57 km; along the row eleven of 0.56 km.
    assert filled["distance_to_data"].values[20, 20] == pytest.approx(5 * 1114.1, rel=1e-3)
    assert filled["distance_to_data"].values[20, 12] == pytest.approx(3 * 558.0, rel=1e-3)


def test_what_is_complete_stays_itself():
    values = np.random.default_rng(2).normal(size=(12, 15))
    filled = fill(values)
    assert np.array_equal(filled["magnetic_anomaly"].values, values)
    assert not filled["quality_flag"].values.any()


def test_input_is_left_alone():
    values = np.where(ELLIPSE, np.nan, X)
    before = values.copy()
    fill(values)
    assert np.array_equal(values, before, equal_nan=True)


def test_nothing_measured_is_refused():
    with pytest.raises(SourceError, match=r"every node .* void.*no_data"):
        fill(np.full((8, 9), np.nan))
