"""Pictures of an observatory: quiet days, residual, autocorrelations, sigma against tau.

They are those of Canciani and Raquet (2016), figure 10, and of what a filter takes from them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.kernels.activity_classes import STORMY_KP
from magtiles.pipeline.artifacts import open_artifact
from magtiles.pipeline.plotting import save_png
from magtiles.stages.temporal.days import local_days
from magtiles.stages.temporal.fogm import autocorrelation
from magtiles.stages.temporal.residual import Segments, cut, residual

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

ELEMENTS = ("north", "east", "down", "total")
TOTAL = 3
PAPER_SIGMA_NT = 25.0
"""Below it, sigma of about 98 % of segments at Boulder (Canciani and Raquet 2016)."""

_SIZE = (9.0, 6.2)
_QUIET, _STORMY, _MEAN = "#0072B2", "#D55E00", "#000000"  # Okabe and Ito's palette
_DAYS = ("#E69F00", "#56B4E9", "#009E73", "#CC79A7", "#0072B2")
_MOST_CURVES = 250
_SECONDS_PER_HOUR = 3600.0
_LONGEST_TAU_H = 1000.0
"""Where tau has no bound, it is drawn here."""


@dataclass(frozen=True)
class StationData:
    """The artifacts of one observatory: as ingested, as checked, its curves and its fits."""

    record: Path
    series: Path
    baseline: Path
    fits: Path


def draw_station(station: StationData, folder: Path) -> dict[str, Path]:
    """Draw every picture of an observatory to `folder`; file names to paths."""
    with (
        open_artifact(station.series) as series,
        open_artifact(station.baseline) as curves,
        open_artifact(station.fits) as fits,
    ):
        code = str(series.attrs["iaga_code"])
        figures = {
            "quiet-days": quiet_days_figure(series, curves),
            "residual": residual_figure(series, curves, fits),
            "autocorrelation": autocorrelation_figure(series, curves, fits),
            "sigma-tau": sigma_tau_figure(fits),
        }
    drawn = {}
    for kind, figure in figures.items():
        path = folder / f"temporal-{code}-{kind}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        save_png(figure, path)
        drawn[path.name] = path
    return drawn


def quiet_days_figure(series: xr.Dataset, curves: xr.Dataset) -> Figure:
    """The quiet days of the middle month and their mean, by local solar time, each element."""
    figure, panels = _panels(2, 2, sharex=True)
    known = np.flatnonzero(np.isfinite(curves["level"].values[0]).any(axis=0))
    month = int(known[len(known) // 2])
    name = str(curves["month"].values[month])[:7]
    _title(figure, series, f"quiet days of {name} and their mean, from local midnight")
    days = local_days(series)
    chosen = curves["quiet_day"].values[0, month].astype("datetime64[D]")
    for element, axes in enumerate(panels.ravel()):
        for colour, day in zip(_DAYS, chosen[~np.isnat(chosen)], strict=False):
            at = int(np.searchsorted(days.date, day))
            axes.plot(
                days.minute / 60.0, days.departure[element, at], color=colour, lw=0.7,
                label=str(day),
            )  # fmt: skip
        hour = curves["minute"].values / 60.0
        mean = curves["baseline"].values[0, element, month]
        error = curves["baseline_standard_error"].values[0, element, month]
        axes.fill_between(hour, mean - error, mean + error, color=_MEAN, alpha=0.15, lw=0)
        axes.plot(hour, mean, color=_MEAN, lw=1.6, label="mean, 1 standard error")
        axes.axhline(0.0, color="#999999", lw=0.6, zorder=0)
        axes.set_title(ELEMENTS[element], fontsize=10, loc="left")
        axes.set_xlim(0.0, 24.0)
        axes.set_xticks(range(0, 25, 4))
    _label(panels, "local mean solar time, h", "nT")
    _legend_below(figure, panels[0, 0])
    return figure


def residual_figure(series: xr.Dataset, curves: xr.Dataset, fits: xr.Dataset) -> Figure:
    """What a month leaves once level and quiet-day curve are out; stormy intervals shaded."""
    figure, panels = _panels(4, 1, sharex=True)
    name, inside = _month_with_most_activity(series, fits)
    _title(figure, series, f"residual of {name}: record less level and quiet-day curve")
    left = residual(series, curves)[:, inside]
    time = series["time"].values[inside]
    for element, axes in enumerate(panels.ravel()):
        _shade_stormy(axes, fits, time)
        axes.plot(time, left[element], color=_QUIET, lw=0.5)
        axes.axhline(0.0, color="#999999", lw=0.6, zorder=0)
        axes.set_title(ELEMENTS[element], fontsize=10, loc="left")
        axes.set_ylabel("nT")
        axes.set_xlim(time[0], time[-1])
    _dates(panels[-1, 0])
    if np.isfinite(fits["kp"].values).any():
        _below(figure, f"Shaded: stormy intervals, Kp of {STORMY_KP:g} and more.")
    return figure


def autocorrelation_figure(series: xr.Dataset, curves: xr.Dataset, fits: xr.Dataset) -> Figure:
    """Autocorrelation of each segment's total, and the fits: of each class, and where most lie."""
    figure, panels = _panels(1, 2, sharex=True)
    segments = _segments(series, curves, fits)
    values, weights = autocorrelation(segments.values[TOTAL])
    values = np.where(weights > 0, values, np.nan)
    lags: Floats = np.arange(float(values.shape[1])) * segments.step_s / _SECONDS_PER_HOUR
    _title(figure, series, f"autocorrelation of {len(values)} residual segments, total field")
    known = np.flatnonzero(np.isfinite(values[:, 0]) & (values[:, 0] > 0))
    drawn = known[:: -(-len(known) // _MOST_CURVES) or 1]
    kp = _kp_of(fits, segments)
    plain, unit = panels[0]
    for row in drawn:
        colour = _STORMY if kp[row] >= STORMY_KP else _QUIET
        plain.plot(lags, values[row], color=colour, lw=0.4, alpha=0.35)
        unit.plot(lags, values[row] / values[row, 0], color=colour, lw=0.4, alpha=0.25)
    _draw_class_fits(plain, fits, lags)
    _draw_envelope(unit, fits, lags)
    typical = float(np.median(values[known, 0])) if known.size else 1.0
    plain.set_yscale("symlog", linthresh=typical)
    plain.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    plain.set_title("about zero", fontsize=10, loc="left")
    unit.set_ylim(-1.0, 1.05)
    unit.set_title("divided by each one's own variance", fontsize=10, loc="left")
    plain.set_ylabel("nT\N{SUPERSCRIPT TWO}")
    for axes in (plain, unit):
        axes.set_xlim(0.0, float(lags[-1]))
        axes.set_xlabel("lag, h")
        axes.axhline(0.0, color="#999999", lw=0.6, zorder=0)
        axes.legend(fontsize=8, frameon=False, loc="lower left")
    return figure


def sigma_tau_figure(fits: xr.Dataset) -> Figure:
    """Sigma against tau of every segment, total field, by activity; the paper's 25 nT."""
    figure, panels = _panels(1, 1)
    axes = panels[0, 0]
    sigma, tau = (fits[name].values[0, TOTAL].astype(np.float64) for name in ("sigma", "tau"))
    known = np.isfinite(sigma)
    tau = np.clip(np.where(np.isnan(tau), np.inf, tau) / _SECONDS_PER_HOUR, 0, _LONGEST_TAU_H)
    kp, open_ended = fits["kp"].values, fits["tau_unidentified"].values[0, TOTAL] != 0
    stormy = kp >= STORMY_KP
    for chosen, colour, name in (
        (known & ~stormy, _QUIET, f"Kp below {STORMY_KP:g}, or not known"),
        (known & stormy, _STORMY, f"Kp of {STORMY_KP:g} and more"),
    ):
        axes.scatter(
            tau[chosen & ~open_ended], sigma[chosen & ~open_ended], s=12, color=colour,
            alpha=0.7, lw=0, label=name,
        )  # fmt: skip
        axes.scatter(
            tau[chosen & open_ended], sigma[chosen & open_ended], s=12, facecolors="none",
            edgecolors=colour, alpha=0.6, lw=0.7,
        )  # fmt: skip
    share = float(np.mean(sigma[known] < PAPER_SIGMA_NT))
    axes.axhline(PAPER_SIGMA_NT, color=_MEAN, lw=1.0, ls="--")
    axes.annotate(
        f"{share:.1%} of {known.sum()} segments below {PAPER_SIGMA_NT:g} nT",
        (0.02, PAPER_SIGMA_NT), (0, 4), xycoords=("axes fraction", "data"),
        textcoords="offset points", fontsize=9,
    )  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(top=max(60.0, 2.0 * float(np.max(sigma[known], initial=1.0))))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_xlabel("tau, h")
    axes.set_ylabel("sigma, nT")
    axes.legend(fontsize=9, frameon=False, loc="lower right")
    hours = float(fits.attrs["segment_s"]) / _SECONDS_PER_HOUR
    _title(figure, None, f"{fits['iaga_code'].values[0]}: segments of {hours:g} h, total field")
    _below(
        figure,
        "Maximum likelihood about zero. Hollow: tau is longer than its segment, or unbounded.",
    )
    return figure


def _panels(rows: int, columns: int, sharex: bool = False) -> tuple[Figure, NDArray[Any]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=_SIZE, layout="constrained")
    panels = figure.subplots(rows, columns, sharex=sharex, squeeze=False)
    figure.get_layout_engine().set(rect=(0.0, 0.055, 1.0, 0.895))  # type: ignore[call-arg,union-attr]
    for axes in panels.ravel():
        axes.tick_params(labelsize=8)
        axes.spines[["top", "right"]].set_visible(False)
    return figure, panels


def _title(figure: Figure, series: xr.Dataset | None, text: str) -> None:
    if series is not None:
        text = f"{series.attrs['iaga_code']}: {text}"
    figure.text(0.01, 0.985, text, size=12, weight="bold", va="top")


def _below(figure: Figure, text: str) -> None:
    figure.text(0.01, 0.015, text, size=8, color="#444444")


def _label(panels: NDArray[Any], x: str, y: str) -> None:
    for axes in panels[-1]:
        axes.set_xlabel(x)
    for axes in panels[:, 0]:
        axes.set_ylabel(y)


def _legend_below(figure: Figure, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="lower left", ncols=len(labels), fontsize=8, frameon=False,
        columnspacing=1.2, handlelength=1.4,
    )  # fmt: skip


def _dates(axes: Axes) -> None:
    from matplotlib.dates import DateFormatter, DayLocator

    every_fifth = DayLocator(bymonthday=range(1, 32, 5))  # type: ignore[no-untyped-call]
    axes.xaxis.set_major_locator(every_fifth)
    axes.xaxis.set_major_formatter(DateFormatter("%Y-%m-%d"))  # type: ignore[no-untyped-call]


def _month_with_most_activity(
    series: xr.Dataset, fits: xr.Dataset
) -> tuple[str, NDArray[np.bool_]]:
    """The month whose segments reach the largest sigma, and which samples are of it."""
    of_time = series["time"].values.astype("datetime64[M]")
    of_segment = fits["segment_start"].values.astype("datetime64[M]")
    sigma = np.nan_to_num(fits["sigma"].values[0, TOTAL])
    month = of_segment[int(np.argmax(sigma))]
    return str(month), of_time == month


def _shade_stormy(axes: Axes, fits: xr.Dataset, time: NDArray[np.datetime64]) -> None:
    start, kp = fits["segment_start"].values, fits["kp"].values
    length = np.timedelta64(round(float(fits.attrs["segment_s"])), "s")
    inside = (start >= time[0]) & (start <= time[-1]) & (kp >= STORMY_KP)
    for begin in start[inside]:
        axes.axvspan(begin, begin + length, color=_STORMY, alpha=0.15, lw=0)


def _segments(series: xr.Dataset, curves: xr.Dataset, fits: xr.Dataset) -> Segments:
    step, length = float(series.attrs["cadence_s"]), float(fits.attrs["segment_s"])
    return cut(residual(series, curves), series["time"].values, step, length)


def _kp_of(fits: xr.Dataset, segments: Segments) -> Floats:
    """Kp of segments; NaN where the fits have none of that start."""
    start = fits["segment_start"].values
    at = np.searchsorted(start, segments.start).clip(max=start.size - 1)
    kp: Floats = np.where(start[at] == segments.start, fits["kp"].values[at], np.nan)
    return kp


def _draw_class_fits(axes: Axes, fits: xr.Dataset, lags: Floats) -> None:
    codes = np.stack([fits[f"class_{k}"].values for k in ("kp", "season", "local_time")], axis=1)
    for kp, colour, name in ((0, _QUIET, "quiet"), (1, _STORMY, "stormy")):
        row = int(np.flatnonzero((codes == (kp, -1, -1)).all(axis=1))[0])
        sigma, tau = (float(fits[f"class_{k}"].values[0, TOTAL, row]) for k in ("sigma", "tau"))
        if np.isfinite(sigma):
            label = f"{name}: {sigma:.3g} nT, {tau / _SECONDS_PER_HOUR:.2g} h, pooled"
            decay = np.exp(-lags * _SECONDS_PER_HOUR / tau)
            axes.plot(lags, sigma**2 * decay, color=colour, lw=2.2, label=label)


def _draw_envelope(axes: Axes, fits: xr.Dataset, lags: Floats) -> None:
    """Exponentials of the autocorrelation fits: their median, and where eight of ten lie."""
    tau = fits["tau_autocorrelation"].values[0, TOTAL]
    tau = tau[np.isfinite(tau) & (tau > 0)]
    if not tau.size:
        return
    low, middle, high = np.percentile(tau, [10, 50, 90])
    curves = [np.exp(-lags * _SECONDS_PER_HOUR / t) for t in (low, middle, high)]
    axes.fill_between(lags, curves[0], curves[2], color=_MEAN, alpha=0.18, lw=0,
                      label="fitted to each segment: 8 of 10")  # fmt: skip
    axes.plot(lags, curves[1], color=_MEAN, lw=1.8,
              label=f"their median, tau {middle / _SECONDS_PER_HOUR:.2g} h")  # fmt: skip
