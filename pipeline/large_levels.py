"""Levels of large maps: blocks made side by side, each a file of its own, then one level on disk.

The files of the level ``level-650m.nc`` are in ``level-650m.nc.blocks``, each with a receipt, so
that a build that was interrupted goes on from what is there. They go when the level is whole.
The map laid on its plane, ``filled.nc.plane.nc``, serves all levels and stays.
"""

from __future__ import annotations

import contextlib
import itertools
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.pipeline import receipts
from magtiles.pipeline.artifacts import create_variable, open_artifact, write_artifact
from magtiles.pipeline.laid_map import lay, opened_map
from magtiles.pipeline.tasks import Task, Tasks
from magtiles.schemas import contracts
from magtiles.stages.declare import parse_params
from magtiles.stages.field.blocks import Block
from magtiles.stages.field.components import (
    STAGE,
    DeriveComponentsParams,
    block_maker,
    large_map,
    makes_blocks,
)
from magtiles.stages.field.large import strips
from magtiles.stages.field.level import mean_angles
from magtiles.stages.field.windows import spans
from magtiles.stages.release.atomic import atomic_path
from magtiles.stages.rows import strips as row_strips

_TASKS_A_WORKER, _IDLE = 3, 1 / 16
"""Tasks of blocks that each worker has at least, and what part of all may be wanting at the end."""
_AXES = ("north", "east", "down")
_UNREAD = (0.0, 1.0)
"""Stand-ins for what only solving needs to know of a map."""


@dataclass(frozen=True)
class LevelJob:
    """A level to be made: from which filled grid, with which parameters, into which file.

    `made_from` is what its receipt will say.
    """

    grid: Path
    params: DeriveComponentsParams
    out: Path
    made_from: Mapping[str, Any]

    @classmethod
    def of(cls, grid: Path, params: Mapping[str, Any], out: Path) -> LevelJob:
        """A job from plain parameters of derive-components."""
        parsed = parse_params(STAGE.params, params, where=f"stage {STAGE.name}")
        made_from = receipts.identity(STAGE, parsed, {"grid": [grid]})
        return cls(grid.absolute(), parsed, out.absolute(), made_from)

    @property
    def is_large(self) -> bool:
        """Whether it is made block by block."""
        with open_artifact(self.grid) as grid:
            return makes_blocks(grid, self.params)

    @property
    def folder(self) -> Path:
        """Where its blocks are."""
        return self.out.with_name(f"{self.out.name}.blocks")

    @property
    def whole(self) -> Path:
        """The file of what its blocks must know of the whole map."""
        return self.folder / "whole.nc"

    def block(self, row: int, column: int) -> Path:
        """The file of a block."""
        return self.folder / f"r{row:03d}c{column:03d}.nc"

    def part(self, name: str) -> dict[str, Any]:
        """What the receipt of a file in its folder says."""
        return {**self.made_from, "stage": f"{STAGE.name} ({name})"}


def begin(tasks: Tasks, jobs: Sequence[LevelJob]) -> list[list[Task[None]]]:
    """Ask for all that levels need; the tasks of each, of which the last puts it together.

    None of those that are there, as their receipts say. Jobs may differ in height alone.
    """
    stale = [job for job in jobs if receipts.why_stale(job.out, job.made_from) is not None]
    asked: dict[Path, list[Task[None]]] = {job.out: [] for job in jobs}
    for job in jobs:
        if job not in stale:
            shutil.rmtree(job.folder, ignore_errors=True)
    if stale:
        laid = tasks.submit(lay, stale[0].grid, stale[0].made_from)
        for job in stale:
            asked[job.out] = [laid, tasks.submit(_make_whole, job, after=[laid])]
        blocks = _blocks(stale[0])
        for group in _groups(stale, len(blocks) * len(blocks[0]), tasks.workers):
            for place in _places(blocks):
                wholes = [asked[job.out][1] for job in group]
                made = tasks.submit(_make_blocks, group, place, after=wholes)
                for job in group:
                    asked[job.out].append(made)
            for job in group:
                parts = asked[job.out][2:]
                asked[job.out].append(tasks.submit(_make_level, job, blocks, after=parts))
    return list(asked.values())


def _places(blocks: Sequence[Sequence[Block]]) -> Iterator[tuple[int, int]]:
    return itertools.product(range(len(blocks)), range(len(blocks[0])))


