"""What tests compare: the three quantities of an anomaly, answered or exact."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Field:
    """Total (...) nT, vector (..., 3) nT, tensor (..., 5) nT/km; or one sigma (...) of each."""

    total: Floats
    vector: Floats
    tensor: Floats

    def __iter__(self) -> Iterator[tuple[str, Floats]]:
        """Name and values (..., components) of each."""
        shape = np.shape(self.total)
        for name in ("total", "vector", "tensor"):
            values = np.asarray(getattr(self, name))
            yield name, values[..., None] if values.shape == shape else values


def relative(found: Floats, truth: Floats) -> Floats:
    """Rms error over rms truth (components,) of arrays (..., components)."""
    axes = tuple(range(found.ndim - 1))
    return np.asarray(np.sqrt(((found - truth) ** 2).mean(axis=axes) / (truth**2).mean(axis=axes)))


def relative_rms(found: Field, truth: Field) -> dict[str, Floats]:
    """`relative` of each quantity."""
    return {name: relative(f, t) for (name, f), (_, t) in zip(found, truth, strict=True)}
