"""Total, vector and tensor of an anomaly grid that goes all around the globe.

No plane holds a globe, and a map that crosses the dip equator with all declinations has no one
ambient direction: instead of a Fourier transform, spherical harmonics of the crust's potential are
fitted to the anomaly where it was measured (`sphere_fit`), and evaluated where it is wanted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from magtiles.catalog.flags import QualityFlag
from magtiles.catalog.kernels.dipole import geodetic_to_ecef
from magtiles.schemas.errors import ContractError, CoverageError
from magtiles.stages.declare import Params, Stage, quantity
from magtiles.stages.field.direction import DECLINATION_DEG, INCLINATION_DEG, AmbientSource
from magtiles.stages.field.geometry import axes, is_geographic, is_whole_circle
from magtiles.stages.field.harmonic_nodes import Circle, crust_products, static_model
from magtiles.stages.field.level import OF_DATUM, assemble_level, wgs84_variable
from magtiles.stages.field.prepare import sigma_of
from magtiles.stages.field.reuse import content_key, latest
from magtiles.stages.field.spectral import LOW_INCLINATION_SINE
from magtiles.stages.field.sphere_fit import GlobeData, SphereFit, fit
from magtiles.stages.field.sphere_operator import AnomalyOperator
from magtiles.stages.field.sphere_uncertainty import SphereError
from magtiles.stages.field.surface import surface_at
from magtiles.stages.field.target import Axis, geographic_target

Real = NDArray[np.float64]
Mask = NDArray[np.bool_]

HIGHEST_DEGREE = 720
"""A grid of 0.25 degrees: 1.5 GB of Legendre functions, and hours."""

_POLE_DEG = 1e-6
_METRES_A_DEGREE = 111_195.0


class SphereComponentsParams(Params):
    """Parameters of derive-components for a grid around the globe."""

    height_m: float = quantity("m", default=0.0, doc="Height gain above the survey.")
    allow_downward_continuation: bool = quantity(
        "1", default=False, doc="Permit a negative height gain (flagged)."
    )
    inclination_deg: float | None = INCLINATION_DEG
    declination_deg: float | None = DECLINATION_DEG
    latitude: Axis = quantity("degrees_north", doc="Nodes: first, spacing, count (WGS84).")
    longitude: Axis = quantity("degrees_east", doc="Nodes: first, spacing, count (WGS84).")


def is_globe(grid: xr.Dataset) -> bool:
    """Whether a grid's parallels go all around the globe."""
    return is_geographic(grid) and is_whole_circle(grid["longitude"].values)


def resolved_degree(grid: xr.Dataset) -> int:
    """The highest degree that a grid around the globe has nodes for (Nyquist)."""
    return int(180.0 / max(float(axis[1] - axis[0]) for axis in axes(grid)) + 1e-6)


def derive_globe_components(globe: xr.Dataset, *, params: SphereComponentsParams) -> xr.Dataset:
    """Nine products of a survey of the globe, `height_m` higher, with uncertainty and flags.

    Input anomaly-grid/1 (latitude, longitude) around the globe, voids and all, its coordinates
    taken for WGS84's (datums differ by less than a kilometre); output component-grid/1 on
    (latitude, longitude): nT, nT/km, NED. The total is f . B, f the ambient direction at the
    level. VOID_FILLED stands near nodes without data, as far as the height gained and at least a
    cell; BEYOND_COVERAGE poleward of the last parallel with data.

    Raises ContractError for a grid that does not go around or whose heights count from terrain,
    CoverageError for one too fine, without data, or a level below the survey without permission.
    """
    _check(globe, params)
    angles = params.inclination_deg, params.declination_deg
    key = content_key(globe), angles
    survey = latest("globe", key, lambda: _fitted(globe, AmbientSource(globe, *angles)))
    lifted = globe.assign(height=globe["height"] + params.height_m)
    ambient = AmbientSource(lifted, *angles)
    target = geographic_target(params.latitude, params.longitude)
    circle = Circle.of(target.columns, params.longitude[1])
    height_m = survey.height_m + params.height_m

    def along(latitude: Real, longitude: Real, vector: Real) -> tuple[Real, Real]:
        direction = np.stack(ambient.at(*np.meshgrid(latitude, longitude, indexing="ij")), axis=-1)
        return np.einsum("ijc,ijc->ij", direction, vector), direction

    crust = static_model("crust", survey.fit.coefficients)
    products, direction = crust_products(crust, target.rows, circle, height_m, along)
    place = target.rows, circle.longitude
    sigmas = {
        group: sigma[:, circle.again]
        for group, sigma in survey.error.sigmas(
            height_m, *place, lambda *p: ambient.at(*np.broadcast_arrays(*p))
        ).items()
    }
    flags = survey.flags(params.height_m, *place)[:, circle.again]
    flags[np.abs(direction.down) < LOW_INCLINATION_SINE] |= np.uint8(
        QualityFlag.REDUCED_ACCURACY_DIRECTION
    )
    level = assemble_level(
        ("latitude", "longitude"),
        (target.rows, target.columns),
        products,
        sigmas,
        direction,
        flags,
        height=xr.Variable((), float(lifted["height"]), globe["height"].attrs),
        crs=wgs84_variable(),
        attributes={k: v for k, v in globe.attrs.items() if k not in OF_DATUM},
    )
    if (surface := surface_at(globe, target)) is not None:
        level["reference_surface_height"] = surface
    return level


