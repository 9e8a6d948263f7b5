"""The road maps of a product: from logs of vehicles to a map of each road and direction."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import xarray as xr

from magtiles.pipeline import receipts
from magtiles.pipeline.artifacts import open_artifact
from magtiles.pipeline.plotting import save_png
from magtiles.pipeline.road_plots import KINDS, road_figure
from magtiles.pipeline.road_sources import RoadSources, RoadsTable
from magtiles.pipeline.source_paths import data_files, manifest_inputs
from magtiles.pipeline.steps import PartResult, Steps
from magtiles.schemas.errors import SourceError
from magtiles.stages.declare import Stage
from magtiles.stages.ingest.log import stage as ingest_log
from magtiles.stages.ingest.source import Source
from magtiles.stages.release.road_file import road_path, write_road
from magtiles.stages.road import features, merge, resample
from magtiles.stages.road.matchability import with_matchability
from magtiles.stages.road.split import SplitParams, split_drive
from magtiles.stages.vehicle import align
from magtiles.stages.vehicle.calibration import apply, calibrate


class _Tracks:
    """Runs stages in a folder, each once however many roads ask for it."""

    def __init__(self, folder: Path, data: Path | None, steps: Steps) -> None:
        self._folder, self._data, self._steps = folder, data, steps
        self._made: dict[str, Path] = {}

    @property
    def artifacts(self) -> list[Path]:
        """All that was made, in order."""
        return list(self._made.values())

    def expect(self, more: int) -> None:
        """Count on more steps than were known of at first."""
        self._steps.expect(more)

    def run(
        self, stage: Stage, inputs: Mapping[str, Any], name: str, params: Mapping[str, Any]
    ) -> Path:
        """The artifact of a stage, named `name`, or numbered where that is another's."""
        asked = repr((stage.name, inputs, params))
        if asked not in self._made:
            taken = {path.stem for path in self._made.values()}
            numbered = (f"{name}-{number}" for number in itertools.count(2))
            free = next(n for n in itertools.chain([name], numbered) if n not in taken)
            self._made[asked] = self._steps.run(stage, inputs, self._folder / f"{free}.nc", params)
        return self._made[asked]

    def aligned(self, source: Source[Any], table: RoadsTable) -> Path:
        """The track of a log."""
        name = source.source.id
        files = [source.path, *data_files(source, self._data)]
        log = self.run(ingest_log.STAGE, {"files": files}, f"{name}-log", {})
        return self.run(align.STAGE, {"track": log}, f"{name}-aligned", table.lags)

    def calibrated(self, source: Source[Any], by: Source[Any] | None, table: RoadsTable) -> Path:
        """The track of a log, calibrated by that of another if there is one."""
        track = self.aligned(source, table)
        if by is None:
            return track
        circles, method = {"track": self.aligned(by, table)}, {"method": table.calibration_method}
        made = self.run(calibrate.STAGE, circles, f"{by.source.id}-calibration", method)
        inputs = {"track": track, "calibration": made}
        return self.run(apply.STAGE, inputs, f"{source.source.id}-calibrated", {})


def build_roads(
    wanted: Sequence[RoadSources], folder: Path, data: Path | None, steps: Steps
) -> PartResult:
    """Run every stage from logs to road maps and their pictures, in `folder`/roads.

    Matchability is that among all roads of the product of one state of calibration and one
    spacing. `data` is a folder of local copies of the logs, as of `build_product`.

    Raises SourceError where two roads come to have one name; else as the stages do.
    """
    own = folder / "roads"
    tracks = _Tracks(own, data, steps)
    made = [path for roads in wanted for path in _maps(roads, tracks)]
    steps.report("matchability")
    maps = _written(made, own / "maps")
    pictures: dict[str, Path] = {}
    for path in maps.values():
        steps.report(f"drawing road {path.stem}")
        pictures |= _drawn(path, folder / "preview")
    return PartResult({**maps, **pictures}, tracks.artifacts, list(_inputs(wanted, data)))


def _drawn(path: Path, folder: Path) -> dict[str, Path]:
    """Pictures of a map by their place in the release."""
    made = {}
    with open_artifact(path) as road:
        for kind in KINDS:
            name = f"road-{path.stem}-{kind}.png"
            save_png(road_figure(road, kind), folder / name)
            made[f"preview/{name}"] = folder / name
    return made


@dataclass(frozen=True)
class _Drive:
    vehicle: str
    name: str
    track: Path


@dataclass(frozen=True)
class _Road:
    """A road, the part of the first drive that lays down its points, and how it is driven."""

    name: str
    part: int | None
    directions: Sequence[str]


