"""Pictures of a release's level: the map, its uncertainty and its flags beside it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.flags import QualityFlag
from magtiles.stages.release.atomic import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DPI = 140
_MAX_NODES = 900
"""Nodes along an axis that a picture can show; more are thinned."""
_SMOOTH_BELOW = 700
"""Nodes below which a picture would show single cells, and is interpolated instead."""


@dataclass(frozen=True)
class Quantity:
    """A variable that can be drawn, with the variable of its uncertainty."""

    variable: str
    uncertainty: str
    label: str
    unit: str


def _quantities() -> dict[str, Quantity]:
    found = {
        "total": Quantity(
            "magnetic_anomaly", "magnetic_anomaly_uncertainty", "total-field anomaly", "nT"
        )
    }
    for axis in ("north", "east", "down"):
        found[axis] = Quantity(f"anomaly_{axis}", "vector_uncertainty", f"anomaly {axis}", "nT")
    for pair in ("nn", "ne", "nd", "ee", "ed"):
        found[pair] = Quantity(
            f"gradient_{pair}", "tensor_uncertainty", f"gradient {pair}", "nT/km"
        )
    return found


QUANTITIES = _quantities()

# Okabe and Ito's palette, which people with any colour vision tell apart; first drawn on top.
_FLAG_COLOURS = {
    QualityFlag.BEYOND_COVERAGE: "#999999",
    QualityFlag.VOID_FILLED: "#E69F00",
    QualityFlag.DOWNWARD_CONTINUED: "#CC79A7",
    QualityFlag.POORLY_LEVELLED: "#D55E00",
    QualityFlag.REDUCED_ACCURACY_DIRECTION: "#56B4E9",
}
_NO_FLAG_COLOUR = "#F2F2EC"


def preview_figure(
    latitude: NDArray[np.float64],
    longitude: NDArray[np.float64],
    values: NDArray[np.floating[Any]],
    uncertainty: NDArray[np.floating[Any]],
    flags: NDArray[np.uint8],
    *,
    quantity: str,
    title: str,
    note: str,
    change: bool = False,
) -> Figure:
    """Draw one level: shaded map, uncertainty, flags.

    Parameters
    ----------
    latitude, longitude : (rows,), (columns,) ascending, uniform, degrees.
    values, uncertainty, flags : (rows, columns).
    quantity : a key of `QUANTITIES`; says the unit and the labels.
    note : small print below: reference field and epoch, source.
    change : `values` are changes: all in the range of colours, and no relief over them.
    """
    from matplotlib.figure import Figure

    step = max(1, -(-max(values.shape) // _MAX_NODES))
    thin = (slice(None, None, step), slice(None, None, step))
    latitude, longitude = latitude[::step], longitude[::step]
    values, uncertainty, flags = values[thin], uncertainty[thin], flags[thin]
    shown = (flags & QualityFlag.BEYOND_COVERAGE) == 0
    kind = QUANTITIES[quantity]
    shape = float(np.ptp(latitude) / (np.ptp(longitude) * _cosine(latitude)))
    layout = _Layout(shape, legend_lines=1 + len(_flags_present(flags)))
    figure = Figure(figsize=layout.size)
    axes = {name: figure.add_axes(box) for name, box in layout.boxes().items()}
    place = (latitude, longitude)
    values = np.where(shown, values, np.nan)
    _draw_map(axes["map"], axes["map bar"], *place, values, flags, kind, change)
    _draw_uncertainty(
        axes["side"], axes["side bar"], *place, np.where(shown, uncertainty, np.nan), kind.unit
    )
    _draw_flags(axes["flags"], *place, flags)
    figure.text(0.01, 1 - 0.12 / layout.height, title, size=13, weight="bold", va="top")
    figure.text(0.01, 0.1 / layout.height, note, size=8, color="#444444")
    return figure


def save_png(figure: Figure, path: Path) -> None:
    """Write a figure; the same figure gives the same bytes (no date, no version of anything)."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", dpi=_DPI, metadata={"Software": None})


