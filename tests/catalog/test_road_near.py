"""The index of a road's plane against looking at every point."""

from __future__ import annotations

from dataclasses import fields
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from magtiles.catalog.kernels import road_near_compiled as kernels
from magtiles.catalog.kernels.geodesy import metres_per_degree, wrap_longitude
from magtiles.catalog.kernels.road_near import make_index

Floats = NDArray[np.float64]


class Shape(NamedTuple):
    latitude: float
    longitude: float
    spacing: float
    turn: float
    points: int
    id: str


SHAPES = [
    Shape(40.0, -84.0, 1.0, 0.02, 1500, "winding"),
    Shape(-33.0, 151.0, 0.5, 0.3, 800, "knotted"),
    Shape(64.0, 179.9999, 3.0, 0.05, 600, "over the date line"),
    Shape(0.0, 0.0, 1.0, 0.0, 2, "two points"),
    Shape(10.0, 20.0, 1.0, 0.0, 700, "straight"),
]


def line(shape: Shape, seed: int = 4) -> tuple[Floats, Floats]:
    """Latitude and longitude of a road."""
    rng = np.random.default_rng(seed)
    course = np.cumsum(rng.normal(0.0, shape.turn, shape.points)) + 0.7
    step = shape.spacing * np.column_stack([np.cos(course), np.sin(course)])
    place = np.cumsum(step, axis=0)
    north, east = metres_per_degree(np.array(shape.latitude), 0.0)
    latitude = shape.latitude + place[:, 0] / north
    return latitude, wrap_longitude(shape.longitude + place[:, 1] / east)


def by_hand(
    latitude: Floats, longitude: Floats, lat: float, lon: float
) -> tuple[float, float, float]:
    """Distances to the nearest node and to the nearest of all lines, and the place on that."""
    north, east = metres_per_degree(np.array(lat), 0.0)
    y, x = (latitude - lat) * north, wrap_longitude(longitude - lon) * east
    uy, ux = np.diff(y), np.diff(x)
    t = np.clip(-(y[:-1] * uy + x[:-1] * ux) / (uy**2 + ux**2), 0.0, 1.0)
    away = np.hypot(y[:-1] + t * uy, x[:-1] + t * ux)
    best = int(away.argmin())
    return float(np.hypot(y, x).min()), float(away[best]), best + float(t[best])


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: s.id)
def test_nearest_place(shape: Shape) -> None:
    """As close as the change of scale allows; another strand may be nearer by s^2 / 8d."""
    latitude, longitude = line(shape)
    index = make_index(latitude, longitude, 0.0)
    rng = np.random.default_rng(5)
    row = rng.integers(0, len(latitude), 600)
    north, east = metres_per_degree(latitude[row], 0.0)
    away = rng.choice([0.0, 1.0, 8.0, 40.0, 400.0], 600) * rng.normal(size=(2, 600))
    lat, lon = latitude[row] + away[0] / north, longitude[row] + away[1] / east
    place, offset = np.empty(600), np.empty(600)
    arrays = [getattr(index, f.name) for f in fields(index)]
    assert kernels.nearest(*arrays, lat, lon + 360.0, place, offset) == -1
    strands, feet = 0, []
    for k in range(600):
        node, least, where = by_hand(latitude, longitude, lat[k], lon[k])
        slack = 1e-4 + 1e-3 * np.hypot(*away[:, k]) ** 2 / 1e3
        assert least - slack < offset[k] < node + slack
        if abs(offset[k] - least) > slack:
            strands += 1
            assert offset[k] - least <= shape.spacing**2 / (8.0 * least) + slack
        elif abs(place[k] - where) < 1.0:
            feet.append(abs(place[k] - where) * shape.spacing)
    assert strands < 10
    assert len(feet) > 550
    assert np.median(feet) < 1e-4


def test_far_away_and_bad_places() -> None:
    latitude, longitude = line(SHAPES[0])
    index = make_index(latitude, longitude, 0.0)
    arrays = [getattr(index, f.name) for f in fields(index)]
    lat = np.array([latitude[0] - 1.0, np.nan, 40.0])
    lon = np.array([longitude[0], 0.0, np.nan])
    place, offset = np.empty(3), np.empty(3)
    assert kernels.nearest(*arrays, lat, lon, place, offset) == -1
    assert np.isnan(place[1:]).all()
    assert 1.1e5 < offset[0] < 1.12e5
    assert kernels.nearest(*arrays, np.array([0.0, 91.0]), np.zeros(2), place, offset) == 1
    assert kernels.nearest(*arrays, np.zeros(1), np.array([np.inf]), place, offset) == 0
