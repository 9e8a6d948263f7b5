"""The field of a model, and its gradient, at any positions and dates."""

from __future__ import annotations

import threading
import weakref
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtiles.catalog.kernels.dipole import geodetic_to_ecef
from magtiles.catalog.kernels.harmonics import Harmonics, at_points, field_harmonics
from magtiles.catalog.models.dates import Date
from magtiles.catalog.models.model import FieldModel
from magtiles.schemas.errors import QueryError

Floats = NDArray[np.float64]

LOWEST_M = -12_000.0
"""Heights below this are inside the Earth: a slip of unit or sign."""

_KEPT = 6
"""Prepared functions kept for each model."""

_prepared: weakref.WeakKeyDictionary[FieldModel, dict[Any, Any]] = weakref.WeakKeyDictionary()
_lock = threading.Lock()


@overload
def evaluate(
    model: FieldModel,
    latitude: ArrayLike,
    longitude: ArrayLike,
    height: ArrayLike,
    date: Date,
    *,
    gradient: Literal[False] = False,
    allow_extrapolated: bool = False,
) -> Floats: ...
@overload
def evaluate(
    model: FieldModel,
    latitude: ArrayLike,
    longitude: ArrayLike,
    height: ArrayLike,
    date: Date,
    *,
    gradient: Literal[True],
    allow_extrapolated: bool = False,
) -> tuple[Floats, Floats]: ...
def evaluate(
    model: FieldModel,
    latitude: ArrayLike,
    longitude: ArrayLike,
    height: ArrayLike,
    date: Date,
    *,
    gradient: bool = False,
    allow_extrapolated: bool = False,
) -> Floats | tuple[Floats, Floats]:
    """The field of `model` in true north, east, down.

    Parameters
    ----------
    latitude, longitude, height : WGS84 geodetic degrees and metres above the ellipsoid.
    date : one, or one for each position; all four broadcast to (...).
    gradient : return the gradient tensor, too.
    allow_extrapolated : answer for dates beyond the model's validity (`FieldModel.covers`).

    Returns
    -------
    field (..., 3) in nT and, with `gradient`, tensor (..., 3, 3) in nT/km: [i, j] is the
    derivative of B_i along axis j, in the Cartesian axes that are north, east, down there.
    It is symmetric and traceless; along a meridian or parallel, the turning of these axes adds
    to the change of the components.

    Raises
    ------
    QueryError : a position or date that is none, or outside the model.

    The method is in `magtiles.catalog.kernels.harmonics`.
    """
    from magtiles.catalog.kernels.harmonics_compiled import turn_to_ned

    year = model.years(date, allow_extrapolated=allow_extrapolated)
    lat, lon, h, year = broadcast(latitude, longitude, height, year)
    check_positions(lat, lon, h)
    shape = lat.shape
    places = geodetic_to_ecef(lat.ravel(), lon.ravel(), h.ravel())
    fields = _fields(model, places, year.ravel(), gradient)
    vector = np.empty((len(places), 3))
    tensor = np.empty((len(places) if gradient else 0, 3, 3))
    turn_to_ned(fields, cosine_and_sine(lat), cosine_and_sine(lon), vector, tensor)
    if gradient:
        return vector.reshape(*shape, 3), tensor.reshape(*shape, 3, 3)
    return vector.reshape(*shape, 3)


def broadcast(*arrays: ArrayLike) -> tuple[Floats, ...]:
    """The arrays, broadcast together; QueryError where their shapes do not fit."""
    floats = [np.asarray(a, dtype=np.float64) for a in arrays]
    try:
        return tuple(np.broadcast_arrays(*floats))
    except ValueError:
        shapes = ", ".join(str(a.shape) for a in floats)
        raise QueryError(
            f"latitude, longitude, height and date have shapes {shapes}",
            expected="shapes that broadcast together",
        ) from None


def check_positions(latitude: Floats, longitude: Floats, height: Floats) -> None:
    """Raise QueryError naming the first value that is no position, NaN included."""
    for name, values, good, expected in (
        ("latitude", latitude, np.abs(latitude) <= 90.0, "-90 to 90 degrees"),
        ("longitude", longitude, np.isfinite(longitude), "a finite number of degrees"),
        (
            "height",
            height,
            np.isfinite(height) & (height >= LOWEST_M),
            f"{LOWEST_M:g} m above the ellipsoid, or higher",
        ),
    ):
        if not good.all():
            index = int(np.flatnonzero(~good.ravel())[0])
            value = values.ravel()[index]
            inside = " is inside the Earth" if name == "height" and value < LOWEST_M else ""
            raise QueryError(
                f"{name} {value:g}{inside}",
                where=f"{name}[{index}]" if values.ndim else name,
                expected=expected,
            )


def cosine_and_sine(degrees: Floats) -> Floats:
    """(n, 2) of angles (...)."""
    angle = np.radians(degrees.ravel())
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _fields(model: FieldModel, places: Floats, year: Floats, gradient: bool) -> Floats:
    """Field and tensor (n, 3 or 8) in Earth-centred axes: base and rate of each segment."""
    fields = np.zeros((len(places), 8 if gradient else 3))
    segments = model.segments(year)
    for segment in np.unique(segments).tolist():
        here = segments == segment
        some = slice(None) if here.all() else here
        base, rate = _harmonics(model, segment, gradient)
        if base is not None:
            fields[some] += at_points(base, places[some])
        elapsed = year[some] - model.epochs[segment]
        if rate is not None and elapsed.any():
            fields[some] += elapsed[:, None] * at_points(rate, places[some])
    return fields


def _harmonics(
    model: FieldModel, segment: int, gradient: bool
) -> tuple[Harmonics | None, Harmonics | None]:
    """Functions of the coefficients at an epoch and of their rate, made once."""
    with _lock:
        kept = _prepared.setdefault(model, {})
        if (segment, gradient) not in kept:
            while len(kept) >= _KEPT:
                del kept[next(iter(kept))]
            kept[segment, gradient] = tuple(
                field_harmonics(values, model.reference_radius_km, gradient=gradient)
                for values in model.line(segment)
            )
        base, rate = kept[segment, gradient]
        return base, rate
