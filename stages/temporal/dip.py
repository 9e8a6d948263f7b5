"""Dip latitude: where a place lies along the field, which orders its daily variation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.models import evaluate
from magtiles.stages.ingest.field_model import igrf

Real = NDArray[np.float64]


def dip_latitude(latitude: Real, longitude: Real, height: Real, date: np.datetime64) -> Real:
    """Dip latitude (...), degrees: tan(dip latitude) = tan(inclination) / 2, of the IGRF.

    The latitude at which a centred dipole has this inclination; zero on the dip equator,
    under the equatorial electrojet. Raises QueryError for a date the IGRF does not cover.
    """
    north, east, down = np.moveaxis(evaluate(igrf(), latitude, longitude, height, date), -1, 0)
    return np.asarray(np.degrees(np.arctan2(down, 2.0 * np.hypot(north, east))), np.float64)
