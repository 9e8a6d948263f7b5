"""A patch: the map around one height, held ready for a filter's hot loop.

Where heights count from the ellipsoid, levels are combined at that height once, on the nodes:
what is left is one spline of the value and one of its vertical derivative, at one level.
Where they count from a surface, the height above it changes from place to place, and the
patch keeps the levels that it crosses.
"""

from __future__ import annotations

from typing import Any, TypeGuard

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtiles.catalog.flags import QualityFlag
from magtiles.catalog.kernels import compiled
from magtiles.catalog.kernels.bspline import HALO, Floats, prefilter
from magtiles.catalog.kernels.geodesy import metres_per_degree
from magtiles.catalog.kernels.hermite import bracket
from magtiles.catalog.releases import level_curve
from magtiles.catalog.releases.anomaly import Anomaly
from magtiles.catalog.releases.arguments import broadcast, check_positions, numbers
from magtiles.catalog.releases.level_curve import LevelPoint, PathMatch
from magtiles.catalog.releases.manifest import Manifest
from magtiles.catalog.releases.patch_nodes import Bounds, FlatNodes, PatchNodes, window_of
from magtiles.catalog.releases.positions import Nodes, choose_height
from magtiles.schemas.errors import QueryError


class Patch:
    """The map around one height; see `Anomaly.patch`.

    Covers the bounds rounded outward to whole cells; elsewhere, and where the release has no
    answer, the answer is NaN. Shapes, units and errors are those of `Anomaly`. The total is
    ready when the patch is made, vector and tensor are at their first use.
    """

    def __init__(self, nodes: PatchNodes | FlatNodes, height: float, extrapolate: bool) -> None:
        self._anomaly = Anomaly(nodes.manifest, nodes, extrapolate)
        name = "height" if nodes.manifest.takes_ellipsoidal_height else "height_above_reference"
        self._height: dict[str, Any] = {name: height}
        self._total: _TotalKernel | None = None
        if isinstance(nodes, FlatNodes):
            self._total = _TotalKernel(nodes, height, extrapolate)

    def total(self, latitude: ArrayLike, longitude: ArrayLike) -> Floats:
        """Total-field anomaly, nT; shape (...,)."""
        if self._total is None:
            return self._anomaly.total(latitude, longitude, **self._height)
        return self._total(latitude, longitude, slopes=False)[0]

    def total_with_gradient(
        self, latitude: ArrayLike, longitude: ArrayLike
    ) -> tuple[Floats, Floats]:
        """Total-field anomaly, nT, (...,), and its gradient north, east, down, nT/km, (..., 3)."""
        if self._total is None:
            return self._anomaly.total_with_gradient(latitude, longitude, **self._height)
        return self._total(latitude, longitude, slopes=True)

    def vector(self, latitude: ArrayLike, longitude: ArrayLike) -> Floats:
        """Anomaly vector north, east, down, nT; shape (..., 3)."""
        return self._anomaly.vector(latitude, longitude, **self._height)

    def vector_with_gradient(
        self, latitude: ArrayLike, longitude: ArrayLike
    ) -> tuple[Floats, Floats]:
        """Anomaly vector, nT, (..., 3), and its gradient, nT/km, (..., 3, 3)."""
        return self._anomaly.vector_with_gradient(latitude, longitude, **self._height)

    def tensor(self, latitude: ArrayLike, longitude: ArrayLike) -> Floats:
        """Gradient tensor nn, ne, nd, ee, ed, nT/km; shape (..., 5)."""
        return self._anomaly.tensor(latitude, longitude, **self._height)

    def nearest_on_level_curve(
        self, value: float, latitude: float, longitude: float, *, within_m: float
    ) -> LevelPoint:
        """The place nearest to a position where the total is `value`, nT."""
        return level_curve.nearest_on_level_curve(self.total, value, latitude, longitude, within_m)

    def mean_absolute_deviation(
        self,
        values: ArrayLike,
        latitude: ArrayLike,
        longitude: ArrayLike,
        *,
        half_width_m: float,
        step_m: float,
    ) -> PathMatch:
        """How measured totals (n,), nT, fit along a path (n,) and parallels to it."""
        return level_curve.mean_absolute_deviation(
            self.total, values, latitude, longitude, half_width_m, step_m
        )


