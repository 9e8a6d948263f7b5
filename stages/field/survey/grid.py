"""A small area's point survey as a grid: ``grid-survey`` (Cuenca 2020, section 3.1)."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from magtiles.schemas.errors import ContractError, CoverageError, ParameterError
from magtiles.stages.declare import Many, Params, Stage, quantity
from magtiles.stages.field.survey.polynomial import fit_polynomial, goodness_attributes
from magtiles.stages.field.survey.samples import (
    FIELD_TOTAL,
    Blocks,
    Places,
    Real,
    block_means,
    collect,
)
from magtiles.stages.field.survey.spread import node_sigma
from magtiles.stages.field.survey.surface import fit_scatter, rms

_LOG = logging.getLogger(__name__)

_MOST_NODES = 4096**2
_WHOLE = 1e-9


class GridSurveyParams(Params):
    """Parameters of grid-survey."""

    method: Literal["spline", "linear", "cubic", "polynomial"] = quantity(
        "1", default="spline", doc="Surface: through the blocks' means, or a polynomial."
    )
    spacing_m: float = quantity(
        "m",
        default=1.0,
        gt=0,
        doc="Width of the blocks that samples are averaged in, and of cells.",
    )
    refine_to_m: float | None = quantity(
        "m", default=None, gt=0, doc="Node spacing of the result; default spacing_m."
    )
    max_distance_m: float | None = quantity(
        "m", default=None, gt=0, doc="Nodes farther from data are NaN; default two spacings."
    )
    height_tolerance_m: float = quantity(
        "m", default=1.0, ge=0, doc="How far heights may be from their median."
    )
    noise_nt: float | None = quantity(
        "nT", default=None, gt=0, doc="1 sigma of a sample; method 'polynomial' needs it."
    )
    max_degree: int = quantity(
        "1", default=5, ge=1, le=8, doc="Highest degree of a polynomial that is tried."
    )


def grid_survey(track: Sequence[xr.Dataset], *, params: GridSurveyParams) -> xr.Dataset:
    """The total-field anomaly of point surveys on a grid (y, x), nT, with one sigma, nT.

    Axes are metres in the UTM zone of the survey's middle, nodes at whole multiples of their
    spacing. Samples are averaged in blocks about the nodes of `spacing_m`; the surface through
    the means is evaluated at every node of `refine_to_m`. NaN farther than `max_distance_m`
    from any sample, and outside the triangles of samples where the method is linear or cubic.

    Raises ContractError for tracks that cannot be mixed or heights that differ too much,
    CoverageError for samples that are too few, too many or on one line, ParameterError for a
    spacing that is no whole part of the other, or noise that is not stated.
    """
    return _grid(track, "magnetic_anomaly", params)


def grid_total(total: Sequence[xr.Dataset], *, params: GridSurveyParams) -> xr.Dataset:
    """The total field itself of point surveys, less `diurnal` where the tracks have one.

    As `grid_survey`; the grid's reference field is "none", for remove-core-field.
    """
    return _grid(total, FIELD_TOTAL, params)


def _grid(tracks: Sequence[xr.Dataset], variable: str, params: GridSurveyParams) -> xr.Dataset:
    fine = _node_spacing(params)
    samples = collect(tracks, variable)
    _check_area(np.stack([samples.x, samples.y], axis=1), params.spacing_m, fine)
    _check_heights(samples.height, params.height_tolerance_m)
    blocks = block_means(samples, params.spacing_m)
    _LOG.info("%d samples in %d blocks", blocks.samples.value.size, blocks.value.size)
    x, y = (_axis(a, params.spacing_m, fine) for a in (blocks.samples.x, blocks.samples.y))
    values, sigma, facts = _on_nodes(blocks, (x, y), params)
    facts |= {
        "survey_method": params.method,
        "block_m": params.spacing_m,
        "samples_used": blocks.samples.value.size,
        "samples_left_out": samples.value.size - blocks.samples.value.size,
    }
    return _dataset(blocks, (x, y), values, sigma, facts)


def _on_nodes(
    blocks: Blocks, axes: Places, params: GridSurveyParams
) -> tuple[Real, Real, dict[str, Any]]:
    """Values and one sigma (y, x), nT, and what the fit says of itself."""
    shape = axes[1].size, axes[0].size
    x, y = (a.ravel() for a in np.meshgrid(*axes))
    tree = cKDTree(np.stack([blocks.samples.x, blocks.samples.y], axis=1))
    distance = tree.query(np.stack([x, y], axis=1))[0]
    farthest = params.max_distance_m or 2.0 * params.spacing_m
    near = distance <= farthest
    values, sigma = np.full((2, x.size), np.nan)
    if params.method == "polynomial":
        assert params.noise_nt is not None
        fitted = fit_polynomial(blocks, params.noise_nt, params.max_degree)
        values[near], sigma[near] = fitted(x[near], y[near]), fitted.sigma(x[near], y[near])
        facts, residual = goodness_attributes(fitted.table), fitted.residual
        degrees = fitted.goodness.degrees
        facts["polynomial_chosen"] = np.array([degrees.x, degrees.y], np.int32)
    else:
        surface = fit_scatter(blocks, params.method, params.spacing_m, farthest)
        values[near] = surface(x[near], y[near])
        near &= np.isfinite(values)
        sigma[near] = node_sigma(blocks, surface, x[near], y[near])
        facts, residual = {}, surface.residual
        if surface.damping is not None:
            facts["spline_damping"] = surface.damping
    facts["cross_validated_residual_nt"] = rms(residual)
    return values.reshape(shape), sigma.reshape(shape), facts


def _dataset(
    blocks: Blocks, axes: Places, values: Real, sigma: Real, facts: dict[str, Any]
) -> xr.Dataset:
    mapped = {"units": "nT", "grid_mapping": "crs"}
    stated = dict(blocks.samples.attributes)
    variables: dict[str, Any] = {
        "magnetic_anomaly": (
            ("y", "x"), values, mapped | {"long_name": "total-field magnetic anomaly"}
        ),
        "magnetic_anomaly_uncertainty": (
            ("y", "x"), sigma, mapped | {"long_name": "1 sigma of the gridded anomaly"}
        ),
        "height": ((), float(blocks.samples.height.mean()), {"units": "m", "positive": "up"}),
        "crs": ((), np.int32(0), blocks.samples.crs.to_cf()),
    }  # fmt: skip
    if "reference_surface_height" in stated:
        surface = stated.pop("reference_surface_height")
        variables["reference_surface_height"] = ((), surface, {"units": "m"})
    coordinates = {
        name: (name, axis, {"units": "m", "standard_name": f"projection_{name}_coordinate"})
        for name, axis in zip("xy", axes, strict=True)
    }
    return xr.Dataset(variables, coordinates, stated | facts)


def _node_spacing(params: GridSurveyParams) -> float:
    """Spacing of the result's nodes, m."""
    if params.method == "polynomial" and params.noise_nt is None:
        raise ParameterError(
            "key 'noise_nt' is missing",
            where="method 'polynomial'",
            expected="1 sigma of a sample, nT: chi-squared is counted in it",
            remedy="add noise_nt, from the sensor's noise density and bandwidth",
        )
    fine = params.refine_to_m or params.spacing_m
    parts = params.spacing_m / fine
    if parts < 1.0 - _WHOLE or abs(parts - round(parts)) > _WHOLE * parts:
        raise ParameterError(
            f"key 'refine_to_m' is {fine:g}",
            expected=f"a whole part of spacing_m, {params.spacing_m:g}",
            remedy="such as a tenth of it",
        )
    return params.spacing_m / round(parts)


