"""Classes that segments of time are pooled by: activity, season and local time.

One rule for the fit that pools and for the reader that asks. A class that does not tell one of
the three apart carries `ANY` for it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

ANY = -1
KP_CLASSES = ("quiet", "stormy")
SEASONS = ("winter", "equinox", "summer")
LOCAL_TIMES = ("00-06", "06-12", "12-18", "18-24")

STORMY_KP = 3.0
"""Least Kp of magnetic storm conditions (Canciani and Raquet 2016, "Results")."""

# Lloyd's seasons of the northern hemisphere, January to December.
_LLOYD = np.array([0, 0, 1, 1, 2, 2, 2, 2, 1, 1, 0, 0], np.int8)


def kp_class(kp: ArrayLike) -> NDArray[np.int8]:
    """0 for quiet, 1 for stormy, `ANY` where Kp is NaN; any shape."""
    values = np.asarray(kp, np.float64)
    return np.where(np.isnan(values), ANY, values >= STORMY_KP).astype(np.int8)


def season(time: NDArray[np.datetime64], latitude_deg: ArrayLike) -> NDArray[np.int8]:
    """Lloyd's season of the hemisphere: 0 winter, 1 equinox, 2 summer; shapes broadcast."""
    month = np.asarray(time).astype("datetime64[M]").astype(np.int64) % 12
    north = _LLOYD[month]
    south = np.asarray(latitude_deg, np.float64) < 0.0
    return np.where(south, 2 - north, north).astype(np.int8)


def local_time(solar_minute: ArrayLike) -> NDArray[np.int8]:
    """Quarter of the local day, from midnight, of minutes in [0, 1440); any shape."""
    return np.asarray(np.asarray(solar_minute, np.float64) // 360.0, np.int8)
