"""Metres per degree on the WGS84 ellipsoid, and longitudes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# NGA.STND.0036 (2014), table 3.1. The reader must not need PROJ, so the two defining numbers
# stand here; a test compares them with PROJ's.
SEMI_MAJOR_AXIS_M = 6378137.0
FLATTENING = 1.0 / 298.257223563
_E2 = FLATTENING * (2.0 - FLATTENING)


def metres_per_degree(latitude: Floats, height: Floats | float) -> tuple[Floats, Floats]:
    """Metres per degree of latitude and of longitude at an ellipsoidal height.

    (M + h) and (N + h) cos(latitude), times pi / 180, with the ellipsoid's meridian radius
    M and prime-vertical radius N of curvature (Torge and Mueller 2012, Geodesy, 4th ed.).

    Parameters
    ----------
    latitude : geodetic, degrees.
    height : metres above the ellipsoid; broadcasts with `latitude`.
    """
    phi = np.radians(latitude)
    w2 = 1.0 - _E2 * np.sin(phi) ** 2
    prime_vertical = SEMI_MAJOR_AXIS_M / np.sqrt(w2)
    meridian = prime_vertical * (1.0 - _E2) / w2
    return (
        np.radians(meridian + height),
        np.radians((prime_vertical + height) * np.cos(phi)),
    )


def degrees_east_of(west: float, longitude: Floats) -> Floats:
    """How far east of the meridian `west` a longitude lies, in [0, 360)."""
    return np.mod(longitude - west, 360.0)


def wrap_longitude(longitude: Floats) -> Floats:
    """The same longitude in [-180, 180)."""
    return np.mod(longitude + 180.0, 360.0) - 180.0
