"""Vertical derivatives of anomaly, vector and tensor at the nodes of one level.

Outside its sources the anomaly B is a potential field, B = -grad V, so its gradients
G_ij = d_i B_j commute (d_k G_ij is symmetric in all three) and are traceless. Vertical
derivatives then follow from horizontal ones of the tensor (Blakely 1995, Potential Theory
in Gravity and Magnetic Applications, ch. 2), with h up, d down and north-east-down axes:

    dB_i/dh = -G_id           d2B_i/dh2 = d_d G_id = -(a, b, c)
    dG_ij/dh = -d_d G_ij      d2G_ij/dh2 = d_d d_d G_ij
    a = d_n (G_nn + G_ee),  b = d_e (G_nn + G_ee),  c = d_n G_nd + d_e G_ed

Horizontal derivatives are seven-point differences on the nodes: sixth order, and unlike a
spline's they reach three nodes only, so that neighbouring tiles agree on them within halos.

The turning of north and east from node to node is left out: it adds terms of G over the
earth's radius, 1e-3 of these where the anomaly varies over 6 km.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.kernels.bspline import Floats

Planes = Mapping[str, NDArray[np.floating]]

FAMILIES: dict[str, tuple[str, ...]] = {
    "total": ("magnetic_anomaly",),
    "vector": ("anomaly_north", "anomaly_east", "anomaly_down"),
    "tensor": ("gradient_nn", "gradient_ne", "gradient_nd", "gradient_ee", "gradient_ed"),
}
"""What can be asked for, and the variables it is made of."""

AMBIENT = ("ambient_north", "ambient_east", "ambient_down")

_TENSOR = FAMILIES["tensor"]
_VERTICAL = ("gradient_nn", "gradient_nd", "gradient_ee", "gradient_ed")

Derivative = Callable[[Floats], Floats]

# Row i differentiates, at node i of seven, the polynomial through all seven (exact for the
# powers 0 to 6, which is how it is made).
_NODES = np.arange(-3.0, 4.0)
_POWERS = np.arange(7)
_SEVEN = (_POWERS * _NODES[:, None] ** np.maximum(_POWERS - 1, 0)) @ np.linalg.inv(
    _NODES[:, None] ** _POWERS
)


def required_variables(family: str) -> tuple[str, ...]:
    """Variables of one level that `hermite_planes` needs for a family."""
    return _TENSOR if family == "tensor" else FAMILIES[family] + _VERTICAL


def hermite_planes(
    family: str, planes: Planes, metres_north: Floats, metres_east: Floats
) -> Floats:
    """Values and their first and second derivatives in height, at the nodes.

    Parameters
    ----------
    family : a key of `FAMILIES`.
    planes : (rows, columns) arrays of one level, nT and nT/km; for "total" also `AMBIENT`.
    metres_north, metres_east : (rows, 1) metres between neighbouring nodes.

    Returns
    -------
    (rows, columns, 3, components): order of derivative (per m, per m2), then component.
    """
    north = _derivative(0, metres_north)
    east = _derivative(1, metres_east)
    tensor = {name: np.asarray(planes[name], np.float64) for name in _TENSOR if name in planes}
    if family == "tensor":
        first, second = _tensor_orders(tensor, north, east)
    else:
        first, second = _vector_orders(tensor, north, east)
    if family == "total":
        f = np.stack([planes[name] for name in AMBIENT], axis=-1).astype(np.float64)
        first, second = (np.einsum("yxc,yxc->yx", f, v)[..., None] for v in (first, second))
    values = np.stack([planes[name] for name in FAMILIES[family]], axis=-1)
    return np.stack([values, first, second], axis=2)


def _derivative(axis: int, metres: Floats) -> Derivative:
    """Derivative per metre along `axis` of (rows, columns, components)."""
    return lambda stack: node_derivative(stack, axis) / metres[..., None]


def node_derivative(values: Floats, axis: int) -> Floats:
    """Derivative at the nodes along `axis` (seven or more), per node spacing; same shape."""
    f = np.moveaxis(values, axis, 0)
    slope = np.empty_like(f)
    slope[:3] = np.tensordot(_SEVEN[:3], f[:7], 1)
    slope[-3:] = np.tensordot(_SEVEN[4:], f[-7:], 1)
    near, middle, far = _SEVEN[3, 4:]
    slope[3:-3] = near * (f[4:-2] - f[2:-4])
    slope[3:-3] += middle * (f[5:-1] - f[1:-5])
    slope[3:-3] += far * (f[6:] - f[:-6])
    return np.moveaxis(slope, 0, axis)


def _vector_orders(g: Planes, north: Derivative, east: Derivative) -> tuple[Floats, Floats]:
    trace = g["gradient_nn"] + g["gradient_ee"]
    of_north = north(np.stack([trace, g["gradient_nd"]], axis=-1))
    of_east = east(np.stack([trace, g["gradient_ed"]], axis=-1))
    first = np.stack([g["gradient_nd"], g["gradient_ed"], -trace], axis=-1)
    second = np.stack(
        [of_north[..., 0], of_east[..., 0], of_north[..., 1] + of_east[..., 1]], axis=-1
    )
    return first / -1000.0, second / -1000.0


def _tensor_orders(g: Planes, north: Derivative, east: Derivative) -> tuple[Floats, Floats]:
    trace = g["gradient_nn"] + g["gradient_ee"]
    of_north = north(np.stack([trace, g["gradient_nd"], g["gradient_ed"]], axis=-1))
    of_east = east(np.stack([trace, g["gradient_ed"]], axis=-1))
    a, b = of_north[..., 0], of_east[..., 0]
    c = of_north[..., 1] + of_east[..., 1]
    first = np.stack([of_north[..., 1], of_north[..., 2], -a, of_east[..., 1], -b], axis=-1)
    abc_north, bc_east = north(np.stack([a, b, c], axis=-1)), east(np.stack([b, c], axis=-1))
    second = np.concatenate([abc_north, bc_east], axis=-1)
    return -first, -second
