"""Answers of the reader against exact dipole fields, and its refusals."""

from __future__ import annotations

import gc
import weakref
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from synthetic_release import World

from magtiles.catalog import Release, open_release
from magtiles.catalog.kernels.geodesy import metres_per_degree
from magtiles.catalog.releases.tile import Tile
from magtiles.schemas.errors import QueryError

INSIDE = {"latitude": 44.2, "longitude": 10.3, "height": 500.0}


def positions(world: World, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Random positions on the covered part of a world's lattice."""
    rng = np.random.default_rng(seed)
    area = world.lattice
    lat = rng.uniform(area.south, area.south + 38 * area.latitude_spacing, count)
    return lat, rng.uniform(area.west, area.east, count)


def relative(found: Any, truth: np.ndarray) -> float:
    return float(np.sqrt(np.mean((np.asarray(found) - truth) ** 2) / np.mean(truth**2)))


def errors_at(world: World, release: Release, height: float) -> dict[str, float]:
    """Relative rms error of each answer at one height."""
    lat, lon = positions(world, 1500)
    h = np.full_like(lat, height)
    total, vector, tensor = world.truth(lat, lon, h)
    nn, ne, nd, ee, ed = np.moveaxis(tensor, -1, 0)
    full = np.stack([nn, ne, nd, ne, ee, ed, nd, ed, -nn - ee], axis=-1).reshape(-1, 3, 3)
    step = 1.0
    north, east = metres_per_degree(lat, height)
    slope = np.stack(
        [
            world.truth(lat + step / north, lon, h)[0] - world.truth(lat - step / north, lon, h)[0],
            world.truth(lat, lon + step / east, h)[0] - world.truth(lat, lon - step / east, h)[0],
            world.truth(lat, lon, h - step)[0] - world.truth(lat, lon, h + step)[0],
        ],
        axis=-1,
    ) * (1000.0 / (2.0 * step))
    an = release.anomaly
    found, gradient = an.total_with_gradient(lat, lon, height)
    found_vector, jacobian = an.vector_with_gradient(lat, lon, height)
    return {
        "total": relative(found, total),
        "total gradient": relative(gradient, slope),
        "vector": relative(found_vector, vector),
        "vector gradient": relative(jacobian, full),
        "tensor": relative(an.tensor(lat, lon, height), tensor),
    }


def test_between_levels_the_map_is_as_good_as_on_them(world: World, release: Release) -> None:
    # Measured, total: 0.063, 0.017, 0.006, 0.0016 and 0.0003 % on the levels, and at most
    # 0.013 % more between them, at 6 km; on a like map cubic Hermite added 0.6 %. Total gradient
    # 0.58 % at the surface; at most 0.04 % more between levels, the tensor's 0.09 %.
    on = {h: errors_at(world, release, h) for h in world.heights}
    for low, high in zip(world.heights, world.heights[1:], strict=False):
        between = errors_at(world, release, (low + high) / 2)
        for name, error in between.items():
            at_levels = max(on[low][name], on[high][name])
            allowed = 0.0002 if name in ("total", "vector") else 0.001
            assert error < at_levels + allowed, (name, low)
    assert on[0.0]["total"] < 0.001
    assert max(on[0.0].values()) < 0.007
    assert on[8000.0]["total"] < 1e-5


@pytest.mark.parametrize("height", [1.0, 333.0, 1000.0, 5000.0, 7999.0])
def test_gradients_are_the_exact_derivatives_of_the_values(
    world: World, folder: Path, height: float
) -> None:
    an = open_release(folder, allow_extrapolated=True).anomaly
    lat, lon = positions(world, 300, seed=1)
    h = np.full_like(lat, height)
    _check_derivatives(an, lat, lon, h)


def test_gradients_over_terrain_are_exact_and_include_its_slope(
    terrain_world: World, terrain_folder: Path
) -> None:
    an = open_release(terrain_folder, allow_extrapolated=True).anomaly
    lat, lon = positions(terrain_world, 300, seed=2)
    h = an.reference_surface(lat, lon) + np.linspace(101.0, 999.0, len(lat))
    _check_derivatives(an, lat, lon, h)


def _check_derivatives(an: Any, lat: np.ndarray, lon: np.ndarray, h: np.ndarray) -> None:
    step = 0.5
    north, east = metres_per_degree(lat, h)
    moves = [(step / north, 0.0, 0.0), (0.0, step / east, 0.0), (0.0, 0.0, -step)]
    for method, gradient in (
        (an.total, an.total_with_gradient(lat, lon, h)[1]),
        (an.vector, an.vector_with_gradient(lat, lon, h)[1]),
    ):
        for axis, (dy, dx, dh) in enumerate(moves):
            ahead = method(lat + dy, lon + dx, h + dh)
            behind = method(lat - dy, lon - dx, h - dh)
            difference = (ahead - behind) / (2 * step) * 1000.0
            scale = np.sqrt(np.mean(gradient**2))
            np.testing.assert_allclose(gradient[..., axis], difference, rtol=0, atol=1e-6 * scale)


def test_value_and_gradient_are_continuous_across_levels_and_tiles(
    world: World, release: Release
) -> None:
    an, area = release.anomaly, world.lattice
    lat, lon = positions(world, 100, seed=3)
    seam_lat = area.south + area.tile_rows * area.latitude_spacing
    seam_lon = area.west + area.tile_columns * area.longitude_spacing
    eps = 1e-10
    for here, there in (
        ((lat, lon, 2000.0 - 1e-5), (lat, lon, 2000.0 + 1e-5)),
        ((seam_lat - eps, lon, 700.0), (seam_lat + eps, lon, 700.0)),
        ((lat, seam_lon - eps, 700.0), (lat, seam_lon + eps, 700.0)),
    ):
        for method in (an.total_with_gradient, an.vector_with_gradient):
            for a, b in zip(method(*here), method(*there), strict=True):
                np.testing.assert_allclose(a, b, rtol=0, atol=2e-6)
        np.testing.assert_allclose(an.tensor(*here), an.tensor(*there), rtol=0, atol=2e-6)


def test_over_terrain_heights_count_from_the_ellipsoid(
    terrain_world: World, terrain_folder: Path
) -> None:
    release = open_release(terrain_folder)
    lat, lon = positions(terrain_world, 500, seed=4)
    surface = terrain_world.surface_height(lat, lon)
    np.testing.assert_allclose(release.anomaly.reference_surface(lat, lon), surface, atol=0.5)
    h = surface + 250.0
    total, vector, _ = terrain_world.truth(lat, lon, h)
    # Hills of 200 m over 10 km break the flat assumption of the vertical derivatives a little.
    assert relative(release.anomaly.total(lat, lon, h), total) < 0.005
    assert relative(release.anomaly.vector(lat, lon, h), vector) < 0.005


def test_a_release_that_does_not_know_its_terrain_takes_height_above_it(
    blind_terrain_folder: Path,
) -> None:
    an = open_release(blind_terrain_folder).anomaly
    assert np.isfinite(an.total(44.2, 10.3, height_above_reference=150.0))
    with pytest.raises(QueryError, match="give height_above_reference="):
        an.total(44.2, 10.3, 150.0)
    with pytest.raises(QueryError, match="ellipsoidal height is not known"):
        an.reference_surface(44.2, 10.3)


def test_an_ellipsoidal_release_refuses_height_above_reference(release: Release) -> None:
    with pytest.raises(QueryError, match=r"height_above_reference does not apply.*give height="):
        release.anomaly.total(44.2, 10.3, height_above_reference=150.0)
    with pytest.raises(QueryError, match="height is missing"):
        release.anomaly.total(44.2, 10.3)


def test_arguments_broadcast_to_the_shape_of_the_answer(release: Release) -> None:
    an = release.anomaly
    lat, lon = np.array([[44.1], [44.2]]), np.array([10.1, 10.2, 10.3])
    total, gradient = an.total_with_gradient(lat, lon, 500)
    vector, jacobian = an.vector_with_gradient(lat, lon, [500, 600, 700])
    shapes = [a.shape for a in (total, gradient, vector, jacobian, an.tensor(lat, lon, 5.0))]
    assert shapes == [(2, 3), (2, 3, 3), (2, 3, 3), (2, 3, 3, 3), (2, 3, 5)]
    assert an.flags(lat, lon, 500).dtype == np.uint8
    assert an.uncertainty(lat, lon, 500, quantity="tensor").shape == (2, 3)
    assert total[1, 2] == an.total(44.2, 10.3, 500.0)
    assert np.ndim(an.total(44.2, 10.3, 500.0)) == 0
    assert an.total([], [], []).shape == (0,)


def test_longitudes_may_be_given_in_any_turn(release: Release) -> None:
    turns = release.anomaly.total(44.2, np.array([10.3, 370.3, -349.7]), 500.0)
    np.testing.assert_allclose(turns, turns[0], rtol=0, atol=1e-9)


def test_a_release_crosses_the_date_line(date_line_world: World, date_line_folder: Path) -> None:
    an = open_release(date_line_folder).anomaly
    lon = np.array([179.999, -179.999, 180.0, -180.0, 180.001])
    truth, _, _ = date_line_world.truth(np.full(5, -17.8), lon, np.full(5, 500.0))
    found = an.total(-17.8, lon, 500.0)
    np.testing.assert_allclose(found, truth, rtol=0, atol=0.02)
    assert found[2] == found[3]
    assert found[4] == pytest.approx(found[1], abs=1e-9)
    assert np.isnan(an.total(-17.8, [179.6, -179.7], 500.0)).tolist() == [True, False]


def test_outside_above_and_lost_positions_answer_nan_and_flag_2(release: Release) -> None:
    an, nan = release.anomaly, np.nan
    lat = np.array([43.9, 44.2, 44.2, nan, 44.2, 44.2])
    lon = np.array([10.3, 9.0, 10.3, 10.3, nan, 10.3])
    h = np.array([500.0, 500.0, 8001.0, 500.0, 500.0, nan])
    assert np.isnan(an.total(lat, lon, h)).all()
    assert np.isnan(an.vector_with_gradient(lat, lon, h)[1]).all()
    assert np.isnan(an.uncertainty(lat, lon, h)).all()
    np.testing.assert_array_equal(an.flags(lat, lon, h), 2)
    assert an.flags(44.2, 10.3, -1.0) == 6
    assert an.flags(44.2, 10.3, 500.0) == 0


def test_next_to_a_node_beyond_coverage_the_answer_is_nan(world: World, folder: Path) -> None:
    area = world.lattice
    # The first flagged node is array node (52, 50), lattice node (40, 38).
    first_lat = area.south + 40 * area.latitude_spacing
    first_lon = area.west + 38 * area.longitude_spacing
    half = 0.5 * area.latitude_spacing
    lat = first_lat + np.array([-2 * half, -half, 0.0, half])
    an = open_release(folder).anomaly
    assert np.isnan(an.total(lat, first_lon, 500.0)).tolist() == [False, True, True, True]
    assert an.flags(lat, first_lon, 500.0).tolist() == [0, 2, 2, 2]
    brave = open_release(folder, allow_extrapolated=True).anomaly
    truth, _, _ = world.truth(lat, np.full(4, first_lon), np.full(4, 500.0))
    np.testing.assert_allclose(brave.total(lat, first_lon, 500.0), truth, atol=0.05)


def test_every_edge_of_the_lattice_is_inside(world: World, folder: Path) -> None:
    area = world.lattice
    an = open_release(folder, allow_extrapolated=True).anomaly
    lat, lon = np.meshgrid([area.south, area.north], [area.west, area.east])
    assert np.isfinite(an.total(lat, lon, 0.0)).all()
    assert np.isnan(an.total([area.south - 1e-6, area.north + 1e-6], area.west, 0.0)).all()
    assert np.isnan(an.total(area.south, [area.west - 1e-6, area.east + 1e-6], 0.0)).all()


def test_extrapolation_goes_on_along_the_vertical_gradient(folder: Path) -> None:
    an = open_release(folder, allow_extrapolated=True).anomaly
    for level, beyond in ((8000.0, 8100.0), (0.0, -100.0)):
        value, gradient = an.total_with_gradient(44.2, 10.3, level)
        expected = value - gradient[2] * (beyond - level) / 1000.0
        assert an.total(44.2, 10.3, beyond) == pytest.approx(expected, abs=1e-12)
    assert np.isnan(an.total(43.0, 10.3, 500.0))


def test_uncertainty_is_linear_between_the_nodes(world: World, release: Release) -> None:
    lat = world.lattice.latitudes(np.array([3, 4]))
    lon = world.lattice.longitudes(np.array([7]))[0]
    ends = release.anomaly.uncertainty(lat, lon, 0.0)
    middle = release.anomaly.uncertainty(lat.mean(), lon, 300.0)
    assert middle == pytest.approx(ends.mean(), rel=1e-6)
    assert release.anomaly.uncertainty(lat[0], lon, 0.0, quantity="vector") == pytest.approx(
        2 * ends[0], rel=1e-6
    )


def test_a_single_level_answers_at_its_height_only(world: World, tmp_path: Path) -> None:
    single = World(heights=(150.0,))
    an = open_release(single.publish(tmp_path).path).anomaly
    truth, _, _ = single.truth(np.array(44.2), np.array(10.3), np.array(150.0))
    assert an.total(44.2, 10.3, 150.0) == pytest.approx(truth, abs=0.05)
    down = np.diff(single.truth(np.full(2, 44.2), np.full(2, 10.3), np.array([151.0, 149.0]))[0])
    assert an.total_with_gradient(44.2, 10.3, 150.0)[1][2] == pytest.approx(500 * down[0], rel=0.01)
    assert np.isnan(an.total(44.2, 10.3, 150.001))
    with pytest.raises(QueryError, match=r"height: is 149\.999; expected at least 150 m"):
        an.total(44.2, 10.3, 149.999)


class Refusal(NamedTuple):
    arguments: dict[str, Any]
    message: str
    id: str


REFUSALS = [
    Refusal({"latitude": 91.0}, r"latitude: is 91; expected degrees in \[-90, 90\]", "latitude 91"),
    Refusal({"latitude": [44.0, -90.5]}, r"latitude\[1\]: is -90\.5", "second latitude"),
    Refusal({"latitude": [[44.2], [np.inf]]}, r"latitude\[1, 0\]: is inf", "infinite latitude"),
    Refusal({"longitude": np.inf}, "longitude: is inf", "infinite longitude"),
    Refusal({"height": np.inf}, "height: is inf", "infinite height"),
    Refusal({"height": [5.0, -1.0]}, r"height\[1\]: is -1; expected at least 0 m", "below survey"),
    Refusal({"latitude": "44"}, "latitude: has dtype <U2", "text"),
    Refusal({"latitude": 44 + 0j}, "latitude: has dtype complex128", "complex"),
    Refusal({"latitude": True}, "latitude: has dtype bool", "bool"),
    Refusal({"longitude": [[1.0], [1.0, 2.0]]}, "longitude: is no array", "ragged"),
    Refusal(
        {"latitude": [44.0, 44.1], "longitude": [10.0, 10.1, 10.2]},
        r"shapes do not broadcast: latitude \(2,\), longitude \(3,\)",
        "shapes",
    ),
]


@pytest.mark.parametrize("case", REFUSALS, ids=lambda case: case.id)
def test_a_query_that_makes_no_sense_is_refused(release: Release, case: Refusal) -> None:
    with pytest.raises(QueryError, match=case.message):
        release.anomaly.total_with_gradient(**{**INSIDE, **case.arguments})


def test_an_unknown_quantity_is_refused(release: Release) -> None:
    with pytest.raises(QueryError, match="expected one of total, vector, tensor"):
        release.anomaly.uncertainty(**INSIDE, quantity="field")


def test_what_the_release_has_not_is_said(release: Release) -> None:
    with pytest.raises(QueryError, match=r"demo 1\.0\.0: has no temporal model"):
        _ = release.temporal
    with pytest.raises(QueryError, match="has no road maps"):
        _ = release.roads


def test_masked_positions_are_lost_ones(release: Release) -> None:
    lat = np.ma.masked_array([44.2, 44.2], mask=[False, True])
    assert np.isnan(release.anomaly.total(lat, 10.3, 500.0)).tolist() == [False, True]


def test_threads_and_a_cache_of_one_tile_change_nothing(world: World, folder: Path) -> None:
    lat, lon = positions(world, 400, seed=5)
    wanted = open_release(folder).anomaly.total(lat, lon, 700.0)
    shared = open_release(folder, cache_bytes=0).anomaly
    with ThreadPoolExecutor(4) as pool:
        for found in pool.map(lambda _: shared.total(lat, lon, 700.0), range(8)):
            np.testing.assert_array_equal(found, wanted)


def test_releases_in_threads_of_their_own_share_one_library(world: World, folder: Path) -> None:
    # HDF5 crashes the process where two threads are in it.
    wanted = len(list(open_release(folder).tiles()))
    with ThreadPoolExecutor(4) as pool:
        found = pool.map(lambda _: len(list(open_release(folder).tiles())), range(12))
        assert set(found) == {wanted}


def test_files_are_closed_with_the_release_not_by_the_garbage_collector(
    world: World, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The collector runs in any thread, also while another one is inside HDF5.
    opened: list[weakref.ref[Tile]] = []
    monkeypatch.setattr(Tile, "_check", lambda tile: opened.append(weakref.ref(tile)))
    lat, lon = positions(world, 50, seed=6)
    gc.disable()
    try:
        release = open_release(folder)
        release.anomaly.total(lat, lon, 700.0)
        assert opened[0]() is not None
        del release
        assert [tile() for tile in opened] == [None] * len(opened)
    finally:
        gc.enable()
