"""Drives along a road in a known field: vehicles, lanes, stops, receivers and passing trucks."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.kernels.dipole import dipole_vector
from magtiles.stages.road.plane import Plane

Real = NDArray[np.float64]

CORE = np.array([20_000.0, -2_100.0, 49_300.0])
PLANE = Plane(39.78, -84.08)
START = np.datetime64("2011-08-11T14:00:00", "ns")
_STEP_M = 0.25


@dataclass(frozen=True)
class Road:
    """A winding road with steel beside and below it."""

    length_m: float = 1500.0
    dipoles: int = 300
    seed: int = 7

    @cached_property
    def distance(self) -> Real:
        return np.arange(-30.0, self.length_m + 30.0, _STEP_M)

    @cached_property
    def course(self) -> Real:
        return 0.5 + 0.9 * np.sin(self.distance / 210.0) + 0.3 * np.sin(self.distance / 67.0)

    @cached_property
    def place(self) -> Real:
        step = np.column_stack([np.cos(self.course), np.sin(self.course)]) * _STEP_M
        place = np.cumsum(step, axis=0)
        return np.asarray(place - place[np.searchsorted(self.distance, 0.0)])

    @cached_property
    def sources(self) -> tuple[Real, Real]:
        """Places (k, 3), m north, east, down of the sensor, and moments (k, 3), A m2."""
        rng = np.random.default_rng(self.seed)
        row = rng.integers(0, len(self.distance), self.dipoles)
        side = rng.uniform(3.0, 9.0, self.dipoles) * rng.choice([-1, 1], self.dipoles)
        down = rng.uniform(1.5, 4.0, self.dipoles)
        normal = np.column_stack([-np.sin(self.course[row]), np.cos(self.course[row])])
        place = self.place[row] + side[:, None] * normal
        size = rng.lognormal(6.4, 0.6, (self.dipoles, 1))
        return np.column_stack([place, down]), size * rng.normal(size=(self.dipoles, 3))

    def field(self, place: Real) -> Real:
        """North, east, down (n, 3), nT, at places (n, 2)."""
        points = np.column_stack([place, np.zeros(len(place))])
        return CORE + dipole_vector(points, *self.sources)

    def body_field(self, distance: Real, lane_m: Real | float = 0.0) -> Real:
        """Forward, right, down (n, 3), nT, of a vehicle without steel, at distances (n,)."""
        place, course = self.at(distance, lane_m)
        return turned(self.field(place), course)

    def at(self, distance: Real, lane_m: Real | float = 0.0) -> tuple[Real, Real]:
        """Place (n, 2) and course (n,) of a lane so far to the right."""
        course = np.interp(distance, self.distance, self.course)
        place = np.column_stack([np.interp(distance, self.distance, p) for p in self.place.T])
        normal = np.column_stack([-np.sin(course), np.cos(course)])
        return place + np.broadcast_to(lane_m, distance.shape)[:, None] * normal, course

    def distance_of(self, latitude: Real, longitude: Real) -> Real:
        """Nearest distance along the road of WGS84 places."""
        from scipy.spatial import cKDTree

        return self.distance[cKDTree(self.place).query(PLANE.metres(latitude, longitude))[1]]


def turned(field: Real, heading: Real) -> Real:
    """North, east, down to forward, right, down, of a level vehicle."""
    c, s = np.cos(heading), np.sin(heading)
    return np.column_stack(
        [c * field[:, 0] + s * field[:, 1], -s * field[:, 0] + c * field[:, 1], field[:, 2]]
    )


@dataclass(frozen=True)
class Vehicle:
    """What is left after calibration: reading = matrix @ field + bias, and the wheels' scale."""

    name: str = "perfect"
    matrix: Real = field(default_factory=lambda: np.eye(3))
    bias: Real = field(default_factory=lambda: np.zeros(3))
    wheel_scale: float = 1.0

    @classmethod
    def random(cls, name: str, seed: int) -> Vehicle:
        """Left with some 6 mG of one vehicle against another (Shockley 2012, table 4.1)."""
        rng = np.random.default_rng(seed)
        matrix = np.eye(3) + 0.01 * rng.normal(size=(3, 3))
        return cls(name, matrix, 450.0 * rng.normal(size=3), 1.0 + 0.01 * rng.normal())


@dataclass(frozen=True)
class Trip:
    """How a road is driven.

    `stops` are (distance m, duration s); `trucks` are (distance m, nT) of steel that passes;
    `lane_m` is the mean place in the lane, `weave_m` how much it varies.
    """

    seed: int = 1
    speed_m_s: float = 14.0
    stops: tuple[tuple[float, float], ...] = ()
    trucks: tuple[tuple[float, float], ...] = ()
    lane_m: float = 0.0
    weave_m: float = 0.4
    fix_noise_m: float = 0.3
    fix_drift_m: float = 1.2
    sensor_noise_nt: float = 40.0
    rate_hz: float = 50.0
    wheels: bool = True
    backward: bool = False
    start_m: float = 0.0
    end_m: float | None = None


