"""One level of a map as a component grid, whatever it was made from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.flags import flag_attributes
from magtiles.stages.crs import WGS84
from magtiles.stages.field.direction import Ambient

Single = NDArray[np.float32]

PRODUCTS = (
    "magnetic_anomaly", "anomaly_north", "anomaly_east", "anomaly_down",
    "gradient_nn", "gradient_ne", "gradient_nd", "gradient_ee", "gradient_ed",
)  # fmt: skip
OF_DATUM = ("datum_pipeline", "datum_operation", "datum_accuracy_m", "allow_ballpark_datum")
"""Attributes of a survey's own CRS that do not hold for a level in WGS84."""

SIGMAS = {
    "magnetic_anomaly_uncertainty": "total",
    "vector_uncertainty": "vector",
    "tensor_uncertainty": "tensor",
}


def assemble_level(
    dims: tuple[str, str],
    axes: tuple[NDArray[np.float64], NDArray[np.float64]],
    products: Single,
    sigmas: Mapping[str, NDArray[np.floating]],
    ambient: Ambient,
    flags: NDArray[np.uint8],
    *,
    height: xr.Variable,
    crs: xr.Variable,
    attributes: Mapping[str, Any],
) -> xr.Dataset:
    """A dataset of contract component-grid/1.

    `products` (9, m, n) in the order of `PRODUCTS`; `sigmas` by "total", "vector" and "tensor",
    `flags` and the parts of `ambient` (m, n); nT, nT/km, NED.
    """

    def field(values: NDArray[Any], units: str) -> tuple[Any, ...]:
        return dims, values.astype(np.float32, copy=False), {"units": units, "grid_mapping": "crs"}

    variables: dict[str, Any] = {
        name: field(values, "nT km-1" if name.startswith("gradient") else "nT")
        for name, values in zip(PRODUCTS, products, strict=True)
    }
    for name, group in SIGMAS.items():
        variables[name] = field(_rounded(sigmas[group]), "nT km-1" if group == "tensor" else "nT")
    for axis, values in zip(("north", "east", "down"), ambient, strict=True):
        variables[f"ambient_{axis}"] = field(values, "1")
    variables["quality_flag"] = (dims, flags, flag_attributes() | {"grid_mapping": "crs"})
    variables["height"] = height
    variables["crs"] = crs
    units = ("m", "m") if dims[0] == "y" else ("degrees_north", "degrees_east")
    coordinates = {
        name: ((name,), values, {"units": unit})
        for name, values, unit in zip(dims, axes, units, strict=True)
    }
    angles = mean_angles(*(float(part.mean(dtype=float)) for part in ambient))
    return xr.Dataset(variables, coords=coordinates, attrs={**attributes, **angles})


def mean_angles(north: float, east: float, down: float) -> dict[str, float]:
    """Attributes that say which way the mean ambient vector of a level points."""
    middle = Ambient(*(np.asarray(part) for part in (north, east, down)))
    return {
        "ambient_inclination_deg": float(middle.inclination_deg),
        "ambient_declination_deg": float(middle.declination_deg),
    }


def wgs84_variable() -> xr.Variable:
    """The grid mapping of nodes in WGS84 degrees."""
    return xr.Variable((), np.int32(0), WGS84.to_cf())


def _rounded(sigma: NDArray[np.floating]) -> Single:
    """Sigma to three digits (eleven bits): more would say nothing, and not compress."""
    bits = sigma.astype(np.float32).view(np.uint32)
    return ((bits + np.uint32(1 << 12)) & np.uint32(0xFFFFE000)).view(np.float32)
