"""A road-map/1 as a dataset: its variables with their dimensions, units and flags."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.flags import RoadFlag, flag_attributes

FRAME = "body: forward, right, down"
AXES = ("forward", "right", "down")

_POINT = ("point",)
_FIELD = ("point", "axis")
_VEHICLE = ("vehicle", "point", "axis")

_VARIABLES: dict[str, tuple[tuple[str, ...], dict[str, Any]]] = {
    "distance": (_POINT, {"units": "m", "long_name": "distance along the road"}),
    "latitude": (_POINT, {"units": "degrees_north", "standard_name": "latitude"}),
    "longitude": (_POINT, {"units": "degrees_east", "standard_name": "longitude"}),
    "height": (_POINT, {"units": "m", "positive": "up"}),
    "heading": (_POINT, {"units": "degree", "long_name": "clockwise from true north"}),
    "speed": (_POINT, {"units": "m s-1", "long_name": "mean speed of the passes"}),
    "field_body": (_FIELD, {"units": "nT", "long_name": "magnetic field"}),
    "field_body_uncertainty": (_FIELD, {"units": "nT", "long_name": "1 sigma of field_body"}),
    "variation_same_vehicle": (
        _FIELD,
        {"units": "nT", "long_name": "standard deviation of passes of one vehicle"},
    ),
    "variation_cross_vehicle": (
        _FIELD,
        {"units": "nT", "long_name": "standard deviation of passes of different vehicles"},
    ),
    "passes": (_POINT, {"long_name": "number of passes"}),
    "samples": (_POINT, {"long_name": "number of samples"}),
    "quality_flag": (_POINT, flag_attributes(RoadFlag)),
    "vehicle_name": (("vehicle",), {}),
    "vehicle_passes": (("vehicle", "point"), {"long_name": "number of passes of each vehicle"}),
    "vehicle_mean": (_VEHICLE, {"units": "nT", "long_name": "mean field of each vehicle"}),
    "vehicle_square_sum": (
        _VEHICLE,
        {"units": "nT2", "long_name": "sum of squared deviations from vehicle_mean"},
    ),
    "pass_name": (("pass",), {}),
    "pass_digest": (("pass",), {"long_name": "SHA-256 of the samples of a pass"}),
    "pass_vehicle": (("pass",), {}),
    "pass_start": (("pass",), {}),
}


def road_dataset(values: Mapping[str, NDArray[Any]], attrs: Mapping[str, Any]) -> xr.Dataset:
    """A road-map/1 of its variables by name and its attributes."""
    variables = {}
    for name, array in values.items():
        dims, about = _VARIABLES[name]
        variables[name] = (dims, array, dict(about))
    made = xr.Dataset(variables, attrs={"Conventions": "CF-1.11", "frame": FRAME, **attrs})
    return made.assign_coords(axis=("axis", np.array(AXES)))
