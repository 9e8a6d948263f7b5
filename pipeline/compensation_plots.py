"""Pictures of a compensated track: the field before and after, in time and its spectra."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy.signal
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.flags import TrackFlag
from magtiles.schemas.errors import ContractError
from magtiles.stages.vehicle.tolles_lawson.filter import Filter
from magtiles.stages.vehicle.tolles_lawson.runs import Run, find_runs

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

_BAND_HZ = (0.1, 0.9)
# Okabe and Ito's palette.
_MEASURED, _COMPENSATED, _SWING = "#D55E00", "#0072B2", "#E9E9E0"
_SPECTRUM_S = 40.0


def compensation_figure(track: xr.Dataset) -> Figure:
    """Draw what `apply-tolles-lawson` did to a track: in time, and its spectra.

    The field before and after is band-passed to 0.1-0.9 Hz, where manoeuvres are and the Earth's
    field is not; manoeuvres are shaded. Spectra are Welch's, of the manoeuvres' samples.

    Raises ContractError for a track that was not compensated, or is too short or coarse.
    """
    from matplotlib.figure import Figure

    names = ("field_total_raw", "field_total")
    for name in names:
        if name not in track:
            raise ContractError(
                f"'{name}' is missing",
                where=track.attrs.get("source"),
                expected="what apply-tolles-lawson makes",
            )
    fields = {name: track[name].values.astype(np.float64) for name in names}
    runs = _runs(track, fields["field_total"])
    band = Filter(*_BAND_HZ)
    minutes = (track["time"].values - track["time"].values[0]) / np.timedelta64(60, "s")
    figure = Figure(figsize=(9.0, 7.6), layout="constrained")
    panels = figure.subplot_mosaic([["before"], ["after"], ["spectra"]], height_ratios=[1, 1, 1.3])
    panels["after"].sharex(panels["before"])
    looks = (("before", "measured", _MEASURED), ("after", "compensated", _COMPENSATED))
    swinging = _swinging(track)
    for (panel, label, colour), values in zip(looks, fields.values(), strict=True):
        filtered = _filtered(values, runs, band)
        spread = float(np.nanstd(filtered[swinging] if swinging.any() else filtered))
        where = "in manoeuvres" if swinging.any() else "over the track"
        _draw_time(panels[panel], minutes, filtered, swinging, colour)
        panels[panel].set_title(f"{label}: {spread:.3g} nT rms {where}", loc="left", size=10)
        _draw_spectrum(panels["spectra"], values, runs, swinging, label, colour)
    panels["before"].tick_params(labelbottom=False)
    panels["after"].set_xlabel(f"minutes since {str(track['time'].values[0])[:19]} UTC")
    _finish_spectra(panels["spectra"], swinging)
    figure.align_ylabels(list(panels.values()))
    about = f"{track.attrs.get('compensation', 'compensation')}: {track.attrs['source']}"
    figure.suptitle(about, x=0.01, ha="left", weight="bold")
    return figure


def _runs(track: xr.Dataset, field: Floats) -> list[Run]:
    shortest = round(_SPECTRUM_S)
    runs = find_runs(track, np.isfinite(field), shortest)
    if not runs or max(run.step_s for run in runs) > 0.5 / _BAND_HZ[1]:
        raise ContractError(
            "is too short, too broken or sampled too seldom for a band up to 0.9 Hz",
            where=track.attrs.get("source"),
            expected="runs of 40 samples, more than 1.8 a second",
        )
    return runs


def _swinging(track: xr.Dataset) -> NDArray[np.bool_]:
    if "quality_flag" not in track:
        return np.zeros(track.sizes["time"], dtype=bool)
    found: NDArray[np.bool_] = (track["quality_flag"].values & TrackFlag.MANOEUVRE) != 0
    return found


def _filtered(values: Floats, runs: list[Run], band: Filter) -> Floats:
    out = np.full_like(values, np.nan)
    for run in runs:
        edge = band.edge(run.step_s)
        if len(run) > 2 * edge:
            inner = slice(run.start + edge, run.stop - edge)
            out[inner] = band.apply(values[run.rows], run.step_s)[edge : len(run) - edge]
    return out


def _draw_time(
    axes: Axes, minutes: Floats, values: Floats, swinging: NDArray[np.bool_], colour: str
) -> None:
    axes.fill_between(
        minutes, 0.0, 1.0, where=swinging.tolist(), transform=axes.get_xaxis_transform(),
        color=_SWING, linewidth=0.0,
    )  # fmt: skip
    axes.plot(minutes, values, color=colour, linewidth=0.6)
    axes.set_ylabel("0.1-0.9 Hz (nT)")
    axes.margins(x=0.0)


def _draw_spectrum(
    axes: Axes,
    values: Floats,
    runs: list[Run],
    swinging: NDArray[np.bool_],
    label: str,
    colour: str,
) -> None:
    """Amplitude spectrum of the longest run, from its first manoeuvre to its last."""
    run = max(runs, key=len)
    part = values[run.rows]
    inside = np.flatnonzero(swinging[run.rows])
    if inside.size:
        part = part[inside[0] : inside[-1] + 1]
    length = min(part.size, round(_SPECTRUM_S / run.step_s))
    frequency, power = scipy.signal.welch(
        part, 1.0 / run.step_s, nperseg=length, detrend="linear", scaling="density"
    )
    axes.loglog(frequency[1:], np.sqrt(power[1:]), color=colour, label=label)


def _finish_spectra(axes: Axes, swinging: NDArray[np.bool_]) -> None:
    axes.axvspan(*_BAND_HZ, color=_SWING, zorder=0)
    axes.set_xlabel("frequency (Hz)")
    axes.set_ylabel("nT per root Hz")
    where = "first manoeuvre to last" if swinging.any() else "whole track"
    axes.set_title(f"spectra, {where}; the band above is shaded", loc="left", size=10)
    axes.legend(frameon=False)
