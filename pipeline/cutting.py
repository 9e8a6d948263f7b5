"""Cutting tiles and drawing previews in a few processes: netCDF compresses on one thread each."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from magtiles.catalog.releases.lattice import Lattice
from magtiles.pipeline import receipts
from magtiles.pipeline.artifacts import open_artifact
from magtiles.pipeline.preview import write_preview
from magtiles.pipeline.progress import Progress
from magtiles.pipeline.runner import run_stage
from magtiles.pipeline.tasks import Task, Tasks
from magtiles.stages.release import tiles
from magtiles.stages.release.records import MeasuredTile, measure_tile

_WORTH_PROCESSES = 4_000_000
"""Nodes of all levels above which processes save more time than their start takes."""


def worth_processes(lattice: Lattice, levels: int) -> bool:
    """Whether cutting so many levels of a lattice is work for several processes."""
    return lattice.rows * lattice.columns * levels >= _WORTH_PROCESSES


@dataclass(frozen=True)
class Cutter:
    """Cuts the tiles of a lattice, and draws its levels."""

    lattice: Lattice
    tasks: Tasks
    pictures: list[Task[None]] = field(default_factory=list)

    def cut(
        self, levels: Sequence[Path], surface: Path | None, folder: Path, progress: Progress
    ) -> list[MeasuredTile]:
        """Cut every tile from the level grids and their surface into `folder`, measured."""
        rows, columns = self.lattice.shape
        grids = [level.absolute() for level in levels]
        inputs = {"grid": grids} | ({} if surface is None else {"surface": surface.absolute()})
        jobs = [
            self.tasks.submit(
                _cut_one,
                inputs,
                folder.absolute() / f"r{r:03d}c{c:03d}.nc",
                tiles.tile_params(self.lattice, r, c),
            )
            for r in range(rows)
            for c in range(columns)
        ]
        return self.tasks.results(jobs, lambda done: progress("cutting tiles", done, len(jobs)))

    def draw(self, level: Path, picture: Path, product: str, version: str) -> None:
        """Draw the preview of a level, while the next one is made if there are processes."""
        task = self.tasks.submit(_draw, level.absolute(), picture.absolute(), product, version)
        self.pictures.append(task)

    def finish_drawing(self) -> None:
        """Wait until all pictures are there; raises what drawing one raised."""
        for picture in self.pictures:
            picture.result()


def _cut_one(inputs: Mapping[str, Any], out: Path, params: Mapping[str, Any]) -> MeasuredTile:
    made = run_stage(tiles.STAGE, inputs, out, params)
    return measure_tile(made.out, made.dataset)


def _draw(level: Path, picture: Path, product: str, version: str) -> None:
    made_from = _identity(level, product, version)
    if receipts.why_stale(picture, made_from) is None:
        return
    with open_artifact(level) as opened:
        write_preview(opened, picture, product, version)
    receipts.write_receipt(picture, made_from, "none")


def _identity(level: Path, product: str, version: str) -> dict[str, Any]:
    """Everything that decides what a preview shows."""
    drawing = {"matplotlib": importlib.metadata.version("matplotlib")}
    return {
        "stage": "preview",
        "version": 1,
        "params": {"product": product, "version": version},
        "inputs": {"level": [{"name": level.name, "sha256": receipts.digest(level)}]},
        "packages": receipts.package_versions() | drawing,
        "code": receipts.code_digest("magtiles.pipeline"),
    }
