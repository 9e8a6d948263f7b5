"""One pass over a whole map that is too large for one transform.

It finds what blocks of the map cannot know by themselves: the long wavelengths, solved on a
thinned copy, and of the uncertainty all that is the map's and not a place's, so that no seam
shows in it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import sparse
from scipy.special import expit

from magtiles.stages.field.decimation import passed, thinning_matrix
from magtiles.stages.field.direction import AmbientSource
from magtiles.stages.field.missing import MissingData, ThinMap, missing_data, thinning_of
from magtiles.stages.field.padding import Padding, plan_padding
from magtiles.stages.field.product import Level
from magtiles.stages.field.solve import (
    Followed,
    coarse_directions,
    follow,
    noise_to_signal,
    split_direction,
)
from magtiles.stages.field.spectral import (
    TENSOR,
    VECTOR,
    Complex,
    Inversion,
    Wavenumbers,
    forward,
    inverse,
    odd_fast_length,
)
from magtiles.stages.field.uncertainty import (
    GROUPS,
    Budget,
    alias_gain,
    lost_power,
    noise_gain_of,
)
from magtiles.stages.field.windows import MapWindows, Reflection, Span, spans

Real = NDArray[np.float64]
Direction = tuple[float, float, float]

NINE = ("total", *VECTOR, *TENSOR)

LONG_CELLS, SHORT_CELLS = 80.0, 36.0
"""From which wavelength on, in cells, all is long, and up to which nothing is."""
_THIN_CELLS, _DENSITY = 8.0, 2
_STRIP, _PATCHES = 512, 4
"""Rows that are read at a time, and how many patches as wide as that beside each other."""
_NOISE_NODES, _WIDE_CELLS = 1025, 16.0


def survey_whole(windows: MapWindows, ambient: AmbientSource, height_gain: float) -> xr.Dataset:
    """What every block of a map must know of it, `height_gain` m above it.

    Variables: `long_*`, cubic B-spline coefficients (long_row, long_column), periodic over the
    padded map, of the long wavelengths: "map", the anomaly as it is mapped (nT), and the nine
    products at the level (nT, nT/km) along plane axes; `missing_*`, as of `MissingData`.
    Attributes: `mean` and `sigma` of the map, the `direction` that the long wavelengths' total is
    along and the `rounds` it took, and the numbers of the uncertainty's `Budget`.
    """
    padding = plan_padding(windows.shape, windows.spacing, height_gain)
    sums = _pass(windows, padding)
    directions = coarse_directions(windows.plane, windows.y, windows.x, ambient)
    direction, variation = split_direction(directions)
    ratio = noise_to_signal(sums.noise, sums.variance)
    thinned = sums.coarse + windows.mean
    inversion, observed, found = _long_spectra(thinned, padding, windows, direction, variation)
    variables: dict[str, tuple[tuple[str, str], NDArray[np.floating]]] = {}
    for name, spectrum, height in [
        ("map", observed, 0.0),
        *((n, found.total, height_gain) for n in NINE),
    ]:
        level = Level(spectrum, inversion, height, ratio, _DENSITY)
        product = "total" if name == "map" else name
        values = level.values(product, slice(None), slice(None))
        variables[f"long_{name}"] = (("long_row", "long_column"), values)
    missing = missing_data(sums.thin, padding, direction, height_gain)
    for name, variance in missing.variance.items():
        variables[f"missing_{name}"] = (("thin_row", "thin_column"), variance)
    attributes = {
        "mean": windows.mean,
        "sigma": windows.sigma,
        "direction": np.array(direction),
        "rounds": found.rounds,
        "noise_to_signal": ratio,
        "signal": sums.signal,
        "thinning": missing.thinning,
    }
    extended = [float((axis.weights**2).sum()) / axis.count for axis in Reflection.pair(padding)]
    power = sums.power * np.prod(extended)
    parts = _gains(windows, power - sums.noise, direction, ratio, height_gain)
    attributes |= {
        f"{part}_{group}": gains[group] for part, gains in parts.items() for group in GROUPS
    }
    return xr.Dataset(variables, attrs=attributes)


def budget_of(whole: xr.Dataset) -> Budget:
    """The uncertainty's parts that `survey_whole` found."""
    noise, faded, alias = (
        {group: float(whole.attrs[f"{part}_{group}"]) for group in GROUPS}
        for part in ("noise", "faded", "alias")
    )
    names = (*GROUPS, "roughness")
    variance = {name: whole[f"missing_{name}"].values for name in names}
    missing = MissingData(variance, int(whole.attrs["thinning"]))
    return Budget(noise, faded, alias, float(whole.attrs["signal"]), missing)