class _TotalKernel:
    """The compiled total of a flat patch."""

    def __init__(self, nodes: FlatNodes, height: float, extrapolate: bool) -> None:
        lattice = nodes.manifest.lattice
        north, east = metres_per_degree(lattice.tile_axes(0, 0)[0], height)
        metres = [north * lattice.latitude_spacing, east * lattice.longitude_spacing]
        self._map = (
            nodes.coefficients((0, 0), "total", 0, (0, 0))[0] * [1.0, 1000.0],
            prefilter(1000.0 / np.stack(metres, axis=-1), (0,)),
            *_hidden(nodes.plane((0, 0), "quality_flag"), extrapolate),
            np.array(
                [lattice.south, lattice.west, lattice.latitude_spacing, lattice.longitude_spacing]
            ),
        )

    def __call__(
        self, latitude: ArrayLike, longitude: ArrayLike, *, slopes: bool
    ) -> tuple[Floats, Floats]:
        shape, lat, lon = _flat_positions(latitude, longitude)
        value, gradient = np.empty(len(lat)), np.empty((len(lat) if slopes else 0, 3))
        bad = compiled.total(*self._map, lat, lon, value, gradient)
        if bad >= 0:
            check_positions(shape, lat, lon)
        if slopes:
            gradient = gradient.reshape((*shape, 3))
        return value.reshape(shape)[()], gradient


def _hidden(
    flags: NDArray[np.uint8], extrapolate: bool
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Nodes beyond coverage, and cells with such a node, as the kernel takes them."""
    beyond = np.bitwise_and(flags, np.uint8(QualityFlag.BEYOND_COVERAGE)).astype(np.bool_)
    core = (beyond & (not extrapolate))[HALO : 2 - HALO, HALO : 2 - HALO]
    cells = core[:-1, :-1] | core[:-1, 1:] | core[1:, :-1] | core[1:, 1:]
    return np.ascontiguousarray(core[:-1, :-1]), cells


def _flat_positions(
    latitude: ArrayLike, longitude: ArrayLike
) -> tuple[tuple[int, ...], Floats, Floats]:
    if _is_plain(latitude) and _is_plain(longitude) and latitude.shape == longitude.shape:
        return latitude.shape, latitude.reshape(-1), longitude.reshape(-1)
    shape, (lat, lon) = broadcast(latitude=latitude, longitude=longitude)
    return shape, lat, lon


def _is_plain(value: ArrayLike) -> TypeGuard[Floats]:
    return type(value) is np.ndarray and value.dtype == np.float64


def make_patch(
    manifest: Manifest,
    source: Nodes,
    bounds: Bounds,
    height: ArrayLike | None,
    height_above_reference: ArrayLike | None,
    *,
    extrapolate: bool,
) -> Patch:
    """See `Anomaly.patch`."""
    name, given = choose_height(manifest, height, height_above_reference)
    level = numbers(name, given)
    if level.shape or not np.isfinite(level):
        raise QueryError(f"is {given!r}", where=name, expected="one finite number of metres")
    nodes = PatchNodes(manifest, source, window_of(manifest.lattice, bounds))
    if manifest.height_reference != "ellipsoid" and manifest.has_reference_surface:
        return Patch(nodes, float(level), extrapolate)
    around = bracket(np.array(manifest.heights_m), level.reshape(1))
    if (around.below | around.above)[0] and not extrapolate:
        raise QueryError(
            f"is {float(level):g}",
            where=name,
            expected=f"{manifest.heights_m[0]:g} to {manifest.heights_m[-1]:g} m, "
            "the levels of the release",
        )
    return Patch(FlatNodes(nodes, float(level)), float(level), extrapolate)
