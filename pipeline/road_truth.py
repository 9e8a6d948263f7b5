"""The magnetic field along a sample route: the core field and steel in and beside the road.

Every piece of steel is a point dipole, or a row of them, so that the field is exact anywhere above
the road. Positions are north, east, down in metres on the route's plane; down is zero there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from magtiles.catalog.kernels.dipole import dipole_vector
from magtiles.pipeline.road_paths import Lane, Route, lane_of
from magtiles.pipeline.synthetic import DEMO, core_field

Floats = NDArray[np.float64]

_NT_M3_PER_A_M2 = 100.0
"""Field of a dipole on its equator, nT, times the cube of the distance, m, for 1 A m^2."""
_SPACING_M = 0.5
_CLEAR_M = 4.5
_AROUND_M = 3000.0
"""So far from its origin a route may lead."""


@dataclass(frozen=True)
class Furniture:
    """What lies along a route: metres between pieces on average; 0 for none.

    Attributes
    ----------
    start_m, end_m : part of the lane that it is placed along; 0 for the whole.
    bridges : start and end of each, along the lane.
    """

    start_m: float = 0.0
    end_m: float = 0.0
    ground: float = 8.0
    rebar: float = 12.0
    pipes: float = 90.0
    covers: float = 60.0
    poles: float = 30.0
    bridges: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class Passing:
    """A truck that comes the other way in one drive, and is not there in the others.

    Attributes
    ----------
    vehicle, number : whose drive, counted from 1.
    distance_m : where the two meet, along the lane.
    aside_m : of its middle, to the right of that of the lane.
    moment_a_m2 : 3 V B / mu0 of a permeable sphere is that in 24 m3: a lorry of 6 m.
    """

    vehicle: str
    number: int
    distance_m: float
    speed_m_s: float = 12.0
    aside_m: float = -3.6
    moment_a_m2: float = 3000.0


@dataclass(frozen=True)
class Road:
    """A route with the steel along it.

    Attributes
    ----------
    date : of the core field, ISO.
    """

    route: Route
    furniture: Furniture
    date: str
    seed: int
    passing: tuple[Passing, ...] = ()

    @cached_property
    def lane(self) -> Lane:
        """The middle of the lane."""
        return lane_of(self.route)

    @property
    def induced(self) -> Floats:
        """Direction (3,) of the core field, along which steel is magnetised."""
        core = self.core(np.zeros(1), np.zeros(1), 0.0)[0]
        return np.asarray(core / np.linalg.norm(core))

    @cached_property
    def sources(self) -> tuple[Floats, Floats]:
        """Positions (k, 3) m and moments (k, 3) A m^2 of all that is fixed."""
        return _sources(self)

    def core(self, north: Floats, east: Floats, above: float) -> Floats:
        """The core field (n, 3) at a height above the road, nT north, east, down."""
        return _quadratic(north, east, above) @ self._core_coefficients

    @cached_property
    def _core_coefficients(self) -> Floats:
        """Of the core field over the route, in which IGRF is a quadratic to 1e-6 nT."""
        side = np.linspace(-_AROUND_M, _AROUND_M, 5)
        north, east, above = (a.ravel() for a in np.meshgrid(side, side, [0.0, 3.0]))
        latitude, longitude = self.route.geodetic(north, east)
        spec = replace(DEMO, epoch=self.date)
        core = core_field(spec, latitude, longitude, self.route.height_m + above)
        fitted = np.linalg.lstsq(_quadratic(north, east, above), core, rcond=None)[0]
        return np.asarray(fitted)

    def field(self, north: Floats, east: Floats, above: float) -> Floats:
        """The whole field (n, 3) at a height above the road, nT north, east, down."""
        points = np.column_stack([north, east, np.full(north.shape, -above)])
        return self.core(north, east, above) + dipole_vector(points, *self.sources)

    def truth(self, above: float) -> xr.Dataset:
        """The field along the middle of the lane at a height above it.

        Dimensions (point) and (point, axis): `field_ned` north, east, down and `field_body`
        forward, right, down of a level vehicle. With them the sources, (source, axis).
        """
        distance = np.arange(0.0, self.lane.distance[-1], _SPACING_M)
        north, east, heading = self.lane.at(distance)
        latitude, longitude = self.route.geodetic(north, east)
        field = self.field(north, east, above)
        positions, moments = self.sources
        one, three = ("point",), ("point", "axis")
        metres, nt = {"units": "m"}, {"units": "nT"}
        variables: dict[str, Any] = {
            "distance": (one, distance, metres),
            "latitude": (one, latitude, {"units": "degrees_north"}),
            "longitude": (one, longitude, {"units": "degrees_east"}),
            "heading": (one, np.degrees(heading) % 360.0, {"units": "degree"}),
            "field_ned": (three, field, nt | {"comment": "north, east, down"}),
            "field_body": (three, levelled(field, heading), nt | {"comment": "of a level vehicle"}),
            "source_position": (("source", "axis"), positions, metres),
            "source_moment": (("source", "axis"), moments, {"units": "A m2"}),
        }
        return xr.Dataset(
            variables,
            attrs={
                "title": f"exact field along the middle of the lane of route '{self.route.name}'",
                "spacing_m": _SPACING_M,
                "height": self.route.height_m + above,
                "height_reference": "ellipsoid",
                "source_frame": "north, east, down of the route's origin "
                f"{self.route.latitude} N, {self.route.longitude} E, on the road",
            },
        )


def _quadratic(north: Floats, east: Floats, above: Floats | float) -> Floats:
    """Columns of a quadratic in the plane that is linear in height, (n, 7), of order one."""
    n, e = north / _AROUND_M, east / _AROUND_M
    return np.column_stack([np.ones_like(n), n, e, n * n, n * e, e * e, 0.0 * n + above])


def levelled(field: Floats, heading: Floats) -> Floats:
    """Fields (n, 3) north, east, down as forward, right, down of a level vehicle."""
    cos, sin = np.cos(heading), np.sin(heading)
    north, east, down = field.T
    return np.column_stack([cos * north + sin * east, cos * east - sin * north, down])


def passing_field(
    road: Road, passing: Passing, seconds: Floats, distance: Floats, points: Floats
) -> Floats:
    """Field (n, 3) nT of a passing truck at a vehicle's places (n, 3) over time.

    The truck is three dipoles along 6 m, a metre above the road, magnetised by the core field.
    """
    meeting = np.interp(passing.distance_m, distance, seconds)
    moment = passing.moment_a_m2 / 3.0 * road.induced
    field = np.zeros_like(points)
    for along in (-3.0, 0.0, 3.0):
        where = passing.distance_m - passing.speed_m_s * (seconds - meeting) + along
        north, east, heading = road.lane.at(where)
        north, east = (
            north - passing.aside_m * np.sin(heading), east + passing.aside_m * np.cos(heading),
        )  # fmt: skip
        r = points - np.column_stack([north, east, np.full_like(north, -1.0)])
        r2 = (r**2).sum(axis=1, keepdims=True)
        field += (3.0 * (r @ moment)[:, None] * r / r2 - moment) / r2**1.5
    there = np.abs(passing.speed_m_s * (seconds - meeting)) < _OUT_OF_SIGHT_M
    return np.asarray(_NT_M3_PER_A_M2 * field * there[:, None])


_OUT_OF_SIGHT_M = 120.0  # 0.3 nT is left there of the truck's field


def _sources(road: Road) -> tuple[Floats, Floats]:
    rng = np.random.default_rng(road.seed)
    furniture = road.furniture
    span = furniture.start_m, furniture.end_m or road.route.length_m
    groups = [
        _scattered(furniture.ground, span, (-10.0, 10.0), (4.0, 12.0), 300.0, rng),
        _scattered(furniture.rebar, span, (-4.0, 4.0), (0.8, 2.5), 500.0, rng),
        _scattered(furniture.covers, span, (-2.0, 2.0), (0.3, 0.5), 2500.0, rng),
        _scattered(furniture.poles, span, (5.0, 12.0), (-2.0, 0.0), 500.0, rng),
        *(_pipe(at, rng) for at in _places(furniture.pipes, span, rng)),
        *(_bridge(start, end, rng) for start, end in furniture.bridges),
    ]
    along, aside, down, strength = np.concatenate(groups, axis=1)
    north, east, heading = road.lane.at(along)
    positions = np.column_stack(
        [north - aside * np.sin(heading), east + aside * np.cos(heading), down]
    )
    remanent = rng.normal(size=positions.shape)
    remanent /= np.linalg.norm(remanent, axis=1, keepdims=True)
    moments = strength[:, None] * (road.induced + 0.7 * remanent)
    # A pole beside one street may stand in another.
    lane = cKDTree(np.column_stack([road.lane.north, road.lane.east])[::5])
    clear = (down > 0.0) | (lane.query(positions[:, :2])[0] > _CLEAR_M)
    return positions[clear], moments[clear]


def _places(every: float, span: tuple[float, float], rng: np.random.Generator) -> list[float]:
    return sorted(rng.uniform(*span, round((span[1] - span[0]) / every)).tolist()) if every else []


def _scattered(
    every: float,
    span: tuple[float, float],
    aside: tuple[float, float],
    down: tuple[float, float],
    nt: float,
    rng: np.random.Generator,
) -> Floats:
    """Single dipoles (along, aside, down, moment), (4, k): `nt` at a metre above the road.

    On either side where `aside` does not cross the lane.
    """
    along = np.array(_places(every, span, rng))
    across, depth = rng.uniform(*aside, along.size), rng.uniform(*down, along.size)
    if aside[0] > 0.0:
        across *= rng.choice([-1.0, 1.0], along.size)
    distance = np.hypot(across, depth + 1.0) if aside[0] > 0.0 else depth + 1.0
    return np.stack([along, across, depth, _moment(nt, distance, rng)])


def _pipe(at: float, rng: np.random.Generator) -> Floats:
    """A pipe across the road: a dipole every metre and a half."""
    across = np.arange(-12.0, 12.1, 1.5)
    slant, depth = rng.normal(0.0, 0.3), rng.uniform(1.2, 2.2)
    moment = _moment(1200.0, np.array([depth + 1.0]), rng)
    rest = np.full((2, across.size), [[depth], [moment[0]]])
    return np.stack([at + slant * across, across, *rest])


def _bridge(start: float, end: float, rng: np.random.Generator) -> Floats:
    """Girders under a deck: four rows of dipoles every two metres, no two alike."""
    along, across = (
        a.ravel() for a in np.meshgrid(np.arange(start, end, 2.0), [-4.5, -1.5, 1.5, 4.5])
    )
    depth = np.full(along.size, 1.5)
    return np.stack([along, across, depth, _moment(1500.0, depth + 1.0, rng)])


def _moment(nt: float, distance: Floats, rng: np.random.Generator) -> Floats:
    return np.asarray(rng.normal(0.0, nt / _NT_M3_PER_A_M2, distance.shape) * distance**3)