@dataclass(frozen=True)
class _Pass:
    """What one reading of the map gives.

    Attributes
    ----------
    coarse : the map extended by its padding and thinned, less the map's mean, nT.
    thin : the copy that the errors for want of data are measured on.
    variance, signal, noise : of all values, of the measured ones, and of the survey's noise.
    power : spectral power of patches of the map, mean over them, per node.
    """

    coarse: Real
    thin: ThinMap
    variance: float
    signal: float
    noise: float
    power: Real


def _pass(windows: MapWindows, padding: Padding) -> _Pass:
    shape, size = windows.shape, windows.shape[0] * windows.shape[1]
    counts = _coarse_shape(padding, windows.spacing)
    down, across = (
        thinning_matrix(axis, n) for axis, n in zip(Reflection.pair(padding), counts, strict=True)
    )
    thinning = thinning_of(shape)
    rows_of, columns_of = (_block_means(n, thinning) for n in shape)
    coarse = np.zeros(counts)
    thin = np.zeros((3, rows_of.shape[0], columns_of.shape[0]))
    patch = _patch_shape(shape)
    power, patches = np.zeros((patch[0], patch[1] // 2 + 1)), 0
    squares = noise = 0.0
    measured = np.zeros(3)
    pieces = [
        (columns, starts, across[:, slice(*columns)], columns_of[:, slice(*columns)])
        for columns, starts in _pieces(shape[1])
    ]
    for rows in spans(shape[0], _STRIP):
        part, count = slice(*rows), rows[1] - rows[0]
        narrow = np.zeros((counts[1], count))
        means = np.zeros((3, columns_of.shape[0], count))
        for columns, starts, across_here, columns_here in pieces:
            piece = windows.read(rows, columns)
            centred = piece.values - windows.mean
            narrow += across_here @ centred.T
            for total, values in zip(means, (piece.values, piece.void, piece.beyond), strict=True):
                total += columns_here @ values.T.astype(float)
            squares += float((centred**2).sum())
            noise += float(np.mean(piece.sigma**2)) * centred.size
            known = centred[~(piece.void | piece.beyond)]
            measured += known.size, known.sum(), (known**2).sum()
            for found in _powers(centred, starts, patch):
                power += found
                patches += 1
        coarse += down[:, part] @ narrow.T
        for total, thinned in zip(thin, means, strict=True):
            total += rows_of[:, part] @ thinned.T
    mean = measured[1] / measured[0]
    return _Pass(
        coarse,
        ThinMap(thin[0], thin[1], thin[2], thinning, windows.spacing, noise / size),
        squares / size,
        float(measured[2] / measured[0] - mean**2),
        noise / size,
        power / patches,
    )


def _coarse_shape(padding: Padding, spacing: tuple[float, float]) -> tuple[int, int]:
    """Samples of the thinned map: as far apart along both axes, over the padding's period.

    The period is that of one transform of the whole map, so that both take the same view of
    what lies beyond the map.
    """
    step = _THIN_CELLS * max(spacing)
    first, second = (
        odd_fast_length(max(int(np.ceil(n * d / step)), 3))
        for n, d in zip(padding.shape, spacing, strict=True)
    )
    return first, second


def _long_spectra(
    thinned: Real,
    padding: Padding,
    windows: MapWindows,
    direction: Direction,
    variation: list[Real],
) -> tuple[Inversion, Complex, Followed]:
    """Spectra of the long wavelengths: as mapped, and their total along the mean direction."""
    ratio = [n / m for n, m in zip(padding.shape, thinned.shape, strict=True)]
    spacing = windows.spacing[0] * ratio[0], windows.spacing[1] * ratio[1]
    w = Wavenumbers((thinned.shape[0], thinned.shape[1]), spacing)
    inversion = Inversion(w, direction)
    offset, extent = (
        tuple(v / q for v, q in zip(values, ratio, strict=True))
        for values in (padding.offset, (n - 1 for n in padding.map_shape))
    )
    shape = extent[0] + 1.0, extent[1] + 1.0
    kept = _long(w.k * max(windows.spacing)) / (passed(w.y, spacing[0]) * passed(w.x, spacing[1]))
    observed = kept * forward(thinned)
    # Filtered first and followed then: the other way round is not the same where f turns.
    mapped = inverse(observed.copy(), w.shape, slice(None), slice(None)).astype(float, copy=False)
    found = follow(mapped, inversion, variation, (offset[0], offset[1]), shape)
    return inversion, observed, found


def _long(k: Real) -> Real:
    """What counts as long at wavenumbers k (rad/cell): a step, smooth to every order."""
    with np.errstate(divide="ignore"):
        wavelength = 2 * np.pi / k
        t = np.log(wavelength / SHORT_CELLS) / np.log(LONG_CELLS / SHORT_CELLS)
    t = np.clip(t, 1e-6, 1.0 - 1e-6)
    return np.asarray(expit(1.0 / (1.0 - t) - 1.0 / t))


def _gains(
    windows: MapWindows, power: Real, direction: Direction, ratio: float, height_gain: float
) -> dict[str, dict[str, float]]:
    """The numbers of the uncertainty's budget; `power` is the signal's, of patches of the map."""
    patch = _patch_shape(windows.shape)
    spectrum = Inversion(Wavenumbers(patch, windows.spacing), direction)
    # Far up only wavelengths of many nodes are left: wider nodes resolve them as well.
    wide = max(1.0, height_gain / _WIDE_CELLS / max(windows.spacing))
    spacing = windows.spacing[0] * wide, windows.spacing[1] * wide
    shape = odd_fast_length(_NOISE_NODES), odd_fast_length(_NOISE_NODES)
    white = noise_gain_of(Inversion(Wavenumbers(shape, spacing), direction), height_gain, ratio)
    return {
        "noise": {group: gain / wide**2 for group, gain in white.items()},
        "faded": lost_power(spectrum, power, height_gain),
        "alias": alias_gain(windows.grid, spectrum, height_gain),
    }


def _block_means(count: int, size: int) -> sparse.csr_array:
    """Means over blocks of `size` of `count` nodes; the last block repeats the last node."""
    blocks = -(-count // size)
    nodes = np.arange(blocks * size)
    weights = np.full(nodes.size, 1.0 / size)
    places = nodes // size, np.minimum(nodes, count - 1)
    return sparse.csr_array(sparse.coo_array((weights, places), shape=(blocks, count)))


def _patch_shape(shape: tuple[int, int]) -> tuple[int, int]:
    """Nodes of a patch whose spectrum is taken: odd, for the transform."""
    first, second = ((n // len(spans(n, _STRIP)) - 1) // 2 * 2 + 1 for n in shape)
    return first, second


def _pieces(columns: int) -> list[tuple[Span, list[int]]]:
    """Spans of columns that are read at a time, and where the patches in each of them start."""
    found = spans(columns, _STRIP)
    groups = [found[i : i + _PATCHES] for i in range(0, len(found), _PATCHES)]
    return [((g[0][0], g[-1][1]), [first - g[0][0] for first, _ in g]) for g in groups]


def _powers(piece: Real, starts: list[int], patch: tuple[int, int]) -> Iterator[Real]:
    """Spectral power of a piece's patches under a Hann window, per node."""
    window = np.multiply.outer(*(np.hanning(n + 2)[1:-1] for n in patch))
    for first in starts:
        part = piece[: patch[0], first : first + patch[1]]
        centred = (part - np.average(part, weights=window)) * window
        yield np.abs(forward(centred)) ** 2 / (window**2).sum()
