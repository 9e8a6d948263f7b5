"""The two maps of a road driven in both directions, and how one follows from the other."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.schemas.errors import ContractError

Real = NDArray[np.float64]


def field_at_heading(road: xr.Dataset, heading: Real) -> Real:
    """The field (point, 3), nT, that a level vehicle at the map's points has at other headings.

    A turn by d to the right takes forward f and right r to f cos d + r sin d and
    r cos d - f sin d; down stays. At the map's heading plus 180 degrees that is the map of the
    other direction, but for the other lane.

    Parameters
    ----------
    heading : (point,) or scalar, degrees clockwise from true north.

    Raises
    ------
    ContractError : the map's heading is not that of an attitude.
    """
    if road.attrs.get("heading_source") != "attitude":
        raise ContractError(
            f"the heading is that of the {road.attrs.get('heading_source', 'course')}",
            where="attrs.heading_source",
            expected="the attitude's, to which the field belongs",
            remedy="map the other direction from drives of its own",
        )
    turn = np.radians(heading - road["heading"].values.astype(np.float64))
    forward, right, down = road["field_body"].values.astype(np.float64).T
    c, s = np.cos(turn), np.sin(turn)
    return np.column_stack([c * forward + s * right, c * right - s * forward, down])
