"""Gauss coefficients with known fields, and the textbook sum: truth for models and harmonics."""

from __future__ import annotations

import math

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from magtiles.catalog.models import FieldModel

Floats = NDArray[np.float64]

RADIUS_KM = 6371.2
_MU0_4PI = 100.0  # 1e-7 T m/A in nT m/A


def static(gauss: Floats, name: str = "test") -> FieldModel:
    """A model of Gauss coefficients (k,) that does not change."""
    n_max = math.isqrt(len(gauss) + 1) - 1
    forever = (-math.inf, math.inf)
    return FieldModel(name, 1, n_max, RADIUS_KM, np.array([2020.0]), gauss[None], None, forever)


def random_crust(n_min: int, n_max: int, rms_nt: float, seed: int = 1) -> Floats:
    """Gauss coefficients of a field of `rms_nt` at the reference radius, every degree alike."""
    rng = np.random.default_rng(seed)
    n = np.floor(np.sqrt(np.arange(n_max * (n_max + 2)) + 1))
    power = rms_nt**2 / (n_max - n_min + 1) / ((n + 1) * (2 * n + 1))
    return np.where(n >= n_min, np.sqrt(power) * rng.normal(size=len(n)), 0.0)


def dipole_gauss(n_max: int, position: Floats, moment: Floats) -> Floats:
    """Coefficients, nT, of a dipole at an Earth-centred place (m) with a moment (A m^2).

    The addition theorem (Blakely 1995, ch. 6) expands 1 / |r - s| about the centre; the dipole's
    potential is its derivative with respect to the source s along the moment.
    """
    x, y, z = position
    r, rho, lon = float(np.linalg.norm(position)), math.hypot(x, y), math.atan2(y, x)
    t, u = z / r, rho / r
    radial = np.array([x, y, z]) / r
    south = np.array([t * math.cos(lon), t * math.sin(lon), -u])
    east = np.array([-math.sin(lon), math.cos(lon), 0.0])
    p_r, p_s, p_e = (float(moment @ axis) for axis in (radial, south, east))
    s = schmidt(n_max, t)
    a = RADIUS_KM * 1000.0
    gauss = np.zeros(n_max * (n_max + 2))
    for n in range(1, n_max + 1):
        m = np.arange(n + 1)
        size = _MU0_4PI * (r / a) ** n / (r * a * a)
        slope = (n * t * s[n, : n + 1] - np.sqrt(n * n - m * m) * s[n - 1, : n + 1]) / u
        c = (p_r * n * s[n, : n + 1] + p_s * slope) * np.exp(1j * m * lon)
        c = size * (c + 1j * m * p_e * s[n, : n + 1] / u * np.exp(1j * m * lon))
        row = gauss[n * n - 1 : n * n + 2 * n]
        row[0], row[1::2], row[2::2] = c[0].real, c[1:].real, c[1:].imag
    return gauss


def schmidt(n_max: int, t: float) -> Floats:
    """S_nm(t) by plain recursion; what underflows beside the pole is smaller than 1e-300."""
    u = math.sqrt(1.0 - t * t)
    s = np.zeros((n_max + 1, n_max + 2))
    s[0, 0], s[1, 0], s[1, 1] = 1.0, t, u
    for n in range(2, n_max + 1):
        m = np.arange(n)
        root = np.sqrt(n * n - m * m)
        before = np.sqrt(np.maximum((n - 1) ** 2 - m * m, 0.0)) * s[n - 2, :n]
        s[n, :n] = ((2 * n - 1) * t * s[n - 1, :n] - before) / root
        s[n, n] = math.sqrt((2 * n - 1) / (2 * n)) * u * s[n - 1, n - 1]
    return s


def textbook_field(gauss: Floats, latitude: float, longitude: float, radius_m: float) -> Floats:
    """North, east, down in geocentric axes, by the sums as every report prints them.

    Legendre functions and their derivatives come from NumPy's polynomials (degree 15 or less).
    """
    theta, lam = math.radians(90.0 - latitude), math.radians(longitude)
    t, u = math.cos(theta), math.sin(theta)
    north = east = down = 0.0
    for n in range(1, math.isqrt(len(gauss) + 1)):
        q = (RADIUS_KM * 1000.0 / radius_m) ** (n + 2)
        for m in range(n + 1):
            norm = math.sqrt((2 - (m == 0)) * math.factorial(n - m) / math.factorial(n + m))
            pn = legendre.legder(np.eye(n + 1)[n], m)
            value = u**m * legendre.legval(t, pn)
            slope = m * u ** (m - 1) * t * legendre.legval(t, pn) if m else 0.0
            slope -= u ** (m + 1) * legendre.legval(t, legendre.legder(pn))
            g = gauss[n * n - 1 + (2 * m - 1 if m else 0)]
            h = gauss[n * n - 1 + 2 * m] if m else 0.0
            along = g * math.cos(m * lam) + h * math.sin(m * lam)
            across = g * math.sin(m * lam) - h * math.cos(m * lam)
            north += q * norm * slope * along
            east += q * norm * m * value / u * across
            down -= q * norm * (n + 1) * value * along
    return np.array([north, east, down])


def shc_text(model: FieldModel) -> str:
    """The model as an SHC file, all digits."""
    lines = ["# made by a test", f"{model.n_min} {model.n_max} {len(model.epochs)} 2 1"]
    lines.append(" ".join(repr(float(e)) for e in model.epochs))
    for n in range(model.n_min, model.n_max + 1):
        for i in range(2 * n + 1):
            m = (i + 1) // 2 * (1 if i % 2 else -1)
            values = " ".join(repr(float(v)) for v in model.coefficients[:, n * n - 1 + i])
            lines.append(f"{n} {m} {values}")
    return "\n".join(lines) + "\n"


def cof_rows(gauss: Floats, n_min: int = 1, order: int = 10_000, *more: Floats) -> list[str]:
    """Rows ``n m g h [dg dh]`` of a COF file."""
    rows = []
    for n in range(n_min, math.isqrt(len(gauss) + 1)):
        for m in range(min(n, order) + 1):
            g, h = n * n - 1 + (2 * m - 1 if m else 0), n * n - 1 + 2 * m
            values = [float(v) for c in (gauss, *more) for v in (c[g], c[h] if m else 0.0)]
            rows.append(f"{n:4d}{m:4d} " + " ".join(map(repr, values)))
    return rows
