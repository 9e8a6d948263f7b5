"""What validation asks of a release's road maps: contract, digests, and that they are roads."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from magtiles.catalog.kernels.geodesy import metres_per_degree
from magtiles.catalog.releases.digest import array_digest
from magtiles.catalog.releases.reader import Release
from magtiles.catalog.releases.road import Road
from magtiles.pipeline.artifacts import check_artifact
from magtiles.pipeline.temporal_checks import Finding
from magtiles.schemas.errors import MagtilesError

STRETCH_M = 100.0
"""Positions are compared with distances over stretches of this length, or the whole road."""
STRETCH_TOLERANCE = 0.05
"""By how much the way between positions may differ from the distance: a wheel's scale is known to
some percent, and chords cut corners."""


def check_roads(release: Release) -> Iterator[Finding]:
    """Every finding on the road maps of a release that has some. Raises MagtilesError."""
    broken, other = [], []
    least, worst, where = np.inf, 0.0, ""
    for name, record in release.manifest.roads.items():
        road = release.roads[name]
        try:
            check_artifact(release.path / record.path, str(record.contract), role="road")
        except MagtilesError as problem:
            broken.append(str(problem))
        if array_digest(road.variables) != record.array_digest:
            other.append(record.path)
        least = min(least, float(road.variables["field_body_uncertainty"].min()))
        off = stretch_error(road)
        if off >= worst:
            worst, where = off, f"road {name}, over {STRETCH_M:g} m: way between positions"
    count = len(release.manifest.roads)
    yield _count("road contracts", broken, f"{count} roads")
    yield _count("road arrays", other, "agree with the manifest's digests")
    yield Finding(
        "road uncertainty", 0.0 < least < np.inf, least, 0.0, "nT", "least of all; must be above"
    )
    yield Finding(
        "road geometry", worst <= STRETCH_TOLERANCE, worst, STRETCH_TOLERANCE, "of distance", where
    )


def stretch_error(road: Road) -> float:
    """The most that the way between positions differs from the distance, as a share of it."""
    latitude = road.variables["latitude"]
    longitude = np.unwrap(road.variables["longitude"], period=360.0)
    north, east = metres_per_degree(0.5 * (latitude[1:] + latitude[:-1]), 0.0)
    step = np.hypot(np.diff(latitude) * north, np.diff(longitude) * east)
    way = np.concatenate([[0.0], np.cumsum(step)])
    points = min(max(1, round(STRETCH_M / road.spacing_m)), step.size)
    distance = points * road.spacing_m
    return float(np.abs((way[points:] - way[:-points]) / distance - 1.0).max())


def _count(name: str, problems: list[str], fine: str) -> Finding:
    found = len(problems)
    return Finding(name, found == 0, float(found), 0.0, "files", problems[0] if found else fine)
