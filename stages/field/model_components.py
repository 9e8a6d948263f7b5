"""Total, vector and tensor of a field model's crust at one height: ``derive-components``.

Straight from the coefficients, with no Fourier step: exact at every node, and nothing is lost at
a border. The total is |core + crust| - |core|, as a magnetometer would measure it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.flags import QualityFlag
from magtiles.catalog.models import evaluate_grid, read_model
from magtiles.schemas.errors import ParameterError
from magtiles.stages.declare import FILES, OPTIONAL_FILE, IsoDate, Params, Stage, quantity
from magtiles.stages.field.direction import Ambient
from magtiles.stages.field.evaluate_model import Axis
from magtiles.stages.field.harmonic_nodes import Circle, crust_products
from magtiles.stages.field.level import assemble_level, wgs84_variable
from magtiles.stages.field.model_parts import ModelParts, split_model
from magtiles.stages.field.model_uncertainty import ModelError
from magtiles.stages.field.reuse import latest
from magtiles.stages.ingest.field_model import read_coefficients

Real = NDArray[np.float64]
Single = NDArray[np.float32]

LOWEST_LAND_M = -600.0
"""Below any dry land (the Dead Sea's shore, 430 m below a geoid up to 107 m below the
ellipsoid): lower levels are under water or rock, nearer the sources than a model's data."""

_AROUND_M = 2.0 * np.pi * 6_371_200.0


class ModelPartsParams(Params):
    """Which degrees of a model are core and which are crust, at which date."""

    reference_epoch: IsoDate = quantity("1", doc="Date of the core field.")
    core_degree: int = quantity("1", default=15, ge=1, doc="Highest degree of the core field.")
    crust_degree: int = quantity("1", default=16, ge=2, doc="Lowest degree of the anomaly.")
    highest_degree: int | None = quantity(
        "1", default=None, ge=2, doc="Highest degree of the anomaly; default the model's."
    )


class ModelComponentsParams(ModelPartsParams):
    """Parameters of derive-components for a model."""

    height_m: float = quantity("m", default=0.0, doc="Height above the ellipsoid.")
    latitude: Axis = quantity("degrees_north", doc="Nodes: first, spacing, count (WGS84).")
    longitude: Axis = quantity("degrees_east", doc="Nodes: first, spacing, count (WGS84).")
    uncertainty_nt: float | None = quantity(
        "nT", default=None, gt=0, doc="1 sigma of a component; default what the source states."
    )


def model_parts(
    files: Sequence[Path], core: Path | None, params: ModelPartsParams
) -> tuple[ModelParts, float | None]:
    """Core and crust of coefficient files, and the 1 sigma (nT) that their source TOML states.

    What was read last is kept for the next level.
    """
    paths = [*files, *([] if core is None else [core])]
    key = core, tuple((path, path.stat().st_size, path.stat().st_mtime_ns) for path in paths)
    (model, stated), own_core = latest(
        "field models",
        key,
        lambda: (read_coefficients(files), None if core is None else read_model(core)),
    )
    parts = split_model(
        model,
        own_core,
        epoch=params.reference_epoch,
        core_degree=params.core_degree,
        crust_degree=params.crust_degree,
        highest_degree=params.highest_degree,
    )
    return parts, stated


def shortest_wavelength_m(degree: int) -> float:
    """Wavelength along the ground of harmonics of a degree (Jeans: n + 1/2 waves around)."""
    return _AROUND_M / (degree + 0.5)


def derive_model_components(
    model: Sequence[Path], *, params: ModelComponentsParams, core: Path | None = None
) -> xr.Dataset:
    """Nine products of a model's crustal degrees on (latitude, longitude), `height_m` high.

    Contract component-grid/1: nT, nT/km, NED; with uncertainty (`ModelError`) and the direction
    of the core field. Levels below any land carry DOWNWARD_CONTINUED; no other flag applies:
    nothing is filled, has a border, or is inverted from one component.

    Raises ParameterError for degrees and epochs that `split_model` refuses, and where no
    uncertainty is stated; FormatError for bad coefficient files; QueryError for nodes that are
    no positions.
    """
    parts, stated = model_parts(model, core, params)
    sigma = params.uncertainty_nt or stated
    if sigma is None:
        raise ParameterError(
            f"the error of {parts.crust.name} is not stated",
            where="uncertainty_nt",
            expected="1 sigma of a field component at the ellipsoid, nT",
            remedy="give it: coefficients alone do not say how good they are",
        )
    latitude, longitude = (
        first + step * np.arange(count, dtype=np.float64)
        for first, step, count in (params.latitude, params.longitude)
    )
    crust = parts.crust_at(params.reference_epoch)
    products, ambient = _products(parts, crust, latitude, longitude, params)
    flags = np.full(products.shape[1:], _flag(params.height_m), np.uint8)
    error = ModelError(parts.crust, crust, sigma, parts.missing)
    return assemble_level(
        ("latitude", "longitude"),
        (latitude, longitude),
        products,
        error.sigmas(params.height_m, ambient.down),
        ambient,
        flags,
        height=xr.Variable((), params.height_m, {"units": "m", "positive": "up"}),
        crs=wgs84_variable(),
        attributes={
            "reference_field": parts.reference_field,
            "reference_epoch": params.reference_epoch,
            "anomaly_definition": parts.definition,
            "height_reference": "ellipsoid",
            "source": parts.crust.name,
        },
    )


def _flag(height_m: float) -> int:
    return int(QualityFlag.DOWNWARD_CONTINUED) if height_m < LOWEST_LAND_M else 0


def _products(
    parts: ModelParts,
    crust: Real,
    latitude: Real,
    longitude: Real,
    params: ModelComponentsParams,
) -> tuple[Single, Ambient]:
    """The nine products (9, m, n), and the core field's direction."""

    def along(latitudes: Real, longitudes: Real, vector: Real) -> tuple[Real, Real]:
        place = latitudes, longitudes, [params.height_m]
        core = evaluate_grid(parts.core, *place, params.reference_epoch)[0]
        strength = np.linalg.norm(core, axis=-1)
        return _total(core, strength, vector), core / strength[..., None]

    static = replace(
        parts.crust,
        epochs=np.zeros(1),
        coefficients=crust[None],
        secular_variation=None,
        valid=(-np.inf, np.inf),
    )
    circle = Circle.of(longitude, params.longitude[1])
    return crust_products(static, latitude, circle, params.height_m, along)


def _total(core: Real, strength: Real, crust: Real) -> Real:
    """|core + crust| - |core| of vectors (..., 3), without the cancellation."""
    both = np.linalg.norm(core + crust, axis=-1)
    total: Real = np.einsum("...i,...i->...", crust, 2.0 * core + crust) / (both + strength)
    return total


STAGE = Stage(
    name="derive-components",
    version=1,
    params=ModelComponentsParams,
    inputs={"model": FILES, "core": OPTIONAL_FILE},
    output="component-grid/1",
    run=derive_model_components,
)