def drive(road: Road, vehicle: Vehicle | None = None, trip: Trip | None = None) -> xr.Dataset:
    """A track/1 of a trip, with the true `distance` (time,) and `lane` beside it as attributes."""
    vehicle, trip = vehicle or Vehicle(), trip or Trip()
    rng = np.random.default_rng(trip.seed)
    distance, seconds = _schedule(road, trip, rng)
    lane = trip.lane_m + _wander(rng, distance, trip.weave_m, 120.0)
    at = road.length_m - distance if trip.backward else distance
    place, course = road.at(at, -lane if trip.backward else lane)
    heading = course + np.pi if trip.backward else course
    truth = turned(road.field(place), heading)
    for where, size in trip.trucks:
        shape = size * np.exp(-(((at - where) / 6.0) ** 2))
        truth = truth + np.outer(shape, [0.8, -1.0, 0.6])
    reading = truth @ vehicle.matrix.T + vehicle.bias
    reading += trip.sensor_noise_nt * rng.normal(size=reading.shape)
    wheel = np.gradient(distance, seconds) / vehicle.wheel_scale
    track = _track(place, seconds, reading, trip, rng)
    if trip.wheels:
        speed = np.abs(wheel) + np.where(wheel > 0.05, 0.02 * rng.normal(size=len(wheel)), 0.0)
        track["speed"] = ("time", np.maximum(speed, 0.0), {"units": "m s-1"})
    return track.assign_attrs(calibration="known")


def _schedule(road: Road, trip: Trip, rng: np.random.Generator) -> tuple[Real, Real]:
    """Distance at each sample, and its second: slowing for stops, standing there."""
    end = road.length_m if trip.end_m is None else trip.end_m
    grid = np.arange(trip.start_m, end, 0.05)
    speed = trip.speed_m_s * (1.0 + 0.2 * np.sin(grid / 180.0 + rng.uniform(0.0, 6.0)))
    for where, _ in trip.stops:
        speed = np.minimum(speed, np.sqrt(0.05 + 3.0 * np.abs(grid - where)))
    seconds = np.concatenate([[0.0], np.cumsum(0.05 / speed[:-1])])
    for where, duration in trip.stops:
        seconds[grid > where] += duration
    at = np.arange(0.0, seconds[-1], 1.0 / trip.rate_hz)
    return np.interp(at, seconds, grid), at


def _wander(rng: np.random.Generator, along: Real, sigma: float, length: float) -> Real:
    """A Gauss-Markov process (n,) over the values of `along`, which do not descend."""
    from scipy.interpolate import CubicSpline

    knots = np.arange(along[0] - length, along[-1] + 2 * length, length / 2)
    decay = np.exp(-0.5)
    noise = rng.normal(size=len(knots))
    values = np.empty(len(knots))
    values[0] = noise[0]
    for k in range(1, len(knots)):
        values[k] = decay * values[k - 1] + np.sqrt(1.0 - decay**2) * noise[k]
    return np.asarray(sigma * CubicSpline(knots, values)(along))


def _track(
    place: Real, seconds: Real, reading: Real, trip: Trip, rng: np.random.Generator
) -> xr.Dataset:
    """The track with its receiver's 10 Hz fixes, which drift and are noisy."""
    at = np.arange(0.0, seconds[-1], 0.1)
    fixed = np.column_stack([np.interp(at, seconds, p) for p in place.T])
    for axis in (0, 1):
        fixed[:, axis] += _wander(rng, at, trip.fix_drift_m, 100.0)
    fixed += trip.fix_noise_m * rng.normal(size=fixed.shape)
    latitude, longitude = PLANE.degrees(fixed)
    degrees = {"latitude": "degrees_north", "longitude": "degrees_east"}
    places = {
        name: ("time", np.interp(seconds, at, values), {"units": degrees[name]})
        for name, values in (("latitude", latitude), ("longitude", longitude))
    }
    time = START + np.timedelta64(trip.seed, "D") + (seconds * 1e9).astype("timedelta64[ns]")
    return xr.Dataset(
        {
            **places,
            "height": ("time", np.full(len(seconds), 250.0), {"units": "m"}),
            "field_body": (("time", "axis"), reading, {"units": "nT"}),
        },
        coords={"time": time},
        attrs={"height_reference": "ellipsoid", "source": f"trip {trip.seed}"},
    )


def follow(corners: Real, *, speed_m_s: float = 10.0, noise_m: float = 0.2) -> xr.Dataset:
    """A track/1 along straight lines between `corners` (n, 2), m, in the core field."""
    corners = np.asarray(corners, np.float64)
    legs = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    bounds = np.concatenate([[0.0], np.cumsum(legs)])
    seconds = np.arange(0.0, bounds[-1] / speed_m_s, 0.05)
    place = np.column_stack([np.interp(speed_m_s * seconds, bounds, c) for c in corners.T])
    step = np.gradient(place, axis=0)
    reading = turned(np.tile(CORE, (len(place), 1)), np.arctan2(step[:, 1], step[:, 0]))
    trip = Trip(fix_noise_m=noise_m, fix_drift_m=noise_m)
    return _track(place, seconds, reading, trip, np.random.default_rng(1))
