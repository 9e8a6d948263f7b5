"""The field of a spherical-harmonic model on a geographic grid: ``evaluate-model``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pydantic
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.models import FieldModel, evaluate_grid
from magtiles.schemas.errors import ParameterError
from magtiles.stages.crs import WGS84
from magtiles.stages.declare import OPTIONAL_FILE, IsoDate, Params, Stage, quantity
from magtiles.stages.ingest.field_model import named_model

Real = NDArray[np.float64]

Axis = tuple[float, Annotated[float, pydantic.Field(gt=0)], Annotated[int, pydantic.Field(ge=1)]]
_TENSOR = {"nn": (0, 0), "ne": (0, 1), "nd": (0, 2), "ee": (1, 1), "ed": (1, 2)}


class EvaluateModelParams(Params):
    """Parameters of evaluate-model."""

    reference_field: str = quantity(
        "1", default="IGRF-14", min_length=1, doc="Model, where no file is given."
    )
    reference_epoch: IsoDate = quantity("1", doc="Date of the field.")
    latitude: Axis = quantity("degrees_north", doc="First, spacing, count (WGS84).")
    longitude: Axis = quantity("degrees_east", doc="First, spacing, count (WGS84).")
    heights_m: tuple[float, ...] = quantity(
        "m", default=(0.0,), min_length=1, doc="Heights above the ellipsoid, ascending."
    )
    degrees: tuple[int, int] | None = quantity(
        "1", default=None, doc="Lowest and highest degree; default all of the model's."
    )
    gradient: bool = quantity("1", default=False, doc="Add the gradient tensor.")
    allow_extrapolated: bool = quantity(
        "1", default=False, doc="Permit a date outside the span that the model is valid for."
    )


def evaluate_model(*, params: EvaluateModelParams, model: Path | None = None) -> xr.Dataset:
    """A model's north, east, down and total field, nT, on (height, latitude, longitude).

    With `gradient` also the tensor dB_i/dx_j, nT/km. Axes are the true (geodetic) north, east
    and down of each node. Raises ParameterError for an axis that leaves the globe or heights
    that do not ascend, and what the model does for a date it does not cover.
    """
    latitude, longitude, heights = _axes(params)
    used = named_model(params.reference_field, model, role="model")
    if params.degrees is not None:
        used = used.degrees(*params.degrees)
    # One height at a time, whose arrays are the output's own.
    levels = [_level(used, latitude, longitude, height, params) for height in heights]
    names = levels[0].keys()
    variables: dict[str, Any] = {
        name: (
            ("height", "latitude", "longitude"),
            np.stack([level[name] for level in levels]),
            {
                "units": "nT km-1" if name.startswith("gradient") else "nT",
                "grid_mapping": "crs",
            },
        )
        for name in names
    }
    variables["crs"] = ((), np.int32(0), WGS84.to_cf())
    coordinates = {
        "height": ("height", heights, {"units": "m", "positive": "up"}),
        "latitude": ("latitude", latitude, {"units": "degrees_north"}),
        "longitude": ("longitude", longitude, {"units": "degrees_east"}),
    }
    attributes = {
        "reference_field": used.name,
        "reference_epoch": params.reference_epoch,
        "height_reference": "ellipsoid",
        "source": f"{used.name}, degrees {used.n_min} to {used.n_max}",
    }
    return xr.Dataset(variables, coordinates, attributes)


def _level(
    model: FieldModel, latitude: Real, longitude: Real, height: float, params: EvaluateModelParams
) -> dict[str, Real]:
    where = latitude, longitude, np.array([height]), params.reference_epoch
    permit = params.allow_extrapolated
    if params.gradient:
        vector, tensor = evaluate_grid(model, *where, gradient=True, allow_extrapolated=permit)
    else:
        vector, tensor = evaluate_grid(model, *where, allow_extrapolated=permit), None
    vector = vector[0]
    fields = {f"field_{axis}": vector[..., i] for i, axis in enumerate(("north", "east", "down"))}
    fields["field_total"] = np.linalg.norm(vector, axis=-1)
    if tensor is not None:
        fields |= {f"gradient_{name}": tensor[0][..., i, j] for name, (i, j) in _TENSOR.items()}
    return fields


def _axes(params: EvaluateModelParams) -> tuple[Real, Real, Real]:
    latitude, longitude = (
        first + step * np.arange(count, dtype=np.float64)
        for first, step, count in (params.latitude, params.longitude)
    )
    heights = np.asarray(params.heights_m, np.float64)
    for name, bad, expected in (
        ("latitude", np.abs(latitude).max() > 90.0, "nodes from -90 to 90"),
        ("longitude", longitude[0] < -360.0 or longitude[-1] > 540.0, "nodes from -360 to 540"),
        ("heights_m", bool((np.diff(heights) <= 0).any()), "ascending heights"),
    ):
        if bad:
            raise ParameterError(f"is {getattr(params, name)}", where=name, expected=expected)
    return latitude, longitude, heights


STAGE = Stage(
    name="evaluate-model",
    version=1,
    params=EvaluateModelParams,
    inputs={"model": OPTIONAL_FILE},
    output="field-grid/1",
    run=evaluate_model,
)
