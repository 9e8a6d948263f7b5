"""Cutting tiles and drawing previews in a few processes: netCDF compresses on one thread each."""

from __future__ import annotations

import concurrent.futures
import concurrent.futures.process
import contextlib
import multiprocessing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from magtiles.catalog.releases.lattice import Lattice
from magtiles.pipeline.artifacts import open_artifact
from magtiles.pipeline.preview import write_preview
from magtiles.pipeline.progress import Progress
from magtiles.pipeline.runner import run_stage
from magtiles.schemas.errors import MagtilesError
from magtiles.stages.release import tiles
from magtiles.stages.release.records import MeasuredTile, measure_tile

_PROCESSES = 2
_WORTH_PROCESSES = 4_000_000
"""Nodes of all levels above which processes save more time than their start takes."""

_Job = tuple[Mapping[str, Any], Path, Mapping[str, Any]]


@contextlib.contextmanager
def cutting(lattice: Lattice, levels: int) -> Iterator[Cutter]:
    """A cutter for a lattice of so many levels; its processes start now and are ready when asked.

    Small releases are cut in this process.
    """
    if lattice.rows * lattice.columns * levels < _WORTH_PROCESSES:
        yield Cutter(lattice, None)
        return
    # Spawned, not forked: the threads of FFT and numba do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(_PROCESSES, mp_context=context) as pool:
        for _ in range(_PROCESSES):
            pool.submit(_start)
        yield Cutter(lattice, pool)


@dataclass(frozen=True)
class Cutter:
    """Cuts the tiles of a lattice, in the processes of `pool` if there is one."""

    lattice: Lattice
    pool: concurrent.futures.Executor | None
    pictures: list[concurrent.futures.Future[None]] = field(default_factory=list)

    def cut(
        self, levels: Sequence[Path], surface: Path | None, folder: Path, progress: Progress
    ) -> list[MeasuredTile]:
        """Cut every tile from the level grids and their surface into `folder`, measured."""
        rows, columns = self.lattice.shape
        inputs = {"grid": levels} | ({} if surface is None else {"surface": surface})
        jobs: list[_Job] = [
            (inputs, folder / f"r{r:03d}c{c:03d}.nc", tiles.tile_params(self.lattice, r, c))
            for r in range(rows)
            for c in range(columns)
        ]
        done: list[MeasuredTile] = []
        for tile in self._run(jobs):
            done.append(tile)
            progress("cutting tiles", len(done), len(jobs))
        return done

    def draw(self, level: Path, picture: Path, product: str, version: str) -> None:
        """Draw the preview of a level, while the next one is made if there are processes."""
        if self.pool is None:
            _draw(level, picture, product, version)
        else:
            self.pictures.append(self.pool.submit(_draw, level, picture, product, version))

    def finish_drawing(self) -> None:
        """Wait until all pictures are there; raises what drawing one raised."""
        for picture in self.pictures:
            picture.result()

    def _run(self, jobs: Sequence[_Job]) -> Iterator[MeasuredTile]:
        if self.pool is None:
            yield from (_cut_one(*job) for job in jobs)
            return
        try:
            yield from self.pool.map(_cut_one, *zip(*jobs, strict=True))
        except concurrent.futures.process.BrokenProcessPool as caught:
            raise MagtilesError(
                "a process that cuts tiles died",
                remedy="check memory; a script that builds must do so below "
                "if __name__ == '__main__':",
            ) from caught


def _start() -> None:
    """Nothing: a process that can run this has loaded what cutting needs."""


def _cut_one(inputs: Mapping[str, Any], out: Path, params: Mapping[str, Any]) -> MeasuredTile:
    made = run_stage(tiles.STAGE, inputs, out, params)
    return measure_tile(made.out, made.dataset)


def _draw(level: Path, picture: Path, product: str, version: str) -> None:
    with open_artifact(level) as opened:
        write_preview(opened, picture, product, version)
