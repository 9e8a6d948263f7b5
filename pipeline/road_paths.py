"""Where a sample vehicle goes: the lane of a route, and one drive along it in time.

A route lies on a plane: metres north and east of its origin in a transverse Mercator projection
about it, whose scale errs by 1e-7 within 3 km and whose north is the truth to 0.03 degrees.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyproj
import scipy.ndimage
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

FINE_M = 0.1
"""Spacing along a lane at which it is computed."""

_TURN_IN_M = 4.0  # over which steering turns in


@dataclass(frozen=True)
class Route:
    """A lane to drive, and how. Metres, seconds, degrees.

    Attributes
    ----------
    latitude, longitude, height_m : origin, on the road, above the WGS84 ellipsoid.
    heading_deg : at the start.
    legs : length and turn to the right of each.
    cruise_m_s : speed on straight legs; `lateral_m_s2` limits it in turns.
    stops : distance and mean duration of each, as before traffic lights.
    """

    name: str
    latitude: float
    longitude: float
    height_m: float
    heading_deg: float
    legs: tuple[tuple[float, float], ...]
    cruise_m_s: float
    stops: tuple[tuple[float, float], ...] = ()
    lateral_m_s2: float = 2.0

    @property
    def length_m(self) -> float:
        """Length of the lane."""
        return sum(length for length, _ in self.legs)

    def geodetic(self, north: ArrayLike, east: ArrayLike) -> tuple[Floats, Floats]:
        """WGS84 latitude and longitude of places on the plane, degrees."""
        plane = pyproj.CRS.from_dict(
            {"proj": "tmerc", "lat_0": self.latitude, "lon_0": self.longitude, "datum": "WGS84"}
        )
        to_wgs84 = pyproj.Transformer.from_crs(plane, "EPSG:4326", always_xy=True)
        longitude, latitude = to_wgs84.transform(east, north)
        return np.asarray(latitude), np.asarray(longitude)


def turn(degrees: float, radius_m: float) -> tuple[float, float]:
    """A leg along a circle; to the right where `degrees` is positive."""
    return float(np.radians(abs(degrees)) * radius_m), degrees


def through(corners: tuple[tuple[float, float], ...], radius_m: float) -> list[tuple[float, float]]:
    """Legs from the first corner (north, east) to the last, rounded at those between."""
    points = np.array(corners)
    steps = np.diff(points, axis=0)
    bearing = np.degrees(np.arctan2(steps[:, 1], steps[:, 0]))
    turns = (np.diff(bearing) + 180.0) % 360.0 - 180.0
    cut = radius_m * np.tan(np.radians(np.abs(turns)) / 2.0)
    straight = np.hypot(*steps.T) - np.append(cut, 0.0) - np.append(0.0, cut)
    legs = [(float(straight[0]), 0.0)]
    for angle, length in zip(turns.tolist(), straight[1:].tolist(), strict=True):
        legs += [turn(angle, radius_m), (length, 0.0)]
    return legs


@dataclass(frozen=True)
class Lane:
    """The middle of a lane every `FINE_M`: distance, north, east, m, and heading, radians."""

    distance: Floats
    north: Floats
    east: Floats
    heading: Floats

    def at(self, distance: Floats) -> tuple[Floats, Floats, Floats]:
        """North, east (m) and heading (radians) at distances along the lane."""
        north, east, heading = (
            np.interp(distance, self.distance, values)
            for values in (self.north, self.east, self.heading)
        )
        return north, east, heading

    @property
    def curvature(self) -> Floats:
        """Change of heading with distance, radians/m."""
        return np.asarray(np.gradient(self.heading, FINE_M))


def lane_of(route: Route) -> Lane:
    """The lane of a route."""
    distance = np.arange(0.0, route.length_m, FINE_M)
    lengths, turns = np.array(route.legs).T
    ends = np.concatenate([[0.0], np.cumsum(lengths)])
    bearing = route.heading_deg + np.concatenate([[0.0], np.cumsum(turns)])
    sharp = np.radians(np.interp(distance, ends, bearing))
    heading = scipy.ndimage.uniform_filter1d(sharp, round(_TURN_IN_M / FINE_M), mode="nearest")
    middle = 0.5 * (heading[1:] + heading[:-1])
    north, east = (
        np.concatenate([[0.0], np.cumsum(FINE_M * part)])
        for part in (np.cos(middle), np.sin(middle))
    )
    return Lane(distance, north, east, heading)


def wander(x: Floats, shortest: float, longest: float, rng: np.random.Generator) -> Floats:
    """A smooth random function of x, of unit variance, with wavelengths between two limits."""
    count = 12
    waves = np.exp(rng.uniform(np.log(shortest), np.log(longest), count))
    phases = rng.uniform(0.0, 2.0 * np.pi, count)
    smooth = np.zeros_like(x)
    for wave, phase in zip(waves.tolist(), phases.tolist(), strict=True):
        smooth += np.cos(2.0 * np.pi * x / wave + phase)
    return np.asarray(smooth * np.sqrt(2.0 / count))


@dataclass(frozen=True)
class Motion:
    """A vehicle's motion, each (n,), at equal steps in time.

    Attributes
    ----------
    seconds : since the start.
    distance : along the lane's middle, m; `offset` to the right of it, m.
    north, east : m on the route's plane. heading, pitch, roll : radians.
    speed : m/s. acceleration : (n, 3) m/s2 forward, right, down, without gravity.
    turn_rate : of heading, pitch and roll, (n, 3) radians/s.
    """

    seconds: Floats
    distance: Floats
    offset: Floats
    north: Floats
    east: Floats
    heading: Floats
    pitch: Floats
    roll: Floats
    speed: Floats
    acceleration: Floats
    turn_rate: Floats


_GAIN_M_S2, _BRAKE_M_S2 = 1.3, 1.8
_MOST_OFFSET_M = 1.5
_UNEVEN = np.radians(0.25)
_SQUAT, _LEAN = np.radians(0.35), np.radians(0.5)  # for each m/s2


def drive(route: Route, lane: Lane, rate_hz: float, rng: np.random.Generator) -> Motion:
    """One drive along a lane: its own pace, place in the lane, and waits at the stops."""
    step = 1.0 / rate_hz
    clock, places, speeds = _timetable(route, lane, rng)
    seconds = np.arange(0.0, clock[-1], step)
    distance = np.interp(seconds, clock, places)
    aside, slope, stretch = _aside(lane, rng)
    north, east, heading = lane.at(distance)
    offset = np.interp(distance, lane.distance, aside)
    north, east = north - offset * np.sin(heading), east + offset * np.cos(heading)
    heading = heading + np.interp(distance, lane.distance, slope)
    speed = np.interp(distance, lane.distance, speeds * stretch)
    smooth = scipy.ndimage.gaussian_filter1d(speed, 0.2 * rate_hz, mode="nearest")
    forward, right = np.gradient(smooth, step), smooth * np.gradient(heading, step)
    pitch = _SQUAT * forward + _UNEVEN * wander(distance, 4.0, 60.0, rng)
    roll = -_LEAN * right + _UNEVEN * wander(distance, 4.0, 60.0, rng)
    return Motion(
        seconds, distance, offset, north, east, heading, pitch, roll, speed,
        np.column_stack([forward, right, np.zeros_like(forward)]),
        np.column_stack([np.gradient(angle, step) for angle in (heading, pitch, roll)]),
    )  # fmt: skip


def _timetable(route: Route, lane: Lane, rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
    """Times, s, and distances, m, of a drive along a lane; its speed on the lane's points, m/s."""
    pace = rng.uniform(0.9, 1.1) * (1.0 + 0.05 * wander(lane.distance, 150.0, 900.0, rng))
    limit = np.minimum(
        route.cruise_m_s * pace,
        np.sqrt(route.lateral_m_s2 / np.maximum(np.abs(lane.curvature), 1e-6)),
    )
    halts = [round(distance / FINE_M) for distance, _ in route.stops]
    limit[halts] = 0.0
    limit[0] = limit[-1] = 0.0
    squares = _reachable(_reachable(limit**2, _GAIN_M_S2)[::-1], _BRAKE_M_S2)[::-1]
    speeds = np.sqrt(squares)
    steps = FINE_M / (0.5 * (speeds[1:] + speeds[:-1]))
    clock = np.concatenate([[0.0], np.cumsum(steps)])
    places = lane.distance
    for halt, (_, duration) in zip(halts[::-1], route.stops[::-1], strict=True):
        wait = duration * rng.uniform(0.6, 1.4)
        clock[halt + 1 :] += wait
        clock = np.insert(clock, halt + 1, clock[halt] + wait)
        places = np.insert(places, halt + 1, places[halt])
    return clock, places, speeds


def _reachable(squares: Floats, gain: float) -> Floats:
    """Squared speeds that no point exceeds by more than `gain` allows from the one before."""
    ramp = 2.0 * gain * FINE_M * np.arange(len(squares))
    return np.asarray(np.minimum.accumulate(squares - ramp) + ramp)


def _aside(lane: Lane, rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
    """Metres to the right of the lane's middle, the angle to it, radians, and length for length."""
    aside = rng.normal(0.0, 0.35) + 0.3 * wander(lane.distance, 80.0, 500.0, rng)
    aside = _MOST_OFFSET_M * np.tanh(aside / _MOST_OFFSET_M)
    slope = np.arctan(np.gradient(aside, FINE_M))
    return aside, slope, (1.0 - lane.curvature * aside) / np.cos(slope)
