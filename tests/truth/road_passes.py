"""Nine passes of three vehicles against the field that they drove through.

``python tests/truth/road_passes.py 50`` merges the passes of so many roads of 400 m, and prints how
near to the truth the maps are.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from functools import cache
from typing import NamedTuple

import numpy as np
import xarray as xr
from roads import Road, Trip, Vehicle, drive

from magtiles.schemas import contracts
from magtiles.stages.road.merge import MergeParams, merge_passes
from magtiles.stages.road.resample import ResampleParams, resample_by_distance

ROAD = Road(length_m=700.0, dipoles=140)
TRUCK = (350.0, 6000.0)


def one_pass(
    vehicle: Vehicle, seed: int, *, onto: xr.Dataset | None = None, road: Road = ROAD,
    **trip: object,
) -> xr.Dataset:  # fmt: skip
    rng = np.random.default_rng(seed)
    options: dict[str, object] = {
        "speed_m_s": rng.uniform(9.0, 18.0), "lane_m": 0.5 * rng.normal(), **trip,
    }  # fmt: skip
    track = drive(road, vehicle, Trip(seed=seed, **options))  # type: ignore[arg-type]
    params = ResampleParams(vehicle=vehicle.name, pass_name=f"{vehicle.name}-{seed}")
    return resample_by_distance(track, params=params, road=onto)


@cache
def passes(road: Road = ROAD, first: int = 1, truck: int = 4) -> tuple[xr.Dataset, ...]:
    vehicles = [Vehicle.random(name, first + i) for i, name in enumerate(("car", "suv", "truck"))]
    return tuple(
        one_pass(vehicles[i // 3], 10 * first + i, road=road, trucks=(TRUCK,) if i == truck else ())
        for i in range(9)
    )


def merge(given: tuple[xr.Dataset, ...] | list[xr.Dataset], **params: object) -> xr.Dataset:
    road = params.pop("road", None)
    made = merge_passes(list(given), params=MergeParams(**params), road=road)  # type: ignore[arg-type]
    contracts.check(made, "road-map/1")
    return made


def error(made: xr.Dataset, road: Road = ROAD) -> tuple[np.ndarray, np.ndarray]:
    """Error (n, 3) at the places that the map says, and its uncertainty, nT."""
    true = road.distance_of(made["latitude"].values, made["longitude"].values)
    inside = (true > 5.0) & (true < road.length_m - 5.0)
    away = made["field_body"].values - road.body_field(true)
    return away[inside], made["field_body_uncertainty"].values[inside]


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


class Merged(NamedTuple):
    """Errors of a map, nT: its rms, that of each of its passes, share within 1 sigma."""

    rms: float
    passes: list[float]
    within_sigma: float

    @property
    def beaten(self) -> float:
        """Share of the passes that are farther from the truth."""
        return float(np.mean(np.array(self.passes) > self.rms))

    @property
    def ratio(self) -> float:
        """Error of the map over that of the median pass."""
        return self.rms / float(np.median(self.passes))


def merged(seeds: Iterable[int], *, length_m: float, dipoles: int) -> Iterator[Merged]:
    """Maps of roads with three vehicles each.

    One road tells little: its errors are those of three calibrations on a few headings.
    """
    for seed in seeds:
        road = Road(length_m=length_m, dipoles=dipoles, seed=seed)
        given = passes(road, seed, truck=-1)
        away, sigma = error(merge(given), road)
        single = [rms(error(one, road)[0]) for one in given]
        yield Merged(rms(away), single, float(np.mean(np.abs(away) < sigma)))


def run() -> None:
    """The program."""
    made = list(merged(range(300, 300 + int(sys.argv[1])), length_m=400.0, dipoles=80))
    print(
        f"{len(made)} roads: {np.mean([m.beaten for m in made]):.1%} of passes beaten, the median "
        f"pass by a factor of {1 / np.median([m.ratio for m in made]):.2f}; "
        f"{np.mean([m.within_sigma for m in made]):.1%} of errors within one sigma"
    )


if __name__ == "__main__":
    run()
