"""The sample vehicles: what their sensors read on a drive along a road whose field is known.

A vector magnetometer inside a vehicle reads ``raw = distortion @ field + bias + noise``: hard iron
is the bias; scale factors, axes that are not orthogonal and soft iron are the distortion. Sensors
and rates are those of Shockley (2012, section 3.2.2): 2 mG of noise at 50 Hz, a receiver with an
error of 1.5 m.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.signal
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magtiles.catalog.kernels.geodesy import metres_per_degree
from magtiles.pipeline.road_paths import Motion, drive, wander
from magtiles.pipeline.road_truth import Road, passing_field
from magtiles.pipeline.ros_log import (
    Topic,
    imu,
    magnetic_field,
    nav_sat_fix,
    twist_stamped,
)

Floats = NDArray[np.float64]
Vector = tuple[float, float, float]

FIELD_HZ = 50
_FIX_EVERY, _IMU_EVERY, _SPEED_EVERY = 10, 5, 5  # samples of the field
_NED_TO_ENU = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_FLU_TO_FRD = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
_FLU = np.array([1.0, -1.0, -1.0])
_GRAVITY = 9.80665  # m s-2, standard

# Sensors are digital. Steps that are powers of two keep doubles short, and files small.
_FIELD_STEP_T = 2.0**-27  # 7.5 nT; an HMR2300 has 6.7
_SPEED_STEP = 2.0**-7
_TURN_STEP = 2.0**-14
_PLACE_STEP = 2.0**-26  # 1.7 mm of latitude
_HEIGHT_STEP = 2.0**-9

_WALK_M, _WALK_S = 1.0, 40.0  # slow error of fixes on each axis
_JITTER_M = 0.15
_VERTICAL = 1.8  # so many times worse upward
_HEADING_ERROR, _TILT_ERROR = np.radians(0.05), np.radians(0.02)


@dataclass(frozen=True)
class Vehicle:
    """A vehicle and its magnetometer, in body axes forward, right, down.

    Attributes
    ----------
    hard_iron_nt : bias.
    soft_iron : nn, rr, dd, nr, nd, rd of a symmetric matrix that is added to the identity.
    scale : of the sensor's axes.
    skew_deg : by how much y leans to x, z to x, and z to y.
    above_m : height of the magnetometer above the road.
    lever_m : from the receiver's antenna to the magnetometer.
    speed_scale : what the wheels read over the truth.
    """

    name: str
    hard_iron_nt: Vector = (0.0, 0.0, 0.0)
    soft_iron: tuple[float, ...] = (0.0,) * 6
    scale: Vector = (1.0, 1.0, 1.0)
    skew_deg: Vector = (0.0, 0.0, 0.0)
    above_m: float = 1.0
    lever_m: Vector = (0.0, 0.0, 0.0)
    noise_nt: float = 200.0
    speed_scale: float = 1.0
    seed: int = 0

    @property
    def distortion(self) -> Floats:
        """What the readings are of the field, (3, 3); without the bias."""
        xx, yy, zz, xy, xz, yz = self.soft_iron
        soft = np.eye(3) + np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        yx, zx, zy = np.sin(np.radians(self.skew_deg))
        axes = np.array([[1.0, 0.0, 0.0], [yx, 1.0, 0.0], [zx, zy, 1.0]])
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        return np.asarray(np.diag(self.scale) @ axes @ soft)

    @property
    def matrix(self) -> Floats:
        """The true calibration: field = matrix @ (raw - bias)."""
        return np.asarray(np.linalg.inv(self.distortion), np.float64)


TRUCK = Vehicle(
    "truck", (9200.0, -14100.0, 6300.0), (0.06, -0.09, 0.02, 0.035, -0.02, 0.012),
    (1.02, 0.985, 1.01), (0.6, -0.4, 0.5), 1.2, (-1.8, -0.5, 0.9), speed_scale=1.004, seed=1,
)  # fmt: skip
SUV = Vehicle(
    "suv", (-5200.0, 3100.0, -4100.0), (-0.02, 0.03, 0.01, -0.015, 0.01, -0.008),
    (0.99, 1.012, 1.0), (-0.3, 0.5, 0.2), 1.0, (-1.2, 0.4, 0.7), speed_scale=0.997, seed=2,
)  # fmt: skip
CAR = Vehicle(
    "car", (2600.0, 6900.0, 3500.0), (0.025, 0.015, -0.03, 0.02, 0.012, 0.01),
    (1.005, 1.0, 0.99), (0.4, 0.2, -0.6), 0.8, (-0.7, 0.0, 0.6), speed_scale=1.001, seed=3,
)  # fmt: skip
REFERENCE = Vehicle("reference", noise_nt=10.0, seed=4)
"""A cart without steel, its sensor at the height at which the truth is given."""


@dataclass(frozen=True)
class Drive:
    """One drive, known and as recorded.

    Attributes
    ----------
    time : (n,) of the field's samples, UTC.
    field_body : (n, 3) the field there, forward, right, down, nT, without the vehicle's own.
    disturbance : (n,) nT that passing trucks add, its magnitude.
    topics : what the vehicle recorded.
    """

    motion: Motion
    time: NDArray[np.datetime64]
    field_body: Floats
    disturbance: Floats
    topics: tuple[Topic, ...]


def record(road: Road, vehicle: Vehicle, number: int, start: np.datetime64) -> Drive:
    """Drive a road; the same for the same road, vehicle and number of the pass, from 1."""
    rng = np.random.default_rng([road.seed, vehicle.seed, number])
    motion = drive(road.route, road.lane, FIELD_HZ, rng)
    step = np.timedelta64(10**9 // FIELD_HZ, "ns")
    time = start.astype("datetime64[ns]") + step * np.arange(motion.seconds.size)
    attitude = Rotation.from_euler(
        "ZYX", np.column_stack([motion.heading, motion.pitch, motion.roll])
    )
    still = road.field(motion.north, motion.east, vehicle.above_m)
    transient = _transient(road, vehicle, number, motion)
    body = attitude.apply(still + transient, inverse=True)
    topics = (
        _magnetometer(vehicle, time, body, rng),
        _receiver(road, vehicle, time, motion, attitude, rng),
        _inertial(time, motion, attitude, rng),
        _wheels(vehicle, time, motion, rng),
    )
    return Drive(motion, time, body, np.linalg.norm(transient, axis=1), topics)


def _transient(road: Road, vehicle: Vehicle, number: int, motion: Motion) -> Floats:
    above = np.full(motion.north.shape, -vehicle.above_m)
    points = np.column_stack([motion.north, motion.east, above])
    field = np.zeros_like(points)
    for passing in road.passing:
        if (passing.vehicle, passing.number) == (vehicle.name, number):
            field += passing_field(road, passing, motion.seconds, motion.distance, points)
    return field


def _magnetometer(
    vehicle: Vehicle, time: NDArray[np.datetime64], body: Floats, rng: np.random.Generator
) -> Topic:
    raw = body @ vehicle.distortion.T + np.array(vehicle.hard_iron_nt)
    raw += rng.normal(0.0, vehicle.noise_nt, raw.shape)
    tesla = stepped(1e-9 * raw * _FLU, _FIELD_STEP_T)
    return magnetic_field("/magnetometer", time, tesla, sigma_t=1e-9 * vehicle.noise_nt)


def _receiver(
    road: Road,
    vehicle: Vehicle,
    time: NDArray[np.datetime64],
    motion: Motion,
    attitude: Rotation,
    rng: np.random.Generator,
) -> Topic:
    """Fixes of the antenna, whose error wanders slowly and jitters a little."""
    rows = slice(None, None, _FIX_EVERY)
    antenna = -attitude[rows].apply(vehicle.lever_m)
    error = _slow_error(len(antenna), rng) * [1.0, 1.0, _VERTICAL]
    north, east = motion.north[rows] + antenna[:, 0], motion.east[rows] + antenna[:, 1]
    height = road.route.height_m + vehicle.above_m - antenna[:, 2] + error[:, 2]
    latitude, longitude = road.route.geodetic(north, east)
    per_degree = metres_per_degree(latitude, height)
    place = [
        stepped(latitude + error[:, 0] / per_degree[0], _PLACE_STEP),
        stepped(longitude + error[:, 1] / per_degree[1], _PLACE_STEP),
        stepped(height, _HEIGHT_STEP),
    ]
    sigma = float(np.hypot(_WALK_M, _JITTER_M))
    sigmas = (sigma, sigma, _VERTICAL * sigma)
    return nav_sat_fix("/gnss/fix", time[rows], np.column_stack(place), sigma_m=sigmas)


def _slow_error(count: int, rng: np.random.Generator) -> Floats:
    """First-order Gauss-Markov errors with jitter, (count, 3) m."""
    kept = np.exp(-_FIX_EVERY / FIELD_HZ / _WALK_S)
    driving = rng.normal(0.0, _WALK_M * np.sqrt(1.0 - kept**2), (count, 3))
    driving[0] = rng.normal(0.0, _WALK_M, 3)
    walk = scipy.signal.lfilter([1.0], [1.0, -kept], driving, axis=0)
    return np.asarray(walk + rng.normal(0.0, _JITTER_M, (count, 3)))


def _inertial(
    time: NDArray[np.datetime64], motion: Motion, attitude: Rotation, rng: np.random.Generator
) -> Topic:
    rows = slice(None, None, _IMU_EVERY)
    seconds = motion.seconds[rows]
    errors = [
        sigma * wander(seconds, 20.0, 200.0, rng)
        for sigma in (_TILT_ERROR, _TILT_ERROR, _HEADING_ERROR)
    ]
    measured = attitude[rows] * Rotation.from_rotvec(np.column_stack(errors))
    orientation = (_NED_TO_ENU * measured * _FLU_TO_FRD).as_quat()
    held = -attitude[rows].apply([0.0, 0.0, _GRAVITY], inverse=True)
    acceleration = (motion.acceleration[rows] + held) * _FLU
    rate = motion.turn_rate[rows][:, [2, 1, 0]] * _FLU  # for small pitch and roll
    noise = rng.normal(0.0, [2e-4] * 3 + [0.02] * 3, (seconds.size, 6))
    return imu(
        "/imu", time[rows], stepped(orientation, _TURN_STEP),
        stepped(rate + noise[:, :3], _TURN_STEP), stepped(acceleration + noise[:, 3:], 2.0**-10),
    )  # fmt: skip


def _wheels(
    vehicle: Vehicle, time: NDArray[np.datetime64], motion: Motion, rng: np.random.Generator
) -> Topic:
    rows = slice(None, None, _SPEED_EVERY)
    speed = vehicle.speed_scale * motion.speed[rows]
    speed = np.where(speed > 0.0, speed + rng.normal(0.0, 0.02, speed.shape), 0.0)
    return twist_stamped("/wheel_speed", time[rows], stepped(np.maximum(speed, 0.0), _SPEED_STEP))


def stepped(values: Floats, step: float) -> Floats:
    """Values rounded to multiples of a step."""
    return np.asarray(np.round(values / step) * step)
