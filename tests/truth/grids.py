"""Anomaly grids made in memory: what ingest would give of a survey."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyproj
import xarray as xr
from known import Field, Floats

from magtiles.pipeline.sample import Sample
from magtiles.stages.field.level import PRODUCTS


def grid_of(
    sample: Sample, values: Floats | None = None, *, sigma: float | None = None, **attributes: Any
) -> xr.Dataset:
    """The grid of a synthetic survey, with other values (nT) and another sigma (nT) if given."""
    spec = sample.spec
    return projected_grid(
        sample.anomaly if values is None else values,
        sample.y,
        sample.x,
        spec.crs,
        height=spec.height_m,
        sigma=spec.uncertainty_nt if sigma is None else sigma,
        reference_field="IGRF-14",
        reference_epoch=spec.epoch,
        **attributes,
    )


def projected_grid(
    values: Floats,
    y: Floats,
    x: Floats,
    crs: Any = "EPSG:32610",
    *,
    height: float = 0.0,
    sigma: float = 1.0,
    **attributes: Any,
) -> xr.Dataset:
    """An anomaly-grid/1 (y, x), metres and nT."""
    axes = {"y": (y, "m"), "x": (x, "m")}
    return _grid(values, axes, pyproj.CRS.from_user_input(crs), height, sigma, attributes)


def geographic_grid(
    values: Floats, latitude: Floats, longitude: Floats, **attributes: Any
) -> xr.Dataset:
    """An anomaly-grid/1 (latitude, longitude), WGS84 degrees and nT."""
    axes = {"latitude": (latitude, "degrees_north"), "longitude": (longitude, "degrees_east")}
    return _grid(values, axes, pyproj.CRS(4326), 0.0, 1.0, attributes)


def _grid(
    values: Floats,
    axes: dict[str, tuple[Floats, str]],
    crs: pyproj.CRS,
    height: float,
    sigma: float,
    attributes: dict[str, Any],
) -> xr.Dataset:
    variables: dict[str, Any] = {
        "magnetic_anomaly": (tuple(axes), values, {"units": "nT", "grid_mapping": "crs"}),
        "magnetic_anomaly_uncertainty": ((), sigma, {"units": "nT"}),
        "height": ((), height, {"units": "m"}),
        "crs": ((), np.int32(0), crs.to_cf()),
    }
    stated = {
        "reference_field": "IGRF-14",
        "reference_epoch": "1990-01-01",
        "anomaly_definition": "total field minus reference field",
        "height_reference": "ellipsoid",
        "source": "test",
    }
    coordinates = {name: (name, a, {"units": unit}) for name, (a, unit) in axes.items()}
    return xr.Dataset(variables, coordinates, stated | attributes)


def products(components: xr.Dataset) -> Field:
    """The nine products of a component grid, float64."""
    total, *rest = (components[name].values.astype(float) for name in PRODUCTS)
    return Field(total, np.stack(rest[:3], axis=-1), np.stack(rest[3:], axis=-1))
