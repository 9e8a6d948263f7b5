"""Carrying an anomaly map forward in time: what its rocks do under the core field of today.

The crustal field is largely induced, and the inducing field changes (Canciani and Raquet 2016,
sec. III): in the decades since a survey its direction may turn by several degrees.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import ndimage

from magtiles.catalog.flags import QualityFlag, flag_attributes
from magtiles.schemas.errors import ContractError
from magtiles.stages.declare import OPTIONAL_FILE, IsoDate, Params, Stage, quantity
from magtiles.stages.field.core_field import NO_REFERENCE, Core, with_anomaly
from magtiles.stages.field.geometry import axes, is_geographic
from magtiles.stages.field.padding import Padding, plan_padding
from magtiles.stages.field.plane import STEP_DEG, STEP_M, Plane, on_lattice
from magtiles.stages.field.prepare import PlaneMap, prepare
from magtiles.stages.field.rereference import MIXED
from magtiles.stages.field.spectral import (
    LOW_INCLINATION_SINE,
    Complex,
    Inversion,
    Wavenumbers,
    forward,
    inverse,
)
from magtiles.stages.ingest.field_model import igrf, igrf_coefficients, named_model

Real = NDArray[np.float64]

_ANCHORS = 3
"""Places along each axis whose own field directions are used; the rest follows by parabolas."""
_AZIMUTHS = 64
_FADE_CELLS = 6


class CarryForwardParams(Params):
    """Parameters of carry-forward."""

    reference_epoch: IsoDate = quantity("1", doc="Date to carry the map to.")
    reference_field: str | None = quantity(
        "1", default=None, min_length=1, doc="Core field model then; default the grid's own."
    )
    allow_extrapolated: bool = quantity(
        "1", default=False, doc="Permit dates outside the span that a model is valid for."
    )


class Fields(NamedTuple):
    """The core fields that the map was made under and is carried to."""

    old: Core
    new: Core
    height: float

    def at(self, plane: Plane, y: Real, x: Real) -> tuple[Real, Real]:
        """Both fields, old and new, along the plane's axes y, x, down; (..., 3) nT."""
        latitude, longitude = plane.geographic(x, y)
        north_x, north_y = plane.north(latitude, longitude)
        turned = []
        for core in (self.old, self.new):
            north, east, down = np.moveaxis(
                core.vector(latitude, longitude, np.full(np.shape(latitude), self.height)), -1, 0
            )
            along = north * north_y - east * north_x, north * north_x + east * north_y, down
            turned.append(np.stack(along, axis=-1))
        return turned[0], turned[1]


def carry_forward(
    grid: xr.Dataset,
    *,
    params: CarryForwardParams,
    old_model: Path | None = None,
    new_model: Path | None = None,
) -> xr.Dataset:
    """The total-field anomaly (nT) of a filled grid under the core field of another date.

    Assumed is that all magnetisation is induced: parallel to the core field and proportional
    to its strength. Each wavenumber of the anomaly holds theta = k f_d + i (k_y f_y + k_x f_x)
    once for the direction f that it is measured along and once for that of the magnetisation
    (Blakely 1995, sec. 12.3), so that::

        T_new = T_old (F_new / F_old) (theta_new / theta_old)^2

    `magnetization_assumption` says "induced". Remanent magnetisation does not turn; where it
    prevails, the map should not be carried. The sigma stays the survey's own: what the
    assumption costs is not in it, nor what sources beyond the border do, which no map tells;
    a low inclination or a turn of ten degrees carries that far inside. Where either field's
    inclination is below 20 degrees the division is damped, and flagged.

    The directions of all core models agree within hundredths of a degree: the newest IGRF
    stands in for one that is not at hand. Raises ContractError when the grid has voids or no
    reference field, and what the models do for dates they do not cover.
    """
    fields = _fields(grid, params, old_model, new_model)
    plane_map = prepare(grid)
    change = _at_nodes(grid, plane_map, change_on_plane(plane_map, fields))
    anomaly = grid["magnetic_anomaly"].values.astype(np.float64) + change
    out = _flag_low_inclination(with_anomaly(grid, anomaly), plane_map.plane, fields)
    name, epoch = str(grid.attrs["reference_field"]), str(grid.attrs["reference_epoch"])
    return out.assign_attrs(
        reference_field=name if name.lower() == MIXED else fields.new.model.name,
        reference_epoch=params.reference_epoch,
        anomaly_definition=f"{grid.attrs['anomaly_definition']}; carried from {epoch} to "
        f"{params.reference_epoch}, all magnetisation taken as induced{fields.new.note}",
        magnetization_assumption="induced",
    )


