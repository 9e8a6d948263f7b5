"""What the sample's drives show of road maps: run as a script, it prints the tables of the docs.

Maps are made by the pipeline as a product has them; truth is the field of the sample's steel.
"""

from __future__ import annotations

import argparse
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyproj
import xarray as xr
from numpy.typing import NDArray
from road_matching import rows
from scipy.spatial import cKDTree

from magtiles.pipeline.artifacts import open_artifact
from magtiles.pipeline.progress import silent
from magtiles.pipeline.road_sources import RoadsTable, load_roads
from magtiles.pipeline.road_truth import Road, levelled
from magtiles.pipeline.roads_part import build_roads
from magtiles.pipeline.sample_drives import (
    LOOP,
    LOT,
    MAPPING,
    PASSES,
    ROAD,
    roads_tables,
    write_drives,
)
from magtiles.pipeline.steps import Steps
from magtiles.stages.declare import parse_params
from magtiles.stages.road.match import MatchRoadParams, match_road
from magtiles.stages.road.resample import ResampleParams, resample_by_distance

Floats = NDArray[np.float64]

ROUTES = {"loop": LOOP, "road": ROAD}
MAPS = {"loop-forward": LOOP, "road-forward": ROAD, "road-backward": ROAD}
HIS = {"same": (266, 251, 277), "cross": (719, 701, 742)}
"""Shockley (2012), table 4.1, nT."""
_ABOVE_M = 1.0  # the mean height of the vehicles' sensors
_STEPS_M = 0.1


def build(folder: Path, roads: Sequence[Road] = (LOT, LOOP, ROAD)) -> Path:
    """Make the sample's drives and all of their maps; the folder of the artifacts."""
    write_drives(folder / "drives", roads)
    tables = tomllib.loads("\n".join(roads_tables("drives")))["roads"]
    wanted = [parse_params(RoadsTable, table, where="roads") for table in tables]
    build_roads(load_roads(wanted, folder / "x.toml"), folder, None, Steps(silent, 0))
    return folder / "roads"


def opened(path: Path) -> xr.Dataset:
    """An artifact, in memory."""
    with open_artifact(path) as dataset:
        return dataset.load()


def passes_of(name: str, roads: Path) -> dict[str, xr.Dataset]:
    """The passes of a map, by the names of their drives."""
    found = sorted(roads.glob(f"{name}-*-*-[0-9]*.nc"))
    if not found:
        raise FileNotFoundError(f"no passes of {name} in {roads}")
    return {str(p["pass_name"].values[0]): p for p in map(opened, found)}


@dataclass(frozen=True)
class Truth:
    """The field along the middle of a lane, in the frame of a level vehicle."""

    road: Road

    def at(self, latitude: Floats, longitude: Floats, heading: Floats) -> Floats:
        """At places (point,) of a map, driven toward headings in degrees, nT (point, 3)."""
        lane, route = self.road.lane, self.road.route
        plane = pyproj.Transformer.from_crs(
            "EPSG:4326",
            pyproj.CRS.from_dict(
                {"proj": "tmerc", "lat_0": route.latitude, "lon_0": route.longitude,
                 "datum": "WGS84"}
            ),
            always_xy=True,
        )  # fmt: skip
        east, north = plane.transform(longitude, latitude)
        lane_north, lane_east, course = lane.at(np.arange(0.0, lane.distance[-1], _STEPS_M))
        # Both lanes of the road are near: only the one driven this way counts.
        tree = cKDTree(_turned(lane_north, lane_east, course))
        nearest = tree.query(_turned(north, east, np.radians(heading)))[1]
        field = self.road.field(lane_north[nearest], lane_east[nearest], _ABOVE_M)
        return levelled(field, course[nearest])


def _turned(north: Floats, east: Floats, course: Floats) -> Floats:
    """Places with courses, radians, as two more coordinates: the other way is as ten metres."""
    return np.column_stack([north, east, 5.0 * np.cos(course), 5.0 * np.sin(course)])


