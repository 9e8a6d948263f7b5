"""The core field where a dataset is, and the stages that subtract it: ``remove-core-field``.

The total-field anomaly is what a magnetometer measures less the core field's magnitude,
|F| - |F_core|, at each sample's own place, height and date (Canciani and Raquet 2016).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from magtiles.catalog.models import FieldModel, evaluate
from magtiles.schemas.errors import ContractError
from magtiles.stages.crs import dataset_to_wgs84
from magtiles.stages.declare import OPTIONAL_FILE, IsoDate, Params, Stage, quantity
from magtiles.stages.field.geometry import axes, variable
from magtiles.stages.ingest.field_model import named_model
from magtiles.stages.ingest.source import TOTAL_FIELD_ANOMALY
from magtiles.stages.rows import by_rows, rows_of

Real = NDArray[np.float64]

NO_REFERENCE = "none"
"""`reference_field` of a grid from which no core field was removed: the total field itself."""

_LESS_DIURNAL = ", less the diurnal variation"

_ROWS_LOOKED_AT = 512
"""Of a grid, to tell a total field from an anomaly."""

_NODES_AT_ONCE = 1 << 18
"""Of a grid: each takes some 170 bytes while its core field is evaluated."""

_WEAKEST_NT = 10_000.0
"""Below the weakest core field anywhere up to 1000 km, some 15,000 nT."""


@dataclass(frozen=True)
class Core:
    """A core field model at a date, or, with several dates, at each place's own."""

    model: FieldModel
    date: Any
    allow_extrapolated: bool = False

    def vector(self, latitude: Real, longitude: Real, height: ArrayLike) -> Real:
        """North, east, down (..., 3), nT, at WGS84 degrees and ellipsoidal metres (...)."""
        return evaluate(
            self.model,
            latitude,
            longitude,
            height,
            self.date,
            allow_extrapolated=self.allow_extrapolated,
        )

    def total(self, latitude: Real, longitude: Real, height: ArrayLike) -> Real:
        """Magnitude (...), nT; where a coordinate is NaN, NaN."""
        known = np.isfinite(latitude) & np.isfinite(longitude) & np.isfinite(height)
        place = (np.where(known, a, 0.0) for a in (latitude, longitude, height))
        return np.where(known, np.linalg.norm(self.vector(*place), axis=-1), np.nan)

    @property
    def note(self) -> str:
        """What a definition adds where the model is used outside the span it was made for."""
        return (
            ""
            if np.all(self.model.covers(self.date))
            else f" ({self.model.name} extrapolated in time)"
        )


def grid_places(grid: xr.Dataset) -> tuple[Real, Real, Real]:
    """WGS84 latitude and longitude (degrees) and ellipsoidal height (m) of a grid's nodes.

    Each (rows, columns). Raises ContractError where the height of the survey's reference
    surface is not known.
    """
    x, y = np.meshgrid(*axes(grid)[::-1])
    longitude, latitude = dataset_to_wgs84(grid).transform(x, y)
    height = np.broadcast_to(ellipsoidal_height(grid), x.shape)
    return np.asarray(latitude), np.asarray(longitude), height


def ellipsoidal_height(dataset: xr.Dataset) -> Real:
    """Height above the WGS84 ellipsoid, m, of a grid or track: scalar or of its shape.

    Raises ContractError where heights count from a surface that the dataset does not know.
    """
    height = np.asarray(dataset["height"].values, np.float64)
    reference = str(dataset.attrs["height_reference"])
    if reference == "ellipsoid":
        return height
    if "reference_surface_height" not in dataset:
        surface = reference.replace("_", " ")
        raise ContractError(
            f"heights count from {surface}, whose own height is not known",
            where=dataset.attrs.get("source"),
            expected="heights above the ellipsoid, or a reference_surface_height",
            remedy="a core field cannot be evaluated above an unknown surface"
            + (": set undulation_m in the source's TOML" if "sea" in reference else ""),
        )
    return height + np.asarray(dataset["reference_surface_height"].values, np.float64)


class RemoveCoreFieldParams(Params):
    """Parameters of remove-core-field, for grids and tracks."""

    reference_field: str = quantity(
        "1", default="IGRF-14", min_length=1, doc="Core field model to subtract."
    )
    allow_extrapolated: bool = quantity(
        "1", default=False, doc="Permit dates outside the span that the model is valid for."
    )


class RemoveFromGridParams(RemoveCoreFieldParams):
    """Parameters of remove-core-field for a grid."""

    reference_epoch: IsoDate | None = quantity(
        "1", default=None, doc="Date of the core field; default the grid's own reference_epoch."
    )