def _fields(
    grid: xr.Dataset, params: CarryForwardParams, old_model: Path | None, new_model: Path | None
) -> Fields:
    name = str(grid.attrs["reference_field"])
    if name == NO_REFERENCE:
        raise ContractError(
            "no reference field was removed from this grid",
            where="reference_field 'none'",
            remedy="run remove-core-field first",
        )
    cores = []
    for field, epoch, file, role in (
        (name, str(grid.attrs["reference_epoch"]), old_model, "old_model"),
        (params.reference_field or name, params.reference_epoch, new_model, "new_model"),
    ):
        at_hand = file is not None or igrf_coefficients(field) is not None
        stands_in = not at_hand and field != params.reference_field
        model = igrf() if stands_in else named_model(field, file, role=role)
        cores.append(Core(model, epoch, params.allow_extrapolated))
    height = np.asarray(grid["height"].values, np.float64)
    if "reference_surface_height" in grid:
        height = height + grid["reference_surface_height"].values
    # Within kilometres of height the direction changes by thousandths of a degree.
    return Fields(cores[0], cores[1], float(np.nanmean(height)))


def change_on_plane(plane_map: PlaneMap, fields: Fields) -> Real:
    """What is added to a map (ny, nx), nT.

    The factor's directions are those of the place: it is applied for the directions at
    Chebyshev points of the map, and the results are joined by the polynomials through them.
    """
    spacing = plane_map.spacing
    padding = plan_padding((plane_map.y.size, plane_map.x.size), spacing, 0.0)
    wavenumbers = Wavenumbers(padding.shape, spacing)
    total = forward(extend(plane_map.values, padding)) * wavenumbers.window
    (ys, down), (xs, across) = (_anchors(axis) for axis in (plane_map.y, plane_map.x))
    out = np.zeros(plane_map.values.shape)
    for y, along_y in zip(ys, down, strict=True):
        for x, along_x in zip(xs, across, strict=True):
            old, new = fields.at(plane_map.plane, np.array(y), np.array(x))
            out += np.multiply.outer(along_y, along_x) * _changed(
                total, wavenumbers, padding, old, new
            )
    return out


def extend(values: Real, padding: Padding) -> Real:
    """The map with some mirrored cells around it, which fade into its mean.

    A mirrored anomaly is one of rocks magnetised the mirrored way: the farther it goes on, the
    more it changes wrongly. Six cells do better than none or `padding.pad`'s long taper.
    """
    tapers = []
    for before, count, total in zip(padding.offset, padding.map_shape, padding.shape, strict=True):
        beyond = np.abs(np.arange(total) - before - (count - 1) / 2) - (count - 1) / 2
        tapers.append(0.5 + 0.5 * np.cos(np.pi * np.clip(beyond / (_FADE_CELLS + 1), 0.0, 1.0)))
    widths = [
        (before, total - before - count)
        for before, count, total in zip(
            padding.offset, padding.map_shape, padding.shape, strict=True
        )
    ]
    mean = values.mean()
    mirrored = np.pad(values - mean, widths, mode="reflect" if min(values.shape) > 1 else "edge")
    return np.asarray(mirrored * np.multiply.outer(*tapers) + mean)


