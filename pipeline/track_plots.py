"""Pictures of tracks: the path coloured by its anomaly, and spectra of a vector magnetometer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.signal
import xarray as xr
from numpy.typing import NDArray

from magtiles.schemas.errors import ContractError
from magtiles.stages.vehicle.calibration.samples import AXES
from magtiles.stages.vehicle.tolles_lawson.runs import Run, find_runs

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

_ROBUST = 99.0  # percent of samples within the colours
_SPECTRUM_S = 20.0
_FEWEST = 64
"""Samples in a row that a spectrum needs."""
_COLOURS = ("#0072B2", "#D55E00", "#009E73")  # Okabe and Ito's palette
_SPECTRA_INCH = 3.2


def track_figure(track: xr.Dataset) -> Figure:
    """Draw the path of a track in true shape, coloured by its anomaly.

    A track without `magnetic_anomaly` is coloured by its total field, or the magnitude of its
    vector, less the median, and has spectra of the vector's components below (Welch's, of the
    longest stretch that is evenly sampled). Raises ContractError for a track without any field,
    or without places.
    """
    from matplotlib.figure import Figure

    values, label = _coloured(track)
    latitude, longitude = track["latitude"].values, np.unwrap(_bridged(track), period=360.0)
    known = np.isfinite(values) & np.isfinite(latitude) & np.isfinite(longitude)
    if not known.any():
        raise ContractError(
            "no sample has both a place and a field", where=track.attrs.get("source")
        )
    if "magnetic_anomaly" not in track:
        middle = float(np.median(values[known]))
        values, label = values - middle, f"{label} less {middle:.0f} nT (nT)"
    cosine = float(np.cos(np.radians(latitude[known].mean())))
    shape = float(np.ptp(latitude[known])) / (float(np.ptp(longitude[known])) * cosine or 1.0)
    height = float(np.clip(7.4 * shape + 1.7, 3.5, 9.0))
    run = _longest_run(track)
    figure = Figure(figsize=(8.0, height + _SPECTRA_INCH * bool(run)), layout="constrained")
    parts: list[Any] = [figure]
    if run:
        grid = figure.add_gridspec(2, 1, height_ratios=[height, _SPECTRA_INCH])
        parts = [figure.add_subfigure(grid[row]) for row in range(2)]
    axes = parts[0].add_subplot()
    axes.plot(longitude, latitude, color="#BBBBBB", linewidth=0.5, zorder=1)
    _draw_colours(axes, longitude[known], latitude[known], values[known], label, shape < 0.8)
    axes.set_aspect(1.0 / cosine)
    if run:
        _draw_spectra(parts[1].add_subplot(), track["field_body"].values[run.rows], run.step_s)
    figure.suptitle(str(track.attrs["source"]), x=0.01, ha="left", weight="bold")
    return figure


def _coloured(track: xr.Dataset) -> tuple[Floats, str]:
    """What colours the path (time,), nT, and its name."""
    for name, label in (
        ("magnetic_anomaly", "total-field anomaly (nT)"),
        ("field_total", "total field"),
    ):
        if name in track:
            return track[name].values.astype(np.float64), label
    if "field_body" in track:
        vector = track["field_body"].values.astype(np.float64)
        return np.linalg.norm(vector, axis=1), "magnitude of the field"
    raise ContractError(
        "'magnetic_anomaly', 'field_total' and 'field_body' are missing",
        where=track.attrs.get("source"),
        expected="one of them, nT",
    )


def _bridged(track: xr.Dataset) -> Floats:
    """Longitudes; gaps bridged, since one NaN would break what unwraps them."""
    longitude = track["longitude"].values.astype(np.float64)
    known = np.flatnonzero(np.isfinite(longitude))
    if known.size == 0:
        return longitude
    bridged = longitude[known][np.searchsorted(known, np.arange(longitude.size)) - 1]
    return np.where(np.isfinite(longitude), longitude, bridged)


def _draw_colours(
    axes: Axes, longitude: Floats, latitude: Floats, values: Floats, label: str, flat: bool
) -> None:
    from matplotlib.colors import CenteredNorm

    limit = float(np.percentile(np.abs(values), _ROBUST)) or 1.0
    norm: Any = CenteredNorm(0.0, limit)
    dots = axes.scatter(longitude, latitude, c=values, s=6, norm=norm, cmap="RdBu_r", zorder=2)
    axes.figure.colorbar(
        dots,
        ax=axes,
        label=label,
        extend="both" if float(np.abs(values).max()) > limit else "neither",
        location="bottom" if flat else "right",
        aspect=40,
    )
    axes.set(xlabel="longitude (degrees east)", ylabel="latitude (degrees north)")
    axes.ticklabel_format(useOffset=False)
    axes.locator_params(axis="x", nbins=5)
    axes.margins(0.05)


def _longest_run(track: xr.Dataset) -> Run | None:
    """The longest stretch whose vector has a spectrum; None where it is too uneven or short."""
    if "magnetic_anomaly" in track or "field_body" not in track:
        return None
    try:
        finite = np.isfinite(track["field_body"].values).all(axis=1)
        return max(find_runs(track, finite, _FEWEST), key=len, default=None)
    except ContractError:  # the path can be drawn all the same
        return None


def _draw_spectra(axes: Axes, field: Floats, step_s: float) -> None:
    length = min(len(field), max(_FEWEST, round(_SPECTRUM_S / step_s)))
    frequency, power = scipy.signal.welch(
        field, 1.0 / step_s, nperseg=length, detrend="linear", scaling="density", axis=0
    )
    for name, colour, column in zip(AXES, _COLOURS, power.T, strict=True):
        axes.loglog(frequency[1:], np.sqrt(column[1:]), color=colour, label=name, linewidth=1.0)
    axes.set(xlabel="frequency (Hz)", ylabel="nT per root Hz")
    minutes = len(field) * step_s / 60.0
    axes.set_title(f"spectra over {minutes:.1f} minutes", loc="left", size=10)
    axes.legend(frameon=False, ncols=3)
