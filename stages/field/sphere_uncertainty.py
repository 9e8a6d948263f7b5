"""One sigma of a globe's map, for total, vector and tensor, at every place.

Three independent parts:

- **Signal**: what the data do not determine, above all of the vector near the dip equator and in
  voids. Random crusts of the likely power go through the same fit; their errors are known.
- **Noise** of the survey, and what its nodes hold of still shorter waves, likewise.
- **Omission**: the degrees above the highest. Their power goes on exponentially from there, like
  that of sources at one depth, so that they make up what the fit leaves of the data.

The random crusts are alike everywhere, while the Earth is rough here and smooth there: all but the
survey's own noise is scaled by how strong the anomaly is around a place, against what is likely.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import brentq

from magtiles.catalog.models import evaluate_grid
from magtiles.catalog.models.model import REFERENCE_RADIUS_KM
from magtiles.stages.field.direction import Ambient
from magtiles.stages.field.harmonic_nodes import TENSOR_PARTS, static_model
from magtiles.stages.field.model_uncertainty import (
    SHALLOWEST_M,
    STORED_OF_TENSOR,
    field_variances,
)
from magtiles.stages.field.sphere_fit import SphereFit

Real = NDArray[np.float64]

_GROUPS = ("total", "vector", "tensor")
_LIMITS = 1 / 9, 9.0
_AROUND = 4.0
"""Over how many half waves of the highest degree the anomaly's strength is taken (1 sigma)."""

_FLOOR = {"total": 1e-3, "vector": 1e-3, "tensor": 1e-6}
_MOST_DEGREES = 4000


