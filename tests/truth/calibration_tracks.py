"""Tracks of a magnetometer in a known core field, with known bias, scale and distortion."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Real = NDArray[np.float64]

CORE = np.array([20_000.0, -2_100.0, 49_300.0])
GIVEN = tuple(CORE.tolist())
TOTAL = float(np.linalg.norm(CORE))
LEVEL_DISTORTION = np.array([[1.10, 0.05, 0.0], [0.05, 0.90, 0.0], [0.0, 0.0, 1.0]])
DISTORTION = np.array([[1.10, 0.05, 0.02], [0.03, 0.90, -0.04], [0.01, 0.06, 1.05]])
BIAS = np.array([30_000.0, -8_000.0, 4_000.0])
START = np.datetime64("2011-08-11T14:00:00", "ns")


def circles(revolutions: float = 3.0, samples: int = 2400) -> Real:
    """Heading (samples,), radians."""
    return np.linspace(0.0, 2.0 * np.pi * revolutions, samples)


def tumbling(samples: int = 3000) -> tuple[Real, Real, Real]:
    """Heading, pitch and roll of a sensor turned through all directions."""
    n = np.arange(samples)
    return circles(4.0, samples), 1.2 * np.sin(n / 37.0), 2.0 * np.sin(n / 53.0)


def track(
    heading: Real,
    pitch: ArrayLike = 0.0,
    roll: ArrayLike = 0.0,
    *,
    distortion: Real = LEVEL_DISTORTION,
    bias: Real = BIAS,
    noise: float = 0.0,
    attitude: bool = False,
    rate_hz: float = 50.0,
    seed: int = 1,
) -> xr.Dataset:
    """A track/1 (time,) at one place near Dayton, Ohio: raw = distortion @ field + bias + noise."""
    n = len(heading)
    angles = np.column_stack([np.broadcast_to(a, n) for a in (heading, pitch, roll)])
    turn = Rotation.from_euler("ZYX", angles)
    raw = turn.inv().apply(CORE) @ distortion.T + bias
    raw += noise * np.random.default_rng(seed).normal(size=raw.shape)
    time = START + (np.arange(n) * 1e9 / rate_hz).astype("timedelta64[ns]")
    made = xr.Dataset(
        {
            "latitude": ("time", np.full(n, 39.78), {"units": "degrees_north"}),
            "longitude": ("time", np.full(n, -84.08), {"units": "degrees_east"}),
            "height": ("time", np.full(n, 250.0), {"units": "m"}),
            "field_body": (("time", "axis"), raw, {"units": "nT"}),
        },
        coords={"time": time},
        attrs={"height_reference": "ellipsoid", "source": "made"},
    )
    if attitude:
        quaternion = turn.as_quat(scalar_first=True)
        made["attitude"] = (("time", "quaternion"), quaternion, {"units": "1"})
    return made
