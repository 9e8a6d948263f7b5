"""The part of checks.json that asks a release's road maps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.releases.reader import Release

UNITS = {
    "field": "nT",
    "uncertainty": "nT",
    "nearest_distance": "m",
    "offset": "m",
    "log_likelihood": "1",
}

_POINTS = 12
_ASIDE_DEG = 2e-5
"""Of latitude and longitude, to either side of the road."""
_OFF_NT = 300.0
"""By how much each measurement misses the map."""


def road_positions(release: Release, name: str) -> dict[str, NDArray[np.float64]]:
    """Distances along a road, a place beside each, and what was measured there, nT."""
    road = release.roads[name]
    share = (0.5 + np.arange(1, _POINTS + 1) * 0.6180339887498949) % 1.0
    distance = np.round(road.distance[0] + share * road.length_m, 3)
    latitude, longitude = road.position(distance)
    aside = _ASIDE_DEG * np.where(np.arange(_POINTS) % 2, 1.0, -1.0)
    return {
        "distance": distance,
        "latitude": np.round(np.clip(latitude + aside, -90.0, 90.0), 7),
        "longitude": np.round(longitude + aside, 7),
        "measured": np.round(road.field(distance) + _OFF_NT * np.cos(np.arange(3)), 1),
    }


def road_answers(
    release: Release, name: str, at: Mapping[str, NDArray[Any]]
) -> dict[str, NDArray[np.float64]]:
    """What the reader says there, (n,) or (n, 3) each."""
    road = release.roads[name]
    place = at["latitude"], at["longitude"]
    nearest = road.nearest(*place)
    likely = [
        road.log_likelihood_at(lat, lon, sample)
        for lat, lon, sample in zip(*place, at["measured"], strict=True)
    ]
    return {
        "field": road.field(at["distance"]),
        "uncertainty": road.uncertainty(at["distance"]),
        "nearest_distance": nearest.distance,
        "offset": nearest.offset_m,
        "log_likelihood": np.array(likely, dtype=np.float64),
    }
