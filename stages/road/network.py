"""Road maps laid side by side, in which a section is looked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.kernels.geodesy import metres_per_degree, wrap_longitude
from magtiles.catalog.kernels.road_match import (
    Choice,
    Floats,
    Form,
    SectionMap,
    choose,
    prepare,
)


@dataclass(frozen=True)
class LocalPlane:
    """Metres north and east of a place: right within 0.3 % some 20 km around it."""

    latitude: float
    longitude: float

    @classmethod
    def around(cls, roads: Sequence[xr.Dataset]) -> LocalPlane:
        """About the first point of the first road."""
        first = roads[0]
        return cls(float(first["latitude"][0]), float(first["longitude"][0]))

    def metres(self, road: xr.Dataset) -> Floats:
        """Points (n, 2) of a road in the order of driving."""
        north, east = metres_per_degree(np.array(self.latitude), 0.0)
        y = (road["latitude"].values - self.latitude) * north
        x = wrap_longitude(road["longitude"].values - self.longitude) * east
        return np.ascontiguousarray(driven(road, np.column_stack([y, x])))


def driven(road: xr.Dataset, values: Floats) -> Floats:
    """Values (n, ...) of a road's points in the order of driving."""
    return values[::-1] if road.attrs["direction"] == "backward" else values


@dataclass(frozen=True)
class Network:
    """Several roads, prepared for sections of one length and form.

    Attributes
    ----------
    roads : each prepared.
    position : (n, 2) m, where a section's last sample lies, of all starts on all roads.
    run : (n,) number of the road of each.
    samples : of a section.
    answer : (n,) written anew for each section: pages of memory need not be asked for.
    """

    roads: tuple[SectionMap, ...]
    counts: tuple[int, ...]
    position: Floats
    run: NDArray[np.int64]
    samples: int
    answer: Floats

    @classmethod
    def of(
        cls, roads: Sequence[xr.Dataset], variances: Sequence[Floats], plane: LocalPlane,
        form: Form, samples: int,
    ) -> Network:  # fmt: skip
        """Prepare roads with variances (n, 3), nT2; one shorter than a section is left out."""
        held = [
            (r, v) for r, v in zip(roads, variances, strict=True) if r.sizes["point"] >= samples
        ]
        counts = [r.sizes["point"] - samples + 1 for r, _ in held]
        maps = [
            prepare(driven(r, r["field_body"].values.astype(np.float64)), driven(r, v), form)
            for r, v in held
        ]
        ends = [plane.metres(r)[samples - 1 :] for r, _ in held]
        return cls(
            tuple(maps),
            tuple(counts),
            np.concatenate([*ends, np.empty((0, 2))]),
            np.repeat(np.arange(len(held)), counts).astype(np.int64),
            samples,
            np.empty(sum(counts)),
        )

    def log_likelihood(self, section: Floats) -> Floats:
        """Of a section (K, 3) that begins at each start; holds until the next is asked for."""
        start = 0
        for road, count in zip(self.roads, self.counts, strict=True):
            road.log_likelihood(section, 0, count, self.answer[start : start + count])
            start += count
        return self.answer

    def choose(self, section: Floats, *, minimum_distance_m: float, bin_points: int) -> Choice:
        """What the methods say of a section (K, 3)."""
        return choose(
            self.log_likelihood(section), self.position, self.run,
            minimum_distance_m=minimum_distance_m, bin_points=bin_points,
        )  # fmt: skip
