"""A plain planar FFT, the yardstick that the chain is measured against; nothing of ours in it."""

from __future__ import annotations

import numpy as np
import pyproj
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def planar_fft(
    anomaly: Floats,
    spacing_m: float,
    gain_m: float,
    *,
    inclination: float,
    declination: float,
    convergence: float | Floats = 0.0,
) -> tuple[Floats, Floats, Floats]:
    """Total, vector and tensor `gain_m` above a total-field anomaly, flat Earth, constant F.

    The map is padded on each side by half of it, by reflection under a cosine taper to the
    mean. With the down axis z and fields that decay upward, a potential P has the gradient
    (i kx, i ky, |k|) P; B = grad P and the total anomaly is f . B (Blakely 1995, sec. 12.1).

    Parameters
    ----------
    anomaly : (y, x) nT without voids, rows northward along the grid.
    inclination, declination : of F, degrees, the latter from true north.
    convergence : grid north from true north, clockwise, degrees; a scalar or (y, x).

    Returns
    -------
    total (y, x) nT, vector (y, x, 3) nT and tensor (y, x, 5) nT/km, in true NED; the vector
    has no mean, which a total-field map does not determine.
    """
    mean = float(anomaly.mean())
    padded, inner = _padded(anomaly - mean)
    k_east = 2.0 * np.pi * np.fft.fftfreq(padded.shape[1], spacing_m)[None, :]
    k_north = 2.0 * np.pi * np.fft.fftfreq(padded.shape[0], spacing_m)[:, None]
    k = np.hypot(k_north, k_east)
    grid_declination = np.radians(declination - float(np.mean(convergence)))
    dip = np.radians(inclination)
    along = (
        1j * np.cos(dip) * (k_north * np.cos(grid_declination) + k_east * np.sin(grid_declination))
        + np.sin(dip) * k
    )
    total = np.fft.fft2(padded) * np.exp(-k * gain_m)
    with np.errstate(invalid="ignore", divide="ignore"):  # the mean has no direction
        potential = np.where(k > 0.0, total / along, 0.0)
    gradient = (1j * k_north, 1j * k_east, k)
    field = [g * potential for g in gradient]
    vector = np.stack([_back(f, inner) for f in field], axis=-1)
    tensor = np.empty((*anomaly.shape, 3, 3))
    for i in range(3):
        for j in range(3):
            tensor[..., i, j] = 1e3 * _back(gradient[j] * field[i], inner)
    to_true = _rotation(np.broadcast_to(np.radians(convergence), anomaly.shape))
    vector = np.einsum("...ij,...j->...i", to_true, vector)
    tensor = to_true @ tensor @ np.swapaxes(to_true, -1, -2)
    five = tensor[..., [0, 0, 0, 1, 1], [0, 1, 2, 1, 2]]
    return _back(total, inner) + mean, vector, five


def grid_convergence(crs: str, x: Floats, y: Floats) -> Floats:
    """Azimuth of grid north at every node, (y, x) degrees clockwise from true north."""
    to_wgs84 = pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
    east, north = np.meshgrid(x, y)
    here, ahead = to_wgs84.transform(east, north), to_wgs84.transform(east, north + 10.0)
    azimuth, _, _ = pyproj.Geod(ellps="WGS84").inv(*here, *ahead)
    return np.asarray(azimuth)


def _padded(values: Floats) -> tuple[Floats, tuple[slice, slice]]:
    margins = [n // 2 for n in values.shape]
    out = np.pad(values, [(m, m) for m in margins], mode="reflect")
    for axis, (margin, count) in enumerate(zip(margins, values.shape, strict=True)):
        ramp = 0.5 * (1.0 + np.cos(np.pi * np.arange(1, margin + 1) / margin))
        taper = np.concatenate([ramp[::-1], np.ones(count), ramp])
        out = out * np.expand_dims(taper, 1 - axis)
    rows, columns = (slice(m, m + n) for m, n in zip(margins, values.shape, strict=True))
    return out, (rows, columns)


def _back(spectrum: NDArray[np.complex128], inner: tuple[slice, slice]) -> Floats:
    return np.fft.ifft2(spectrum).real[inner]


def _rotation(angle: Floats) -> Floats:
    zero, one = np.zeros_like(angle), np.ones_like(angle)
    rows = [
        [np.cos(angle), -np.sin(angle), zero],
        [np.sin(angle), np.cos(angle), zero],
        [zero, zero, one],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))
