"""A synthetic survey: dipoles under a core field, and the anomaly they make, exactly.

Point dipoles under and around the survey, the core field of IGRF (or a constant one), and the
anomaly as a magnetometer defines it, |F + B| - |F|: nothing is linearised.
"""

from __future__ import annotations

import datetime
from dataclasses import dataclass
from typing import Any

import numpy as np
import ppigrf
import pyproj
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray

from magtiles.catalog.kernels.dipole import dipole_field_geodetic, geodetic_to_ecef, ned_axes

Floats = NDArray[np.float64]

_DEGREE = 10  # Chebyshev degree of IGRF over a survey: below 1e-6 nT up to 5 degrees wide


@dataclass(frozen=True)
class ConstantField:
    """A core field that is the same everywhere: nT and degrees."""

    intensity: float
    inclination: float
    declination: float


@dataclass(frozen=True)
class SampleSpec:
    """What to synthesise. Metres, degrees and nT; heights above the WGS84 ellipsoid.

    Attributes
    ----------
    latitude, longitude : centre of the survey, in a projected `crs` that may be far from its own
        central meridian.
    levels_m : heights above `height_m` for the product and the truth.
    ambient : None for IGRF at `epoch`.
    depth_m : shallowest and deepest dipole below the survey surface.
    margin_m : how far dipoles reach beyond the border.
    rms_nt : of the noise-free anomaly on the survey.
    void, coast : leave out an enclosed ellipse, and a ragged strip along the western border.
    """

    name: str = "demo"
    crs: str = "EPSG:32610"
    latitude: float = 46.0
    longitude: float = -121.5
    width_m: float = 240e3
    length_m: float = 180e3
    spacing_m: float = 1000.0
    height_m: float = 1500.0
    levels_m: tuple[float, ...] = (2500.0, 3500.0, 5500.0, 9500.0)
    epoch: str = "1990-01-01"
    ambient: ConstantField | None = None
    dipoles: int = 600
    depth_m: tuple[float, float] = (1500.0, 12000.0)
    margin_m: float = 60e3
    rms_nt: float = 70.0
    noise_nt: float = 1.0
    line_spacing_m: float | None = 1000.0
    void: bool = True
    coast: bool = True
    seed: int = 20260101

    @property
    def reference_field(self) -> str:
        """Name of the core field the anomaly counts from."""
        return "IGRF-14" if self.ambient is None else f"constant {self.ambient.intensity:g} nT"

    @property
    def uncertainty_nt(self) -> float:
        """The noise, or where there is none the smallest that is worth stating."""
        return max(self.noise_nt, 0.01)


DEMO = SampleSpec()


@dataclass(frozen=True)
class Sample:
    """A synthetic survey and the sources it comes from.

    Attributes
    ----------
    x, y : nodes in the projected CRS, ascending, metres.
    latitude, longitude : of the nodes, (y, x), WGS84 degrees.
    anomaly : as surveyed, (y, x) nT: noise added, voids NaN.
    exact : the same without noise or voids.
    positions, moments : of the dipoles, ECEF, (k, 3) m and A m^2.
    """

    spec: SampleSpec
    x: Floats
    y: Floats
    latitude: Floats
    longitude: Floats
    anomaly: Floats
    exact: Floats
    positions: Floats
    moments: Floats

    def truth(
        self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike
    ) -> tuple[Floats, Floats, Floats]:
        """Exact anomaly at WGS84 degrees and ellipsoidal metres that broadcast to (...).

        Returns total (...) nT, vector (..., 3) nT north, east, down, and tensor (..., 5)
        nT/km: nn, ne, nd, ee, ed.
        """
        vector, tensor = dipole_field_geodetic(
            latitude, longitude, height, self.positions, self.moments
        )
        return _total(vector, self.ambient(latitude, longitude, height)), vector, tensor

    def ambient(self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike) -> Floats:
        """The core field, (..., 3) nT north, east, down."""
        return core_field(self.spec, latitude, longitude, height)


def synthesize(spec: SampleSpec = DEMO) -> Sample:
    """The survey that `spec` describes, the same for the same spec."""
    rng = np.random.default_rng(spec.seed)
    to_wgs84 = pyproj.Transformer.from_crs(spec.crs, "EPSG:4326", always_xy=True)
    x, y = _axes(spec, to_wgs84)
    longitude, latitude = (np.asarray(a) for a in to_wgs84.transform(*np.meshgrid(x, y)))
    positions, moments = _dipoles(spec, x, y, to_wgs84, rng)

    ambient = core_field(spec, latitude, longitude, spec.height_m)
    vector, _ = dipole_field_geodetic(latitude, longitude, spec.height_m, positions, moments)
    gain = spec.rms_nt / float(np.std(_total(vector, ambient)))
    exact = _total(gain * vector, ambient)

    anomaly = exact + rng.normal(0.0, spec.noise_nt, exact.shape)
    anomaly[_missing(spec, x, y, rng)] = np.nan
    return Sample(spec, x, y, latitude, longitude, anomaly, exact, positions, gain * moments)


