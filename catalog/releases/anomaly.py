"""Queries of the anomaly: total, vector, tensor, uncertainty and flags at any position."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtiles.catalog.flags import QualityFlag
from magtiles.catalog.kernels.bspline import Floats
from magtiles.catalog.kernels.vertical import FAMILIES
from magtiles.catalog.releases import level_curve
from magtiles.catalog.releases.level_curve import LevelPoint, PathMatch
from magtiles.catalog.releases.manifest import Manifest
from magtiles.catalog.releases.positions import (
    Nodes,
    Positions,
    evaluate,
    flags_at,
    levels_of,
    locate,
    refuse_below,
    uncovered,
)
from magtiles.schemas.errors import QueryError

if TYPE_CHECKING:
    from magtiles.catalog.releases.patch import Patch
    from magtiles.catalog.releases.patch_nodes import Bounds

UNCERTAINTIES = {
    "total": "magnetic_anomaly_uncertainty",
    "vector": "vector_uncertainty",
    "tensor": "tensor_uncertainty",
}


class Anomaly:
    """The anomaly of a release.

    Every method takes latitude and longitude in degrees (WGS84; any multiple of 360 may be
    added to a longitude) and height in metres above the ellipsoid: scalars or arrays that
    broadcast to the shape ``...`` of the answer. A terrain or sea-level release that does not
    know its reference surface takes ``height_above_reference=`` in place of height, and its
    gradients are then taken at constant height above that surface.

    Horizontally the map is a cubic B-spline through the nodes, vertically a quintic Hermite
    form between levels whose derivatives come from the tensor (`kernels.vertical`). Gradients
    are the exact derivatives of the values returned, and both are continuous.

    The answer is NaN where a coordinate is NaN, outside the lattice, above the highest level,
    and where a contributing node is beyond coverage; `flags` says which. A release opened
    with ``allow_extrapolated=True`` answers beyond coverage, and goes on above the highest and
    below the lowest level along the vertical gradient there; outside the lattice it has
    nothing to go on from and answers NaN still. A height below the lowest level raises
    QueryError otherwise, as does a latitude beyond 90 degrees, an infinite value, an array
    that is not real, or shapes that do not broadcast.
    """

    def __init__(self, manifest: Manifest, nodes: Nodes, allow_extrapolated: bool) -> None:
        self._manifest = manifest
        self._nodes = nodes
        self._extrapolate = allow_extrapolated

    def total(
        self,
        latitude: ArrayLike,
        longitude: ArrayLike,
        height: ArrayLike | None = None,
        *,
        height_above_reference: ArrayLike | None = None,
    ) -> Floats:
        """Total-field anomaly, nT; shape (...,)."""
        at = self._locate(latitude, longitude, height, height_above_reference)
        return _shaped(at, self._interpolate("total", at, slopes=False)[0][:, 0])

    def total_with_gradient(
        self,
        latitude: ArrayLike,
        longitude: ArrayLike,
        height: ArrayLike | None = None,
        *,
        height_above_reference: ArrayLike | None = None,
    ) -> tuple[Floats, Floats]:
        """Total-field anomaly, nT, (...,), and its gradient north, east, down, nT/km, (..., 3)."""
        at = self._locate(latitude, longitude, height, height_above_reference)
        values, gradients = self._interpolate("total", at, slopes=True)
        return _shaped(at, values[:, 0]), _shaped(at, gradients[:, 0])

    def vector(
        self,
        latitude: ArrayLike,
        longitude: ArrayLike,
        height: ArrayLike | None = None,
        *,
        height_above_reference: ArrayLike | None = None,
    ) -> Floats:
        """Anomaly vector north, east, down, nT; shape (..., 3)."""
        at = self._locate(latitude, longitude, height, height_above_reference)
        return _shaped(at, self._interpolate("vector", at, slopes=False)[0])

    def vector_with_gradient(
        self,
        latitude: ArrayLike,
        longitude: ArrayLike,
        height: ArrayLike | None = None,
        *,
        height_above_reference: ArrayLike | None = None,
    ) -> tuple[Floats, Floats]:
        """Anomaly vector, nT, (..., 3), and its gradient, nT/km, (..., 3, 3).

        Element [..., i, j] of the gradient is the derivative of component i along axis j.
        """
        at = self._locate(latitude, longitude, height, height_above_reference)
        values, gradients = self._interpolate("vector", at, slopes=True)
        return _shaped(at, values), _shaped(at, gradients)

    def tensor(
        self,
        latitude: ArrayLike,
        longitude: ArrayLike,
        height: ArrayLike | None = None,
        *,
        height_above_reference: ArrayLike | None = None,
    ) -> Floats:
        """Gradient tensor nn, ne, nd, ee, ed, nT/km; shape (..., 5); dd is -(nn + ee)."""
        at = self._locate(latitude, longitude, height, height_above_reference)
        return _shaped(at, self._interpolate("tensor", at, slopes=False)[0])

    def uncertainty(
        self,
        latitude: ArrayLike,
        longitude: ArrayLike,
        height: ArrayLike | None = None,
        *,
        height_above_reference: ArrayLike | None = None,
        quantity: str = "total",
    ) -> Floats:
        """1 sigma of the map's error of "total" or "vector" (nT) or "tensor" (nT/km); (...,).

        Linear between nodes and levels, so never below the smallest of the nodes around.
        """
        if quantity not in UNCERTAINTIES:
            raise QueryError(
                f"is {quantity!r}", where="quantity", expected=f"one of {', '.join(UNCERTAINTIES)}"
            )
        at = self._locate(latitude, longitude, height, height_above_reference)
        answer = np.zeros(len(at.inside))
        for group in at.groups:
            for level, side, chosen in levels_of(at.bracket, group):
                plane = self._nodes.plane(group.place, UNCERTAINTIES[quantity], level)
                index = group.index[chosen]
                linear = _bilinear(plane, group.y[chosen], group.x[chosen])
                answer[index] += at.bracket.linear[side, index] * linear
        self._hide(at, answer)
        return _shaped(at, answer)

    def flags(
        self,
        latitude: ArrayLike,
        longitude: ArrayLike,
        height: ArrayLike | None = None,
        *,
        height_above_reference: ArrayLike | None = None,
    ) -> NDArray[np.uint8]:
        """Quality flags of all contributing nodes joined; uint8, shape (...,).

        `QualityFlag.BEYOND_COVERAGE` where a coordinate is NaN, outside the lattice and above
        the highest level; that and DOWNWARD_CONTINUED below the lowest. Never raises for a
        height.
        """
        at = locate(
            self._manifest, self._nodes, latitude, longitude, height, height_above_reference
        )
        flags = flags_at(self._nodes, at)
        beyond = ~at.inside | at.bracket.above | at.bracket.below
        flags[beyond] |= np.uint8(QualityFlag.BEYOND_COVERAGE)
        flags[at.bracket.below] |= np.uint8(QualityFlag.DOWNWARD_CONTINUED)
        return _shaped(at, flags)

    def reference_surface(self, latitude: ArrayLike, longitude: ArrayLike) -> Floats:
        """Ellipsoidal height of the surface that the release's levels count from, m; (...,).

        Zero where they count from the ellipsoid itself, NaN outside the lattice. Raises
        QueryError when the release does not know its surface.
        """
        if not self._manifest.takes_ellipsoidal_height:
            raise QueryError(
                "its ellipsoidal height is not known",
                where=f"{self._manifest.height_reference} of release {self._manifest.product}",
                remedy="build the release with a reference_surface_height",
            )
        # Any height will do: only the surface is asked for.
        at = locate(self._manifest, self._nodes, latitude, longitude, 0.0, None)
        return _shaped(at, np.where(at.inside, -at.relative, np.nan))

    def nearest_on_level_curve(
        self,
        value: float,
        latitude: float,
        longitude: float,
        height: float | None = None,
        *,
        within_m: float,
        height_above_reference: float | None = None,
    ) -> LevelPoint:
        """The place nearest to a position where the total is `value`, nT, at that height.

        See `level_curve.nearest_on_level_curve`; NaN where there is none within `within_m`.
        """

        def total(lat: Floats, lon: Floats) -> Floats:
            return self.total(lat, lon, height, height_above_reference=height_above_reference)

        return level_curve.nearest_on_level_curve(total, value, latitude, longitude, within_m)

    def mean_absolute_deviation(
        self,
        values: ArrayLike,
        latitude: ArrayLike,
        longitude: ArrayLike,
        height: float | None = None,
        *,
        half_width_m: float,
        step_m: float,
        height_above_reference: float | None = None,
    ) -> PathMatch:
        """How measured totals (n,), nT, fit along a path (n,) and parallels to it.

        See `level_curve.mean_absolute_deviation`.
        """

        def total(lat: Floats, lon: Floats) -> Floats:
            return self.total(lat, lon, height, height_above_reference=height_above_reference)

        return level_curve.mean_absolute_deviation(
            total, values, latitude, longitude, half_width_m, step_m
        )

    def patch(
        self,
        bounds: Bounds,
        height: float | None = None,
        *,
        height_above_reference: float | None = None,
    ) -> Patch:
        """The map around one height, prepared for a filter's hot loop.

        Parameters
        ----------
        bounds : ``{"latitude": (south, north), "longitude": (west, east)}``, degrees; west >
            east crosses the date line.
        height, height_above_reference : one number, as for a query.

        Raises QueryError when the bounds do not meet the release or the height is outside it.
        """
        # Brings numba, which a reader that makes no patch does not need.
        from magtiles.catalog.releases.patch import make_patch

        return make_patch(
            self._manifest,
            self._nodes,
            bounds,
            height,
            height_above_reference,
            extrapolate=self._extrapolate,
        )

    def _locate(self, *arguments: Any) -> Positions:
        at = locate(self._manifest, self._nodes, *arguments)
        if not self._extrapolate:
            refuse_below(self._manifest, at)
        return at

    def _interpolate(self, family: str, at: Positions, *, slopes: bool) -> tuple[Floats, Floats]:
        """Values (n, components) and, with `slopes`, gradients (n, components, 3)."""
        count = len(FAMILIES[family])
        values = np.zeros((len(at.inside), count))
        gradients = np.zeros((len(at.inside), count, 3 if slopes else 0))
        for group in at.groups:
            for level, side, chosen in levels_of(at.bracket, group):
                index = group.index[chosen]
                here = group.__class__(
                    group.place, group.block, index, group.y[chosen], group.x[chosen]
                )
                found = evaluate(self._nodes, here, family, level, slopes=slopes)
                found = found.reshape(len(found), len(index), -1, count)
                add_level(found, at, side, index, values, gradients)
        self._hide(at, values, gradients)
        return values, gradients

    def _hide(self, at: Positions, *answers: Floats) -> None:
        """Set NaN where there is no answer."""
        hidden = ~at.inside
        if not self._extrapolate:
            hidden |= uncovered(at, flags_at(self._nodes, at))
        for answer in answers:
            answer[hidden] = np.nan


def add_level(
    found: Floats,
    at: Positions,
    side: int,
    index: NDArray[np.intp],
    values: Floats,
    gradients: Floats,
) -> None:
    """Add one level's share of values (nT) and gradients (north, east, down, nT/km).

    `found` is (3 or 1, n, order, components): the splines and their slopes per cell.
    """
    orders = found.shape[2]
    weight = at.bracket.value[side, index, :orders]
    rate = at.bracket.slope[side, index, :orders]
    values[index] += np.einsum("no,noc->nc", weight, found[0])
    if len(found) == 1:
        return
    # At a constant ellipsoidal height, height above the reference falls as the surface rises.
    upward = np.einsum("no,noc->nc", rate, found[0])
    for axis in (0, 1):
        level = np.einsum("no,noc->nc", weight, found[1 + axis])
        level -= upward * at.surface_slope[axis, index, None]
        gradients[index, :, axis] += 1000.0 * level / at.metres[axis, index, None]
    gradients[index, :, 2] -= 1000.0 * upward


def _bilinear(plane: NDArray[Any], y: Floats, x: Floats) -> Floats:
    i = np.minimum(np.floor(y).astype(np.intp), plane.shape[0] - 2)
    j = np.minimum(np.floor(x).astype(np.intp), plane.shape[1] - 2)
    t, s = y - i, x - j
    south = (1 - s) * plane[i, j] + s * plane[i, j + 1]
    north = (1 - s) * plane[i + 1, j] + s * plane[i + 1, j + 1]
    return np.asarray((1 - t) * south + t * north, np.float64)


def _shaped(at: Positions, answer: NDArray[Any]) -> NDArray[Any]:
    """The answer in the shape of the arguments; scalars for scalars."""
    shaped: NDArray[Any] = answer.reshape(at.shape + answer.shape[1:])[()]
    return shaped
