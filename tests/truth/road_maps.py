"""Road maps made directly of a known field: the truth for matching and for the reader.

The field along the road is that of a level vehicle without steel: a slowly turning core field
and many small dipoles beside the road. A pass sees it a little aside, through what is left of its
vehicle's steel, and once in a while through a passing truck.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.kernels.dipole import dipole_vector
from magtiles.catalog.kernels.geodesy import metres_per_degree

Floats = NDArray[np.float64]

CORE = np.array([20_000.0, -2_000.0, 48_000.0])
PLACE = (39.78, -84.08)
HEIGHT = 250.0


def _noise(rng: np.random.Generator, along: Floats, length_m: float) -> Floats:
    """A smooth process of unit variance over ascending metres."""
    knots = np.arange(along[0] - 4 * length_m, along[-1] + 4 * length_m, length_m / 4)
    kernel = np.exp(-0.5 * (np.arange(-24, 25) / 4.0) ** 2)
    white = np.convolve(rng.normal(size=knots.size + 48), kernel, mode="valid")
    return np.interp(along, knots, white / np.linalg.norm(kernel))


@dataclass(frozen=True)
class Road:
    """A winding road with steel beside it, some 30 m from one piece to the next."""

    name: str = "loop"
    length_m: float = 1500.0
    pieces: int = 120
    seed: int = 3
    size: float = 6.0

    @cached_property
    def line(self) -> tuple[Floats, Floats, Floats]:
        """Distance (n,), place (n, 2) m north and east, course (n,) radians, every 0.25 m."""
        at = np.arange(-20.0, self.length_m + 20.0, 0.25)
        course = 0.3 * self.seed + 0.9 * np.sin(at / 230.0) + 0.25 * np.sin(at / 61.0)
        step = 0.25 * np.column_stack([np.cos(course), np.sin(course)])
        return at, np.cumsum(step, axis=0) - step[0], course

    @cached_property
    def steel(self) -> tuple[Floats, Floats]:
        """Places (k, 3) m and moments (k, 3) A m2."""
        rng = np.random.default_rng(self.seed)
        at, place, course = self.line
        row = rng.integers(0, at.size, self.pieces)
        side = rng.uniform(2.5, 9.0, self.pieces) * rng.choice([-1, 1], self.pieces)
        across = np.column_stack([-np.sin(course[row]), np.cos(course[row])])
        down = rng.uniform(1.0, 4.0, self.pieces)
        where = np.column_stack([place[row] + side[:, None] * across, down])
        moment = rng.lognormal(self.size, 0.9, (self.pieces, 1)) * rng.normal(size=where.shape)
        return where, moment

    def at(self, distance: Floats, aside: Floats | float = 0.0) -> tuple[Floats, Floats]:
        """Place (n, 2), m north and east, and course (n,), so far to the right of the road."""
        at, place, course = self.line
        here = np.column_stack([np.interp(distance, at, p) for p in place.T])
        turn = np.interp(distance, at, course)
        across = np.column_stack([-np.sin(turn), np.cos(turn)])
        return here + np.broadcast_to(aside, distance.shape)[:, None] * across, turn

    def body_field(self, distance: Floats, aside: Floats | float = 0.0) -> Floats:
        """Forward, right, down (n, 3), nT, of a vehicle without steel."""
        place, course = self.at(distance, aside)
        total = CORE + dipole_vector(np.column_stack([place, 0.0 * course]), *self.steel)
        c, s = np.cos(course), np.sin(course)
        forward = c * total[:, 0] + s * total[:, 1]
        return np.column_stack([forward, c * total[:, 1] - s * total[:, 0], total[:, 2]])


@dataclass(frozen=True)
class Vehicle:
    """What it adds: (I + `scale`) field + `bias`, nT."""

    name: str = "perfect"
    scale: Floats = field(default_factory=lambda: np.zeros((3, 3)))
    bias: Floats = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def of(cls, name: str, seed: int, *, calibrated: bool) -> Vehicle:
        """Left with some hundred nT after calibration, with some ten thousand before."""
        rng = np.random.default_rng(seed)
        scale, bias = (0.004, 350.0) if calibrated else (0.05, 9000.0)
        return cls(name, scale * rng.normal(size=(3, 3)), bias * rng.normal(size=3))


@dataclass(frozen=True)
class Pass:
    """How the road is driven: `lane_m` of weaving, `noise_nt`, `shift_m` of error along it."""

    seed: int = 1
    lane_m: float = 0.35
    noise_nt: float = 120.0
    shift_m: float = 0.5


def road_map(
    road: Road | None = None,
    vehicle: Vehicle | None = None,
    drive: Pass | None = None,
    *,
    spacing_m: float = 1.0,
    calibrated: bool = True,
    sigma_nt: float = 266.0,
) -> xr.Dataset:
    """A road-map/1 of one pass; without `vehicle` and `drive` it is the truth itself."""
    road, vehicle = road or Road(), vehicle or Vehicle()
    distance = spacing_m * np.arange(int(road.length_m / spacing_m) + 1)
    rng = np.random.default_rng(0 if drive is None else drive.seed)
    aside: Any = 0.0
    seen = distance
    if drive is not None:
        aside = drive.lane_m * _noise(rng, distance, 40.0)
        seen = distance + drive.shift_m * _noise(rng, distance, 150.0)
    # The mean over the cell, as of several samples in it.
    parts = (np.arange(4) - 1.5) / 4 * spacing_m
    truth = np.mean([road.body_field(seen + p, aside) for p in parts], axis=0)
    reading = truth + truth @ vehicle.scale.T + vehicle.bias
    if drive is not None:
        reading = reading + drive.noise_nt * np.stack(
            [_noise(rng, distance, 2.0) for _ in range(3)], axis=1
        )
    # Truths carry the road's place, a pass its own: the miss is between places.
    return _dataset(road, vehicle, drive, distance, reading, spacing_m, calibrated, sigma_nt)


def _dataset(
    road: Road, vehicle: Vehicle, drive: Pass | None, distance: Floats, reading: Floats,
    spacing_m: float, calibrated: bool, sigma_nt: float,
) -> xr.Dataset:  # fmt: skip
    n = distance.size
    place, course = road.at(distance)
    north, east = metres_per_degree(np.array(PLACE[0]), HEIGHT)
    point, body = ("point",), ("point", "axis")
    digest = hashlib.sha256(np.ascontiguousarray(reading)).hexdigest()
    start = np.datetime64("2024-05-01T10:00:00", "ns")
    units = {
        "distance": "m", "latitude": "degrees_north", "longitude": "degrees_east", "height": "m",
        "heading": "degree", "field_body": "nT", "field_body_uncertainty": "nT",
        "vehicle_mean": "nT", "vehicle_square_sum": "nT2",
    }  # fmt: skip
    flags = {
        "flag_masks": np.array([1, 2, 4, 8, 16, 32], np.uint8),
        "flag_meanings": "interpolated undersampled position_doubtful transient_dropped "
        "single_pass uncalibrated",
    }
    values: dict[str, Any] = {
        "distance": (point, distance),
        "latitude": (point, PLACE[0] + place[:, 0] / float(north)),
        "longitude": (point, PLACE[1] + place[:, 1] / float(east)),
        "height": (point, np.full(n, HEIGHT)),
        "heading": (point, np.degrees(course) % 360.0),
        "field_body": (body, reading),
        "field_body_uncertainty": (body, np.full((n, 3), sigma_nt)),
        "passes": (point, np.ones(n, np.int32)),
        "samples": (point, np.full(n, 4, np.int32)),
        "quality_flag": (point, np.zeros(n, np.uint8), flags),
        "vehicle_name": (("vehicle",), np.array([vehicle.name])),
        "vehicle_passes": (("vehicle", "point"), np.ones((1, n), np.int32)),
        "vehicle_mean": (("vehicle", *body), reading[None]),
        "vehicle_square_sum": (("vehicle", *body), np.zeros((1, n, 3))),
        "pass_name": (
            ("pass",),
            np.array([f"{vehicle.name} {0 if drive is None else drive.seed}"]),
        ),
        "pass_digest": (("pass",), np.array([digest])),
        "pass_vehicle": (("pass",), np.array([vehicle.name])),
        "pass_start": (("pass",), np.array([start])),
    }
    made = xr.Dataset(values)
    for name, unit in units.items():
        made[name].attrs["units"] = unit
    return made.assign_attrs(
        road=road.name, spacing_m=spacing_m, length_m=float(np.ptp(distance)),
        frame="body: forward, right, down", calibrated="true" if calibrated else "false",
        direction="forward", height_reference="ellipsoid", source="simulated",
    )  # fmt: skip
