"""Level curves and parallel paths of a small map, against what is known of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from magtiles.catalog import Release
from magtiles.catalog.kernels.geodesy import metres_per_degree
from magtiles.catalog.releases.level_curve import mean_absolute_deviation, nearest_on_level_curve
from magtiles.schemas.errors import QueryError

Floats = NDArray[np.float64]

PLACE = (47.0, 179.9999)
NORTH, EAST = (float(m) for m in metres_per_degree(np.array(PLACE[0]), 0.0))


def metres(lat: Floats, lon: Floats) -> tuple[Floats, Floats]:
    return (lat - PLACE[0]) * NORTH, (lon - PLACE[1]) * EAST


def cone(lat: Floats, lon: Floats) -> Floats:
    """10 nT a metre from a summit 30 m north and 40 m east."""
    y, x = metres(lat, lon)
    return np.asarray(500.0 - 10.0 * np.hypot(y - 30.0, x - 40.0))


class Curve(NamedTuple):
    value: float
    within: float
    distance: float
    place: tuple[float, float]
    id: str


CURVES = [
    Curve(200.0, 60.0, 20.0, (12.0, 16.0), "toward the summit"),
    Curve(-200.0, 60.0, 20.0, (-12.0, -16.0), "away from it"),
    Curve(0.0, 60.0, 0.0, (0.0, 0.0), "here"),
    Curve(300.0, 29.0, np.nan, (np.nan, np.nan), "too far"),
    Curve(600.0, 60.0, np.nan, (np.nan, np.nan), "nowhere"),
]


@pytest.mark.parametrize("case", CURVES, ids=lambda c: c.id)
def test_circles(case: Curve) -> None:
    """Within 0.1 mm in distance and 1 mm along the curve."""
    found = nearest_on_level_curve(cone, case.value, *PLACE, case.within)
    assert found.distance_m == pytest.approx(case.distance, abs=1e-4, nan_ok=True)
    east = (found.longitude - PLACE[1] + 180.0) % 360.0 - 180.0
    y, x = (found.latitude - PLACE[0]) * NORTH, east * EAST
    assert (y, x) == pytest.approx(case.place, abs=1e-3, nan_ok=True)


def test_on_a_release_and_its_patch(release: Release) -> None:
    here = 44.2, 10.3
    value = float(release.anomaly.total(*here, 500.0)) + 5.0
    found = release.anomaly.nearest_on_level_curve(value, *here, 500.0, within_m=2000.0)
    total, gradient = release.anomaly.total_with_gradient(found.latitude, found.longitude, 500.0)
    assert abs(total - value) < 1e-6
    north, east = metres_per_degree(np.array(here[0]), 0.0)
    away = np.array([(found.latitude - here[0]) * north, (found.longitude - here[1]) * east])
    assert np.hypot(*away) == pytest.approx(found.distance_m)
    # The shortest way stands upright on the curve, but for the scale's change over 1 km.
    sine = (away[0] * gradient[1] - away[1] * gradient[0]) / found.distance_m
    sine /= np.hypot(*gradient[:2])
    assert abs(sine) < 2e-3
    bounds = {"latitude": (44.15, 44.25), "longitude": (10.2, 10.4)}
    patch = release.anomaly.patch(bounds, 500.0)
    again = patch.nearest_on_level_curve(value, *here, within_m=2000.0)
    assert again.distance_m == pytest.approx(found.distance_m, abs=1e-4)
    far = release.anomaly.nearest_on_level_curve(value, 0.0, 0.0, 500.0, within_m=100.0)
    assert np.isnan(far.distance_m)


def test_a_shifted_path_is_found(release: Release) -> None:
    latitude, longitude = 44.2 + 2e-4 * np.arange(20), 10.3 + 4e-4 * np.arange(20)
    north, east = metres_per_degree(latitude, 0.0)
    values = release.anomaly.total(latitude + 300.0 / north, longitude - 200.0 / east, 500.0)
    found = release.anomaly.mean_absolute_deviation(
        values, latitude, longitude, 500.0, half_width_m=500.0, step_m=50.0
    )
    assert (found.best_north_m, found.best_east_m) == (300.0, -200.0)
    assert found.deviation.shape == (21, 21)
    assert found.deviation.min() < 1e-9
    i, j = 3, 17
    shifted = release.anomaly.total(
        latitude + found.north_m[i] / north, longitude + found.east_m[j] / east, 500.0
    )
    assert found.deviation[i, j] == pytest.approx(np.abs(shifted - values).mean())


def test_no_coverage_is_nan() -> None:
    def half(lat: Floats, lon: Floats) -> Floats:
        return np.where(metres(lat, lon)[0] < 0.0, np.nan, cone(lat, lon))

    found = mean_absolute_deviation(half, [0.0], [PLACE[0]], [PLACE[1]], 2.0, 1.0)
    assert np.isnan(found.deviation).sum() == 10
    assert (found.best_north_m, found.best_east_m) == (0.0, 0.0)
    nowhere = mean_absolute_deviation(
        lambda lat, lon: np.full(lat.shape, np.nan), [0.0], [0.0], [0.0], 2.0, 1.0
    )
    assert np.isnan(nowhere.best_north_m)


REFUSED: list[tuple[Callable[[], Any], str]] = [
    (lambda: nearest_on_level_curve(cone, np.nan, *PLACE, 5.0), "value: is nan"),
    (lambda: nearest_on_level_curve(cone, 1.0, 91.0, 0.0, 5.0), "latitude: is 91"),
    (lambda: nearest_on_level_curve(cone, 1.0, *PLACE, 0.0), "within_m: is 0"),
    (lambda: mean_absolute_deviation(cone, [np.nan], [0.0], [0.0], 1.0, 1.0), "not all finite"),
    (lambda: mean_absolute_deviation(cone, [], [], [], 1.0, 1.0), "not all finite"),
    (lambda: mean_absolute_deviation(cone, [1.0], [0.0], [0.0], 1e6, 1.0), "makes .* shifts"),
    (lambda: mean_absolute_deviation(cone, [1.0], [0.0], [0.0], 1.0, -1.0), "step_m: is -1"),
]


@pytest.mark.parametrize(("ask", "message"), REFUSED)
def test_refused(ask: Callable[[], Any], message: str) -> None:
    with pytest.raises(QueryError, match=message):
        ask()
