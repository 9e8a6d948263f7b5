"""Sampling a gridded surface at the nodes of a geographic lattice, without aliasing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import ndimage

from magtiles.stages.crs import dataset_to_wgs84
from magtiles.stages.field.geometry import is_whole_circle
from magtiles.stages.field.interpolate import evaluate_linear
from magtiles.stages.field.plane import STEP_DEG, on_lattice

Real = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEAST_WEIGHT = 0.5
"""Of what an average or interpolation asks for, the share that must be there."""


@dataclass(frozen=True)
class Sampled:
    """Values at nodes (m, n), and where there are any."""

    values: Real
    known: Mask


def node_index(
    values: xr.DataArray, dataset: xr.Dataset, latitude: Real, longitude: Real
) -> tuple[Real, Real]:
    """Fractional rows and columns (m, n) in a grid of WGS84 nodes (m,) by (n,), degrees."""
    rows, columns = (dataset[dim].values for dim in values.dims)
    geographic = values.dims[0] == "latitude"
    source = dataset_to_wgs84(dataset)

    def smooth(lat: Real, lon: Real) -> tuple[Real, Real]:
        x, y = source.transform(lon, lat, direction="INVERSE")
        # A longitude must not jump between nodes, as those are splined.
        return np.asarray(y), lon + _half_turn(np.asarray(x) - lon) if geographic else np.asarray(x)

    y, x = on_lattice(smooth, latitude, longitude, STEP_DEG)
    if geographic:
        middle = (columns[0] + columns[-1]) / 2
        x = middle + _half_turn(x - middle)
    return (y - rows[0]) / (rows[1] - rows[0]), (x - columns[0]) / (columns[1] - columns[0])


def sample(values: xr.DataArray, dataset: xr.Dataset, latitude: Real, longitude: Real) -> Sampled:
    """`values` of a grid (rows, columns) at WGS84 nodes (m,) by (n,), degrees.

    Bilinear; along an axis whose nodes are denser than the lattice's, of running means as wide
    as a cell of the lattice. A value counts as far as half a cell around its node. What is NaN
    is left out of means; unknown is where it would weigh more than half.
    """
    heights = values.values.astype(np.float64)
    row, column = node_index(values, dataset, latitude, longitude)
    width = _lattice_cell(row, column)
    if values.dims[0] == "latitude" and is_whole_circle(dataset["longitude"].values):
        # Columns go on around the globe.
        beside = int(np.ceil(max(width[1], 1.0))) + 1
        heights = np.pad(heights, ((0, 0), (beside, beside)), mode="wrap")
        column = column % values.shape[1] + beside
    rows, row = _window(heights.shape[0], row, width[0])
    columns, column = _window(heights.shape[1], column, width[1])
    part = heights[rows, columns]
    known = np.isfinite(part)
    weight = _means(known.astype(np.float64), width)
    means = _means(np.where(known, part, 0.0), width)
    known = weight > _LEAST_WEIGHT
    out, share = np.empty(row.shape), np.empty(row.shape)
    evaluate_linear(known.astype(np.float64), row, column, 1.0, 0.0, share)
    evaluate_linear(
        np.divide(means, weight, out=np.zeros(part.shape), where=known),
        row, column, 1.0, 0.0, out,
    )  # fmt: skip
    found = share > _LEAST_WEIGHT
    for index, size in ((row, part.shape[0]), (column, part.shape[1])):
        found &= (index >= -0.5) & (index <= size - 0.5)
    return Sampled(np.divide(out, share, out=np.full(out.shape, np.nan), where=found), found)


def nearest_known(sampled: Sampled) -> Real:
    """Values with those of the nearest node, by rows and columns, where there is none."""
    if sampled.known.all():
        return sampled.values
    nearest = ndimage.distance_transform_edt(
        ~sampled.known, return_distances=False, return_indices=True
    )
    return np.asarray(sampled.values[tuple(nearest)])


def _half_turn(angle: Real) -> Real:
    """An angle in degrees, within half a turn of zero."""
    return (angle + 180.0) % 360.0 - 180.0


def _lattice_cell(row: Real, column: Real) -> tuple[float, float]:
    """How many of a grid's rows and columns a cell in the middle of the lattice spans."""
    i, j = (min(n // 2, n - 2) for n in row.shape)
    return tuple(
        float(abs(index[i + 1, j] - index[i, j]) + abs(index[i, j + 1] - index[i, j]))
        for index in (row, column)
    )  # type: ignore[return-value]


def _window(size: int, index: Real, width: float) -> tuple[slice, Real]:
    """The part of an axis that nodes at `index` ask for, and their index in it."""
    margin = width / 2 + 2.0
    first = int(np.clip(np.floor(index.min() - margin), 0, size - 1))
    last = int(np.clip(np.ceil(index.max() + margin), first, size - 1))
    return slice(first, last + 1), index - first


def _means(values: Real, width: tuple[float, float]) -> Real:
    """Running means (rows, columns) over windows of `width` nodes, zero beyond the array."""
    for axis, size in enumerate(width):
        if size > 1.0:
            beside = int(np.ceil((size - 1.0) / 2.0))
            kernel = np.ones(2 * beside + 1)
            kernel[[0, -1]] = (size - (2 * beside - 1)) / 2.0
            values = ndimage.convolve1d(values, kernel / size, axis=axis, mode="constant")
    return values