def core_field(
    spec: SampleSpec, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike
) -> Floats:
    """The core field of a spec, (..., 3) nT north, east, down.

    IGRF has no wavelength below some 3000 km, so it is evaluated on Chebyshev nodes over the
    box around the points and interpolated, far below its own rounding.
    """
    place = np.broadcast_arrays(*(np.asarray(a, float) for a in (latitude, longitude, height)))
    if spec.ambient is not None:
        inc, dec = np.radians([spec.ambient.inclination, spec.ambient.declination])
        unit = np.cos(inc) * np.cos(dec), np.cos(inc) * np.sin(dec), np.sin(inc)
        return np.broadcast_to(spec.ambient.intensity * np.array(unit), (*place[0].shape, 3))
    return _interpolated_igrf(place, datetime.datetime.fromisoformat(spec.epoch))


def _total(vector: Floats, ambient: Floats) -> Floats:
    # |F + B| - |F| = B.(2F + B) / (|F + B| + |F|), which does not cancel.
    total: Floats = (vector * (2.0 * ambient + vector)).sum(axis=-1) / (
        np.linalg.norm(ambient + vector, axis=-1) + np.linalg.norm(ambient, axis=-1)
    )
    return total


def _axes(spec: SampleSpec, to_wgs84: pyproj.Transformer) -> tuple[Floats, Floats]:
    centre = to_wgs84.transform(spec.longitude, spec.latitude, direction="INVERSE")
    axes = []
    for middle, extent in zip(centre, (spec.width_m, spec.length_m), strict=True):
        count = round(extent / spec.spacing_m)
        first = np.round(middle / spec.spacing_m - 0.5 * count)
        axes.append((first + np.arange(count)) * spec.spacing_m)
    return axes[0], axes[1]


def _dipoles(
    spec: SampleSpec,
    x: Floats,
    y: Floats,
    to_wgs84: pyproj.Transformer,
    rng: np.random.Generator,
) -> tuple[Floats, Floats]:
    """Positions and moments, ECEF: half induced, half remanent in any direction."""
    k, margin = spec.dipoles, spec.margin_m
    east = rng.uniform(x[0] - margin, x[-1] + margin, k)
    north = rng.uniform(y[0] - margin, y[-1] + margin, k)
    shallowest, deepest = np.log(spec.depth_m)
    depth = np.exp(rng.uniform(shallowest, deepest, k))
    longitude, latitude = (np.asarray(a) for a in to_wgs84.transform(east, north))
    height = spec.height_m - depth
    ambient = core_field(spec, latitude, longitude, height)
    remanent = rng.normal(size=(k, 3))
    direction = _unit(ambient) + 0.7 * _unit(remanent)
    # Fields fall with the cube of the distance: this gives all depths like amplitudes.
    strength = rng.normal(size=k) * depth**3
    moments = np.einsum("ki,kia->ka", strength[:, None] * direction, ned_axes(latitude, longitude))
    return geodetic_to_ecef(latitude, longitude, height), moments


def _unit(vector: Floats) -> Floats:
    unit: Floats = vector / np.linalg.norm(vector, axis=-1, keepdims=True)
    return unit


def _missing(spec: SampleSpec, x: Floats, y: Floats, rng: np.random.Generator) -> Any:
    """Where the survey has no data, (y, x)."""
    missing = np.zeros((y.size, x.size), dtype=bool)
    if spec.coast:
        missing |= x - x[0] < _coastline(y, rng)[:, None]
    if spec.void:
        east = (x - (x[0] + 0.74 * (x[-1] - x[0]))) / 6000.0
        north = (y - (y[0] + 0.60 * (y[-1] - y[0]))) / 4000.0
        missing |= east**2 + north[:, None] ** 2 < 1.0
    return missing


def _coastline(y: Floats, rng: np.random.Generator) -> Floats:
    """How far the sea reaches in from the border: octaves of a fractal curve, metres."""
    turns = (y - y[0]) / (y[-1] - y[0])
    coast = np.full(y.size, 18e3)
    for octave in range(7):
        wave = np.sin(2.0 * np.pi * (2**octave * turns + rng.uniform()))
        coast += 8e3 * 2.0 ** (-0.7 * octave) * rng.normal() * wave
    inland: Floats = np.maximum(coast, 0.0)
    return inland


def _interpolated_igrf(place: Any, date: datetime.datetime) -> Floats:
    """IGRF at (latitude, longitude, height) arrays by Chebyshev interpolation over their box."""
    nodes, bases = [], []
    for values in place:
        low, high = float(values.min()), float(values.max())
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        degree = _DEGREE if half > 0.0 else 0
        points = chebyshev.chebpts1(degree + 1)
        nodes.append(middle + half * points)
        scaled = (values.ravel() - middle) / (half or 1.0)
        to_coefficients = np.linalg.inv(chebyshev.chebvander(points, degree))
        bases.append(chebyshev.chebvander(scaled, degree) @ to_coefficients)
    latitude, longitude, height = np.meshgrid(*nodes, indexing="ij")
    east, north, up = ppigrf.igrf(longitude, latitude, height / 1e3, date)
    field = np.stack([north[0], east[0], -up[0]], axis=-1)
    found: Floats = np.einsum("pi,pj,pk,ijkc->pc", *bases, field, optimize=True)
    return found.reshape(*place[0].shape, 3)
