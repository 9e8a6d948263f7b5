"""The direction of the ambient field that a total-field anomaly is measured along."""

from __future__ import annotations

import logging
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.models import FieldModel, evaluate, load_igrf, read_model
from magtiles.schemas.errors import CoverageError, ParameterError
from magtiles.stages.declare import quantity
from magtiles.stages.ingest.field_model import igrf_coefficients

Real = NDArray[np.float64]

INCLINATION_DEG: float | None = quantity(
    "degree",
    default=None,
    ge=-90,
    le=90,
    doc="Ambient inclination; default the reference field's at its epoch.",
)
DECLINATION_DEG: float | None = quantity(
    "degree", default=None, ge=-180, le=180, doc="Ambient declination, with inclination_deg."
)
"""Parameters of stages and products that give the direction by hand."""

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
        self._date = str(grid.attrs["reference_epoch"])
        self._height = float(np.mean(grid["height"].values))
        if inclination_deg is None:
            self._igrf = _igrf(str(grid.attrs["reference_field"]), self._date)

    def at(self, latitude: Real, longitude: Real) -> Ambient:
        """The direction at WGS84 positions (degrees), of their shape."""
        inclination, declination = self._angles
        if inclination is not None and declination is not None:
            return from_angles(inclination, declination, np.shape(latitude))
        field = evaluate(self._igrf, latitude, longitude, self._height, self._date)
        return Ambient(*np.moveaxis(field / np.linalg.norm(field, axis=-1, keepdims=True), -1, 0))


def _igrf(reference_field: str, date: str) -> FieldModel:
    """The generation of that name, else the newest; CoverageError for a date it does not cover."""
    file = igrf_coefficients(reference_field)
    if file is None:
        _log.warning(
            "no coefficients of reference field '%s' at hand: the ambient direction is the newest "
            "IGRF's",
            reference_field,
        )
    model = load_igrf() if file is None else read_model(file)
    if not model.covers(date):
        raise CoverageError(
            f"reference_epoch {date} is outside the span of the IGRF",
            expected=f"{model.valid[0]:g} to {model.valid[1]:g}",
            remedy="correct it, or give inclination_deg and declination_deg",
        )
    return model
