"""Pictures of a calibration: readings before and after, their magnitude and heading in time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.schemas.errors import ContractError
from magtiles.stages.vehicle.calibration.calibrate import PLANAR, check_raw, heading
from magtiles.stages.vehicle.calibration.samples import AXES, select_samples
from magtiles.stages.vehicle.calibration.spatial import to_ned

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

Real = NDArray[np.float64]

# Okabe and Ito's palette.
_RAW, _CALIBRATED, _CORE = "#E69F00", "#0072B2", "black"
_MOST = 4000
"""Samples that a picture shows; more are thinned."""
_UNIT = 1e-3
_LABEL = "\N{GREEK SMALL LETTER MU}T"


@dataclass(frozen=True)
class _Drawn:
    """What is drawn, in microtesla and seconds.

    Attributes
    ----------
    seconds : (n,) since the first sample.
    raw, calibrated : (n, 3) body axes.
    core : (3,) north, east, down.
    attitude : (n, 4) quaternions, NaN where unknown.
    heading : (n,) true, degrees, where the attitude is known.
    level : whether the calibration is one of level circles.
    """

    seconds: Real
    raw: Real
    calibrated: Real
    core: Real
    attitude: Real
    heading: Real | None
    level: bool

    def length(self, field: Real) -> Real:
        """Magnitude (..., 3) -> (...): of the horizontal part for level circles."""
        return np.asarray(np.linalg.norm(field[..., :2] if self.level else field, axis=-1))


def calibration_figure(track: xr.Dataset, calibration: xr.Dataset) -> Figure:
    """Draw the samples of `track` that a sensor-calibration/1 was made from, before and after.

    Panels: the readings in the planes of the axes beside the core field's circle, the magnitude
    and, of level circles or with attitude, the heading by the field.

    Raises ContractError for a calibration of another kind, or a track calibrated already or
    of another time.
    """
    from matplotlib.figure import Figure

    drawn = _drawn(track, calibration)
    figure = Figure(figsize=(11.0, 6.6), layout="constrained")
    widths = [1.0 if drawn.level else 0.62, 1.25]
    left, right = np.asarray(figure.subfigures(1, 2, width_ratios=widths)).tolist()
    planes = [(1, 0)] if drawn.level else [(1, 0), (0, 2)]
    shown = list(left.subplot_mosaic([[f"{plane}"] for plane in planes]).values())
    for panel, (across, up) in zip(shown, planes, strict=True):
        _draw_plane(panel, drawn, across, up)
    shown[0].legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, frameon=False, fontsize=9,
        handletextpad=0.3, columnspacing=1.0, markerscale=4.0,
    )  # fmt: skip
    _draw_in_time(right, drawn, str(calibration.attrs["start"])[:19])
    figure.suptitle(_title(calibration), x=0.01, ha="left", weight="bold", size=11)
    return figure


def _drawn(track: xr.Dataset, calibration: xr.Dataset) -> _Drawn:
    if "matrix" not in calibration:
        raise ContractError(
            "'matrix' is missing: these are coefficients of Tolles-Lawson",
            where="calibration",
            expected="matrix and bias of a vector magnetometer",
        )
    check_raw(track)
    attrs = calibration.attrs
    north, east, down = (float(c) for c in attrs["core_field_nt"])
    samples = select_samples(
        track,
        start=str(attrs["start"]),
        end=str(attrs["end"]),
        core_field_nt=(north, east, down),
        reference_field="",
        allow_extrapolated=False,
        model=None,
    )
    samples = samples.take(slice(None, None, -(-len(samples.time) // _MOST)))
    calibrated = (samples.raw - calibration["bias"].values) @ calibration["matrix"].values.T
    angle = heading(samples)
    return _Drawn(
        samples.seconds,
        _UNIT * samples.raw,
        _UNIT * calibrated,
        _UNIT * samples.core_mean,
        samples.attitude,
        None if angle is None else np.degrees(angle),
        attrs["method"] in PLANAR,
    )


def _title(calibration: xr.Dataset) -> str:
    attrs = calibration.attrs
    residual = _UNIT * float(calibration["residual_rms"])
    return (
        f"{attrs['source']}: {attrs['method']}, {attrs['samples']} samples, "
        f"{attrs['outliers']} outliers, residual {residual:.2g} {_LABEL} rms"
    )


def _draw_plane(panel: Axes, drawn: _Drawn, across: int, up: int) -> None:
    for field, colour, label in (
        (drawn.raw, _RAW, "as read"),
        (drawn.calibrated, _CALIBRATED, "calibrated"),
    ):
        panel.plot(field[:, across], field[:, up], ".", ms=2.0, color=colour, label=label)
    name = "core field's horizontal part" if drawn.level else "core field"
    radius = float(drawn.length(drawn.core))
    turn = np.linspace(0.0, 2.0 * np.pi, 361)
    panel.plot(radius * np.cos(turn), radius * np.sin(turn), color=_CORE, lw=1.2, label=name)
    panel.axhline(0.0, lw=0.5, color="#BBBBBB", zorder=0)
    panel.axvline(0.0, lw=0.5, color="#BBBBBB", zorder=0)
    panel.set_aspect("equal", adjustable="datalim")
    panel.set_xlabel(f"{AXES[across]}, {_LABEL}")
    panel.set_ylabel(f"{AXES[up]}, {_LABEL}")
    if AXES[up] == "down":
        panel.invert_yaxis()


def _draw_in_time(part: SubFigure, drawn: _Drawn, start: str) -> None:
    with_heading = drawn.level or drawn.heading is not None
    names = ["magnitude", "heading", "error"] if with_heading else ["magnitude", "error"]
    panels = part.subplot_mosaic([[name] for name in names], sharex=True)
    _draw_magnitude(panels["magnitude"], drawn)
    if with_heading:
        _draw_heading(panels["heading"], drawn)
    if drawn.heading is None:
        _draw_magnitude_error(panels["error"], drawn)
    else:
        _draw_heading_error(panels["error"], drawn, drawn.heading)
    panels["error"].set_xlabel(f"seconds since {start} UTC")
    part.align_ylabels(list(panels.values()))


def _draw_magnitude(panel: Axes, drawn: _Drawn) -> None:
    panel.axhline(float(drawn.length(drawn.core)), color=_CORE, lw=1.2)
    for field, colour in ((drawn.raw, _RAW), (drawn.calibrated, _CALIBRATED)):
        panel.plot(drawn.seconds, drawn.length(field), ".", ms=1.5, color=colour)
    what = "horizontal\nmagnitude" if drawn.level else "magnitude"
    panel.set_ylabel(f"{what}, {_LABEL}")
    panel.set_ylim(bottom=0.0)


def _draw_magnitude_error(panel: Axes, drawn: _Drawn) -> None:
    error = drawn.length(drawn.calibrated) - float(drawn.length(drawn.core))
    panel.plot(drawn.seconds, error, ".", ms=1.5, color=_CALIBRATED)
    panel.axhline(0.0, color=_CORE, lw=1.2)
    panel.set_ylabel(f"calibrated\nless core, {_LABEL}")


def _draw_heading(panel: Axes, drawn: _Drawn) -> None:
    if drawn.heading is not None:
        panel.plot(drawn.seconds, drawn.heading % 360.0, ".", ms=5.0, color=_CORE)
    for field, colour in ((drawn.raw, _RAW), (drawn.calibrated, _CALIBRATED)):
        found = _field_heading(field, drawn) % 360.0
        panel.plot(drawn.seconds, found, ".", ms=1.5, color=colour)
    panel.set_ylabel("heading, degrees")
    panel.set_ylim(0.0, 360.0)
    panel.set_yticks(range(0, 361, 90))


def _draw_heading_error(panel: Axes, drawn: _Drawn, heading: Real) -> None:
    for field, colour in ((drawn.raw, _RAW), (drawn.calibrated, _CALIBRATED)):
        error = (_field_heading(field, drawn) - heading + 180.0) % 360.0 - 180.0
        panel.plot(drawn.seconds, error, ".", ms=1.5, color=colour)
    panel.axhline(0.0, color=_CORE, lw=1.2)
    panel.set_ylabel("error of\nheading, degrees")


def _field_heading(field: Real, drawn: _Drawn) -> Real:
    """True heading (n,) by the horizontal field, degrees (Shockley 2012, eq. 2.11).

    Where the attitude is known the field is levelled by it: its azimuth less that of the core
    field is then the error of the heading.
    """
    declination = np.degrees(np.arctan2(drawn.core[1], drawn.core[0]))
    if drawn.heading is None:
        return np.asarray(declination - np.degrees(np.arctan2(field[:, 1], field[:, 0])))
    azimuth = np.full(len(field), np.nan)
    known = np.isfinite(drawn.attitude).all(axis=1)
    levelled = to_ned(field[known], drawn.attitude[known])
    azimuth[known] = np.degrees(np.arctan2(levelled[:, 1], levelled[:, 0]))
    return np.asarray(drawn.heading + declination - azimuth)