@dataclass(frozen=True)
class Closeness:
    """Errors (point, 3), nT, of a merged map, and of each of its passes at the same points."""

    merged: Floats
    sigma: Floats
    passes: dict[str, Floats]

    @property
    def rms(self) -> float:
        """Of the merged map, nT."""
        return float(np.sqrt(np.mean(self.merged**2)))

    @property
    def rms_of_passes(self) -> dict[str, float]:
        """Of each pass, nT."""
        return {name: float(np.sqrt(np.mean(e**2))) for name, e in self.passes.items()}

    @property
    def within_sigma(self) -> float:
        """Share of the merged map's errors."""
        return float(np.mean(np.abs(self.merged) < self.sigma))


def closeness(name: str, roads: Path) -> Closeness:
    """How near a map and its passes are to truth, at the points that all of them have."""
    merged, passes = opened(roads / f"{name}-features.nc"), passes_of(name, roads)
    truth = Truth(MAPS[name])
    shared = set.intersection(
        *(set(np.rint(p["distance"].values / p.attrs["spacing_m"]).astype(int).tolist())
          for p in [merged, *passes.values()])
    )  # fmt: skip

    def errors(road_map: xr.Dataset) -> tuple[Floats, NDArray[np.bool_]]:
        number = np.rint(road_map["distance"].values / road_map.attrs["spacing_m"]).astype(int)
        kept = np.isin(number, list(shared))
        where = (road_map[name].values for name in ("latitude", "longitude", "heading"))
        return (road_map["field_body"].values - truth.at(*where))[kept], kept

    error, kept = errors(merged)
    return Closeness(
        error,
        merged["field_body_uncertainty"].values[kept],
        {pass_name: errors(one)[0] for pass_name, one in passes.items()},
    )


def variation(name: str, roads: Path) -> dict[str, Floats]:
    """Root mean square over the points of the standard deviations of passes, nT (3,)."""
    merged = opened(roads / f"{name}-features.nc")
    return {
        kind: np.sqrt(np.nanmean(merged[f"variation_{kind}_vehicle"].values ** 2, axis=0))
        for kind in ("same", "cross")
    }


def sizes(route: str, roads: Path) -> Iterator[tuple[str, float, int, int]]:
    """Drive, seconds stood, samples of the log, points of its part of the map."""
    for vehicle in MAPPING:
        for number in range(1, PASSES + 1):
            drive = f"{vehicle.name}-{route}-{number}"
            log = opened(roads / f"{drive}-log.nc")
            seconds = np.diff(log["time"].values) / np.timedelta64(1, "s")
            stood = float(seconds[log["speed"].values[1:] < 0.3].sum())
            points = sum(
                p[drive].sizes["point"]
                for p in (passes_of(m, roads) for m in MAPS if m.startswith(route))
            )
            yield drive, stood, log.sizes["time"], points


def resampled(roads: Path, *, calibrated: bool, spacing_m: float) -> dict[str, list[xr.Dataset]]:
    """Pass 1 of every vehicle and road as maps, pass 2 as what is looked for in them."""
    made: dict[str, list[xr.Dataset]] = {"maps": [], "passes": []}
    for route in ROUTES:
        base = None
        for vehicle in MAPPING:
            for number, kept in ((1, "maps"), (2, "passes")):
                drive = f"{vehicle.name}-{route}-{number}"
                params = ResampleParams(
                    spacing_m=spacing_m, vehicle=vehicle.name, pass_name=drive, road=route,
                    part=0 if base is None and route == "road" else None,
                    direction=None if base is None else "forward",
                )  # fmt: skip
                state = "calibrated" if calibrated else "aligned"
                track = opened(roads / f"{drive}-{state}.nc")
                one = resample_by_distance(track, params=params, road=base)
                base = one if base is None else base
                made[kept].append(one)
    return made


