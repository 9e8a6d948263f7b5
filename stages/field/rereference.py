"""Counting an anomaly from another core field model, or the same at another date."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.schemas.errors import ContractError
from magtiles.stages.declare import OPTIONAL_FILE, IsoDate, Params, Stage, quantity
from magtiles.stages.field.core_field import (
    NO_REFERENCE,
    Core,
    each_node,
    grid_places,
    with_anomaly,
)
from magtiles.stages.ingest.field_model import named_model

MIXED = "mixed"


class ReReferenceParams(Params):
    """Parameters of re-reference."""

    reference_field: str = quantity(
        "1", default="IGRF-14", min_length=1, doc="Core field model to count from."
    )
    reference_epoch: IsoDate | None = quantity(
        "1", default=None, doc="Its date; default the grid's own reference_epoch."
    )
    allow_extrapolated: bool = quantity(
        "1", default=False, doc="Permit dates outside the span that a model is valid for."
    )


def re_reference(
    grid: xr.Dataset,
    *,
    params: ReReferenceParams,
    old_model: Path | None = None,
    new_model: Path | None = None,
) -> xr.Dataset:
    """The anomaly (nT, float64) that the same survey has under another reference field.

    anomaly + |F_old| - |F_new|, each model at its own epoch and at every node's height: the
    total field that was measured stays as it was. To bring a map to another date than the
    survey's, use carry-forward: the core field's own change is no anomaly.

    Raises ContractError for a grid of mixed reference fields, whose parts no one difference
    serves, for one with none, and for heights above an unknown surface.
    """
    old_name, old_epoch = str(grid.attrs["reference_field"]), str(grid.attrs["reference_epoch"])
    _refuse(old_name)
    epoch = params.reference_epoch or old_epoch
    old = Core(
        named_model(old_name, old_model, role="old_model"), old_epoch, params.allow_extrapolated
    )
    new = Core(
        named_model(params.reference_field, new_model, role="new_model"),
        epoch,
        params.allow_extrapolated,
    )

    def anomaly(part: xr.Dataset) -> NDArray[np.float64]:
        places = grid_places(part)
        difference = old.total(*places) - new.total(*places)
        return part["magnetic_anomaly"].values.astype(np.float64) + difference

    definition = _renamed(str(grid.attrs["anomaly_definition"]), old_name, new.model.name)
    definition = definition.replace(old_epoch, epoch)
    return with_anomaly(grid, each_node(grid, anomaly)).assign_attrs(
        reference_field=new.model.name,
        reference_epoch=epoch,
        anomaly_definition=definition + new.note,
    )


def _refuse(reference_field: str) -> None:
    if reference_field.lower() == MIXED:
        raise ContractError(
            "the grid is made of surveys with different reference fields",
            where="reference_field 'mixed'",
            expected="one reference field",
            remedy="re-reference each survey before they are merged",
        )
    if reference_field == NO_REFERENCE:
        raise ContractError(
            "no reference field was removed from this grid",
            where="reference_field 'none'",
            remedy="run remove-core-field",
        )


def _renamed(definition: str, old: str, new: str) -> str:
    """The definition with the old model's name, however it is spelt, replaced."""
    letters = [re.escape(c) for c in old if c not in "- "]
    return re.sub(r"[- ]?".join(letters) + r"(?!\d)", new, definition, flags=re.IGNORECASE)


STAGE = Stage(
    name="re-reference",
    version=1,
    params=ReReferenceParams,
    inputs={"grid": "anomaly-grid/1", "old_model": OPTIONAL_FILE, "new_model": OPTIONAL_FILE},
    output="anomaly-grid/1",
    run=re_reference,
)