def _groups(jobs: Sequence[LevelJob], blocks: int, workers: int) -> list[Sequence[LevelJob]]:
    """Levels of which a task makes a block: what they have in common is then done once.

    As many as leave every worker some tasks, and few without one in the last round. The files are
    the same in any case.
    """
    number = 1
    while number < len(jobs):
        tasks = number * blocks
        if tasks >= _TASKS_A_WORKER * workers and -tasks % workers <= _IDLE * tasks:
            break
        number += 1
    return [jobs[slice(*span)] for span in spans(len(jobs), -(-len(jobs) // number))]


def _blocks(job: LevelJob) -> list[list[Block]]:
    with open_artifact(job.grid) as grid:
        return large_map(grid, job.params, known=_UNREAD).blocks


def _make_whole(job: LevelJob) -> None:
    """What the blocks of a level must know of the whole map."""
    made_from = job.part("whole map")
    if receipts.why_stale(job.whole, made_from) is None:
        return
    with opened_map(job.grid) as (grid, laid):
        whole = large_map(grid, job.params, laid=laid).survey(job.params.height_m)
    with atomic_path(job.whole) as temporary:
        whole.to_netcdf(temporary, engine="netcdf4", format="NETCDF4")
    receipts.write_receipt(job.whole, made_from, "none")


def _make_blocks(jobs: Sequence[LevelJob], place: tuple[int, int]) -> None:
    """The block of levels at one place."""
    stale = [
        job for job in jobs if receipts.why_stale(job.block(*place), job.part("block")) is not None
    ]
    if not stale:
        return
    with contextlib.ExitStack() as opened:
        grid, laid = opened.enter_context(opened_map(stale[0].grid))
        wholes = [opened.enter_context(open_artifact(job.whole)) for job in stale]
        known = float(wholes[0].attrs["mean"]), float(wholes[0].attrs["sigma"])
        large = large_map(grid, stale[0].params, known, laid)
        make = block_maker(large, large.blocks[place[0]][place[1]])
        for job, whole in zip(stale, wholes, strict=True):
            # In no variable: the next is made when this one has gone.
            _write_block(make(job.params.height_m, whole), job.block(*place), job.part("block"))


def _write_block(block: xr.Dataset, out: Path, made_from: Mapping[str, Any]) -> None:
    contracts.check(block, STAGE.output, where=f"block of stage {STAGE.name}")
    write_artifact(block, out, STAGE.output)
    receipts.write_receipt(out, made_from, contracts.resolve(STAGE.output), passing=True)


def _make_level(job: LevelJob, blocks: Sequence[Sequence[Block]]) -> None:
    """The level from its blocks, which then go. Raises MagtilesError for a full disk."""
    if receipts.why_stale(job.out, job.made_from) is not None:
        # A worker of a build that was killed may have come late and put its own in their place.
        _make_whole(job)
        for place in _places(blocks):
            _make_blocks([job], place)
        _write_level(job, blocks)
        receipts.write_receipt(job.out, job.made_from, contracts.resolve(STAGE.output))
    shutil.rmtree(job.folder, ignore_errors=True)


def _write_level(job: LevelJob, blocks: Sequence[Sequence[Block]]) -> None:
    """Join the files of blocks into that of a level, strip by strip."""
    files = {block: job.block(i, j) for i, row in enumerate(blocks) for j, block in enumerate(row)}
    with open_artifact(job.grid) as grid:
        target = large_map(grid, job.params, known=_UNREAD).target
    with (
        contextlib.ExitStack() as opened,
        atomic_path(job.out) as temporary,
        netCDF4.Dataset(temporary, "w", format="NETCDF4") as level,
    ):
        parts = {
            block: opened.enter_context(open_artifact(file, cache=False))
            for block, file in files.items()
        }
        first = parts[blocks[0][0]]
        level.set_auto_mask(False)
        level.setncatts(first.attrs)
        for name, axis in zip(target.dims, (target.rows, target.columns), strict=True):
            level.createDimension(name, axis.size)
            create_variable(level, name, first[name].variable)[...] = axis
        for name in map(str, first.data_vars):
            variable = create_variable(level, name, first[name].variable)
            if variable.ndim:
                _write_strips(variable, blocks, parts)
            else:
                variable[...] = first[name].values
        level.setncatts(mean_angles(*(_mean(level[f"ambient_{axis}"]) for axis in _AXES)))


def _write_strips(
    variable: Any, blocks: Sequence[Sequence[Block]], parts: Mapping[Block, xr.Dataset]
) -> None:
    """Write a variable of a level."""

    def read(block: Block, rows: slice, columns: slice) -> NDArray[Any]:
        return np.asarray(parts[block][variable.name][rows, columns].values)

    for rows, strip in strips(blocks, variable.name, read):
        variable[slice(*rows)] = strip


def _mean(variable: Any) -> float:
    """The mean of a variable in a file, read in strips."""
    total = sum(
        float(variable[slice(*rows)].sum(dtype=float)) for rows in row_strips(variable.shape)
    )
    return total / float(variable.size)
