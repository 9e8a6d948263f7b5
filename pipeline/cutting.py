"""Cutting all tiles of a release in a few processes: netCDF compresses on one thread each."""

from __future__ import annotations

import concurrent.futures
import concurrent.futures.process
import multiprocessing
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from magtiles.catalog.releases.lattice import Lattice
from magtiles.pipeline.progress import Progress
from magtiles.pipeline.runner import run_stage
from magtiles.schemas.errors import MagtilesError
from magtiles.stages.release import tiles
from magtiles.stages.release.records import MeasuredTile, measure_tile

_PROCESSES = 2
_WORTH_PROCESSES = 4_000_000
"""Nodes of all levels above which processes save more time than their start takes."""

_Job = tuple[Sequence[Path], Path, Mapping[str, Any]]


def cut_all(
    lattice: Lattice, levels: Sequence[Path], folder: Path, progress: Progress
) -> list[MeasuredTile]:
    """Cut every tile of a lattice from its level grids into `folder`; read back and measured."""
    rows, columns = lattice.shape
    jobs: list[_Job] = [
        (levels, folder / f"r{r:03d}c{c:03d}.nc", tiles.tile_params(lattice, r, c))
        for r in range(rows)
        for c in range(columns)
    ]
    done: list[MeasuredTile] = []
    alone = lattice.rows * lattice.columns * len(levels) < _WORTH_PROCESSES
    for tile in _in_turn(jobs) if alone else _in_processes(jobs):
        done.append(tile)
        progress("cutting tiles", len(done), len(jobs))
    return done


def _in_turn(jobs: Sequence[_Job]) -> Iterator[MeasuredTile]:
    yield from (_cut_one(*job) for job in jobs)


def _in_processes(jobs: Sequence[_Job]) -> Iterator[MeasuredTile]:
    # Spawned, not forked: the threads of FFT and numba do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(_PROCESSES, mp_context=context) as pool:
        try:
            yield from pool.map(_cut_one, *zip(*jobs, strict=True))
        except concurrent.futures.process.BrokenProcessPool as caught:
            raise MagtilesError(
                "a process that cuts tiles died",
                remedy="check memory; a script that builds must do so below "
                "if __name__ == '__main__':",
            ) from caught


def _cut_one(levels: Sequence[Path], out: Path, params: Mapping[str, Any]) -> MeasuredTile:
    return measure_tile(run_stage(tiles.STAGE, {"grid": levels}, out, params).out)
