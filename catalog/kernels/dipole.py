"""Exact field and gradient tensor of point dipoles: the truth that samples and tests rest on."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtiles.catalog.kernels.geodesy import FLATTENING, SEMI_MAJOR_AXIS_M

Floats = NDArray[np.float64]

_MU0_4PI = 100.0  # 1e-7 T m/A in nT m/A
_PER_KM = 1e3
_PAIRS = 50_000  # point-dipole pairs at once: their arrays stay in cache

TENSOR = ("nn", "ne", "nd", "ee", "ed")
"""Order of the five independent tensor components; dd = -(nn + ee)."""


def dipole_field(points: Floats, positions: Floats, moments: Floats) -> tuple[Floats, Floats]:
    """Field and gradient tensor of dipoles in one Cartesian frame (local NED, ECEF, any other).

    With r from the dipole to the point and m its moment (Blakely 1995, eq. 4.14)::

        B_i  = mu0/4pi [3 (m.r) r_i / r^5 - m_i / r^3]
        dB_i/dx_j = mu0/4pi [3 (m_i r_j + m_j r_i + (m.r) delta_ij) / r^5 - 15 (m.r) r_i r_j / r^7]

    Parameters
    ----------
    points, positions : (n, 3) and (k, 3), metres.
    moments : (k, 3), A m^2.

    Returns
    -------
    field (n, 3) in nT and tensor (n, 3, 3) in nT/km, symmetric and traceless. At a dipole's
    own position they are not finite.
    """
    field = np.empty((len(points), 3))
    tensor = np.empty((len(points), 3, 3))
    step = max(1, _PAIRS // max(1, len(positions)))
    for start in range(0, len(points), step):
        part = slice(start, start + step)
        field[part], tensor[part] = _sum_over_dipoles(points[part], positions, moments)
    return _MU0_4PI * field, _MU0_4PI * _PER_KM * tensor


def dipole_vector(points: Floats, positions: Floats, moments: Floats) -> Floats:
    """The field (n, 3) of `dipole_field`, nT, without its gradient: takes half as long."""
    field = np.empty((len(points), 3))
    step = max(1, _PAIRS // max(1, len(positions)))
    for start in range(0, len(points), step):
        part = slice(start, start + step)
        field[part] = _vector_of(*_pairs(points[part], positions, moments))
    return _MU0_4PI * field


_Pairs = tuple[Floats, Floats, Floats, Floats, Floats, Floats]


def _pairs(p: Floats, s: Floats, m: Floats) -> _Pairs:
    """Points, positions, moments, and of each pair (n, k): r^2, 3 / r^5, 3 (m.r) / r^5."""
    # Every sum over dipoles is a matrix product once r = p - s is multiplied out. About the
    # points' own centre that costs no more than some 1e-12 of accuracy.
    centre = p.mean(axis=0)
    p, s = p - centre, s - centre
    r2 = (p**2).sum(axis=1)[:, None] + (s**2).sum(axis=1) - 2.0 * (p @ s.T)
    e = 3.0 / (r2**2 * np.sqrt(r2))
    return p, s, m, r2, e, (p @ m.T - (s * m).sum(axis=1)) * e


def _vector_of(p: Floats, s: Floats, m: Floats, r2: Floats, e: Floats, b: Floats) -> Floats:
    vector: Floats = b.sum(axis=1)[:, None] * p - b @ s - (e * r2 / 3.0) @ m
    return vector


def _sum_over_dipoles(p: Floats, s: Floats, m: Floats) -> tuple[Floats, Floats]:
    p, s, m, r2, e, b = pairs = _pairs(p, s, m)
    c = 5.0 * b / r2  # 15 (m.r) / r^7

    # sum of e m_i r_j, of c r_i r_j
    m_s = (m[:, :, None] * s[:, None, :]).reshape(-1, 9)
    s_s = (s[:, :, None] * s[:, None, :]).reshape(-1, 9)
    m_r_j = (e @ m)[:, :, None] * p[:, None, :] - (e @ m_s).reshape(-1, 3, 3)
    p_s = p[:, :, None] * (c @ s)[:, None, :]
    r_r = p[:, :, None] * p[:, None, :] * c.sum(axis=1)[:, None, None]
    r_r = r_r - p_s - p_s.transpose(0, 2, 1) + (c @ s_s).reshape(-1, 3, 3)
    tensor = m_r_j + m_r_j.transpose(0, 2, 1) + b.sum(axis=1)[:, None, None] * np.eye(3) - r_r
    return _vector_of(*pairs), tensor


def dipole_field_geodetic(
    latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike, positions: Floats, moments: Floats
) -> tuple[Floats, Floats]:
    """Field and tensor of dipoles in the true north, east, down frame of each point.

    Parameters
    ----------
    latitude, longitude, height : WGS84 geodetic degrees and metres; broadcast to (...).
    positions, moments : (k, 3) ECEF metres and (k, 3) ECEF A m^2.

    Returns
    -------
    vector (..., 3) nT north, east, down, and tensor (..., 5) nT/km in the order of `TENSOR`.
    """
    lat, lon, h = np.broadcast_arrays(
        *(np.asarray(a, dtype=np.float64) for a in (latitude, longitude, height))
    )
    points = geodetic_to_ecef(lat, lon, h).reshape(-1, 3)
    field, tensor = dipole_field(points, positions, moments)
    axes = ned_axes(lat, lon).reshape(-1, 3, 3)
    vector = np.einsum("pia,pa->pi", axes, field)
    rotated = axes @ tensor @ axes.transpose(0, 2, 1)
    five = rotated[:, [0, 0, 0, 1, 1], [0, 1, 2, 1, 2]]
    return vector.reshape(*lat.shape, 3), five.reshape(*lat.shape, 5)


def geodetic_to_ecef(latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike) -> Floats:
    """Earth-centred, Earth-fixed (..., 3) metres of WGS84 degrees and ellipsoidal metres."""
    phi, lam = np.radians(latitude), np.radians(longitude)
    h = np.asarray(height, dtype=np.float64)
    e2 = FLATTENING * (2.0 - FLATTENING)
    n = SEMI_MAJOR_AXIS_M / np.sqrt(1.0 - e2 * np.sin(phi) ** 2)
    x = (n + h) * np.cos(phi) * np.cos(lam)
    y = (n + h) * np.cos(phi) * np.sin(lam)
    z = (n * (1.0 - e2) + h) * np.sin(phi)
    return np.stack(np.broadcast_arrays(x, y, z), axis=-1)


def ned_axes(latitude: ArrayLike, longitude: ArrayLike) -> Floats:
    """Rows north, east, down as ECEF unit vectors, (..., 3, 3); local = axes @ ecef."""
    phi, lam = np.broadcast_arrays(np.radians(latitude), np.radians(longitude))
    sin_p, cos_p, sin_l, cos_l = np.sin(phi), np.cos(phi), np.sin(lam), np.cos(lam)
    north = np.stack([-sin_p * cos_l, -sin_p * sin_l, cos_p], axis=-1)
    east = np.stack([-sin_l, cos_l, np.zeros_like(phi)], axis=-1)
    down = np.stack([-cos_p * cos_l, -cos_p * sin_l, -sin_p], axis=-1)
    return np.stack([north, east, down], axis=-2)
