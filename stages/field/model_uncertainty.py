"""One sigma of a crustal field model, for total, vector and tensor, from its power spectrum.

Two independent parts, both by degree n as powers at the Earth's surface and carried to a
height h by (a / (a + h))^(2n + 4):

- Commission, what the model's own degrees err by: its stated sigma, spread over the degrees as
  the model's own power is.
- Omission, what the model has no degrees for: above its highest degree the Lowes-Mauersberger
  spectrum goes on along the exponential that fits the upper half of the model's degrees
  best; degrees missing below its lowest have the mean power of its lowest three.

Both are means over the globe: the crust of a shield is rougher than that of a basin. An
exponential (a - d)^(2n) / a^(2n) is the spectrum of sources at depth d. The Earth's surface follows
the ellipsoid and so do its sources, so heights and not radii count.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.models import FieldModel, power_spectrum

Real = NDArray[np.float64]

SHALLOWEST_M = 2000.0
"""Least depth of the omitted sources: half of what water and sediment amount to on average."""

_NEAREST_M = 1000.0
"""A level below the ellipsoid is taken to be at least so far above the omitted sources."""

_LOWEST_DEGREES = 3
_E_FOLDINGS = 40.0
STORED_OF_TENSOR = 3.0 / 32.0
"""Mean square of the five stored components, of the sum of all nine squared.

For plane waves of any azimuth, which the field is at degrees above ten: nn and ee have 3/32 of the
sum each, ne 1/32, nd and ed 4/32.
"""


class ModelError:
    """The error of a crustal field model at any height, means over the globe.

    Parameters
    ----------
    crust : the model's crustal degrees.
    gauss : (k,) its coefficients at the map's epoch, nT.
    uncertainty_nt : stated 1 sigma of a field component at the ellipsoid.
    missing : degrees below the lowest that are in no model.
    """

    def __init__(
        self, crust: FieldModel, gauss: Real, uncertainty_nt: float, missing: range
    ) -> None:
        self._radius_km = crust.reference_radius_km
        n = np.arange(crust.n_min, crust.n_max + 1)
        power = power_spectrum(gauss)[n - 1]
        # Rms over the components: a third of the mean square of the vector.
        self._commission = n, power * (3.0 * uncertainty_nt**2 / power.sum())
        self._omission = _omission(n, power, missing, self._radius_km)

    def sigmas(
        self, height_m: float, ambient_down: NDArray[np.floating]
    ) -> dict[str, NDArray[np.floating]]:
        """1 sigma by "total", "vector" (nT) and "tensor" (nT/km); shape of `ambient_down`.

        Vector and tensor per component, rms over the components. The total is the part along
        the ambient field, whose sine of inclination is `ambient_down` (...). At degree n the
        down component has (n + 1) / (2n + 1) of the mean square, north and east n / (4n + 2) each.
        """
        down, horizontal, tensor = self._variances(height_m)
        steep = np.square(ambient_down)
        vector = (down + 2.0 * horizontal) / 3.0
        return {
            "total": np.sqrt(down * steep + horizontal * (1.0 - steep)),
            "vector": np.broadcast_to(np.sqrt(vector), steep.shape),
            "tensor": np.broadcast_to(np.sqrt(STORED_OF_TENSOR * tensor), steep.shape),
        }

    def _variances(self, height_m: float) -> tuple[float, float, float]:
        """Mean squares: down, north (or east), and the sum of all squares of the tensor."""
        commission = field_variances(*self._commission, height_m, self._radius_km)
        height = max(height_m, _NEAREST_M - SHALLOWEST_M)
        omission = field_variances(*self._omission, height, self._radius_km)
        down, horizontal, tensor = (a + b for a, b in zip(commission, omission, strict=True))
        return down, horizontal, tensor

    @property
    def parts(self) -> Mapping[str, float]:
        """1 sigma of a component at the ellipsoid, nT, of each part."""
        return {
            name: float(np.sqrt(power.sum() / 3.0))
            for name, (_, power) in (
                ("commission", self._commission),
                ("omission", self._omission),
            )
        }


def field_variances(
    n: NDArray[np.int_], power: Real, height_m: float, radius_km: float
) -> tuple[float, float, float]:
    """Mean squares over the globe of a field whose degrees `n` have `power` at `radius_km`.

    Down, north (or east), and the sum of all squares of the tensor, nT^2 and nT^2/km^2.
    """
    radius = radius_km + height_m / 1000.0
    lifted = power * (radius_km / radius) ** (2.0 * n + 4.0)
    # The Laplacian of |B|^2, which goes as r^-(2n + 4), is twice the sum of squares.
    return (
        float(np.sum(lifted * (n + 1) / (2 * n + 1))),
        float(np.sum(lifted * n / (4 * n + 2))),
        float(np.sum(lifted * (n + 2) * (2.0 * n + 3.0))) / radius**2,
    )


def _omission(
    n: NDArray[np.int_], power: Real, missing: range, radius_km: float
) -> tuple[NDArray[np.int_], Real]:
    """Degrees without coefficients, and the mean square of the field that they are given."""
    level, ratio = _exponential(n, power, radius_km)
    above = n[-1] + np.arange(1, int(_E_FOLDINGS / -np.log(ratio)) + 2)
    below = np.array(missing, dtype=np.int_)
    lost = np.full(len(below), power[:_LOWEST_DEGREES].mean())
    extended = level * ratio ** (above - n[-1])
    return np.concatenate([below, above]), np.concatenate([lost, extended])


def _exponential(n: NDArray[np.int_], power: Real, radius_km: float) -> tuple[float, float]:
    """Power at the highest degree, and its ratio from one degree to the next."""
    steepest = ((radius_km - SHALLOWEST_M / 1000.0) / radius_km) ** 2
    upper = (n >= n[-1] / 2) & (power > 0.0)
    if np.count_nonzero(upper) < _LOWEST_DEGREES:
        return float(power.mean()), steepest
    slope, log_level = np.polyfit(n[upper] - n[-1], np.log(power[upper]), 1)
    if np.exp(slope) > steepest:
        # Flatter than any sources could be: the mean of these degrees goes on instead.
        return float(np.exp(np.log(power[upper]).mean())), steepest
    return float(np.exp(log_level)), float(np.exp(slope))