def matching(
    roads: Path, *, calibrated: bool, spacing_m: float, lengths: tuple[float, ...]
) -> xr.Dataset:
    """match-road of every pair of vehicles."""
    made = resampled(roads, calibrated=calibrated, spacing_m=spacing_m)
    return match_road(made["maps"], made["passes"], params=MatchRoadParams(section_m=lengths))


def print_closeness(roads: Path) -> None:
    """Errors of maps and passes."""
    print("| map | merged, nT | passes: least, median, most | nearer than | within 1 sigma |")
    print("|---|---|---|---|---|")
    for name in MAPS:
        found = closeness(name, roads)
        single = np.array(list(found.rms_of_passes.values()))
        nearer = f"{(single > found.rms).sum()} of {single.size}"
        spread = f"{single.min():.0f}, {np.median(single):.0f}, {single.max():.0f}"
        print(
            f"| {name} | {found.rms:.0f} | {spread} | {nearer} | {100 * found.within_sigma:.0f} % |"
        )


def print_variation(roads: Path) -> None:
    """Standard deviations of passes beside the paper's."""
    print("\n| map | same vehicle, nT | different vehicles, nT |\n|---|---|---|")
    for name in MAPS:
        found = variation(name, roads)
        same, cross = (", ".join(f"{v:.0f}" for v in found[k]) for k in ("same", "cross"))
        print(f"| {name} | {same} | {cross} |")
    his = (", ".join(map(str, HIS[k])) for k in ("same", "cross"))
    print(f"| Shockley, table 4.1 | {' | '.join(his)} |")


def print_sizes(roads: Path) -> None:
    """Samples of logs and points of maps."""
    print(
        "\n| drive | stood, s | samples at 50 Hz | points at 1 m | fewer |\n|---|---|---|---|---|"
    )
    for route in ROUTES:
        for drive, stood, samples, points in sizes(route, roads):
            fewer = f"{100 * (1 - points / samples):.0f} %"
            print(f"| {drive} | {stood:.0f} | {samples} | {points} | {fewer} |")


def print_matching(roads: Path) -> None:
    """The order of methods, and every pair of vehicles by ML."""
    print("\n| fields | pairs | spacing m | section m | samples | method | within 10 m | of |")
    print("|---|---|---|---|---|---|---|---|")
    for calibrated, spacing, lengths in (
        (True, 1.0, (0.0, 3.0, 9.0)), (True, 3.0, (3.0, 9.0)), (False, 1.0, (0.0, 9.0)),
    ):  # fmt: skip
        found = matching(roads, calibrated=calibrated, spacing_m=spacing, lengths=lengths)
        state = "calibrated" if calibrated else "uncalibrated"
        for row in rows(found):
            print(
                f"| {state} | {row['pairs']} | {row['spacing']:g} | {row['length']:g} "
                f"| {row['form']} | {row['method']} | {row['within'][1]:.0f} "  # type: ignore[index]
                f"| {row['available']:.0f} |"
            )
        if calibrated and spacing == 1.0:
            pairs = found
    print("\n| map of | passes of " + " | passes of ".join(v.name for v in MAPPING) + " |")
    print("|---|---|---|---|")
    chosen = pairs.isel(
        case=(pairs["method"] == "ml") & (pairs["form"] == "measured")
        & (pairs["section_length"] == 9.0)
    )  # fmt: skip
    percent = {
        (str(m), str(s)): float(p[1])
        for m, s, p in zip(
            chosen["map_vehicle"].values, chosen["section_vehicle"].values,
            chosen["percent_within"].values, strict=True,
        )
    }  # fmt: skip
    for a in MAPPING:
        print(
            f"| {a.name} | " + " | ".join(f"{percent[a.name, b.name]:.0f}" for b in MAPPING) + " |"
        )


def main() -> None:
    """Print every table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="where drives and maps are made")
    roads = build(parser.parse_args().folder)
    print_closeness(roads)
    print_variation(roads)
    print_sizes(roads)
    print_matching(roads)


if __name__ == "__main__":
    main()
