"""One sigma of a continued map's own error, for total, vector and tensor.

Four independent parts are added in quadrature: the survey's noise, carried through the
transform's own gain; the shortest wavelengths, which the transform fades out; what the survey's
lines could not resolve (aliasing); and the want of data in voids and beyond the border. The
second and third are larger where the map is rough.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numba import njit
from numpy.typing import NDArray

from magtiles.stages.field.interpolate import evaluate_linear
from magtiles.stages.field.missing import MissingData, missing_data, thin_map
from magtiles.stages.field.prepare import PlaneMap
from magtiles.stages.field.solve import AnomalousField
from magtiles.stages.field.spectral import TENSOR, VECTOR, Inversion, fade

Real = NDArray[np.float64]
Single = NDArray[np.float32]

GROUPS = ("total", "vector", "tensor")
_FLOOR = {"total": 1e-3, "vector": 1e-3, "tensor": 1e-6}
_PER_KM2 = 1e6
_ROWS = 256


@dataclass(frozen=True)
class Budget:
    """The parts of a level's uncertainty that hold for the whole map.

    Attributes
    ----------
    noise, alias : variance of each group per unit variance of the survey's noise, and of its
        anomaly.
    faded : mean square of what the window takes of each group.
    signal : variance of the anomaly where it was measured, nT^2.
    missing : variance for want of data.
    """

    noise: Mapping[str, float]
    faded: Mapping[str, float]
    alias: Mapping[str, float]
    signal: float
    missing: MissingData

    def sigma(self, survey: Real, row: Real, column: Real) -> dict[str, Single]:
        """Sigma of each product group at fractional rows and columns of the map.

        `survey`: variance of the survey's own values there, nT^2. "total" and "vector" in nT,
        "tensor" in nT/km; vector and tensor per component, rms over the components.
        """
        out = {group: np.empty(row.shape, np.float32) for group in GROUPS}
        # Some rows at a time: all that is added up would else be in memory at once.
        for first in range(0, row.shape[0], _ROWS):
            part = slice(first, first + _ROWS)
            here = row[part], column[part]
            rough = self.missing.at("roughness", *here)
            own = survey[part] if survey.ndim else survey
            for group in GROUPS:
                out[group][part] = np.sqrt(
                    own * self.noise[group]
                    + rough * (self.faded[group] + self.signal * self.alias[group])
                    + self.missing.at(group, *here)
                    + _FLOOR[group] ** 2
                )
        return out


def budget(
    grid: xr.Dataset, plane_map: PlaneMap, field: AnomalousField, height_gain: float
) -> Budget:
    """The uncertainty of a map that was transformed at once, `height_gain` m above it."""
    noise_variance = float(np.mean(plane_map.sigma**2))
    measured = plane_map.values[~(plane_map.void | plane_map.beyond)]
    direction = field.inversion.direction
    return Budget(
        noise_gain(field, height_gain),
        faded_power(field, height_gain, noise_variance),
        alias_gain(grid, field.inversion, height_gain),
        float(np.var(measured)),
        missing_data(thin_map(plane_map), field.padding, direction, height_gain),
    )


def survey_variance(plane_map: PlaneMap, row: Real, column: Real) -> Real:
    """Variance of the survey's own values (nT^2) at fractional rows and columns of a map."""
    return np.asarray(_sample(plane_map.sigma, row, column) ** 2)


def noise_gain(field: AnomalousField, height_gain: float) -> dict[str, float]:
    """Variance of each group per unit variance of white noise on the map's nodes (Parseval)."""
    return noise_gain_of(field.inversion, height_gain, field.noise_to_signal)


def noise_gain_of(
    inversion: Inversion, height_gain: float, noise_to_signal: float
) -> dict[str, float]:
    """`noise_gain` of a transform that is not at hand."""
    return group_means(
        inversion, inversion.wavenumbers.continuation(height_gain, noise_to_signal) ** 2
    )


def faded_power(
    field: AnomalousField, height_gain: float, noise_variance: float
) -> dict[str, float]:
    """Mean square (nT^2, nT^2/km^2) of what the window takes from each group, less its noise.

    From the map's own spectrum; what the window fades of the survey's noise is no loss.
    """
    interior = field.padding.map_shape[0] * field.padding.map_shape[1]
    power = np.abs(field.total) ** 2 / interior - noise_variance
    return lost_power(field.inversion, power, height_gain)


