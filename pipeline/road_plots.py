"""Pictures of a road map: the road in true shape, coloured, and what lies along it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.schemas.errors import UsageError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
Kind = Literal["field", "matchability"]

KINDS: tuple[Kind, ...] = ("field", "matchability")
"""What a road can be coloured by."""

_AXES = ("forward", "right", "down")
_COLOURS = ("#0072B2", "#D55E00", "#009E73")  # Okabe and Ito's palette
_FEATURE = "#F0E442"
_ROBUST = (1.0, 99.0)  # percent of points within the colours
_WIDTH = 9.0
_PANEL = 1.5
"""Inches."""


def road_figure(road: xr.Dataset, kind: Kind) -> Figure:
    """Draw a road-map/1: its course coloured by `kind`, and panels along its distance.

    "field" colours by the magnitude and has the three axes with 1 sigma and features below;
    "matchability" has matchability, the 1 sigma of each axis, and the number of passes. Raises
    UsageError for the matchability of a map that has none.
    """
    from matplotlib.figure import Figure

    if kind == "matchability" and "matchability" not in road:
        raise UsageError(
            "the map has no matchability",
            where=str(road.attrs["road"]),
            remedy="build a release of it, which has",
        )
    latitude = road["latitude"].values
    longitude = np.unwrap(road["longitude"].values, period=360.0)
    cosine = float(np.cos(np.radians(latitude.mean())))
    shape = float(np.ptp(latitude)) / (float(np.ptp(longitude)) * cosine or 1.0)
    height = float(np.clip(0.8 * _WIDTH * shape, 1.2, 5.0)) + 1.1
    figure = Figure(figsize=(_WIDTH, height + 3 * _PANEL + 0.9), layout="constrained")
    grid = figure.add_gridspec(4, 1, height_ratios=[height, *3 * [_PANEL]])
    course = figure.add_subplot(grid[0])
    _draw_course(course, longitude, latitude, road, kind)
    course.set_aspect(1.0 / cosine)
    panels = [figure.add_subplot(grid[1])]
    panels += [figure.add_subplot(grid[row], sharex=panels[0]) for row in (2, 3)]
    (_draw_axes if kind == "field" else _draw_quality)(panels, road)
    for panel in panels[:-1]:
        panel.tick_params(labelbottom=False)
    panels[-1].set_xlabel("distance along the road (m)")
    panels[0].set_xlim(float(road["distance"][0]), float(road["distance"][-1]))
    figure.suptitle(_title(road, kind), x=0.01, ha="left", weight="bold", size=11)
    return figure


def _title(road: xr.Dataset, kind: Kind) -> str:
    what = "magnitude of the field" if kind == "field" else "matchability"
    state = "calibrated" if road.attrs["calibrated"] == "true" else "uncalibrated"
    name = f"{road.attrs['road']}, driven {road.attrs['direction']}"
    passes, vehicles = road.sizes["pass"], road.sizes["vehicle"]
    of = f"{passes} pass{'es' * (passes > 1)}, {vehicles} vehicle{'s' * (vehicles > 1)}"
    return f"{name}: {what}; {of}, {state}"


def _draw_course(
    axes: Axes, longitude: Floats, latitude: Floats, road: xr.Dataset, kind: Kind
) -> None:
    if kind == "field":
        values = np.linalg.norm(road["field_body"].values.astype(np.float64), axis=1) / 1e3
        limits = tuple(np.percentile(values, _ROBUST))
        label, colours = "magnitude (µT)", "viridis"
    else:
        values = road["matchability"].values.astype(np.float64)
        limits, label, colours = (0.0, 1.0), "matchability", "cividis"
    axes.plot(longitude, latitude, color="#BBBBBB", linewidth=0.5, zorder=1)
    dots = axes.scatter(
        longitude, latitude, c=values, s=9, vmin=limits[0], vmax=limits[1], cmap=colours, zorder=2
    )
    beyond = "both" if kind == "field" else "neither"
    axes.figure.colorbar(dots, ax=axes, label=label, extend=beyond, aspect=20)
    start = 0 if road.attrs["direction"] == "forward" else -1
    inward = 18 if latitude[start] < latitude.mean() else -22
    axes.annotate(
        "start",
        (longitude[start], latitude[start]),
        xytext=(0, inward),
        textcoords="offset points",
        ha="center",
        arrowprops={"arrowstyle": "->"},
        fontsize=8,
        zorder=3,
    )
    axes.set(xlabel="longitude (degrees east)", ylabel="latitude (degrees north)")
    axes.ticklabel_format(useOffset=False)
    axes.locator_params(axis="both", nbins=5)
    axes.margins(0.05, 0.12)


def _draw_axes(panels: list[Axes], road: xr.Dataset) -> None:
    distance = road["distance"].values
    field = road["field_body"].values.astype(np.float64) / 1e3
    sigma = road["field_body_uncertainty"].values.astype(np.float64) / 1e3
    for axis, panel in enumerate(panels):
        for start, end, of in _features(road):
            panel.axvspan(start, end, color=_FEATURE, alpha=0.9 if of == axis else 0.2, lw=0)
        low, high = field[:, axis] - sigma[:, axis], field[:, axis] + sigma[:, axis]
        panel.fill_between(distance, low, high, color=_COLOURS[axis], alpha=0.35, lw=0)
        panel.plot(distance, field[:, axis], color=_COLOURS[axis], linewidth=0.8)
        panel.set_ylabel(f"{_AXES[axis]} (µT)")
    count = road.sizes.get("feature", 0)
    about = f"yellow: {count} features, stronger where they peak on this axis" if count else ""
    panels[0].set_title(f"shaded: 1 sigma. {about}", loc="left", size=9)


def _features(road: xr.Dataset) -> list[tuple[float, float, int]]:
    if "feature_start" not in road:
        return []
    names = ("feature_start", "feature_end", "feature_axis")
    half = 0.5 * float(road.attrs["spacing_m"])
    rows = zip(*(road[name].values.tolist() for name in names), strict=True)
    return [(start - half, end + half, int(axis)) for start, end, axis in rows]


def _draw_quality(panels: list[Axes], road: xr.Dataset) -> None:
    from matplotlib.ticker import MaxNLocator

    distance, share = road["distance"].values, road["matchability"].values
    panels[0].plot(distance, share, color="#000000", linewidth=0.8)
    panels[0].set(ylim=(0.0, 1.05), ylabel="matchability")
    whole = road.attrs.get("matchability")
    if whole is not None:
        panels[0].set_title(f"of the whole road: {float(whole):.2f}", loc="left", size=9)
    sigma = road["field_body_uncertainty"].values
    for axis, colour in enumerate(_COLOURS):
        panels[1].plot(distance, sigma[:, axis], color=colour, label=_AXES[axis], linewidth=0.8)
    panels[1].set(ylim=(0.0, 1.4 * float(sigma.max())), ylabel="1 sigma (nT)")
    panels[1].legend(frameon=False, ncols=3, fontsize=8, loc="upper right")
    panels[2].step(distance, road["passes"].values, color="#000000", where="mid", linewidth=0.8)
    panels[2].set(ylim=(0.0, None), ylabel="passes")
    panels[2].yaxis.set_major_locator(MaxNLocator(integer=True))
