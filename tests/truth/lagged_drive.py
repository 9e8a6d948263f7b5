"""A drive whose field, attitude and fixes are known, each stamped by its own clock.

The car drives circles, then a winding road with hills, then stands. Its magnetometer has hard and
soft iron; the attitude's stamps and the fixes' are late by known lags.
"""

from __future__ import annotations

import functools

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magtiles.catalog.kernels.geodesy import metres_per_degree

Real = NDArray[np.float64]

START = np.datetime64("2024-05-01T08:00:00", "ns")
DURATION_S = 300.0
STANDS_FROM_S = 260.0
FIELD_NED = np.array([19_800.0, -300.0, 48_700.0])
MATRIX = np.array([[1.08, 0.03, -0.02], [-0.01, 0.94, 0.04], [0.02, 0.01, 1.05]])
BIAS = np.array([4_000.0, -7_500.0, 12_000.0])
ORIGIN = 45.0, 9.0


def heading(seconds: Real) -> Real:
    """Radians from north: circles of 20 s for two minutes, then a winding road, then still."""
    moving = np.minimum(seconds, STANDS_FROM_S)
    return np.where(moving < 120.0, 2 * np.pi * moving / 20.0, np.sin((moving - 120.0) / 4.0))


def speed(seconds: Real) -> Real:
    """m/s: 8, slowing to a stop over the last ten seconds before it stands."""
    return 8.0 * np.clip((STANDS_FROM_S - seconds) / 10.0, 0.0, 1.0)


def attitude(seconds: Real, hills: float = 1.0) -> Rotation:
    """Body to north, east, down."""
    moves = hills * speed(seconds) / 8.0
    pitch, roll = 0.06 * np.sin(seconds / 3.0) * moves, 0.04 * np.sin(seconds / 2.2) * moves
    return Rotation.from_euler("ZYX", np.stack([heading(seconds), pitch, roll], axis=1))


@functools.cache
def _path() -> tuple[Real, Real, Real]:
    """Seconds, metres north and east: the speed along the heading, summed by the millisecond."""
    fine = np.arange(0.0, DURATION_S + 5.0, 1e-3)
    north = np.cumsum(speed(fine) * np.cos(heading(fine))) * 1e-3
    east = np.cumsum(speed(fine) * np.sin(heading(fine))) * 1e-3
    return fine, north, east


def place(seconds: Real) -> tuple[Real, Real]:
    """Latitude and longitude, degrees."""
    fine, north, east = _path()
    per_latitude, per_longitude = metres_per_degree(np.array(ORIGIN[0]), 0.0)
    clipped = np.clip(seconds, 0.0, fine[-1])
    return (
        ORIGIN[0] + np.interp(clipped, fine, north) / per_latitude,
        ORIGIN[1] + np.interp(clipped, fine, east) / per_longitude,
    )


@functools.cache
def drive(
    *,
    attitude_lag_s: float = 0.0,
    fix_lag_s: float = 0.0,
    field_noise_nt: float = 0.0,
    fix_noise_m: float = 0.0,
    attitude_noise_rad: float = 0.0,
    fix_rate_hz: float = 5.0,
    hills: float = 1.0,
) -> xr.Dataset:
    """A track/1 of 50 Hz, with fixes and attitude samples (100 Hz) on their own dimensions."""
    rng = np.random.default_rng(6)
    seconds = np.arange(0.0, DURATION_S, 0.02)
    sampled = np.arange(-1.0, DURATION_S + 1.0, 0.01)
    fixed = np.arange(0.0, DURATION_S, 1.0 / fix_rate_hz)
    turns = attitude(sampled, hills) * Rotation.from_rotvec(
        attitude_noise_rad * rng.normal(size=(sampled.size, 3))
    )
    body = attitude(seconds, hills).inv().apply(FIELD_NED) @ MATRIX.T + BIAS
    body += field_noise_nt * rng.normal(size=body.shape)
    latitude, longitude = place(fixed)
    per_latitude, per_longitude = metres_per_degree(np.array(ORIGIN[0]), 0.0)
    latitude = latitude + fix_noise_m * rng.normal(size=fixed.size) / per_latitude
    longitude = longitude + fix_noise_m * rng.normal(size=fixed.size) / per_longitude
    blank, one = np.full(seconds.size, np.nan), ("attitude_sample",)
    north, east, metre = {"units": "degrees_north"}, {"units": "degrees_east"}, {"units": "m"}
    unit = {"units": "1"}
    return xr.Dataset(
        {
            "latitude": ("time", blank, north),
            "longitude": ("time", blank, east),
            "height": ("time", blank, metre),
            "field_body": (("time", "axis"), body, {"units": "nT"}),
            "attitude": (("time", "quaternion"), np.full((seconds.size, 4), np.nan), unit),
            "fix_time": ("fix", stamps(fixed + fix_lag_s)),
            "fix_latitude": ("fix", latitude, north),
            "fix_longitude": ("fix", longitude, east),
            "fix_height": ("fix", np.full(fixed.size, 250.0), metre),
            "fix_status": ("fix", np.zeros(fixed.size, np.int8)),
            "attitude_time": (one, stamps(sampled + attitude_lag_s)),
            "attitude_quaternion": ((*one, "quaternion"), turns.as_quat(scalar_first=True), unit),
        },
        coords={"time": stamps(seconds)},
        attrs={"height_reference": "ellipsoid", "source": "simulated", "max_gap_s": 2.0},
    )


def stamps(seconds: Real) -> NDArray[np.datetime64]:
    """UTC of seconds after the start."""
    return START + np.round(seconds * 1e9).astype("timedelta64[ns]")


def metres_apart(track: xr.Dataset, seconds: Real) -> Real:
    """How far the track's places are from the true ones at `seconds` (time,)."""
    latitude, longitude = place(seconds)
    per_latitude, per_longitude = metres_per_degree(np.array(ORIGIN[0]), 0.0)
    return np.asarray(
        np.hypot(
            (track["latitude"].values - latitude) * per_latitude,
            (track["longitude"].values - longitude) * per_longitude,
        )
    )
