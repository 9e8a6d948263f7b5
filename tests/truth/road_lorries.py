"""Which lorries that one pass meets are left out of a map, and what steel is: run, it prints both.

The drives are the sample's, over roads of several seeds and without lorries; after calibration,
resampling and alignment the field of a lorry is added to one pass of nine, somewhere.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from unittest import mock

import numpy as np
from numpy.typing import NDArray
from road_sample import MAPS, build, opened, passes_of

from magtiles.catalog.kernels.dipole import dipole_vector
from magtiles.pipeline.sample_drives import (
    LOOP,
    LOT,
    MAPPING,
    PASSES,
    ROAD,
)
from magtiles.stages.road import merge
from magtiles.stages.road.statistics import Statistics
from magtiles.stages.road.transient import drop_transients

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

VEHICLES = tuple(vehicle.name for vehicle in MAPPING for _ in range(PASSES))
MOMENTS = (1000.0, 1500.0, 2000.0, 3000.0, 5000.0)


def lorry(
    distance: Floats, at: float, core: Floats, moment: float, *, aside_m: float = -3.6,
    closing: float = 2.0,
) -> Floats:  # fmt: skip
    """Field (point, 3), nT, of 6 m of steel that comes by at a distance along the road.

    As `magtiles.pipeline.road_truth.passing_field`, at the height of the sensor; `core` is the
    direction of the field in the vehicle's frame, `closing` the speed of both over its own.
    """
    places = np.array([[along, aside_m, 0.0] for along in (-3.0, 0.0, 3.0)])
    points = np.zeros((len(distance), 3))
    points[:, 0] = closing * (distance - at)
    return dipole_vector(points, places, np.tile(moment / 3.0 * core, (3, 1)))


def dropped(fields: Floats, vehicles: Sequence[str] = VEHICLES, spacing_m: float = 1.0) -> Mask:
    """Where something is dropped (point,) of aligned passes (pass, point, 3), NaN where none is."""
    count = fields.shape[1]
    kept = Statistics([], np.zeros((0, count), np.int32), *np.zeros((2, 0, count, 3)))
    already = np.zeros(count, np.bool_)
    for name, field in zip(vehicles, fields, strict=True):
        vehicle, where = kept.index(name), np.isfinite(field).all(axis=1)
        known = np.where(where[:, None], field, 0.0)
        if kept.passes.any():
            where, out = drop_transients(kept, vehicle, known, where, spacing_m, already)
            already |= out
        kept.add(vehicle, known, where)
    return already


def felt(field: Floats) -> Mask:
    """Where a lorry's field is above half of its greatest."""
    size = np.linalg.norm(field, axis=1)
    return np.asarray(size > 0.5 * size.max())


@dataclass(frozen=True)
class Aligned:
    """Passes of a road (pass, point, 3), the points' distance, heading (radians) and speed."""

    fields: Floats
    distance: Floats
    heading: Floats
    speed: Floats
    core: Floats

    def with_lorry(
        self, number: int, moment: float, rng: np.random.Generator
    ) -> tuple[Floats, Mask]:
        """The passes, of which one meets a lorry where it drives, and where it is felt."""
        driven = np.flatnonzero(self.speed[50:-50] > 8.0) + 50
        point = rng.choice(driven)
        cos, sin = np.cos(self.heading[point]), np.sin(self.heading[point])
        north, east, down = self.core
        core = np.array([cos * north + sin * east, cos * east - sin * north, down])
        field = lorry(
            self.distance, self.distance[point], core, moment,
            aside_m=-3.6 - 0.5 * rng.normal(), closing=1.0 + 12.0 / self.speed[point],
        )  # fmt: skip
        fields = self.fields.copy()
        fields[number] += field
        return fields, felt(field)


def aligned(folder: Path, seed: int) -> list[Aligned]:
    """Make the drives over the sample's roads with other steel; their passes, each on the first."""
    roads = [replace(road, seed=road.seed + seed, passing=()) for road in (LOOP, ROAD)]
    made = build(folder, [LOT, *roads])
    return [_aligned(name, made) for name in MAPS]


def _aligned(name: str, roads: Path) -> Aligned:
    found = passes_of(name, roads)
    route = name.split("-")[0]
    drives = [f"{v.name}-{route}-{n}" for v in MAPPING for n in range(1, PASSES + 1)]
    seen: list[Floats] = [found[drives[0]]["field_body"].values]

    def keep(_: object, __: int, field: Floats, where: Mask, *___: object) -> tuple[Mask, Mask]:
        seen.append(np.where(where[:, None], field, np.nan))
        return where, np.zeros_like(where)

    with mock.patch.object(merge, "drop_transients", keep):
        merge.merge_passes([found[drive] for drive in drives], params=merge.MergeParams())
    made = opened(roads / f"{name}-features.nc")
    return Aligned(
        np.stack(seen), made["distance"].values, np.radians(made["heading"].values),
        made["speed"].values, MAPS[name].induced,
    )  # fmt: skip


def print_steel(roads: Sequence[Aligned]) -> None:
    """Points that are dropped where there is no lorry."""
    out = [dropped(road.fields) for road in roads]
    stretches = sum(int((np.diff(np.concatenate([[0], o.astype(int)])) == 1).sum()) for o in out)
    print(
        f"without lorries {sum(int(o.sum()) for o in out)} points in {stretches} stretches "
        f"are dropped of {sum(o.size for o in out)} points of {len(VEHICLES)} passes\n"
    )


def print_lorries(roads: Sequence[Aligned], trials: int) -> None:
    """Share of lorries dropped, by moment, of the first two passes and of the others."""
    print(
        "| moment, kA m2 | felt, uT | of the first two passes | of the others |\n|---|---|---|---|"
    )
    for moment in MOMENTS:
        rng = np.random.default_rng(1)
        found: dict[bool, list[bool]] = {True: [], False: []}
        peaks = []
        for trial in range(trials):
            number = trial % len(VEHICLES)
            for road in roads:
                fields, where = road.with_lorry(number, moment, rng)
                peaks.append(np.nanmax(np.linalg.norm(fields - road.fields, axis=2)[number]))
                found[number < 2].append(bool(dropped(fields)[where].mean() > 0.5))
        low, high = np.percentile(peaks, [10.0, 90.0]) / 1000.0
        first, others = (f"{100 * np.mean(found[k]):.0f} %" for k in (True, False))
        print(f"| {moment / 1000:g} | {low:.1f} to {high:.1f} | {first} | {others} |")


def main() -> None:
    """Print how many points and lorries are dropped."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 10, 20])
    parser.add_argument("--trials", type=int, default=9)
    options = parser.parse_args()
    roads = []
    for seed in options.seeds:
        with tempfile.TemporaryDirectory() as folder:
            roads += aligned(Path(folder), seed)
    print_steel(roads)
    print_lorries(roads, options.trials)


if __name__ == "__main__":
    main()