def lost_power(inversion: Inversion, power: Real, height_gain: float) -> dict[str, float]:
    """Mean square of what the window takes from each group of a total of that spectral power."""
    w = inversion.wavenumbers
    lost = ((1.0 - w.window) * np.exp(-w.k * max(height_gain, 0.0))) ** 2
    return {group: max(mean, 0.0) for group, mean in group_means(inversion, lost * power).items()}


def group_means(inversion: Inversion, total_power: Real) -> dict[str, float]:
    """Mean variance of each group's components, from the spectral power of the total."""
    w = inversion.wavenumbers
    sums = group_sums(
        total_power, w.y[:, 0], w.x[0], w.multiplicity[0], inversion.direction, inversion.damping
    )
    count = w.shape[0] * w.shape[1]
    return {
        "total": sums[0] / count,
        "vector": sums[1] / len(VECTOR) / count,
        "tensor": sums[2] * _PER_KM2 / len(TENSOR) / count,
    }


@njit(cache=True, nogil=True)
def group_sums(
    total_power: Real,
    ky: Real,
    kx: Real,
    multiplicity: Real,
    direction: tuple[float, float, float],
    damping: float,
) -> tuple[float, float, float]:
    """Sum of power of the total, of the vector's components and of the tensor's five (per m^2).

    With p the potential's power the vector's is 2 k^2 p, the tensor's (2 k^4 - ky^2 kx^2) p.
    """
    fy, fx, fd = direction
    total = vector = tensor = 0.0
    for i in range(ky.size):
        for j in range(kx.size):
            power = total_power[i, j] * multiplicity[j]
            total += power
            y2, x2 = ky[i] * ky[i], kx[j] * kx[j]
            k2 = y2 + x2
            if k2 > 0.0:
                projected = k2 * fd * fd + (ky[i] * fy + kx[j] * fx) ** 2
                potential = power * projected / (projected + damping * damping * k2) ** 2
                vector += 2.0 * k2 * potential
                tensor += (2.0 * k2 * k2 - y2 * x2) * potential
    return total, vector, tensor


def alias_gain(grid: xr.Dataset, inversion: Inversion, height_gain: float) -> dict[str, float]:
    """Variance of each group per unit variance of the anomaly, from structure between the lines.

    At a height h over its sources a field's power falls as exp(-2 k h), so that the fraction
    exp(-2 pi h / dx) lies beyond the Nyquist wavenumber K = pi / dx of lines dx apart (Canciani
    and Raquet 2016, eq. 1). It is folded to 2K - k, windowed and continued upward from there.
    Zero where the grid does not state `line_spacing_m` and `source_distance_m`.
    """
    if "line_spacing_m" not in grid.attrs or "source_distance_m" not in grid.attrs:
        return dict.fromkeys(GROUPS, 0.0)
    spacing, distance = float(grid.attrs["line_spacing_m"]), float(grid.attrs["source_distance_m"])
    nyquist = np.pi / spacing
    k = nyquist * (np.arange(400) + 0.5) / 400
    folded = np.exp(-2 * (nyquist - k) * distance)
    weight = folded / folded.sum() * np.exp(-2 * nyquist * distance)
    cell = max(inversion.wavenumbers.spacing)
    lifted = weight * (fade(k * cell / np.pi) * np.exp(-k * height_gain)) ** 2
    ring = _ring(inversion)
    return {
        "total": float(lifted.sum()),
        "vector": float(lifted.sum()) * ring["vector"],
        "tensor": float((lifted * k**2).sum()) * ring["tensor"] * _PER_KM2,
    }


def _ring(inversion: Inversion) -> dict[str, float]:
    """Mean over azimuth of the vector's and (per k^2) the tensor's power, per power of total."""
    azimuth = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    y, x = np.cos(azimuth), np.sin(azimuth)
    fy, fx, fd = inversion.direction
    power = fd**2 + (fy * y + fx * x) ** 2
    gain = power / (power + inversion.damping**2) ** 2
    return {
        "vector": float(np.mean(gain)) * 2 / len(VECTOR),
        "tensor": float(np.mean(gain * (2 - (y * x) ** 2))) / len(TENSOR),
    }


def _sample(sigma: Real, row: Real, column: Real) -> Real:
    if sigma.ndim == 0:
        return np.asarray(sigma)
    out = np.empty(row.shape)
    evaluate_linear(sigma, row, column, 1.0, 0.0, out)
    return out
