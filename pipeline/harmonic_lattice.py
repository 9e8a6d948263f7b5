"""How far apart the nodes of a map made from spherical harmonics are, and how near a pole."""

from __future__ import annotations

import logging

from magtiles.catalog.kernels.bspline import HALO
from magtiles.catalog.releases.lattice import Lattice
from magtiles.schemas.errors import ParameterError
from magtiles.stages.field.model_components import shortest_wavelength_m
from magtiles.stages.release.plan import POLAR_LIMIT, Bounds

_log = logging.getLogger(__name__)

_NODES_A_WAVE = 8.0
"""Default nodes on the shortest wave: a cubic spline then errs by 0.04 % of that wave."""
_COARSE, _NYQUIST = 4.0, 2.0
"""Nodes on the shortest wave below which a spline errs by 0.6 % of it and more, and by all."""

_WIDEST_M = 100e3
"""Wider by default, and the largest tile would hold fewer cells than its halo."""

_METRES_A_DEGREE = 110_574.0
"""Least length of a degree of latitude."""

GLOBE: Bounds = (-POLAR_LIMIT, POLAR_LIMIT, -180.0, 180.0)


def harmonic_spacing(asked: float | None, degree: int, bounds: Bounds, table: str) -> float:
    """Node spacing, m: as asked, or what the shortest wave and the room to the pole allow.

    Raises ParameterError, naming the key of the product's `table`, for nodes that cannot hold
    the `degree`; warns where they hold it badly.
    """
    wave = shortest_wavelength_m(degree)
    if asked is None:
        farthest = max(abs(bounds[0]), abs(bounds[1]))
        room = max(90.0 - farthest, 90.0 - POLAR_LIMIT) / (HALO + 1) * _METRES_A_DEGREE
        return min(wave / _NODES_A_WAVE, room, _WIDEST_M)
    if asked > wave / _NYQUIST:
        raise ParameterError(
            f"nodes {asked:g} m apart cannot hold degree {degree}",
            where=f"{table}.spacing_m",
            expected=f"at most {wave / _NYQUIST:.0f} m (Nyquist), better {wave / _COARSE:.0f}",
            remedy="lower it" + (", or lower highest_degree" if table == "model" else ""),
        )
    if asked > wave / _COARSE:
        _log.warning(
            "spacing_m %g leaves less than four nodes on the shortest wave of degree %d: "
            "interpolation errs by 0.6 %% of it and more; %.0f m would do",
            asked, degree, wave / _COARSE,
        )  # fmt: skip
    return asked


def check_halo(lattice: Lattice, table: str) -> None:
    """Raise ParameterError where the halo would pass a pole."""
    reach = HALO * lattice.latitude_spacing
    if max(-lattice.south, lattice.north) + reach > 90.0:
        room = (90.0 - max(-lattice.south, lattice.north)) / HALO * _METRES_A_DEGREE
        raise ParameterError(
            f"{HALO} nodes beyond {lattice.south:g} to {lattice.north:g} degrees reach over a pole",
            where=f"{table}.spacing_m",
            expected=f"nodes at most {room:.0f} m apart there",
            remedy="lower spacing_m, or set a smaller region.latitude",
        )