class _Layout:
    """Where the panels lie, in inches from the top left: a map, two small maps, their bars.

    `shape` is the true height of the map over its width; every panel has it, so none has gaps.
    """

    def __init__(self, shape: float, legend_lines: int) -> None:
        self._shape = shape
        self._map_width = 5.4 * min(1.0, 1.5 / shape)
        self._side_width = 0.4 * self._map_width
        map_bottom = 0.75 + self._map_width * shape
        side_height = self._side_width * shape
        self._flags_top = max(0.75 + side_height + 0.65, map_bottom - side_height)
        legend_bottom = self._flags_top + side_height + 0.4 + 0.2 * legend_lines
        self._bar_top = map_bottom + 0.42
        self.height = max(self._bar_top + 1.0, legend_bottom + 0.3)
        self._side_left = 0.75 + self._map_width + 0.94
        self._width = self._side_left + self._side_width + 0.75

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the figure, in inches."""
        return self._width, self.height

    def boxes(self) -> dict[str, tuple[float, float, float, float]]:
        """Panels as fractions of the figure: left, bottom, width, height."""
        map_width, side_width, left = self._map_width, self._side_width, self._side_left
        side_height = side_width * self._shape
        inches = {
            "map": (0.75, 0.75, map_width, map_width * self._shape),
            "map bar": (0.75 + 0.1 * map_width, self._bar_top, 0.8 * map_width, 0.14),
            "side": (left, 0.75, side_width, side_height),
            "side bar": (left + side_width + 0.08, 0.75, 0.12, side_height),
            "flags": (left, self._flags_top, side_width, side_height),
        }
        return {
            name: (
                x / self._width,
                1.0 - (y + height) / self.height,
                width / self._width,
                height / self.height,
            )
            for name, (x, y, width, height) in inches.items()
        }


def _cosine(latitude: NDArray[np.float64]) -> float:
    return float(np.cos(np.radians(latitude.mean())))


def _extent(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float, float, float]:
    dx, dy = (x[-1] - x[0]) / (x.size - 1) / 2, (y[-1] - y[0]) / (y.size - 1) / 2
    return x[0] - dx, x[-1] + dx, y[0] - dy, y[-1] + dy


def _draw_map(
    axes: Axes,
    bar_axes: Axes,
    latitude: NDArray[np.float64],
    longitude: NDArray[np.float64],
    values: NDArray[np.floating[Any]],
    flags: NDArray[np.uint8],
    kind: Quantity,
    change: bool,
) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    largest = float(np.nanmax(np.abs(values), initial=0.0))
    limit = (largest or 1.0) if change else _robust_limit(values)
    colours = ScalarMappable(Normalize(-limit, limit), "RdBu_r")
    picture = colours.to_rgba(values)
    if not change:
        shade = hillshade(latitude, longitude, values)
        picture[..., :3] = _lit(picture[..., :3], shade[..., np.newaxis])
    picture[np.isnan(values)] = (1.0, 1.0, 1.0, 0.0)
    smooth = "bilinear" if max(values.shape) < _SMOOTH_BELOW else "auto"
    _show(axes, latitude, longitude, picture, ticks=5, interpolation=smooth)
    beyond = (flags & QualityFlag.BEYOND_COVERAGE) != 0
    filled = (flags & QualityFlag.VOID_FILLED) != 0
    _outline(axes, latitude, longitude, beyond, "solid")
    _outline(axes, latitude, longitude, filled & ~beyond, "dotted")
    _scale_bar(axes, latitude, longitude)
    bar = axes.figure.colorbar(
        colours,
        cax=bar_axes,
        orientation="horizontal",
        extend="both" if largest > limit else "neither",
    )
    bar.set_label(f"{'change of ' if change else ''}{kind.label} ({kind.unit})")


def _robust_limit(values: NDArray[np.floating[Any]]) -> float:
    """The 99.5th percentile of magnitudes, up to two digits, so that few peaks do not decide."""
    finite = np.abs(values[np.isfinite(values)])
    limit = float(np.percentile(finite, 99.5)) if finite.size else 0.0
    if limit == 0.0:
        return 1.0
    digit = 10.0 ** (np.floor(np.log10(limit)) - 1)
    return float(np.ceil(limit / digit) * digit)


def hillshade(
    latitude: NDArray[np.float64],
    longitude: NDArray[np.float64],
    values: NDArray[np.floating[Any]],
) -> NDArray[np.float64]:
    """Light from the north-west on the map as a relief, (rows, columns) in 0 to 1; flat is 0.5.

    The relief is scaled so that one slope in ten is steeper than 45 degrees; NaN is flat.
    """
    cosine = _cosine(latitude)
    south_north, west_east = np.gradient(np.asarray(values, np.float64), latitude, longitude)
    west_east = west_east / cosine
    slope = np.hypot(south_north, west_east)
    finite = slope[np.isfinite(slope)]
    steep = float(np.percentile(finite, 90)) if finite.size else 0.0
    if steep == 0.0:
        return np.full(values.shape, 0.5)
    north, east = south_north / steep, west_east / steep
    # A slope that rises toward the south-east faces the light.
    facing = (east - north) / np.sqrt(2.0 * (1.0 + north**2 + east**2))
    shade: NDArray[np.float64] = np.nan_to_num(0.5 + 0.5 * facing, nan=0.5)
    return shade


def _lit(colour: NDArray[np.float64], shade: NDArray[np.float64]) -> NDArray[np.float64]:
    # Flat ground keeps its colour exactly, so the colour bar stays true.
    light = 0.9 * (shade - 0.5)
    lit: NDArray[np.float64] = np.where(
        light < 0, colour * (1.0 + light), colour + (1.0 - colour) * light
    )
    return lit


def _show(
    axes: Axes,
    latitude: NDArray[np.float64],
    longitude: NDArray[np.float64],
    image: NDArray[Any],
    *,
    ticks: int,
    **options: Any,
) -> Any:
    shown = axes.imshow(image, origin="lower", extent=_extent(longitude, latitude), **options)
    axes.set_aspect(1.0 / _cosine(latitude))
    axes.xaxis.set_major_formatter(lambda x, _: _degrees(x, "E", "W"))
    axes.yaxis.set_major_formatter(lambda y, _: _degrees(y, "N", "S"))
    axes.locator_params(axis="both", nbins=ticks)
    axes.tick_params(labelsize=8, direction="out")
    return shown


def _degrees(value: float, positive: str, negative: str) -> str:
    if positive == "E":
        value = (value + 180.0) % 360.0 - 180.0
    text = f"{abs(round(value, 6)):g}\N{DEGREE SIGN}"
    return text + (positive if value > 0 else negative if value < 0 else "")


def _outline(
    axes: Axes,
    latitude: NDArray[np.float64],
    longitude: NDArray[np.float64],
    marked: NDArray[np.bool_],
    style: str,
) -> None:
    if marked.any() and not marked.all():
        axes.contour(
            longitude,
            latitude,
            marked,
            levels=[0.5],
            colors="black",
            linewidths=0.9,
            linestyles=style,
        )


def _scale_bar(axes: Axes, latitude: NDArray[np.float64], longitude: NDArray[np.float64]) -> None:
    km_per_degree = 111.32 * _cosine(latitude)  # for drawing: WGS84's equator is close enough
    longest = 0.3 * float(np.ptp(longitude)) * km_per_degree
    decade = 10.0 ** np.floor(np.log10(longest))
    length = decade * max(n for n in (1, 2, 5) if n * decade <= longest)
    west, _, south, north = _extent(longitude, latitude)
    x = west + 0.04 * float(np.ptp(longitude))
    y = south + 0.04 * (north - south)
    ends = [x, x + length / km_per_degree]
    for colour, width in (("white", 5.0), ("black", 2.0)):
        axes.plot(ends, [y, y], color=colour, linewidth=width, solid_capstyle="butt")
    axes.annotate(
        f"{length:g} km",
        (float(np.mean(ends)), y),
        (0, 4),
        textcoords="offset points",
        ha="center",
        fontsize=8,
        bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none"},
    )


def _draw_uncertainty(
    axes: Axes,
    bar_axes: Axes,
    latitude: NDArray[np.float64],
    longitude: NDArray[np.float64],
    uncertainty: NDArray[np.floating[Any]],
    unit: str,
) -> None:
    from matplotlib import ticker
    from matplotlib.colors import LogNorm, Normalize

    finite = uncertainty[np.isfinite(uncertainty)]
    low, high = np.percentile(finite, [0.5, 99.5]) if finite.size else (1.0, 1.0)
    wide = low > 0 and high / low > 8
    even = high - low < 0.02 * high
    norm = LogNorm(low, high) if wide else Normalize(low, high)
    if even:
        norm = Normalize(0.9 * low, 1.1 * high)
    drawn = _show(axes, latitude, longitude, uncertainty, ticks=3, cmap="cividis", norm=norm)
    axes.set_title("uncertainty, 1 sigma", fontsize=9, loc="left")
    bar = axes.figure.colorbar(drawn, cax=bar_axes)
    if wide:
        bar.set_ticks(ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
        bar.ax.yaxis.set_minor_locator(ticker.NullLocator())
        bar.ax.yaxis.set_major_formatter(ticker.StrMethodFormatter("{x:g}"))
    bar.set_label(unit, fontsize=8)
    bar.ax.tick_params(labelsize=8)


def _draw_flags(
    axes: Axes,
    latitude: NDArray[np.float64],
    longitude: NDArray[np.float64],
    flags: NDArray[np.uint8],
) -> None:
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Patch
    from matplotlib.transforms import ScaledTranslation

    picture = np.empty((*flags.shape, 3))
    picture[:] = to_rgb(_NO_FLAG_COLOUR)
    clear = float(np.mean(flags == 0))
    legend = [Patch(fc=_NO_FLAG_COLOUR, ec="#888888", label=f"none, {clear:.1%}")]
    undrawn = np.ones(flags.shape, dtype=np.bool_)
    for flag in _flags_present(flags):
        marked = undrawn & ((flags & flag) != 0)
        if not marked.any():
            continue
        undrawn &= ~marked
        picture[marked] = to_rgb(_FLAG_COLOURS[flag])
        name = str(flag.name).lower().replace("_", " ")
        label = f"{name}, {marked.mean():.1%}"
        legend.append(Patch(fc=_FLAG_COLOURS[flag], ec="#888888", label=label))
    _show(axes, latitude, longitude, picture, ticks=3, interpolation="nearest")
    axes.set_title("quality flags", fontsize=9, loc="left")
    below_ticks = ScaledTranslation(0.0, -0.35, axes.figure.dpi_scale_trans)
    axes.legend(
        handles=legend,
        loc="upper left",
        bbox_to_anchor=(0.0, 0.0),
        bbox_transform=axes.transAxes + below_ticks,
        fontsize=8,
        frameon=False,
        borderaxespad=0.0,
    )


def _flags_present(flags: NDArray[np.uint8]) -> list[QualityFlag]:
    together = int(np.bitwise_or.reduce(flags, axis=None))
    return [flag for flag in _FLAG_COLOURS if flag & together]
