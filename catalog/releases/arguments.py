"""Checking what a query is given; every problem is a QueryError with argument and index."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtiles.catalog.kernels.bspline import Floats
from magtiles.schemas.errors import QueryError

Bools = NDArray[np.bool_]


def numbers(name: str, value: ArrayLike) -> Floats:
    """`value` as float64; masked elements become NaN."""
    try:
        array = np.asanyarray(value)
    except ValueError as caught:
        raise QueryError(f"is no array: {caught}", where=name, expected="real numbers") from None
    if array.dtype.kind not in "iuf":
        raise QueryError(
            f"has dtype {array.dtype}", where=name, expected="real numbers, or an array of them"
        )
    floats = np.asarray(array, dtype=np.float64)
    return np.where(np.ma.getmaskarray(array), np.nan, floats) if np.ma.isMA(array) else floats


def broadcast(**arguments: ArrayLike) -> tuple[tuple[int, ...], list[Floats]]:
    """The common shape of several arguments, and each as a flat array of that many numbers."""
    arrays = {name: numbers(name, value) for name, value in arguments.items()}
    try:
        spread = np.broadcast_arrays(*arrays.values())
    except ValueError:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
        raise QueryError(
            f"shapes do not broadcast: {shapes}", expected="equal shapes, or scalars"
        ) from None
    return spread[0].shape, [array.ravel() for array in spread]


def check_positions(shape: tuple[int, ...], latitude: Floats, longitude: Floats) -> None:
    """Raise QueryError at the first latitude or longitude that is none; NaN passes."""
    refuse(np.abs(latitude) > 90.0, shape, "latitude", latitude, "degrees in [-90, 90], or NaN")
    refuse(np.isinf(longitude), shape, "longitude", longitude, "finite degrees, or NaN")


def refuse(
    bad: Bools, shape: tuple[int, ...], name: str, values: Floats, expected: str, remedy: Any = None
) -> None:
    """Raise QueryError naming the first element of `values` that is `bad`."""
    if bad.any():
        first = int(np.argmax(bad))
        index = ", ".join(str(int(i)) for i in np.unravel_index(first, shape))
        place = f"{name}[{index}]" if shape else name
        raise QueryError(f"is {values[first]:.12g}", where=place, expected=expected, remedy=remedy)
