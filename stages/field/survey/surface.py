"""Surfaces through scattered values: verde's gridders, damped and judged by cross-validation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from magtiles.schemas.errors import CoverageError
from magtiles.stages.field.survey.samples import Blocks, Places, Real

Scattered = Literal["spline", "linear", "cubic"]

_DAMPINGS = (1e-10, 1e-8, 1e-6, 1e-4, 1e-2, 1.0)
_FOLDS = 5
_FEWEST = 10
_MOST = 5000
_MATRICES = 5
"""Dense square arrays that a fit of the spline holds at once."""


@dataclass(frozen=True)
class Held:
    """Blocks of one fold (k,) that the others predict, and the others."""

    out: NDArray[np.intp]
    rest: NDArray[np.intp]


@dataclass(frozen=True)
class Scatter:
    """A surface fitted to blocks.

    Attributes
    ----------
    residual : (blocks,) nT, each block's value less what the surface through the other folds
        says there; NaN outside their hull where the method does not extrapolate.
    folds : the blocks that were held out together.
    damping : of the spline; None for methods that have none.
    """

    gridder: Any
    unit: tuple[float, float, float]
    reach: float
    residual: Real
    folds: tuple[Held, ...]
    damping: float | None

    def __call__(self, x: Real, y: Real) -> Real:
        """Values (...) nT at places (...) m; NaN where the method does not extrapolate."""
        return _predict(self.gridder, _scaled((x, y), self.unit), self.reach)


def fit_scatter(blocks: Blocks, method: Scattered, spacing: float, max_distance: float) -> Scatter:
    """A plane and, on what it leaves, verde's gridder of a name, through the blocks' means.

    The biharmonic spline (Sandwell 1987) has a force at every block, damped as five-fold
    cross-validation prefers. The linear and cubic ones go through the means, over triangles
    (Delaunay) with no edge longer than twice `max_distance` m: the outline of a survey is full
    of slivers that reach along it.

    Raises CoverageError for too few blocks, or more than a dense spline should solve for.
    """
    _check_count(blocks.value.size, method)
    unit = float(blocks.x.mean()), float(blocks.y.mean()), spacing
    place, reach = _scaled((blocks.x, blocks.y), unit), max_distance / spacing
    weight = blocks.weight if method == "spline" else None  # the others have no use for it
    folds = tuple(_folds(blocks.value.size))

    def held_out(damping: float | None) -> Real:
        residual = np.empty(blocks.value.size)
        for fold in folds:
            rest = None if weight is None else weight[fold.rest]
            gridder = _gridder(method, damping)
            gridder.fit(_at(place, fold.rest), blocks.value[fold.rest], rest)
            residual[fold.out] = blocks.value[fold.out] - _predict(
                gridder, _at(place, fold.out), reach
            )
        return residual

    dampings = _DAMPINGS if method == "spline" else (None,)
    residuals = [held_out(damping) for damping in dampings]
    best = int(np.argmin([rms(residual) for residual in residuals]))
    gridder = _gridder(method, dampings[best]).fit(place, blocks.value, weight)
    return Scatter(gridder, unit, reach, residuals[best], folds, dampings[best])


def rms(residual: Real) -> float:
    """Root mean square of what is finite."""
    return float(np.sqrt(np.nanmean(residual**2)))


def _gridder(method: Scattered, damping: float | None) -> Any:
    import verde  # heavy, and few commands grid

    gridder = {
        "spline": lambda: verde.Spline(damping=damping),
        "linear": verde.Linear,
        "cubic": verde.Cubic,
    }[method]()
    return verde.Chain([("plane", verde.Trend(degree=1)), ("surface", gridder)])


def _predict(gridder: Any, place: Places, reach: float) -> Real:
    """Values (n,) at scaled places; NaN in triangles with an edge longer than twice `reach`."""
    values = np.asarray(gridder.predict(place), np.float64)
    triangles = getattr(getattr(gridder.steps[-1][1], "interpolator_", None), "tri", None)
    if triangles is None:
        return values
    corner = triangles.points[triangles.simplices]
    longest = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max(axis=1)
    found = triangles.find_simplex(np.stack(place, axis=-1))
    return np.where((found >= 0) & (longest[found] <= 2.0 * reach), values, np.nan)


def _folds(count: int) -> Iterator[Held]:
    # Seeded: the same survey gives the same grid.
    order = np.random.default_rng(0).permutation(count)
    for out in np.array_split(order, _FOLDS):
        yield Held(np.sort(out), np.setdiff1d(order, out))


def _scaled(place: Places, unit: tuple[float, float, float]) -> Places:
    """About the middle and in spacings, so that one range of dampings suits any survey."""
    return (place[0] - unit[0]) / unit[2], (place[1] - unit[1]) / unit[2]


def _at(place: Places, index: NDArray[np.intp]) -> Places:
    return place[0][index], place[1][index]


def _check_count(count: int, method: Scattered) -> None:
    if count < _FEWEST:
        raise CoverageError(
            f"the samples fill {count} blocks",
            where=f"method '{method}'",
            expected=f"at least {_FEWEST}",
            remedy="lower spacing_m, or measure more",
        )
    if method == "spline" and count > _MOST:
        size = _MATRICES * 8 * count**2 / 2**30
        raise CoverageError(
            f"a spline through {count} blocks holds {size:.1f} GiB of dense matrices",
            where="method 'spline'",
            expected=f"at most {_MOST} blocks",
            remedy="widen spacing_m, cut the area, or take method 'linear' or 'cubic'",
        )
