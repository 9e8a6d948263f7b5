"""The direction of the ambient field that a total-field anomaly is measured along."""

from __future__ import annotations

import datetime
import logging
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import ppigrf
import xarray as xr
from numpy.typing import NDArray

from magtiles.schemas.errors import CoverageError, ParameterError

Real = NDArray[np.float64]

_METRES_PER_KM = 1000.0

_log = logging.getLogger(__name__)


class Ambient(NamedTuple):
    """Unit vector of the ambient field in true NED; each part of the positions' shape."""

    north: Real
    east: Real
    down: Real

    @property
    def inclination_deg(self) -> Real:
        """Angle below the horizontal, degrees."""
        return np.asarray(np.degrees(np.arctan2(self.down, np.hypot(self.north, self.east))))

    @property
    def declination_deg(self) -> Real:
        """Angle of the horizontal part, east of true north, degrees."""
        return np.asarray(np.degrees(np.arctan2(self.east, self.north)))


def from_angles(inclination_deg: float, declination_deg: float, shape: tuple[int, ...]) -> Ambient:
    """One direction everywhere (Mount 2018, eq. 96-98)."""
    i, d = np.radians([inclination_deg, declination_deg])
    parts = np.cos(i) * np.cos(d), np.cos(i) * np.sin(d), np.sin(i)
    return Ambient(*(np.full(shape, part) for part in parts))


def reference_coefficients(reference_field: str) -> Path | None:
    """The coefficient file of an IGRF generation that ppigrf carries; None for any other field."""
    generation = reference_field.upper().replace("-", "").replace(" ", "")
    if re.fullmatch(r"IGRF\d+", generation) is None:
        return None
    file = Path(ppigrf.__file__).with_name(f"{generation}.shc")
    return file if file.is_file() else None


def igrf_direction(
    latitude: Real,
    longitude: Real,
    height_m: float,
    date: datetime.datetime,
    coefficients: Path | None = None,
) -> Ambient:
    """Direction of the IGRF at WGS84 positions (degrees) and ellipsoidal height, any shape.

    `coefficients` names an .shc file; default the newest generation.
    """
    file = {} if coefficients is None else {"coeff_fn": str(coefficients)}
    east, north, up = (
        np.asarray(part)[0]
        for part in ppigrf.igrf(longitude, latitude, height_m / _METRES_PER_KM, date, **file)
    )
    strength = np.sqrt(east**2 + north**2 + up**2)
    return Ambient(north / strength, east / strength, -up / strength)


def _check_epoch(date: datetime.datetime, coefficients: Path | None) -> None:
    """Raise CoverageError for a date that the coefficients do not cover."""
    file = () if coefficients is None else (str(coefficients),)
    epochs = ppigrf.ppigrf.read_shc(*file)[0].index
    if not epochs[0] <= date <= epochs[-1]:
        raise CoverageError(
            f"reference_epoch {date:%Y-%m-%d} is outside the span of the IGRF",
            expected=f"{epochs[0]:%Y-%m-%d} to {epochs[-1]:%Y-%m-%d}",
            remedy="correct it, or give inclination_deg and declination_deg",
        )


class AmbientSource:
    """Where the ambient direction of a map comes from: given angles, or the IGRF at its epoch.

    The IGRF is of the generation that `reference_field` names, if it is at hand. The directions
    of all core-field models agree within hundredths of a degree, so for others the newest
    stands in.
    Raises ParameterError if only one of the two angles is given, CoverageError for an epoch
    that the IGRF does not cover.
    """

    def __init__(
        self, grid: xr.Dataset, inclination_deg: float | None, declination_deg: float | None
    ) -> None:
        if (inclination_deg is None) != (declination_deg is None):
            raise ParameterError(
                "only one of inclination_deg and declination_deg is given",
                remedy="give both, or neither to use the reference field at its epoch",
            )
        self._angles = inclination_deg, declination_deg
        self._date = datetime.datetime.fromisoformat(grid.attrs["reference_epoch"])
        self._coefficients = reference_coefficients(str(grid.attrs["reference_field"]))
        if inclination_deg is None:
            _check_epoch(self._date, self._coefficients)
            if self._coefficients is None:
                _log.warning(
                    "no coefficients of reference field '%s' at hand: the ambient direction is "
                    "the newest IGRF's",
                    grid.attrs["reference_field"],
                )
        self._height = float(np.mean(grid["height"].values))

    def at(self, latitude: Real, longitude: Real) -> Ambient:
        """The direction at WGS84 positions (degrees), of their shape."""
        inclination, declination = self._angles
        if inclination is not None and declination is not None:
            return from_angles(inclination, declination, np.shape(latitude))
        return igrf_direction(latitude, longitude, self._height, self._date, self._coefficients)
