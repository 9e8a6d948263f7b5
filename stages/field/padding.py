"""Extending a map beyond its border before a transform."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtiles.stages.field.spectral import odd_fast_length

Real = NDArray[np.float64]

_HEIGHTS = 20.0
_LEAST_CELLS = 128


@dataclass(frozen=True)
class Padding:
    """How many cells were added before and in all: padded[offset : offset + n] is the map."""

    offset: tuple[int, int]
    map_shape: tuple[int, int]
    shape: tuple[int, int]

    @property
    def interior(self) -> tuple[slice, slice]:
        """Where the map lies in the padded array."""
        return tuple(  # type: ignore[return-value]
            slice(o, o + n) for o, n in zip(self.offset, self.map_shape, strict=True)
        )


def plan_padding(
    shape: tuple[int, int], spacing: tuple[float, float], height_gain: float
) -> Padding:
    """Room for the transform's periodic images to stay out of the map.

    Half the map on each side suffices whatever the height; on large maps, 20 height gains and
    at least 128 cells do (component kernels reach farther than continuation's 10).
    """
    pads = [
        min(n // 2, max(_LEAST_CELLS, int(np.ceil(_HEIGHTS * abs(height_gain) / d))))
        for n, d in zip(shape, spacing, strict=True)
    ]
    padded = [odd_fast_length(n + 2 * p) for n, p in zip(shape, pads, strict=True)]
    offset = [(m - n) // 2 for m, n in zip(padded, shape, strict=True)]
    return Padding((offset[0], offset[1]), shape, (padded[0], padded[1]))


def pad(values: Real, padding: Padding) -> Real:
    """Reflect at the border under a cosine taper that ends at the map's mean.

    Reflection keeps the field continuous; the taper keeps the periodic images apart.
    """
    after = [
        total - before - n
        for total, before, n in zip(padding.shape, padding.offset, padding.map_shape, strict=True)
    ]
    widths = list(zip(padding.offset, after, strict=True))
    mean = values.mean()
    padded = np.pad(values - mean, widths, mode="reflect" if min(values.shape) > 1 else "edge")
    padded *= taper(values.shape[0], *widths[0])[:, None]
    padded *= taper(values.shape[1], *widths[1])
    padded += mean
    return np.asarray(padded)


def taper(length: int, before: int, after: int) -> Real:
    """1 over the map, falling as a half cosine to 0 just outside the padded array."""
    rise = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, before + 1) / (before + 1))
    fall = 0.5 + 0.5 * np.cos(np.pi * np.arange(1, after + 1) / (after + 1))
    return np.concatenate([rise, np.ones(length), fall])
