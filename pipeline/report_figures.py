"""Figures of a release's report: spectra and uncertainty of every level."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from magtiles.catalog import Release
from magtiles.catalog.flags import QualityFlag
from magtiles.catalog.kernels.geodesy import metres_per_degree
from magtiles.pipeline.preview import assemble_level

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LARGEST = 1024
"""Nodes along an axis that a spectrum is taken of; larger maps give their middle."""
_GROUPS = {
    "magnetic_anomaly_uncertainty": "total, nT",
    "vector_uncertainty": "vector component, nT",
    "tensor_uncertainty": "gradient, nT/km",
}


def spectra_figure(release: Release) -> Figure:
    """Radial mean power of the total anomaly against wavelength, one line for each level."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4.6), layout="constrained")
    axes = figure.add_subplot()
    manifest = release.manifest
    for level, height in enumerate(manifest.heights_m):
        (values,) = assemble_level(release.tiles(), manifest.lattice, level, ("magnetic_anomaly",))
        wavelength, power = radial_power(values, _spacing(release))
        axes.loglog(wavelength / 1e3, power, label=f"{height:g} m", color=_shade(level, manifest))
    axes.invert_xaxis()
    axes.set_xlabel("wavelength, km")
    axes.set_ylabel("power, nT\N{SUPERSCRIPT TWO} km\N{SUPERSCRIPT TWO}")
    axes.legend(title="level", frameon=False, fontsize=9)
    axes.grid(alpha=0.3)
    return figure


def radial_power(
    values: NDArray[np.floating[Any]], spacing: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Wavelengths (m) and mean power density there (nT^2 km^2) of a map (rows, columns), nT.

    A Hann window keeps the border out; white noise of sigma s has density s^2 dy dx.
    """
    cut = tuple(
        slice((n - min(n, _LARGEST)) // 2, (n + min(n, _LARGEST)) // 2) for n in values.shape
    )
    part = values[cut].astype(np.float64)
    window = np.outer(*(np.hanning(n + 2)[1:-1] for n in part.shape))
    part = (part - np.average(part, weights=window)) * window
    density = np.abs(scipy.fft.fft2(part)) ** 2 / (window**2).sum() * spacing[0] * spacing[1] / 1e6
    k = np.hypot(
        scipy.fft.fftfreq(part.shape[0], spacing[0])[:, None],
        scipy.fft.fftfreq(part.shape[1], spacing[1])[None, :],
    )
    lowest = 1.0 / min(n * d for n, d in zip(part.shape, spacing, strict=True))
    ring = np.rint(k / lowest).astype(int)
    last = int(0.5 / max(spacing) / lowest)
    inside = (ring >= 2) & (ring <= last)
    counts = np.bincount(ring[inside], minlength=last + 1)
    sums = np.bincount(ring[inside], density[inside], minlength=last + 1)
    used = np.flatnonzero(counts)
    return 1.0 / (used * lowest), sums[used] / counts[used]


def uncertainty_figure(release: Release) -> Figure:
    """Cumulative share of covered nodes against 1 sigma: total, vector and tensor."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.6), layout="constrained")
    panels = figure.subplots(1, len(_GROUPS), sharey=True)
    manifest = release.manifest
    for level, height in enumerate(manifest.heights_m):
        *sigmas, flags = assemble_level(
            release.tiles(), manifest.lattice, level, (*_GROUPS, "quality_flag")
        )
        covered = (flags & QualityFlag.BEYOND_COVERAGE) == 0
        for axes, label, sigma in zip(panels, _GROUPS.values(), sigmas, strict=True):
            axes.set_xlabel(f"1 sigma, {label}")
            if covered.any():
                share = np.linspace(0.0, 1.0, 201)
                axes.semilogx(
                    np.quantile(sigma[covered], share),
                    share,
                    label=f"{height:g} m",
                    color=_shade(level, manifest),
                )
            axes.grid(alpha=0.3)
    panels[0].set_ylabel("share of nodes below")
    panels[0].legend(title="level", frameon=False, fontsize=8)
    return figure


def _shade(level: int, manifest: Any) -> Any:
    from matplotlib import colormaps

    return colormaps["viridis"](0.9 * level / max(1, len(manifest.heights_m) - 1))


def _spacing(release: Release) -> tuple[float, float]:
    """Node spacing in metres at the middle of the map, north and east."""
    lattice = release.manifest.lattice
    middle = np.asarray((lattice.south + lattice.north) / 2)
    north, east = metres_per_degree(middle, np.asarray(0.0))
    return float(north) * lattice.latitude_spacing, float(east) * lattice.longitude_spacing
