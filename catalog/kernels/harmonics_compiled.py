"""Sums of spherical harmonics, compiled by numba: import this only when a model is evaluated.

With r, t = sin(geocentric latitude) and u = cos(geocentric latitude) of a place, and q = a / r,

    f = sum_nm q^(n+1) Re[c_nm e^(i m longitude)] S_nm,    S_nm = u^m F_nm

where S_nm are Schmidt's functions. F_nm has no singularity and does not underflow (Holmes and
Featherstone 2002, J. Geodesy 76:279-299); G_nm = q^(n-m) F_nm obeys, down a column of order m,

    G_nm = a_nm (t q) G_(n-1)m - b_nm q^2 G_(n-2)m

and what is left, (q u e^(i longitude))^m = (a (x + i y) / r^2)^m, is Horner's rule over m in
Cartesian coordinates: nothing is divided by u, and the poles are places like any other.

Eight degrees are taken at once: neighbouring places then fill the vector registers, and each
sum that is loaded serves eight terms.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.kernels.jit import compiled

Floats = NDArray[np.float64]

LANES = 128
"""Places taken through a column together: their sums stay in the first cache."""

SCALE = 2.0**-450
"""Its square multiplies all F_nm, which reach 1e570 at degree 2700 beside a pole."""


@compiled
def highest_order(degree: int, top: int, u: float) -> int:
    """Order above which no S_nm up to `degree` exceeds 1e-19 where the cosine is at most `u`.

    For m > x = n u, S_nm falls like the Bessel function J_m(x), that is like
    exp(-2/3 z^1.5) with m = x + z (x / 2)^(1/3); z = 17 and twenty orders more suffice.
    """
    x = degree * u
    return min(top, int(x + 17.0 * (0.5 * x) ** (1.0 / 3.0)) + 20)


@compiled
def column(
    recursion: Floats,
    coefficients: Floats,
    rows: tuple[int, int],
    seed: float,
    tq: Floats,
    q2: Floats,
    work: Floats,
    even: Floats,
    odd: Floats,
) -> None:
    """Sums over the degrees of one order, those of n - m even and odd apart.

    Parameters
    ----------
    recursion : (all rows, 2) a_nm and b_nm.
    coefficients : (all rows, 2 k) real and imaginary parts of c_nm of k functions.
    rows : first and last + 1 of the order.
    seed : F_mm.
    tq, q2 : (places,) t q and q^2.
    work : (8, places) scratch.
    even, odd : (2 k, places), filled.
    """
    even[:] = 0.0
    odd[:] = 0.0
    work[:2] = 0.0
    for i in range(rows[0], rows[1], 8):
        a, b = recursion[i : i + 8, 0], recursion[i : i + 8, 1]
        a0, a1, a2, a3, a4, a5, a6, a7 = a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7]
        b0, b1, b2, b3, b4, b5, b6, b7 = b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7]
        for j in range(tq.size):
            t, q = tq[j], q2[j]
            g0 = (a0 * t) * work[1, j] - (b0 * q) * work[0, j] + seed
            g1 = (a1 * t) * g0 - (b1 * q) * work[1, j]
            g2 = (a2 * t) * g1 - (b2 * q) * g0
            g3 = (a3 * t) * g2 - (b3 * q) * g1
            g4 = (a4 * t) * g3 - (b4 * q) * g2
            g5 = (a5 * t) * g4 - (b5 * q) * g3
            g6 = (a6 * t) * g5 - (b6 * q) * g4
            g7 = (a7 * t) * g6 - (b7 * q) * g5
            work[2, j], work[3, j], work[4, j], work[5, j] = g0, g1, g2, g3
            work[6, j], work[7, j], work[0, j], work[1, j] = g4, g5, g6, g7
        seed = 0.0
        for k in range(even.shape[0]):
            c = coefficients[i : i + 8, k]
            c0, c1, c2, c3, c4, c5, c6, c7 = c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7]
            for j in range(tq.size):
                g0, g1, g2, g3 = work[2, j], work[3, j], work[4, j], work[5, j]
                g4, g5, g6, g7 = work[6, j], work[7, j], work[0, j], work[1, j]
                even[k, j] += c0 * g0 + c2 * g2 + c4 * g4 + c6 * g6
                odd[k, j] += c1 * g1 + c3 * g3 + c5 * g5 + c7 * g7


@compiled
def _horner(sums: Floats, wx: Floats, wy: Floats, even: Floats, odd: Floats) -> None:
    """One step of Horner: sums (wx + i wy) + even + odd, real and imaginary parts in turn."""
    for k in range(0, sums.shape[0], 2):
        for j in range(wx.size):
            re, im = sums[k, j], sums[k + 1, j]
            sums[k, j] = re * wx[j] - im * wy[j] + (even[k, j] + odd[k, j])
            sums[k + 1, j] = re * wy[j] + im * wx[j] + (even[k + 1, j] + odd[k + 1, j])


@compiled
def at_points(
    recursion: Floats,
    coefficients: Floats,
    starts: NDArray[np.int64],
    seeds: Floats,
    degree: int,
    places: Floats,
    out: Floats,
) -> None:
    """Functions at any places.

    Parameters
    ----------
    starts : (orders + 1,) first row of each order, and the number of rows.
    seeds : (orders,) F_mm times SCALE^2.
    degree : the highest.
    places : (n, 3) Cartesian, in units of the reference radius.
    out : (n, k), filled.
    """
    n, functions = out.shape
    lanes = min(LANES, n)
    blocks = (n + lanes - 1) // lanes
    tq, q2 = np.zeros((blocks, lanes)), np.zeros((blocks, lanes))
    wx, wy = np.zeros((blocks, lanes)), np.zeros((blocks, lanes))
    widest = 0.0
    for i in range(n):
        x, y, z = places[i, 0], places[i, 1], places[i, 2]
        r2 = x * x + y * y + z * z
        b, j = i // lanes, i % lanes
        tq[b, j], q2[b, j], wx[b, j], wy[b, j] = z / r2, 1.0 / r2, x / r2, y / r2
        widest = max(widest, (x * x + y * y) / r2)
    sums = np.zeros((blocks, 2 * functions, lanes))
    even, odd = np.empty((2 * functions, lanes)), np.empty((2 * functions, lanes))
    work = np.empty((8, lanes))
    for m in range(highest_order(degree, seeds.size - 1, math.sqrt(widest)), -1, -1):
        rows = (starts[m], starts[m + 1])
        for b in range(blocks):
            column(recursion, coefficients, rows, seeds[m], tq[b], q2[b], work, even, odd)
            _horner(sums[b], wx[b], wy[b], even, odd)
    for i in range(n):
        b, j = i // lanes, i % lanes
        q = math.sqrt(q2[b, j]) / SCALE / SCALE
        for k in range(functions):
            out[i, k] = q * sums[b, 2 * k, j]


@compiled
def along_parallels(
    recursion: Floats,
    coefficients: Floats,
    starts: NDArray[np.int64],
    seeds: Floats,
    degree: int,
    places: Floats,
    north: NDArray[np.complex128],
    south: NDArray[np.complex128],
) -> None:
    """Fourier coefficients over longitude on parallels and on their mirror images.

    Parameters
    ----------
    places : (n, 2) distance from the axis and height above the equator, in reference radii.
    north, south : (n, k, orders), filled: C_m of f = sum_m Re[C_m e^(i m longitude)].

    The others are those of `at_points`.
    """
    n, functions = north.shape[0], north.shape[1]
    tq, q2, root, q = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    widest = 0.0
    for j in range(n):
        s, z = places[j, 0], places[j, 1]
        r2 = s * s + z * z
        tq[j], q2[j], root[j], q[j] = z / r2, 1.0 / r2, math.sqrt(s / r2), 1.0 / math.sqrt(r2)
        widest = max(widest, s * q[j])
    even, odd = np.empty((2 * functions, n)), np.empty((2 * functions, n))
    work = np.empty((8, n))
    north[:] = 0.0
    south[:] = 0.0
    for m in range(highest_order(degree, seeds.size - 1, widest) + 1):
        rows = (starts[m], starts[m + 1])
        column(recursion, coefficients, rows, seeds[m], tq, q2, work, even, odd)
        for j in range(n):
            # In two steps, neither of which leaves the range of a double.
            half = root[j] ** m / SCALE
            for k in range(functions):
                e = complex(even[2 * k, j], even[2 * k + 1, j]) * half * (half * q[j])
                o = complex(odd[2 * k, j], odd[2 * k + 1, j]) * half * (half * q[j])
                north[j, k, m] = e + o
                south[j, k, m] = e - o


@compiled
def turn_to_ned(
    fields: Floats,
    latitude: Floats,
    longitude: Floats,
    vector: Floats,
    tensor: Floats,
) -> None:
    """Turn vector and tensor from Earth-centred axes x, y, z into north, east, down.

    Parameters
    ----------
    fields : (n, 3 or 8): x, y, z and, if asked for, xx, xy, xz, yy, yz.
    latitude, longitude : (n, 2) cosine and sine of the geodetic latitude and longitude.
    vector, tensor : (n, 3), and (n, 3, 3) or (0, 3, 3) without a tensor; filled.
    """
    for i in range(fields.shape[0]):
        cp, sp = latitude[i, 0], latitude[i, 1]
        cl, sl = longitude[i, 0], longitude[i, 1]
        x, y, z = fields[i, 0], fields[i, 1], fields[i, 2]
        out = cl * x + sl * y  # away from the axis
        vector[i, 0] = cp * z - sp * out
        vector[i, 1] = cl * y - sl * x
        vector[i, 2] = -cp * out - sp * z
        if tensor.shape[0] == 0:
            continue
        xx, xy, xz, yy, yz = fields[i, 3], fields[i, 4], fields[i, 5], fields[i, 6], fields[i, 7]
        oo = cl * cl * xx + 2.0 * cl * sl * xy + sl * sl * yy
        oe = cl * sl * (yy - xx) + (cl * cl - sl * sl) * xy
        oz, ez, zz = cl * xz + sl * yz, cl * yz - sl * xz, -(xx + yy)
        nn = sp * sp * oo - 2.0 * sp * cp * oz + cp * cp * zz
        ee = sl * sl * xx - 2.0 * cl * sl * xy + cl * cl * yy
        ne, ed = cp * ez - sp * oe, -cp * oe - sp * ez
        nd = sp * cp * (oo - zz) + (sp * sp - cp * cp) * oz
        tensor[i, 0, 0], tensor[i, 0, 1], tensor[i, 0, 2] = nn, ne, nd
        tensor[i, 1, 0], tensor[i, 1, 1], tensor[i, 1, 2] = ne, ee, ed
        tensor[i, 2, 0], tensor[i, 2, 1], tensor[i, 2, 2] = nd, ed, -(nn + ee)
