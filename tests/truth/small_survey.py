"""A walked survey of a small area above buried dipoles: tracks, and the exact field anywhere."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyproj
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.kernels.dipole import dipole_vector

Floats = NDArray[np.float64]

UTM = "EPSG:32617"
CORNER = 500_100.0, 3_230_200.0
"""South-west corner of the area, m in `UTM`."""
SIDE = 20.0
_AMBIENT = 48_000.0 * np.array([np.cos(np.radians(60.0)), 0.0, np.sin(np.radians(60.0))])
_TO_GEOGRAPHIC = pyproj.Transformer.from_crs(UTM, "EPSG:4326", always_xy=True)


def dipoles(seed: int) -> Callable[[Floats, Floats], Floats]:
    """The total-field anomaly, nT, at x, y (...) m of six dipoles 2.5 to 5 m below the sensor."""
    rng = np.random.default_rng(seed)
    places = np.column_stack([rng.uniform(-2.0, SIDE + 2.0, (6, 2)), rng.uniform(2.5, 5.0, 6)])
    moments = rng.normal(0.0, 30.0, (6, 3))

    def anomaly(x: Floats, y: Floats) -> Floats:
        north, east = np.ravel(y) - CORNER[1], np.ravel(x) - CORNER[0]
        points = np.column_stack([north, east, np.zeros(north.size)])
        field = _AMBIENT + dipole_vector(points, places, moments)
        change = np.linalg.norm(field, axis=1) - np.linalg.norm(_AMBIENT)
        return np.asarray(change.reshape(np.shape(x)))

    return anomaly


def walked(seed: int, *, apart: float = 1.0, step: float = 0.2) -> tuple[Floats, Floats]:
    """Places x, y (n,) of wavy lines northward `apart` m, samples unevenly some `step` m apart."""
    rng = np.random.default_rng(100 + seed)
    east, north = [], []
    for line in np.arange(0.0, SIDE + 0.1, apart):
        along = np.sort(rng.uniform(0.0, SIDE, round(SIDE / step)))
        east.append(line + 0.3 * np.sin(along / 3.0 + rng.uniform(0.0, 6.0)))
        north.append(along)
    return CORNER[0] + np.concatenate(east), CORNER[1] + np.concatenate(north)


def track_of(x: Floats, y: Floats, values: Floats, **attributes: str) -> xr.Dataset:
    """A track-anomaly/1 with an anomaly (n,) nT at places (n,) m, 31 m above the ellipsoid."""
    longitude, latitude = (np.asarray(a) for a in _TO_GEOGRAPHIC.transform(x, y))
    start = np.datetime64("2020-03-04T15:00:00", "ns")
    time = start + np.arange(values.size) * np.timedelta64(20, "ms").astype("m8[ns]")
    core = np.full(values.size, float(np.linalg.norm(_AMBIENT)))
    columns = {
        "latitude": (latitude, "degrees_north"),
        "longitude": (longitude, "degrees_east"),
        "height": (np.full(values.size, 31.0), "m"),
        "field_total": (core + values, "nT"),
        "core_field_total": (core, "nT"),
        "magnetic_anomaly": (values, "nT"),
    }
    stated = {
        "height_reference": "ellipsoid",
        "source": "walk",
        "reference_field": "IGRF-14",
        "anomaly_definition": "total field minus reference field",
    }
    return xr.Dataset(
        {name: ("time", a, {"units": unit}) for name, (a, unit) in columns.items()},
        {"time": time},
        stated | attributes,
    )
