"""The order of Shockley's methods on simulated drives: run as a script, it prints the table.

Three vehicles drive two look-alike streets and a winding road; the first pass of each vehicle is
the map, the second is looked for in it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from road_maps import Pass, Road, Vehicle, road_map

from magtiles.stages.road.match import MatchRoadParams, match_road

ROADS = (Road("loop", 1200.0, 140, seed=3), Road("street", 600.0, 70, seed=4))
VEHICLES = ("car", "suv", "truck")


def drives(
    spacing_m: float, *, calibrated: bool, roads: Sequence[Road] = ROADS
) -> tuple[list[xr.Dataset], list[xr.Dataset]]:
    """Maps and passes of every road by every vehicle."""
    maps, passes = [], []
    for number, name in enumerate(VEHICLES):
        vehicle = Vehicle.of(name, 11 + number, calibrated=calibrated)
        for k, road in enumerate(roads):
            for kept, run in ((maps, 1), (passes, 2)):
                drive = Pass(seed=100 * number + 10 * k + run)
                kept.append(
                    road_map(road, vehicle, drive, spacing_m=spacing_m, calibrated=calibrated)
                )
    return maps, passes


def report(spacing_m: float, *, calibrated: bool, section_m: Sequence[float]) -> xr.Dataset:
    """The examination of all pairs."""
    maps, passes = drives(spacing_m, calibrated=calibrated)
    return match_road(maps, passes, params=MatchRoadParams(section_m=tuple(section_m)))


def rows(found: xr.Dataset) -> list[dict[str, object]]:
    """Cases, with same- and cross-vehicle pairs averaged by their number of answers."""
    same = found["map_vehicle"].values == found["section_vehicle"].values
    keys = list(
        zip(
            same.tolist(),
            found["spacing"].values.tolist(),
            found["section_length"].values.tolist(),
            found["form"].values.tolist(),
            found["method"].values.tolist(),
            strict=True,
        )
    )
    made = []
    for key in dict.fromkeys(keys):
        chosen = np.array([k == key for k in keys])
        tried = found["sections"].values[chosen].astype(float)
        answers = tried * found["percent_available"].values[chosen] / 100.0
        within = np.nan_to_num(found["percent_within"].values[chosen])
        total = answers.sum()
        made.append(
            {
                "pairs": "same" if key[0] else "cross",
                "spacing": key[1],
                "length": key[2],
                "form": key[3],
                "method": key[4],
                "available": 100.0 * total / tried.sum(),
                "within": answers @ within / total if total else np.full(3, np.nan),
            }
        )
    return made


def main() -> None:
    """Print one table for calibrated and one for uncalibrated drives."""
    head = "| pairs | spacing m | section m | samples | method | 3 m | 10 m | 20 m | available |"
    for calibrated in (True, False):
        print(f"\n{'calibrated' if calibrated else 'uncalibrated'}, percent\n\n{head}")
        print("|---|---|---|---|---|---|---|---|---|")
        for spacing, lengths in ((0.5, (0.0, 3.0)), (1.0, (0.0, 3.0, 9.0)), (3.0, (0.0, 3.0, 9.0))):
            found = report(spacing, calibrated=calibrated, section_m=lengths)
            for row in rows(found):
                near = " | ".join(f"{value:.0f}" for value in row["within"])  # type: ignore[attr-defined]
                print(
                    f"| {row['pairs']} | {row['spacing']:g} | {row['length']:g} | {row['form']} "
                    f"| {row['method']} | {near} | {row['available']:.0f} |"
                )


if __name__ == "__main__":
    main()
