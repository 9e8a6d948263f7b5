"""A patch must answer as the release it was cut from."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from magtiles.catalog import Release, open_release
from magtiles.schemas.errors import QueryError

METHODS = ("total", "total_with_gradient", "vector", "vector_with_gradient", "tensor")
BOUNDS = {"latitude": (44.05, 44.4), "longitude": (10.1, 10.62)}

RELAXED = settings(
    max_examples=20,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def differences(patch: Any, anomaly: Any, lat: Any, lon: Any, **height: Any) -> list[float]:
    """Largest difference of each answer; NaN must stand in the same places."""
    found = []
    for name in METHODS:
        ours, wanted = getattr(patch, name)(lat, lon), getattr(anomaly, name)(lat, lon, **height)
        if not isinstance(ours, tuple):
            ours, wanted = (ours,), (wanted,)
        for a, b in zip(ours, wanted, strict=True):
            assert np.shape(a) == np.shape(b)
            np.testing.assert_array_equal(np.isnan(a), np.isnan(b))
            found.append(float(np.nanmax(np.abs(a - b), initial=0.0)))
    return found


@RELAXED
@given(
    height=st.floats(0.0, 8000.0) | st.sampled_from([0.0, 1000.0, 8000.0]),
    south=st.floats(44.0, 44.3),
    west=st.floats(10.0, 10.5),
    seed=st.integers(0, 2**32 - 1),
)
def test_a_patch_answers_as_the_release(
    release: Release, height: float, south: float, west: float, seed: int
) -> None:
    bounds = {"latitude": (south, south + 0.1), "longitude": (west, west + 0.15)}
    patch = release.anomaly.patch(bounds, height=height)
    rng = np.random.default_rng(seed)
    lat, lon = rng.uniform(south, south + 0.1, 50), rng.uniform(west, west + 0.15, 50)
    # Measured at most 1e-7: what is left of the ends of tiles and patch, 12 nodes away.
    assert max(differences(patch, release.anomaly, lat, lon, height=height)) < 1e-6


def test_nodes_and_tile_edges_answer_alike(release: Release) -> None:
    area = release.manifest.lattice
    patch = release.anomaly.patch(
        {"latitude": (area.south, area.north), "longitude": (area.west, area.east)}, height=700.0
    )
    lat = area.latitudes(np.arange(area.rows + 1))[:, None]
    lon = area.longitudes(np.arange(area.columns + 1))
    assert max(differences(patch, release.anomaly, lat, lon, height=700.0)) < 1e-6
    assert np.isnan(patch.total(lat, lon)).sum() == 7 * 8  # as flagged, within the lattice


def test_over_terrain_a_patch_keeps_the_levels(terrain_folder: Path) -> None:
    an = open_release(terrain_folder).anomaly
    patch = an.patch(BOUNDS, height=1500.0)
    lat, lon = np.random.default_rng(1).uniform((44.05, 10.1), (44.4, 10.62), (200, 2)).T
    assert max(differences(patch, an, lat, lon, height=1500.0)) < 1e-6


def test_terrain_below_the_levels_is_refused_as_without_a_patch(terrain_folder: Path) -> None:
    an = open_release(terrain_folder).anomaly
    patch = an.patch(BOUNDS, height=1000.0)
    lat, lon = np.random.default_rng(1).uniform((44.05, 10.1), (44.4, 10.62), (200, 2)).T
    with pytest.raises(QueryError, match="height above the terrain"):
        patch.total(lat, lon)


def test_a_patch_above_unknown_terrain(blind_terrain_folder: Path) -> None:
    an = open_release(blind_terrain_folder).anomaly
    patch = an.patch(BOUNDS, height_above_reference=170.0)
    found = differences(patch, an, 44.2, [10.3, 10.4], height_above_reference=170.0)
    assert max(found) < 1e-6


def test_a_patch_across_the_date_line(date_line_folder: Path) -> None:
    an = open_release(date_line_folder).anomaly
    patch = an.patch({"latitude": (-17.9, -17.7), "longitude": (179.9, -179.9)}, height=500.0)
    lon = np.array([179.95, 179.999, -179.999, -179.95, 180.05, -180.0])
    assert max(differences(patch, an, -17.8, lon, height=500.0)) < 1e-6
    assert np.isfinite(patch.total(-17.8, lon)).all()
    assert np.isnan(patch.total(-17.8, 179.8))


def test_outside_its_bounds_and_lost_a_patch_answers_nan(release: Release) -> None:
    patch = release.anomaly.patch(BOUNDS, height=500.0)
    lat, lon = np.array([44.2, 44.0, 44.2, np.nan]), np.array([10.3, 10.3, 10.9, 10.3])
    value, gradient = patch.total_with_gradient(lat, lon)
    assert np.isnan(value).tolist() == [False, True, True, True]
    assert np.isnan(gradient).all(axis=1).tolist() == [False, True, True, True]
    assert np.isnan(patch.tensor(lat, lon)).all(axis=1).tolist() == [False, True, True, True]


def test_extrapolated_patches_answer_where_the_release_does(folder: Path) -> None:
    an = open_release(folder, allow_extrapolated=True).anomaly
    bounds = {"latitude": (44.3, 44.41), "longitude": (10.4, 10.66)}
    lat, lon = np.random.default_rng(2).uniform((44.3, 10.4), (44.41, 10.66), (200, 2)).T
    for height in (500.0, 9000.0, -50.0):
        assert max(differences(an.patch(bounds, height=height), an, lat, lon, height=height)) < 1e-6


def test_shapes_are_those_of_the_release(release: Release) -> None:
    patch = release.anomaly.patch(BOUNDS, height=500.0)
    square = np.full((2, 3), 44.2)
    assert patch.total_with_gradient(square, np.full((2, 3), 10.3))[1].shape == (2, 3, 3)
    assert patch.total_with_gradient(square[::2, ::2], 10.3)[0].shape == (1, 2)
    assert np.ndim(patch.total(44.2, 10.3)) == 0
    assert patch.total_with_gradient(44.2, 10.3)[1].shape == (3,)
    with pytest.raises(QueryError, match=r"latitude\[1\]: is 91"):
        patch.total(np.array([44.2, 91.0]), np.array([10.3, 10.3]))
    with pytest.raises(QueryError, match="longitude: is inf"):
        patch.total(44.2, np.inf)
    with pytest.raises(QueryError, match="do not broadcast"):
        patch.total(np.zeros(2), np.zeros(3))


class Refusal(NamedTuple):
    bounds: Any
    height: Any
    message: str


@pytest.mark.parametrize(
    "case",
    [
        Refusal(BOUNDS, -1.0, "height: is -1; expected 0 to 8000 m"),
        Refusal(BOUNDS, 8001.0, "height: is 8001"),
        Refusal(BOUNDS, [1.0, 2.0], "one finite number"),
        Refusal(BOUNDS, np.nan, "one finite number"),
        Refusal({"latitude": (44.0, 44.1)}, 5.0, "bounds: are"),
        Refusal({**BOUNDS, "latitude": (44.1, 44.0)}, 5.0, "south is above north"),
        Refusal({**BOUNDS, "latitude": (50.0, 51.0)}, 5.0, "do not meet the release"),
        Refusal({**BOUNDS, "longitude": (20.0, 21.0)}, 5.0, "do not meet the release"),
        Refusal({**BOUNDS, "longitude": (20.0,)}, 5.0, "two numbers"),
    ],
    ids=lambda case: case.message,
)
def test_a_patch_that_makes_no_sense_is_refused(release: Release, case: Refusal) -> None:
    with pytest.raises(QueryError, match=case.message):
        release.anomaly.patch(case.bounds, height=case.height)