def _anchors(axis: Real) -> tuple[Real, Real]:
    """Chebyshev points over an axis (n,), and the Lagrange polynomial of each there (k, n)."""
    middle, half = (axis[0] + axis[-1]) / 2, max((axis[-1] - axis[0]) / 2, 1.0)
    unit = np.cos(np.pi * (np.arange(_ANCHORS) + 0.5) / _ANCHORS)
    t = (axis - middle) / half
    basis = [np.prod([(t - v) / (u - v) for v in unit if v != u], axis=0) for u in unit]
    return middle + half * unit, np.stack(basis)


def _changed(
    total: Complex, wavenumbers: Wavenumbers, padding: Padding, old: Real, new: Real
) -> Real:
    """The change of a map (nT) between two fields (y, x, down; nT) that are the same everywhere."""
    strength = np.linalg.norm(old), np.linalg.norm(new)
    before, after = (
        Inversion(wavenumbers, (float(f[0]), float(f[1]), float(f[2])))
        for f in (old / strength[0], new / strength[1])
    )
    ratio = float(strength[1] / strength[0])
    # (r theta_new^2 - theta_old^2) / theta_old^2, which is exactly zero for equal fields.
    factor = (ratio * after.theta**2 - before.theta**2) * before.potential**2
    factor[0, 0] = _mean_change(before, after, ratio)
    factor *= total
    return np.asarray(inverse(factor, padding.shape, *padding.interior), np.float64)


def _mean_change(before: Inversion, after: Inversion, ratio: float) -> float:
    """The factor at the zero wavenumber, which has no direction: the mean over all azimuths."""
    azimuth = 2 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS
    old, new = (
        f[2] + 1j * (f[0] * np.cos(azimuth) + f[1] * np.sin(azimuth))
        for f in (before.direction, after.direction)
    )
    inverse_of_old = np.conj(old) / (np.abs(old) ** 2 + before.damping**2)
    return float(np.mean((ratio * new**2 - old**2) * inverse_of_old**2).real)


def _at_nodes(grid: xr.Dataset, plane_map: PlaneMap, change: Real) -> Real:
    """A change on the plane (ny, nx), at the grid's own nodes (rows, columns)."""
    plane = plane_map.plane
    if plane.is_source:
        return change
    x, y = on_lattice(lambda r, c: plane.from_source(c, r), *axes(grid), _step(grid))
    place = (
        (values - axis[0]) / step
        for values, axis, step in zip(
            (y, x), (plane_map.y, plane_map.x), plane_map.step, strict=True
        )
    )
    # A cubic's 0.3 % of some hundredths of the anomaly is nothing.
    return np.asarray(ndimage.map_coordinates(change, list(place), order=3, mode="nearest"))


def _flag_low_inclination(grid: xr.Dataset, plane: Plane, fields: Fields) -> xr.Dataset:
    """Flag nodes where the division is damped or nearly so."""

    def sines(row: Real, column: Real) -> tuple[Real, ...]:
        x, y = plane.from_source(column, row)
        return tuple(f[..., 2] / np.linalg.norm(f, axis=-1) for f in fields.at(plane, y, x))

    both = on_lattice(sines, *axes(grid), _step(grid))
    low = np.min(np.abs(both), axis=0) < LOW_INCLINATION_SINE
    if not low.any():
        return grid
    flags = np.zeros(low.shape, np.uint8)
    attributes = flag_attributes() | {"grid_mapping": "crs"}
    if "quality_flag" in grid:
        flags, attributes = grid["quality_flag"].values.copy(), grid["quality_flag"].attrs
    flags[low] |= np.uint8(QualityFlag.REDUCED_ACCURACY_DIRECTION)
    return grid.assign(quality_flag=(grid["magnetic_anomaly"].dims, flags, attributes))


def _step(grid: xr.Dataset) -> float:
    """How far apart smooth functions of position may be sampled, in the axes' unit."""
    return STEP_DEG if is_geographic(grid) else STEP_M


STAGE = Stage(
    name="carry-forward",
    version=1,
    params=CarryForwardParams,
    inputs={"grid": "anomaly-grid/1", "old_model": OPTIONAL_FILE, "new_model": OPTIONAL_FILE},
    output="anomaly-grid/1",
    run=carry_forward,
)
