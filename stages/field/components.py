"""Total, vector and tensor of a magnetic anomaly at one height, in true north, east, down."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.flags import QualityFlag
from magtiles.schemas.errors import ContractError, CoverageError, ParameterError
from magtiles.stages.declare import Params, Stage, quantity
from magtiles.stages.field.direction import Ambient, AmbientSource
from magtiles.stages.field.interpolate import evaluate_linear, evaluate_spline
from magtiles.stages.field.level import PRODUCTS, assemble_level, wgs84_variable
from magtiles.stages.field.padding import plan_padding
from magtiles.stages.field.prepare import PlaneMap, prepare
from magtiles.stages.field.reuse import content_key, latest
from magtiles.stages.field.rotation import rotate_to_ned
from magtiles.stages.field.solve import AnomalousField, solve
from magtiles.stages.field.spectral import (
    LOW_INCLINATION_SINE,
    TENSOR,
    VECTOR,
)
from magtiles.stages.field.surface import surface_at
from magtiles.stages.field.target import Axis, Nodes, Target, geographic_target, locate, own_target
from magtiles.stages.field.uncertainty import budget, survey_variance

Single = NDArray[np.float32]

_OVERSAMPLING = 2
_DROPPED = ("datum_pipeline", "datum_operation", "datum_accuracy_m", "allow_ballpark_datum")


class DeriveComponentsParams(Params):
    """Parameters of derive-components."""

    height_m: float = quantity("m", default=0.0, doc="Height gain above the input surface.")
    allow_downward_continuation: bool = quantity(
        "1", default=False, doc="Permit a negative height gain, which amplifies noise."
    )
    inclination_deg: float | None = quantity(
        "degree",
        default=None,
        ge=-90,
        le=90,
        doc="Ambient inclination; default the reference field's at its epoch.",
    )
    declination_deg: float | None = quantity(
        "degree", default=None, ge=-180, le=180, doc="Ambient declination, with inclination_deg."
    )
    latitude: Axis | None = quantity(
        "degrees_north",
        default=None,
        doc="Output nodes: first, spacing, count (WGS84); default the input's own nodes.",
    )
    longitude: Axis | None = quantity(
        "degrees_east", default=None, doc="Output nodes, with latitude: first, spacing, count."
    )


def derive_components(grid: xr.Dataset, *, params: DeriveComponentsParams) -> xr.Dataset:
    """Nine products of a filled anomaly grid, `height_m` higher, with uncertainty and flags.

    Fourier transform on a near-true-scale plane: continuation upward, vector (Mount 2018,
    eq. 90-98) and tensor, resampled by zero-padding the spectrum twofold, splined to the
    output nodes and turned from grid to true north. The mean of the map, which carries
    no vector information, is given the vector that sources without strike would have.

    Input anomaly-grid/1 (rows, columns) without voids; output component-grid/1 on
    its own nodes or on (latitude, longitude): nT, nT/km, NED.
    Raises ContractError for voids, CoverageError for a level below the survey without
    permission, ParameterError when only one of two angles or axes is given.
    """
    _permit(grid, params)
    key = content_key(grid)
    plane_map = latest("plane map", key, lambda: prepare(grid))
    ambient = AmbientSource(grid, params.inclination_deg, params.declination_deg)
    angles = params.inclination_deg, params.declination_deg
    padding = plan_padding(plane_map.values.shape, plane_map.spacing, params.height_m)
    field = latest("field", (key, angles, padding), lambda: solve(plane_map, ambient, padding))
    if params.latitude is not None and params.longitude is not None:
        target = geographic_target(params.latitude, params.longitude)
    else:
        target = own_target(grid, plane_map)
    axes = params.latitude, params.longitude
    nodes = latest("nodes", (key, angles, axes), lambda: locate(target, plane_map, ambient))
    products = evaluate_products(field, nodes, params.height_m)
    survey = survey_variance(plane_map, nodes.row, nodes.column)
    sigmas = budget(grid, plane_map, field, params.height_m).sigma(survey, nodes.row, nodes.column)
    flags = quality_flags(plane_map, nodes, params.height_m)
    return _assemble(grid, target, nodes, params.height_m, products, sigmas, flags)


def evaluate_products(field: AnomalousField, nodes: Nodes, height_gain: float) -> Single:
    """The nine products (9, m, n) in NED at the nodes, in the order of `PRODUCTS`."""
    out = np.empty((len(PRODUCTS), *nodes.row.shape), np.float32)
    w, offset = field.wavenumbers, field.padding.offset
    first = int((nodes.row.min() + offset[0]) * _OVERSAMPLING) - 2
    last = int((nodes.row.max() + offset[0]) * _OVERSAMPLING) + 4
    rows = slice(max(first, 0), max(min(last, w.shape[0] * _OVERSAMPLING), 8))
    shift = np.array([offset[0] * _OVERSAMPLING - rows.start, offset[1] * _OVERSAMPLING], float)
    level = field.level(height_gain, _OVERSAMPLING)
    for product, values in zip(("total", *VECTOR, *TENSOR), out, strict=True):
        coefficients = level.values(product, rows, slice(None))
        evaluate_spline(coefficients, nodes.row, nodes.column, float(_OVERSAMPLING), shift, values)
    rotate_to_ned(out, nodes.north, nodes.ambient, np.array(field.inversion.direction))
    return out


def quality_flags(plane_map: PlaneMap, nodes: Nodes, height_gain: float) -> NDArray[np.uint8]:
    """Flags (m, n): gaps grown by the height gained, at least by the cell that reaches them."""
    cell = max(plane_map.spacing) * (1 - 1e-6)
    reach = max(abs(height_gain), cell)
    flags = np.zeros(nodes.row.shape, np.uint8)
    near = np.empty(nodes.row.shape, np.float32)
    if plane_map.void.any():
        distance = plane_map.distance(plane_map.void, outside=False)
        evaluate_linear(distance, nodes.row, nodes.column, 1.0, 0.0, near)
        flags[near < reach] |= np.uint8(QualityFlag.VOID_FILLED)
    distance = plane_map.distance(plane_map.beyond, outside=True)
    evaluate_linear(np.pad(distance, 1), nodes.row, nodes.column, 1.0, 1.0, near)
    flags[near < reach] |= np.uint8(QualityFlag.BEYOND_COVERAGE)
    if height_gain < 0:
        flags |= np.uint8(QualityFlag.DOWNWARD_CONTINUED)
    flags[np.abs(nodes.ambient[2]) < LOW_INCLINATION_SINE] |= np.uint8(
        QualityFlag.REDUCED_ACCURACY_DIRECTION
    )
    return flags


def _permit(grid: xr.Dataset, params: DeriveComponentsParams) -> None:
    if params.height_m < 0 and not params.allow_downward_continuation:
        raise CoverageError(
            f"a level {-params.height_m:g} m below the survey",
            where=grid.attrs.get("source"),
            expected="levels at or above the survey surface",
            remedy="raise it, or set allow_downward_continuation = true (flagged, noisier)",
        )
    if (params.latitude is None) != (params.longitude is None):
        raise ParameterError(
            "output nodes are given along one axis only", expected="both latitude and longitude"
        )
    if grid["height"].ndim:
        raise ContractError(
            "the survey's height differs from node to node",
            where="height",
            expected="one height above height_reference",
            remedy="state a drape's height above terrain",
        )


def _assemble(
    grid: xr.Dataset,
    target: Target,
    nodes: Nodes,
    height_gain: float,
    products: Single,
    sigmas: dict[str, NDArray[np.float64]],
    flags: NDArray[np.uint8],
) -> xr.Dataset:
    planar = target.dims[0] == "y"
    height = grid["height"]
    level = assemble_level(
        target.dims,
        (target.rows, target.columns),
        products,
        sigmas,
        Ambient(*nodes.ambient),
        flags,
        height=xr.Variable((), float(height) + height_gain, height.attrs),
        crs=grid["crs"].variable if planar else wgs84_variable(),
        attributes={k: v for k, v in grid.attrs.items() if k not in _DROPPED or planar},
    )
    if (surface := surface_at(grid, target)) is not None:
        level["reference_surface_height"] = surface
    return level


STAGE = Stage(
    name="derive-components",
    version=1,
    params=DeriveComponentsParams,
    inputs={"grid": "anomaly-grid/1"},
    output="component-grid/1",
    run=derive_components,
)