def _maps(roads: RoadSources, tracks: _Tracks) -> Iterator[Path]:
    """One map with features for each road and direction."""
    table = roads.table
    drives = [
        _Drive(
            vehicle, log.source.id, tracks.calibrated(log, roads.calibration.get(vehicle), table)
        )
        for vehicle, logs in roads.logs.items()
        for log in logs
    ]
    for earlier in roads.maps:
        yield _updated(earlier, drives, table, tracks)
    for road in _roads_of(drives[0].track, table) if not roads.maps else ():
        base = _pass(drives[0], road, None, "forward", table, tracks)
        for way in road.directions:
            tracks.expect(len(drives) + 2)
            passes = [
                base
                if drive is drives[0] and way == "forward"
                else _pass(drive, road, base, way, table, tracks)
                for drive in drives
            ]
            stem = f"{road.name}-{way}"
            whole = passes[0]
            if len(passes) > 1:
                whole = tracks.run(merge.STAGE, {"passes": passes}, f"{stem}-merged", {})
            yield tracks.run(features.STAGE, {"road": whole}, f"{stem}-features", {})


def _updated(earlier: Path, drives: Sequence[_Drive], table: RoadsTable, tracks: _Tracks) -> Path:
    """An earlier map with the drives added to it; the drives that made it are not needed."""
    with open_artifact(earlier) as opened:
        way, name = str(opened.attrs["direction"]), str(opened.attrs["road"])
        table = table.model_copy(update={"spacing_m": float(opened.attrs["spacing_m"])})
    tracks.expect(len(drives) + 2)
    road = _Road(name, None, (way,))
    passes = [_pass(drive, road, earlier, way, table, tracks) for drive in drives]
    stem = f"{name}-{way}"
    merged = {"passes": passes, "road": earlier}
    whole = tracks.run(merge.STAGE, merged, f"{stem}-merged", {})
    return tracks.run(features.STAGE, {"road": whole}, f"{stem}-features", {})


def _pass(
    drive: _Drive, road: _Road, base: Path | None, way: str, table: RoadsTable, tracks: _Tracks
) -> Path:
    """A drive's pass of a road: the one that lays down its points, or one laid onto them."""
    params: dict[str, Any] = {
        "road": road.name, "vehicle": drive.vehicle, "pass_name": drive.name,
        "spacing_m": table.spacing_m,
    }  # fmt: skip
    inputs = {"track": drive.track}
    if base is not None:
        inputs["road"], params["direction"] = base, way
    elif road.part is not None:
        params["part"] = road.part
    name = f"{road.name}-{way}-{drive.name}" + ("-base" if base is None else "")
    return tracks.run(resample.STAGE, inputs, name, params)


def _roads_of(track: Path, table: RoadsTable) -> list[_Road]:
    """The roads of a drive, in order; a single one has the table's own name."""
    if not table.split:
        return [_Road(table.name, None, ("forward",))]
    with open_artifact(track) as opened:
        parts = split_drive(opened, params=SplitParams())
    numbers = list(dict.fromkeys(part.road for part in parts))
    return [
        _Road(
            table.name if len(numbers) == 1 else f"{table.name}-{number + 1}",
            next(i for i, part in enumerate(parts) if part.road == number),
            sorted({part.direction for part in parts if part.road == number}, reverse=True),
        )
        for number in numbers
    ]


def _written(made: Sequence[Path], folder: Path) -> dict[str, Path]:
    """Files of a release, by their place in it, with the matchability of each road."""
    with contextlib.ExitStack() as opened:
        roads = [opened.enter_context(open_artifact(path)) for path in made]
        maps: dict[str, Path] = {}
        for road in _told_apart(roads):
            place = road_path(road)
            if place in maps:
                raise SourceError(
                    f"two roads are named '{Path(place).stem}'",
                    where="roads",
                    expected="a name of its own for each",
                )
            maps[place] = folder / Path(place).name
            write_road(road, maps[place])
    return maps


def _told_apart(roads: Sequence[xr.Dataset]) -> list[xr.Dataset]:
    """Roads with their matchability among those of their state of calibration."""
    told: list[xr.Dataset] = []
    for state in ("true", "false"):
        told += with_matchability([r for r in roads if r.attrs["calibrated"] == state])
    return told


def _inputs(wanted: Sequence[RoadSources], data: Path | None) -> Iterator[dict[str, str]]:
    """Of the manifest: each log once, as a road's, else as a calibration."""
    listed: set[str] = set()
    for path in (path for w in wanted for path in w.maps):
        licences = sorted({s.source.licence for w in wanted for s in w.sources})
        yield {
            "id": f"map {path.stem}", "sha256": receipts.digest(path),
            "licence": " and ".join(licences), "role": "road map",
        }  # fmt: skip
    by_role = [("road", [s for w in wanted for logs in w.logs.values() for s in logs])]
    by_role.append(("calibration", [s for w in wanted for s in w.calibration.values()]))
    for role, sources in by_role:
        for source in sources:
            if source.source.id not in listed:
                listed.add(source.source.id)
                yield from manifest_inputs(source, data_files(source, data), role)
