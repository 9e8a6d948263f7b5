"""The terms of the Tolles-Lawson model: what an aircraft adds to a scalar magnetometer.

In the body frame (x forward, y right, z down) the aircraft adds to the Earth's field B the vector
P + M B + S dB/dt: permanent, induced and eddy-current (Nielsen 2023; Tolles and Lawson 1950). A
scalar magnetometer feels its part along the field. With u = B / B_ext the direction cosines::

    P . u  +  B_ext u . M u  +  B_ext u . S u'

where ' is the derivative in time. A term is one column of that sum; its coefficient is an element
of P (nT), of M (1; off the diagonal twice the element, as M is symmetric) or of S (s).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import scipy.signal
from numpy.typing import NDArray

Floats = NDArray[np.float64]

Derivative = Literal["direction_cosines", "field_components"]
"""What eddy terms take the derivative of: u, as Nielsen's matrix, or B, as his vector sum."""

AXES = "xyz"
PERMANENT = tuple(f"permanent_{i}" for i in AXES)
INDUCED = ("induced_xx", "induced_xy", "induced_xz", "induced_yy", "induced_yz", "induced_zz")
EDDY = tuple(f"eddy_{i}{j}" for i in AXES for j in AXES)
"""`eddy_ij` is the element of S that turns the derivative along j into a field along i."""

NULL_DIRECTIONS = (
    ("induced_xx", "induced_yy", "induced_zz"),
    ("eddy_xx", "eddy_yy", "eddy_zz"),
)
"""Terms that add up to what no attitude changes: cos^2 sums to 1, cos cos' to 0."""

SHORTEST = 5
"""Samples without a gap that a derivative needs."""

DERIVATIVE_SPAN_S = 0.8
_DEGREE = 4


def term_names(induced: int = 6, eddy: int = 9) -> tuple[str, ...]:
    """Names of 3 permanent, 5 or 6 induced and 8 or 9 eddy terms; the last of a kind goes."""
    return (*PERMANENT, *INDUCED[:induced], *EDDY[:eddy])


def term_units(names: Sequence[str]) -> list[str]:
    """Unit of each term's coefficient."""
    return [{"p": "nT", "i": "1", "e": "s"}[name[0]] for name in names]


def derivative(values: Floats, step_s: float, span_s: float = DERIVATIVE_SPAN_S) -> Floats:
    """Derivative along the first axis, per second, of samples `step_s` apart; at least 5.

    That of the quartic fitted to the samples within a span about each (Savitzky and Golay 1964);
    to no fewer than five, where it is the central difference of fourth order. A span of 0.8 s at
    10 Hz takes 0.6 % from an oscillation at 0.5 Hz, and passes a third of the noise that five
    samples would. Near the ends it is the derivative of the last whole span's quartic.
    """
    window = max(SHORTEST, 2 * round(0.5 * span_s / step_s) + 1)
    window = min(window, len(values) - 1 + len(values) % 2)
    return np.asarray(
        scipy.signal.savgol_filter(values, window, _DEGREE, deriv=1, delta=step_s, axis=0)
    )


def direction_cosines(field_body: Floats) -> Floats:
    """Unit vectors (n, 3) along vectors (n, 3); NaN where one has no length."""
    length = np.linalg.norm(field_body, axis=1, keepdims=True)
    unit = np.full_like(field_body, np.nan)
    np.divide(field_body, length, out=unit, where=length > 0.0)
    return unit


def term_columns(
    field_body: Floats,
    step_s: float,
    names: Sequence[str],
    of: Derivative = "direction_cosines",
    span_s: float = DERIVATIVE_SPAN_S,
) -> Floats:
    """The matrix A of the model (Nielsen 2023): aircraft field = A @ coefficient, nT.

    Parameters
    ----------
    field_body : (n, 3), nT, evenly sampled without gaps; n >= 5. Its length stands for B_ext.
    step_s : seconds between samples.
    names : terms, of `term_names`.
    of : what eddy terms take the derivative of.
    span_s : of `derivative`.

    Returns
    -------
    (n, terms): u in permanent columns, B_ext u u in induced ones (nT), and in eddy ones B_ext u u'
    or u B' = B_ext u u' + B_ext' u u (nT/s).
    """
    length = np.linalg.norm(field_body, axis=1, keepdims=True)
    u = direction_cosines(field_body)
    turning = derivative(u, step_s, span_s)
    # A unit vector's derivative is perpendicular to it; that of fitted quartics nearly is.
    turning -= u * np.sum(u * turning, axis=1, keepdims=True)
    rate = length * turning
    if of == "field_components":
        rate += u * derivative(length, step_s, span_s)
    columns = []
    for name in names:
        kind, _, axes = name.partition("_")
        i, j = AXES.index(axes[0]), AXES.index(axes[-1])
        second = {"permanent": 1.0, "induced": field_body[:, j], "eddy": rate[:, j]}[kind]
        columns.append(u[:, i] * second)
    return np.stack(columns, axis=1)


def null_directions(names: Sequence[str]) -> Floats:
    """Directions (null, terms) of coefficients that no attitude tells apart.

    Any multiple of a row may be added to the coefficients: the compensation changes by a constant
    share of B_ext (induced) or not at all (eddy; with derivatives of the field's components, by a
    constant share of B_ext').
    """
    rows = [
        [1.0 if name in group else 0.0 for name in names]
        for group in NULL_DIRECTIONS
        if set(group) <= set(names)
    ]
    return np.array(rows).reshape(len(rows), len(names))