def _axis(values: Real, spacing: float, fine: float) -> Real:
    """Nodes from the block of the least value to that of the greatest, `fine` m apart."""
    parts = round(spacing / fine)
    first, last = (int(np.rint(v / spacing)) for v in (values.min(), values.max()))
    return np.arange(first * parts, last * parts + 1, dtype=np.float64) * (spacing / parts)


def _check_area(places: NDArray[np.float64], spacing: float, fine: float) -> None:
    """Refuse an area that is too wide, narrower than a cell, or a line."""
    extent = np.ptp(places, axis=0)
    if not np.prod(extent / fine + 1.0) <= _MOST_NODES:  # also where the projection has no place
        raise CoverageError(
            f"an area of {extent[0]:.0f} x {extent[1]:.0f} m has more than {_MOST_NODES} nodes "
            f"{fine:g} m apart",
            expected="a small area",
            remedy="widen refine_to_m or spacing_m, or crop the tracks",
        )
    if extent.max() < 2.0 * spacing:
        raise CoverageError(
            f"spacing_m is {spacing:g}, and the samples span {extent[0]:.3g} x {extent[1]:.3g} m",
            expected="an area of several cells",
            remedy="lower spacing_m",
        )
    width = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[-1]
    width = float(np.sqrt(12.0 / len(places)) * width)  # of an even strip with that spread
    if width < spacing:
        raise CoverageError(
            f"the samples lie on one line, within {width:.2g} m of width",
            expected=f"an area wider than spacing_m, {spacing:g}",
            remedy="add tracks beside it: a line says nothing of the field across it",
        )


def _check_heights(height: Real, tolerance: float) -> None:
    low, middle, high = np.quantile(height, [0.005, 0.5, 0.995])
    if max(high - middle, middle - low) > tolerance:
        raise ContractError(
            f"99 % of the heights run from {low:.1f} to {high:.1f} m, with median {middle:.1f}",
            where="height",
            expected=f"one height within height_tolerance_m, {tolerance:g}",
            remedy="grid each height apart, or raise height_tolerance_m",
        )


ANOMALY_STAGE = Stage(
    name="grid-survey",
    version=1,
    params=GridSurveyParams,
    inputs={"track": Many("track-anomaly/1")},
    output="anomaly-grid/1",
    run=grid_survey,
)

TOTAL_STAGE = Stage(
    name="grid-survey",
    version=1,
    params=GridSurveyParams,
    inputs={"total": Many("track/1")},
    output="anomaly-grid/1",
    run=grid_total,
)
