"""Total, vector and tensor of a magnetic anomaly at one height, in true north, east, down."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.schemas.errors import ContractError, CoverageError, ParameterError
from magtiles.stages.declare import Params, Stage, quantity
from magtiles.stages.field.at_nodes import evaluate_products, quality_flags
from magtiles.stages.field.blocks import Block
from magtiles.stages.field.direction import DECLINATION_DEG, INCLINATION_DEG, Ambient, AmbientSource
from magtiles.stages.field.laid import lay_on_plane
from magtiles.stages.field.large import LargeMap, is_large, strips
from magtiles.stages.field.level import OF_DATUM, assemble_level, mean_angles, wgs84_variable
from magtiles.stages.field.padding import plan_padding
from magtiles.stages.field.prepare import prepare
from magtiles.stages.field.reuse import content_key, latest
from magtiles.stages.field.solve import solve
from magtiles.stages.field.surface import surface_at
from magtiles.stages.field.target import Axis, Nodes, Target, geographic_target, locate, own_target
from magtiles.stages.field.uncertainty import budget, survey_variance
from magtiles.stages.field.windows import MapWindows

Single = NDArray[np.float32]


class DeriveComponentsParams(Params):
    """Parameters of derive-components."""

    height_m: float = quantity("m", default=0.0, doc="Height gain above the input surface.")
    allow_downward_continuation: bool = quantity(
        "1", default=False, doc="Permit a negative height gain, which amplifies noise."
    )
    inclination_deg: float | None = INCLINATION_DEG
    declination_deg: float | None = DECLINATION_DEG
    latitude: Axis | None = quantity(
        "degrees_north",
        default=None,
        doc="Output nodes: first, spacing, count (WGS84); default the input's own nodes.",
    )
    longitude: Axis | None = quantity(
        "degrees_east", default=None, doc="Output nodes, with latitude: first, spacing, count."
    )
    block_nodes: int | None = quantity(
        "1",
        default=None,
        ge=128,
        doc="Transform in blocks of so many nodes a side; default blocks of 2560 where the grid "
        "has more than 3072 x 3072 nodes, or the output twice that.",
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
    if makes_blocks(grid, params):
        return _blended(grid, params)
    key = content_key(grid)
    plane_map = latest("plane map", key, lambda: prepare(grid))
    ambient = AmbientSource(grid, params.inclination_deg, params.declination_deg)
    angles = params.inclination_deg, params.declination_deg
    padding = plan_padding(plane_map.values.shape, plane_map.spacing, params.height_m)
    field = latest("field", (key, angles, padding), lambda: solve(plane_map, ambient, padding))
    if params.latitude is not None and params.longitude is not None:
        target = geographic_target(params.latitude, params.longitude)
    else:
        target = own_target(grid, plane_map.plane)
    axes = params.latitude, params.longitude
    nodes = latest("nodes", (key, angles, axes), lambda: locate(target, plane_map, ambient))
    products = evaluate_products(field, nodes, params.height_m)
    flags = quality_flags(plane_map, nodes, params.height_m)
    survey = survey_variance(plane_map, nodes.row, nodes.column)
    sigmas = budget(grid, plane_map, field, params.height_m).sigma(survey, nodes.row, nodes.column)
    return _assemble(grid, target, nodes, params.height_m, products, sigmas, flags)


def makes_blocks(grid: xr.Dataset, params: DeriveComponentsParams) -> bool:
    """Whether a level is made block by block."""
    if params.block_nodes is not None:
        return True
    shape = grid["magnetic_anomaly"].shape
    target = [
        axis[2] if axis is not None else n
        for axis, n in zip((params.latitude, params.longitude), shape, strict=True)
    ]
    return is_large((shape[0], shape[1]), (target[0], target[1]))


def large_map(
    grid: xr.Dataset,
    params: DeriveComponentsParams,
    known: tuple[float, float] | None = None,
    laid: xr.Dataset | None = None,
) -> LargeMap:
    """A grid in blocks; where mean and sigma of the map are `known`, it is not read for them.

    `laid` is the map on its plane (`lay_on_plane`), unless it lies on that by itself. The height
    of `params` is only checked. Raises as `derive_components`.
    """
    _permit(grid, params)
    windows = MapWindows.of(grid, known, laid)
    ambient = AmbientSource(grid, params.inclination_deg, params.declination_deg)
    if params.latitude is not None and params.longitude is not None:
        target = geographic_target(params.latitude, params.longitude)
    else:
        target = own_target(grid, windows.plane)
    return LargeMap.plan(windows, ambient, target, params.block_nodes)


def block_maker(large: LargeMap, block: Block) -> Callable[[float, xr.Dataset], xr.Dataset]:
    """What makes a block of a level, overlaps included: component-grid/1 on its nodes.

    From the level's height gain (m) and what `LargeMap.survey` found for it.
    """
    grid = large.windows.grid
    target, nodes, part = large.part(block)

    def make(height_gain: float, whole: xr.Dataset) -> xr.Dataset:
        found = part.solve(height_gain, whole)
        parts = found.products, found.sigmas, found.flags
        return _assemble(grid, target, nodes, height_gain, *parts)

    return make


def _blended(grid: xr.Dataset, params: DeriveComponentsParams) -> xr.Dataset:
    """A level of blocks, in memory."""
    large = large_map(grid, params)
    if not large.windows.plane.is_source:
        laid = xr.concat(lay_on_plane(large.windows), "y", data_vars="minimal")
        large = large_map(grid, params, laid=laid)
    level = params.height_m, large.survey(params.height_m)
    blocks = itertools.chain.from_iterable(large.blocks)
    made = {block: block_maker(large, block)(*level) for block in blocks}
    first = made[large.blocks[0][0]]
    dims, axes = large.target.dims, (large.target.rows, large.target.columns)
    coordinates = {
        name: (name, axis, first[name].attrs) for name, axis in zip(dims, axes, strict=True)
    }
    out = xr.Dataset(coords=coordinates, attrs=first.attrs)
    for name, variable in first.data_vars.items():
        if variable.ndim:
            values = {block: part[name].values for block, part in made.items()}
            whole = strips(large.blocks, str(name), lambda b, *part, of=values: of[b][part])
            out[name] = dims, np.concatenate([strip for _, strip in whole]), variable.attrs
        else:
            out[name] = variable
    means = (float(out[f"ambient_{axis}"].mean(dtype=float)) for axis in ("north", "east", "down"))
    return out.assign_attrs(mean_angles(*means))


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
    sigmas: dict[str, Single],
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
        attributes={k: v for k, v in grid.attrs.items() if k not in OF_DATUM or planar},
    )
    if (surface := surface_at(grid, target)) is not None:
        level["reference_surface_height"] = surface
    return level


STAGE = Stage(
    name="derive-components",
    version=2,
    params=DeriveComponentsParams,
    inputs={"grid": "anomaly-grid/1"},
    output="component-grid/1",
    run=derive_components,
)