def remove_from_grid(
    grid: xr.Dataset, *, params: RemoveFromGridParams, model: Path | None = None
) -> xr.Dataset:
    """The total-field anomaly (nT, float64) of a grid of the total field itself.

    Such a grid is an anomaly-grid/1 whose `reference_field` is "none": nothing was removed.
    The core field is evaluated at every node and its height, at one date.

    Raises ContractError for a grid that has a reference field already, that is no total
    field, or whose heights count from an unknown surface.
    """
    removed = str(grid.attrs["reference_field"])
    if removed != NO_REFERENCE:
        raise ContractError(
            f"'{removed}' was already removed from this grid",
            where="reference_field",
            expected=f"'{NO_REFERENCE}': the total field itself",
            remedy="to change the reference field run re-reference",
        )
    epoch = params.reference_epoch or str(grid.attrs["reference_epoch"])
    used = named_model(params.reference_field, model, role="model")
    core = Core(used, epoch, params.allow_extrapolated)
    total = grid["magnetic_anomaly"]
    _check_total(total[:: max(1, len(total) // _ROWS_LOOKED_AT)])

    def anomaly(part: xr.Dataset) -> Real:
        return part["magnetic_anomaly"].values.astype(np.float64) - core.total(*grid_places(part))

    return with_anomaly(grid, each_node(grid, anomaly)).assign_attrs(
        reference_field=used.name,
        reference_epoch=epoch,
        anomaly_definition=TOTAL_FIELD_ANOMALY + core.note,
    )


def with_anomaly(grid: xr.Dataset, anomaly: Any) -> xr.Dataset:
    """The grid with other anomaly values (nT), in double precision."""
    return grid.assign(
        magnetic_anomaly=variable(grid, anomaly, "nT", "total-field magnetic anomaly")
    )


def each_node(grid: xr.Dataset, make: Callable[[xr.Dataset], Real]) -> Any:
    """Values (rows, columns) at the nodes of a grid, as `make` makes them for any of its rows."""
    return by_rows(
        grid["magnetic_anomaly"].shape,
        np.float64,
        lambda first, last: make(rows_of(grid, first, last)),
        _NODES_AT_ONCE,
    )


def remove_from_track(
    track: xr.Dataset, *, params: RemoveCoreFieldParams, model: Path | None = None
) -> xr.Dataset:
    """The total-field anomaly (time,) along a track, nT.

    The core field is that of each sample's own date, place and height; its magnitude is kept
    as `core_field_total`. Where the track has a `diurnal`, that comes off too; without, the
    variation of the day is still in the anomaly. NaN where a sample has no place, height or
    field, or none of the track's diurnal.

    Raises ContractError for a track without `field_total`, with heights above an unknown
    surface, or whose `diurnal` is a whole field.
    """
    if "field_total" not in track:
        raise ContractError(
            "'field_total' is missing",
            where=track.attrs.get("source"),
            expected="the measured total field, nT",
            remedy="calibrate the vector magnetometer first: its length is the total field",
        )
    _check_total(track["field_total"])
    used = named_model(params.reference_field, model, role="model")
    core = Core(used, track["time"].values, params.allow_extrapolated)
    place = track["latitude"].values, track["longitude"].values
    reference = core.total(*place, np.broadcast_to(ellipsoidal_height(track), place[0].shape))
    return total_anomaly(
        track.assign(
            core_field_total=("time", reference, {"units": "nT", "long_name": "core field"})
        ).assign_attrs(
            reference_field=used.name,
            anomaly_definition=f"{TOTAL_FIELD_ANOMALY} at each sample's date{core.note}",
        )
    )


def total_anomaly(track: xr.Dataset) -> xr.Dataset:
    """The track with `magnetic_anomaly` (time,), nT, of what it holds.

    That is field_total - core_field_total, and less `diurnal` where the track has one, which
    `anomaly_definition` then says. Raises ContractError for a `diurnal` that is a whole field.
    """
    anomaly = track["field_total"].values.astype(np.float64) - track["core_field_total"].values
    definition = str(track.attrs["anomaly_definition"])
    if "diurnal" in track:
        _check_variation(track["diurnal"])
        anomaly = anomaly - track["diurnal"].values
        definition = definition.removesuffix(_LESS_DIURNAL) + _LESS_DIURNAL
    attributes = {"units": "nT", "long_name": "total-field magnetic anomaly"}
    return track.assign(magnetic_anomaly=("time", anomaly, attributes)).assign_attrs(
        anomaly_definition=definition
    )


def _check_variation(diurnal: xr.DataArray) -> None:
    """Refuse a base station's whole field under the name of its variation."""
    middle = float(np.nanmedian(diurnal.values)) if np.isfinite(diurnal.values).any() else 0.0
    if abs(middle) >= _WEAKEST_NT:
        raise ContractError(
            f"its median is {middle:g} nT",
            where=diurnal.name,
            expected=f"a variation about a quiet level, less than {_WEAKEST_NT:g} nT",
            remedy="if it is a base station's total field, run subtract-diurnal on its record",
        )


def _check_total(total: xr.DataArray) -> None:
    """Refuse what is an anomaly, or no nanotesla, under the name of a total field."""
    middle = float(np.nanmedian(total.values)) if np.isfinite(total.values).any() else np.nan
    if not middle >= _WEAKEST_NT:
        raise ContractError(
            f"its median is {middle:g} nT",
            where=total.name,
            expected=f"the total field, more than {_WEAKEST_NT:g} nT anywhere on the Earth",
            remedy="if this is an anomaly already, say what reference_field was removed",
        )


GRID_STAGE = Stage(
    name="remove-core-field",
    version=1,
    params=RemoveFromGridParams,
    inputs={"grid": "anomaly-grid/1", "model": OPTIONAL_FILE},
    output="anomaly-grid/1",
    run=remove_from_grid,
)

TRACK_STAGE = Stage(
    name="remove-core-field",
    version=2,
    params=RemoveCoreFieldParams,
    inputs={"track": "track/1", "model": OPTIONAL_FILE},
    output="track-anomaly/1",
    run=remove_from_track,
)
