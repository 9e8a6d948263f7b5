"""The field of a crust's coefficients on the nodes of a level, around the globe without a seam."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.models import FieldModel, evaluate_grid
from magtiles.catalog.models.model import REFERENCE_RADIUS_KM
from magtiles.stages.field.direction import Ambient
from magtiles.stages.field.level import PRODUCTS

Real = NDArray[np.float64]
Single = NDArray[np.float32]
Along = Callable[[Real, Real, Real], tuple[Real, Real]]
"""Total (m, n) and ambient direction (m, n, 3) at latitudes (m,) and longitudes (n,), of the
anomaly's vector (m, n, 3) there."""

_NODES_AT_ONCE = 2_000_000
"""Field and tensor of so many nodes take 200 MB in double precision."""

TENSOR_PARTS = {"nn": (0, 0), "ne": (0, 1), "nd": (0, 2), "ee": (1, 1), "ed": (1, 2)}


@dataclass(frozen=True)
class Circle:
    """Evenly spaced longitudes: each meridian once, and which of those every longitude is.

    What is a whole turn apart is the same place, and must be the same to the bit.
    """

    longitude: Real
    again: NDArray[np.intp]

    @classmethod
    def of(cls, longitude: Real, step: float) -> Circle:
        """Of ascending longitudes (degrees) that may go around more than once."""
        turn = round(360.0 / step)
        whole = len(longitude) > turn and abs(turn * step - 360.0) < 1e-9
        once = longitude[:turn] if whole else longitude
        return cls(once, np.arange(len(longitude)) % len(once))


def static_model(name: str, gauss: Real, lowest: int = 1) -> FieldModel:
    """A field that does not change, of coefficients (k,), nT, of degrees from 1 up."""
    degree = int(np.sqrt(len(gauss) + 1)) - 1
    always = (-np.inf, np.inf)
    return FieldModel(
        name, lowest, degree, REFERENCE_RADIUS_KM, np.zeros(1), gauss[None], None, always
    )


def crust_products(
    crust: FieldModel, latitude: Real, circle: Circle, height_m: float, along: Along
) -> tuple[Single, Ambient]:
    """The nine products (9, m, n) of a static crust, and the direction, in bands of latitude."""
    shape = len(latitude), len(circle.again)
    products = np.empty((len(PRODUCTS), *shape), np.float32)
    ambient = np.empty((3, *shape), np.float32)
    for band in _bands(*shape):
        place = latitude[band], circle.longitude
        vector, tensor = evaluate_grid(crust, *place, [height_m], 0.0, gradient=True)
        total, direction = along(*place, vector[0])
        ambient[:, band] = np.moveaxis(direction, -1, 0)[..., circle.again]
        products[0, band] = total[:, circle.again]
        products[1:4, band] = np.moveaxis(vector[0], -1, 0)[..., circle.again]
        for out, (i, j) in zip(products[4:], TENSOR_PARTS.values(), strict=True):
            out[band] = tensor[0, ..., i, j][:, circle.again]
    return products, Ambient(*ambient)


def _bands(rows: int, columns: int) -> Iterator[slice]:
    step = max(1, _NODES_AT_ONCE // columns)
    return (slice(start, min(start + step, rows)) for start in range(0, rows, step))
