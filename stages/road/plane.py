"""A plane about a place in which metres are true, for paths of some tens of kilometres."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pyproj
from numpy.typing import NDArray

from magtiles.catalog.kernels.geodesy import SEMI_MAJOR_AXIS_M, wrap_longitude

Real = NDArray[np.float64]


@dataclass(frozen=True)
class Plane:
    """Azimuthal equidistant plane about a place: (..., 2) metres north and east of it.

    Distances are those at `height` m above the ellipsoid; 50 km away they are wrong by
    1e-5 of themselves across the direction to the centre.
    """

    latitude: float
    longitude: float
    height: float = 0.0
    _projection: pyproj.Proj = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        made = pyproj.Proj(proj="aeqd", lat_0=self.latitude, lon_0=self.longitude, ellps="WGS84")
        object.__setattr__(self, "_projection", made)

    @property
    def _stretch(self) -> float:
        return 1.0 + self.height / SEMI_MAJOR_AXIS_M

    def metres(self, latitude: Real, longitude: Real) -> Real:
        """(..., 2) m north and east; NaN where a coordinate is."""
        known = np.isfinite(latitude) & np.isfinite(longitude)
        east, north = self._projection(
            np.where(known, longitude, self.longitude), np.where(known, latitude, self.latitude)
        )
        place = self._stretch * np.stack([north, east], axis=-1)
        return np.asarray(np.where(known[..., None], place, np.nan))

    def degrees(self, place: Real) -> tuple[Real, Real]:
        """Latitude and longitude (...), degrees, of (..., 2) m north and east."""
        north, east = np.moveaxis(place / self._stretch, -1, 0)
        longitude, latitude = self._projection(east, north, inverse=True)
        return np.asarray(latitude), wrap_longitude(np.asarray(longitude))