@dataclass(frozen=True)
class _Survey:
    """A fitted survey of the globe: `height_m` above the ellipsoid, voids (latitude, longitude)."""

    fit: SphereFit
    error: SphereError
    height_m: float
    voids: Real
    south: float
    north: float
    cell_m: float

    def flags(self, gain_m: float, latitude: Real, longitude: Real) -> NDArray[np.uint8]:
        """Flags (m, n) of what was not measured, at nodes (m,) by (n,) so much higher."""
        flags = np.zeros((latitude.size, longitude.size), np.uint8)
        reach = max(abs(gain_m), self.cell_m * (1.0 - 1e-6))
        if len(self.voids):
            tree = cKDTree(_places(self.voids[:, 0], self.voids[:, 1]))
            places = _places(*np.meshgrid(latitude, longitude, indexing="ij"))
            distance, _ = tree.query(places, distance_upper_bound=reach)
            flags[np.isfinite(distance).reshape(flags.shape)] |= np.uint8(QualityFlag.VOID_FILLED)
        inside = max(abs(gain_m) - self.cell_m, 0.0) / _METRES_A_DEGREE - _POLE_DEG
        beyond = (latitude < self.south + inside) | (latitude > self.north - inside)
        flags[beyond] |= np.uint8(QualityFlag.BEYOND_COVERAGE)
        if gain_m < 0.0:
            flags |= np.uint8(QualityFlag.DOWNWARD_CONTINUED)
        return flags


def _fitted(globe: xr.Dataset, ambient: AmbientSource) -> _Survey:
    """The crust of a survey of the globe, its error and its gaps."""
    latitude, longitude = axes(globe)
    values = globe["magnetic_anomaly"].values.astype(float)
    # A pole has no north and no longitude, and no area.
    inner = np.abs(latitude) < 90.0 - _POLE_DEG
    latitude, values = latitude[inner], values[inner]
    known = np.isfinite(values)
    sigma = np.broadcast_to(sigma_of(globe), globe["magnetic_anomaly"].shape)[inner]
    area = np.where(known, np.cos(np.radians(latitude))[:, None], 0.0)
    data = GlobeData(np.where(known, values, 0.0), area, sigma**2)
    rows = np.flatnonzero(known.any(axis=1))
    if rows.size < 2:
        raise CoverageError(
            f"{rows.size} parallels of the grid have data",
            where=globe.attrs.get("source"),
            expected="data around the globe",
            remedy="check no_data in the source's TOML",
        )
    height_m = _ellipsoidal_height(globe)
    direction = ambient.at(*np.meshgrid(latitude, longitude, indexing="ij"))
    operator = AnomalyOperator(latitude, longitude, height_m, direction, resolved_degree(globe))
    fitted = fit(operator, data)
    step = float(latitude[1] - latitude[0])
    south, north = (
        pole if 90.0 - abs(latitude[row]) < 1.5 * step else float(latitude[row])
        for pole, row in ((-90.0, rows[0]), (90.0, rows[-1]))
    )
    measured = slice(rows[0], rows[-1] + 1)
    gaps = np.argwhere(~known[measured])
    return _Survey(
        fitted,
        SphereError(fitted, latitude, float(longitude[0]), direction.down, height_m),
        height_m,
        np.stack([latitude[measured][gaps[:, 0]], longitude[gaps[:, 1]]], axis=-1),
        south,
        north,
        cell_m=_METRES_A_DEGREE * max(step, float(longitude[1] - longitude[0])),
    )


def _places(latitude: Real, longitude: Real) -> Real:
    """Earth-centred metres (n, 3) of nodes on the ellipsoid."""
    return geodetic_to_ecef(latitude.ravel(), longitude.ravel(), 0.0)


def _ellipsoidal_height(globe: xr.Dataset) -> float:
    """Height above the ellipsoid, m: waves of a degree hardly feel the geoid's 100 m (0.3 %)."""
    height = float(globe["height"])
    if "reference_surface_height" in globe:
        height += float(globe["reference_surface_height"].mean())
    return height


def _check(globe: xr.Dataset, params: SphereComponentsParams) -> None:
    where = globe.attrs.get("source")
    if not is_globe(globe):
        raise ContractError(
            "the grid does not go around the globe",
            where=where,
            expected="latitude and longitude, each meridian once",
            remedy="give it as grid=FILE: it is then a plane map",
        )
    if globe["height"].ndim or globe.attrs["height_reference"] == "terrain":
        raise ContractError(
            "heights of a grid around the globe follow terrain, or differ from node to node",
            where=where,
            expected="one height above the ellipsoid or mean sea level",
        )
    degree = resolved_degree(globe)
    if degree > HIGHEST_DEGREE:
        raise CoverageError(
            f"the grid resolves degree {degree}",
            where=where,
            expected=f"at most {HIGHEST_DEGREE} (a quarter of a degree) around the globe at once: "
            "memory grows with the cube of the degree (1.5 GB there), time likewise (hours)",
            remedy="cut it into regions that keep off the dip equator, or thin it by means",
        )
    if params.height_m < 0 and not params.allow_downward_continuation:
        raise CoverageError(
            f"a level {-params.height_m:g} m below the survey",
            where=where,
            expected="levels at or above the survey surface",
            remedy="raise it, or set allow_downward_continuation = true (flagged, noisier)",
        )


STAGE = Stage(
    name="derive-components",
    version=3,
    params=SphereComponentsParams,
    inputs={"globe": "anomaly-grid/1"},
    output="component-grid/1",
    run=derive_globe_components,
)