class SphereError:
    """The error of a fitted crust at any height.

    Parameters
    ----------
    crust : the fit.
    latitude, ambient_down : (rows,) degrees, and (rows, columns) sine of the inclination, of the
        survey's nodes; its columns go around from `west` degrees.
    height_m : of the survey above the ellipsoid.
    """

    def __init__(
        self, crust: SphereFit, latitude: Real, west: float, ambient_down: Real, height_m: float
    ) -> None:
        self._crust, self._survey_height = crust, height_m
        size = crust.degree
        self._step = 180.0 / size
        self._latitude: Real = -90.0 + self._step * (np.arange(size, dtype=np.float64) + 0.5)
        self._longitude: Real = -180.0 + self._step * (np.arange(2 * size, dtype=np.float64) + 0.5)
        steep = np.square(ambient_down)
        self._above = self._omitted(crust.data.mean(steep))
        strength = self._strength(latitude, steep)
        columns = 360.0 / strength.shape[1]
        place = [
            np.asarray(np.interp(self._latitude, latitude, np.arange(latitude.size))),
            np.asarray(np.mod(self._longitude - west, 360.0) / columns),
        ]
        self._rough = _bilinear(strength, *place)

    def sigmas(
        self,
        height_m: float,
        latitude: Real,
        longitude: Real,
        direction: Callable[[Real, Real], Ambient],
    ) -> dict[str, Real]:
        """1 sigma by "total", "vector" (nT) and "tensor" (nT/km), (m, n).

        At `height_m` above the ellipsoid, latitudes (m,) and longitudes (n,); `direction` gives
        the ambient one at latitudes and longitudes that broadcast. Vector and tensor per component,
        rms over the components.
        """
        ambient = direction(self._latitude[:, None], self._longitude[None, :])
        signal = self._spread(self._crust.signal_errors, height_m, ambient)
        noise = self._spread(self._crust.noise_errors, height_m, ambient)
        omitted = self._omission(height_m, np.square(ambient.down))
        own = self._crust.data.mean(self._crust.data.variance)
        excess = self._crust.excess
        noisy = (own + excess * self._rough) / (own + excess)
        rows = (latitude - self._latitude[0]) / self._step
        columns = (longitude - self._longitude[0]) / self._step
        return {
            group: _bilinear(
                np.sqrt(
                    self._rough * (signal[group] + omitted[group])
                    + noisy * noise[group]
                    + _FLOOR[group] ** 2
                ),
                rows,
                columns,
            )
            for group in _GROUPS
        }

    def _spread(self, errors: Real, height_m: float, ambient: Ambient) -> dict[str, Real]:
        """Mean squares of random errors at the own nodes, each over about a half wave around."""
        sums = {group: np.zeros(ambient.down.shape) for group in _GROUPS}
        along = np.stack(ambient, axis=-1)
        for gauss in errors:
            field = static_model("error", gauss)
            place = self._latitude, self._longitude, [height_m]
            vector, tensor = evaluate_grid(field, *place, 0.0, gradient=True)
            sums["total"] += np.einsum("ijc,ijc->ij", along, vector[0]) ** 2
            sums["vector"] += np.mean(vector[0] ** 2, axis=-1)
            five = [tensor[0, ..., i, j] ** 2 for i, j in TENSOR_PARTS.values()]
            sums["tensor"] += np.mean(five, axis=0)
        return {
            group: smooth_around(total / len(errors), self._latitude, self._step)
            for group, total in sums.items()
        }

    def _omission(self, height_m: float, steep: Real) -> dict[str, Real]:
        """Mean squares of the degrees above the highest, at squared sines of inclination."""
        down, horizontal, tensor = field_variances(*self._above, height_m, REFERENCE_RADIUS_KM)
        return {
            "total": down * steep + horizontal * (1.0 - steep),
            "vector": np.full(steep.shape, (down + 2.0 * horizontal) / 3.0),
            "tensor": np.full(steep.shape, STORED_OF_TENSOR * tensor),
        }

    def _omitted(self, steep: float) -> tuple[NDArray[np.int_], Real]:
        """The degrees above the highest and their likely power.

        With u the survey's own sigma: the total that they amount to at the survey is at least
        what the fit leaves of the data beyond u, and at most all that it leaves; between those the
        line that the power of the fitted degrees follows is believed.
        """
        crust = self._crust
        n = crust.degree + np.arange(1, _MOST_DEGREES + 1)
        flattest = 2.0 * np.log1p(-SHALLOWEST_M / (REFERENCE_RADIUS_KM * 1e3))

        def power(slope: float) -> Real:
            return np.asarray(crust.power[-1] * np.exp(slope * (n - crust.degree)))

        def total(slope: float) -> float:
            found = field_variances(n, power(slope), self._survey_height, REFERENCE_RADIUS_KM)
            return found[0] * steep + found[1] * (1.0 - steep)

        own = crust.data.mean(crust.data.variance)
        line = float(np.log(crust.power[-1] / crust.power[-2]))
        wanted = float(
            np.clip(total(min(line, flattest)), max(crust.residual - own, 0.0), crust.residual)
        )
        if wanted >= total(flattest):
            return n, power(flattest) * wanted / total(flattest)
        steepest = -30.0
        if wanted <= total(steepest):
            return n, power(steepest)
        return n, power(float(brentq(lambda slope: total(slope) - wanted, steepest, flattest)))

    def _strength(self, latitude: Real, steep: Real) -> Real:
        """Mean square of the anomaly around each node of the survey over what is likely there."""
        crust, data = self._crust, self._crust.data
        n = np.arange(1, crust.degree + 1)
        down, flat, _ = field_variances(n, crust.power, self._survey_height, REFERENCE_RADIUS_KM)
        beyond = max(crust.residual - data.mean(data.variance), 0.0)
        likely = down * steep + flat * (1.0 - steep) + beyond
        known = (data.area > 0.0).astype(float)
        around = _AROUND * self._step
        found, expected = (
            smooth_around(known * values, latitude, around)
            for values in (data.values**2 - data.variance, likely)
        )
        near = expected > 1e-3 * likely
        ratio = np.divide(found, expected, where=near, out=np.ones(near.shape))
        return np.clip(ratio, *_LIMITS)


def smooth_around(values: Real, latitude: Real, width_deg: float) -> Real:
    """Gaussian mean (1 sigma `width_deg` of arc) around each node of a grid (rows, columns).

    Columns go all around the globe.
    """
    step = 360.0 / values.shape[1]
    along = np.empty(values.shape)
    for row, phi in enumerate(latitude):
        width = min(width_deg / max(np.cos(np.radians(phi)), 1e-6) / step, values.shape[1] / 4)
        along[row] = ndimage.gaussian_filter1d(values[row], width, mode="wrap")
    across = width_deg / float(latitude[1] - latitude[0])
    return np.asarray(ndimage.gaussian_filter1d(along, across, axis=0, mode="nearest"))


def _bilinear(values: Real, rows: Real, columns: Real) -> Real:
    """Values (m, n) at fractional rows (m,) and columns (n,); columns go around."""
    r = np.clip(rows, 0.0, values.shape[0] - 1.0)
    r0 = np.minimum(r.astype(int), values.shape[0] - 2)
    c0 = np.floor(columns).astype(int)
    t, u = (r - r0)[:, None], columns - c0
    left, right = (values[:, np.mod(c0 + i, values.shape[1])] for i in (0, 1))
    across = left * (1.0 - u) + right * u
    return np.asarray(across[r0] * (1.0 - t) + across[r0 + 1] * t)
