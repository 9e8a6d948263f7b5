"""A calibration flight whose scalar field follows the linear Tolles-Lawson model exactly."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magtiles.stages.vehicle.tolles_lawson.terms import term_columns, term_names

Floats = NDArray[np.float64]

EARTH_NT = 52_000.0 * np.array([0.36, 0.08, 0.93]) / np.linalg.norm([0.36, 0.08, 0.93])
STEP_S = 0.1
STRAIGHT = 400
"""Samples of straight flight before the first manoeuvre and after the last."""
TERMS = term_names(6, 9)
COEFFICIENTS = np.concatenate(
    [
        [38.0, -21.0, 55.0],
        [1.3e-3, -6e-4, 9e-4, -8e-4, 5e-4, 7e-4],
        [1.1e-3, -4e-4, 8e-4, 3e-4, 1.9e-3, -6e-4, -9e-4, 5e-4, 1.6e-3],
    ]
)
SCALE = np.repeat([1.0, 52_000.0, 52_000.0 * 1.9], [3, 6, 9])
"""What a unit of each coefficient does to the field at full swing, nT."""


def angles(headings: tuple[float, ...] = (20.0, 110.0, 200.0, 290.0)) -> Floats:
    """Roll, pitch and yaw (n, 3), degrees: 25 s of each of them on every heading.

    There are turns between the headings, and straight flight at both ends.
    """
    t = np.arange(250) * STEP_S
    wave = np.sin(2.0 * np.pi * 0.25 * t) * np.sin(np.pi * t / 25.0)
    quiet = np.zeros(100)
    ramp = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 600))[:, None]
    legs: list[Floats] = []
    for heading in headings:
        leg = np.zeros((1200, 3))
        for axis, amplitude in enumerate((10.0, 5.0, 5.0)):
            series = np.concatenate([quiet, amplitude * wave])
            leg[axis * 350 : axis * 350 + 350, axis] = series
        leg += np.array([0.0, 2.0, heading])
        if legs:  # a minute's turn
            legs.append(legs[-1][-1] + ramp * (leg[0] - legs[-1][-1]))
        legs.append(leg)
    ends = np.repeat([legs[0][:1], legs[-1][-1:]], STRAIGHT, axis=1)
    return np.concatenate([ends[0], *legs, ends[1]])


def body_field(degrees: Floats) -> Floats:
    """The Earth's field (n, 3), nT, in body axes."""
    attitude = Rotation.from_euler("ZYX", degrees[:, ::-1], degrees=True)
    return np.asarray(attitude.apply(EARTH_NT, inverse=True))


def flight(degrees: Floats, of: Any = "direction_cosines", noise_nt: float = 0.0) -> xr.Dataset:
    """track/1 at one place, with the true Earth's field as `expected_total`."""
    body = body_field(degrees)
    own = term_columns(body, STEP_S, TERMS, of) @ COEFFICIENTS
    total = np.linalg.norm(EARTH_NT) + own
    noise = np.random.default_rng(1).normal(0.0, noise_nt, len(body)) if noise_nt else 0.0
    attitude = Rotation.from_euler("ZYX", degrees[:, ::-1], degrees=True).as_quat()
    n = len(body)
    return xr.Dataset(
        {
            "latitude": ("time", np.full(n, 50.0), {"units": "degrees_north"}),
            "longitude": ("time", np.full(n, 8.0), {"units": "degrees_east"}),
            "height": ("time", np.full(n, 3000.0), {"units": "m"}),
            "field_total": ("time", total + noise, {"units": "nT"}),
            "field_body": (("time", "axis"), body, {"units": "nT"}),
            "attitude": (("time", "quaternion"), np.roll(attitude, 1, axis=1), {"units": "1"}),
            "expected_total": ("time", np.full(n, np.linalg.norm(EARTH_NT)), {"units": "nT"}),
        },
        coords={
            "time": np.datetime64("2024-05-01T10:00", "ns")
            + np.arange(n) * np.timedelta64(round(1e9 * STEP_S), "ns")
        },
        attrs={"height_reference": "ellipsoid", "source": "cloverleaf"},
    )
