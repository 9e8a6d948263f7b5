"""What a map's field and its gaps are at output nodes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.flags import QualityFlag
from magtiles.stages.field.interpolate import evaluate_linear, evaluate_spline
from magtiles.stages.field.level import PRODUCTS
from magtiles.stages.field.prepare import PlaneMap
from magtiles.stages.field.rotation import rotate_to_ned
from magtiles.stages.field.solve import AnomalousField
from magtiles.stages.field.spectral import LOW_INCLINATION_SINE, TENSOR, VECTOR
from magtiles.stages.field.target import Nodes

Single = NDArray[np.float32]

_OVERSAMPLING = 2


def evaluate_products(field: AnomalousField, nodes: Nodes, height_gain: float) -> Single:
    """The nine products (9, m, n) in NED at the nodes, in the order of `PRODUCTS`."""
    out = evaluate_on_plane(field, nodes, height_gain)
    rotate_to_ned(out, nodes.north, nodes.ambient, np.array(field.inversion.direction))
    return out


def evaluate_on_plane(field: AnomalousField, nodes: Nodes, height_gain: float) -> Single:
    """The nine products (9, m, n) along the plane's axes, the total along the mean direction."""
    out = np.empty((len(PRODUCTS), *nodes.row.shape), np.float32)
    w, offset = field.wavenumbers, field.padding.offset
    dense = w.shape[0] * _OVERSAMPLING
    first = int(np.clip((nodes.row.min() + offset[0]) * _OVERSAMPLING - 2, 0, dense - 8))
    last = int(np.clip((nodes.row.max() + offset[0]) * _OVERSAMPLING + 4, first + 8, dense))
    rows = slice(first, last)
    shift = np.array([offset[0] * _OVERSAMPLING - rows.start, offset[1] * _OVERSAMPLING], float)
    level = field.level(height_gain, _OVERSAMPLING)
    coefficients: Single | None = None
    for product, values in zip(("total", *VECTOR, *TENSOR), out, strict=True):
        coefficients = level.values(product, rows, slice(None), coefficients)
        evaluate_spline(coefficients, nodes.row, nodes.column, float(_OVERSAMPLING), shift, values)
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
