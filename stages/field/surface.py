"""Stage ``sample-surface``: ellipsoidal height of terrain or geoid at the nodes of a lattice."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.flags import QualityFlag
from magtiles.schemas.errors import ContractError, CoverageError
from magtiles.stages.declare import OptionalInput, Params, Stage, quantity
from magtiles.stages.field.geometry import axes
from magtiles.stages.field.level import wgs84_variable
from magtiles.stages.field.sample import Sampled, nearest_known, node_index, sample
from magtiles.stages.field.target import Axis, Target, geographic_target

Real = NDArray[np.float64]
Mask = NDArray[np.bool_]


class SampleSurfaceParams(Params):
    """Parameters of sample-surface."""

    latitude: Axis = quantity("degrees_north", doc="Nodes: first, spacing, count (WGS84).")
    longitude: Axis = quantity("degrees_east", doc="Nodes: first, spacing, count.")


def sample_surface(
    grid: xr.Dataset,
    surface: xr.Dataset,
    *,
    params: SampleSurfaceParams,
    geoid: xr.Dataset | None = None,
) -> xr.Dataset:
    """What the heights of a survey count from, metres above the ellipsoid, at a lattice's nodes.

    Bilinear between the nodes of `surface`; where those are denser than the lattice, of their
    mean over a cell of the lattice, so that relief too fine for the lattice does not alias into
    it. Heights above sea level are raised by the `geoid`, sampled alike. Nodes that `grid` (the
    survey, filled) does not cover need no surface: they get the nearest one's.

    Inputs anomaly-grid/1 and surface-grid/1; output surface-grid/1 (latitude, longitude), every
    node finite. Raises ContractError for a surface that is not the survey's, or a geoid that is
    missing or not needed; CoverageError, naming where, for surfaces that do not cover the survey.
    """
    _check_kinds(grid, surface, geoid)
    nodes = geographic_target(params.latitude, params.longitude)
    needed = _covered(grid, nodes.rows, nodes.columns)
    height = _whole(surface, nodes.rows, nodes.columns, needed)
    if geoid is not None:
        height = height + _whole(geoid, nodes.rows, nodes.columns, needed)
    attributes = {"units": "m", "positive": "up", "grid_mapping": "crs"}
    return xr.Dataset(
        {
            "surface_height": (nodes.dims, height, attributes),
            "crs": wgs84_variable(),
        },
        coords={
            nodes.dims[0]: (nodes.dims[0], nodes.rows, {"units": "degrees_north"}),
            nodes.dims[1]: (nodes.dims[1], nodes.columns, {"units": "degrees_east"}),
        },
        attrs={
            "Conventions": "CF-1.11",
            "surface": surface.attrs["surface"],
            "height_reference": "ellipsoid",
            "source": " + ".join(str(d.attrs["source"]) for d in (surface, geoid) if d is not None),
        },
    )


def surface_at(grid: xr.Dataset, target: Target) -> xr.Variable | None:
    """`reference_surface_height` of a grid at a target's nodes; none where it has none."""
    if "reference_surface_height" not in grid:
        return None
    own = grid["reference_surface_height"]
    nodes = zip((target.rows, target.columns), axes(grid), strict=True)
    if not own.ndim or (own.dims == target.dims and all(np.array_equal(*pair) for pair in nodes)):
        return own.variable
    found = sample(own, grid, target.rows, target.columns)
    return xr.Variable(target.dims, nearest_known(found), own.attrs)


def _check_kinds(grid: xr.Dataset, surface: xr.Dataset, geoid: xr.Dataset | None) -> None:
    counts_from, given = grid.attrs["height_reference"], surface.attrs["surface"]
    if counts_from != given:
        raise ContractError(
            f"is a surface of {given}",
            where=f"surface {surface.attrs['source']}",
            expected=f"{counts_from}, which the survey's heights count from",
        )
    above_sea = surface.attrs["height_reference"] == "mean_sea_level"
    if above_sea and geoid is None:
        raise ContractError(
            "its heights are above mean sea level",
            where=f"surface {surface.attrs['source']}",
            expected="heights above the ellipsoid, or a geoid",
            remedy="give a geoid, or set undulation_m in the surface's TOML",
        )
    if geoid is not None and not above_sea:
        raise ContractError(
            "a geoid is given, but the surface is above the ellipsoid already",
            where=f"surface {surface.attrs['source']}",
            remedy="leave the geoid out",
        )
    if geoid is not None and geoid.attrs["surface"] != "mean_sea_level":
        raise ContractError(
            f"is a surface of {geoid.attrs['surface']}",
            where=f"geoid {geoid.attrs['source']}",
            expected="the heights of mean_sea_level",
        )


def _covered(grid: xr.Dataset, latitude: Real, longitude: Real) -> Mask:
    """Which nodes (m, n) lie where a survey has data, or gaps inside its outline."""
    values = grid["magnetic_anomaly"]
    covered = np.isfinite(values.values)
    if "quality_flag" in grid:
        covered &= (grid["quality_flag"].values & QualityFlag.BEYOND_COVERAGE) == 0
    row, column = node_index(values, grid, latitude, longitude)
    (rows, columns), inside = covered.shape, np.ones(row.shape, dtype=bool)
    for index, size in ((row, rows), (column, columns)):
        inside &= (index >= 0) & (index <= size - 1)
    r = np.clip(np.rint(row), 0, rows - 1).astype(int)
    c = np.clip(np.rint(column), 0, columns - 1).astype(int)
    return np.asarray(covered[r, c] & inside)


def _whole(surface: xr.Dataset, latitude: Real, longitude: Real, needed: Mask) -> Real:
    """A surface's heights at every node, those that are not needed filled if they must."""
    found: Sampled = sample(surface["surface_height"], surface, latitude, longitude)
    missing = needed & ~found.known
    if missing.any() or not found.known.any():
        raise CoverageError(
            f"has no height at {np.count_nonzero(missing)} of the {np.count_nonzero(needed)} "
            f"nodes that the survey covers: {_bounds(missing, latitude, longitude)}",
            where=f"surface {surface.attrs['source']}",
            expected=f"heights over {_bounds(needed, latitude, longitude)}: the release and 12 "
            "cells around it, as far as the survey reaches",
            remedy="give a surface that covers them without voids, or choose a smaller region",
        )
    return nearest_known(found)


def _bounds(chosen: Mask, latitude: Real, longitude: Real) -> str:
    if not chosen.any():
        return "nowhere"
    lat, lon = latitude[chosen.any(axis=1)], longitude[chosen.any(axis=0)]
    return (
        f"latitude {lat[0]:.5g} to {lat[-1]:.5g}, longitude {_wrapped(lon[0])} "
        f"to {_wrapped(lon[-1])}"
    )


def _wrapped(longitude: float) -> str:
    return f"{(longitude + 180.0) % 360.0 - 180.0:.6g}"


STAGE = Stage(
    name="sample-surface",
    version=1,
    params=SampleSurfaceParams,
    inputs={
        "grid": "anomaly-grid/1",
        "surface": "surface-grid/1",
        "geoid": OptionalInput("surface-grid/1"),
    },
    output="surface-grid/1",
    run=sample_surface,
)
