"""Levels of large maps: blocks made side by side, each a file of its own, then one level on disk.

The files of the level ``level-650m.nc`` are in ``level-650m.nc.blocks``, each with a receipt, so
that a build that was interrupted goes on from what is there. They go when the level is whole.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.pipeline import receipts
from magtiles.pipeline.artifacts import open_artifact, write_artifact
from magtiles.pipeline.tasks import Task, Tasks
from magtiles.schemas import contracts
from magtiles.schemas.errors import MagtilesError
from magtiles.stages.declare import parse_params
from magtiles.stages.field.blocks import Block
from magtiles.stages.field.components import (
    STAGE,
    DeriveComponentsParams,
    derive_block,
    large_level,
    makes_blocks,
)
from magtiles.stages.field.large import strips
from magtiles.stages.field.level import mean_angles
from magtiles.stages.release.atomic import atomic_path

_WHOLE = "whole.nc"
_AXES = ("north", "east", "down")
_UNREAD = (0.0, 1.0)
"""Stand-ins for what only solving needs to know of a map."""

Identity = Mapping[str, Any]


@dataclass(frozen=True)
class LevelJob:
    """A level to be made: from which filled grid, with which parameters, into which file."""

    grid: Path
    params: DeriveComponentsParams
    out: Path

    @classmethod
    def of(cls, grid: Path, params: Mapping[str, Any], out: Path) -> LevelJob:
        """A job from plain parameters of derive-components."""
        parsed = parse_params(STAGE.params, params, where=f"stage {STAGE.name}")
        return cls(grid.absolute(), parsed, out.absolute())

    @property
    def is_large(self) -> bool:
        """Whether it is made block by block."""
        with open_artifact(self.grid) as grid:
            return makes_blocks(grid, self.params)

    @property
    def folder(self) -> Path:
        """Where its blocks are."""
        return self.out.with_name(f"{self.out.name}.blocks")

    def block(self, row: int, column: int) -> Path:
        """The file of a block."""
        return self.folder / f"r{row:03d}c{column:03d}.nc"


@dataclass(frozen=True)
class LevelTasks:
    """The tasks of a level that has been begun, of which the last puts it together.

    None where it was already there.
    """

    job: LevelJob
    made_from: Identity
    tasks: Sequence[Task[None]]


def begin(tasks: Tasks, job: LevelJob) -> LevelTasks:
    """Ask for all that a level needs, unless its receipt says that it is there."""
    made_from = receipts.identity(STAGE, job.params, {"grid": [job.grid]})
    if receipts.why_stale(job.out, made_from) is None:
        shutil.rmtree(job.folder, ignore_errors=True)
        return LevelTasks(job, made_from, ())
    with open_artifact(job.grid) as grid:
        blocks = large_level(grid, job.params, known=_UNREAD).blocks
    whole = tasks.submit(_make_whole, job, made_from)
    parts = [
        tasks.submit(_make_block, job, made_from, (i, j), after=[whole])
        for i, row in enumerate(blocks)
        for j in range(len(row))
    ]
    level = tasks.submit(_make_level, job, made_from, blocks, after=parts)
    return LevelTasks(job, made_from, [whole, *parts, level])


def _make_whole(job: LevelJob, made_from: Identity) -> None:
    """What the blocks of a level must know of the whole map."""
    out, identity = job.folder / _WHOLE, {**made_from, "stage": f"{STAGE.name} (whole map)"}
    if receipts.why_stale(out, identity) is None:
        return
    with open_artifact(job.grid, cache=False) as grid:
        whole = large_level(grid, job.params).survey()
    with atomic_path(out) as temporary:
        whole.to_netcdf(temporary, engine="netcdf4", format="NETCDF4")
    receipts.write_receipt(out, identity, "none")


def _make_block(job: LevelJob, made_from: Identity, place: tuple[int, int]) -> None:
    """One block of a level."""
    out, identity = job.block(*place), {**made_from, "stage": f"{STAGE.name} (block)"}
    if receipts.why_stale(out, identity) is None:
        return
    whole_file = job.folder / _WHOLE
    with open_artifact(job.grid, cache=False) as grid, open_artifact(whole_file) as whole:
        known = float(whole.attrs["mean"]), float(whole.attrs["sigma"])
        level = large_level(grid, job.params, known)
        made = derive_block(level, whole, level.blocks[place[0]][place[1]])
    contracts.check(made, STAGE.output, where=f"block of stage {STAGE.name}")
    write_artifact(made, out, STAGE.output)
    receipts.write_receipt(out, identity, contracts.resolve(STAGE.output))


def _make_level(job: LevelJob, made_from: Identity, blocks: Sequence[Sequence[Block]]) -> None:
    """The level from its blocks, which then go. Raises MagtilesError for a full disk."""
    if receipts.why_stale(job.out, made_from) is not None:
        try:
            _write_level(job, blocks)
        except (OSError, RuntimeError) as caught:
            raise MagtilesError(
                f"cannot be written ({caught})", where=job.out, remedy="check space and permissions"
            ) from caught
        receipts.write_receipt(job.out, made_from, contracts.resolve(STAGE.output))
    shutil.rmtree(job.folder, ignore_errors=True)


def _write_level(job: LevelJob, blocks: Sequence[Sequence[Block]]) -> None:
    """Join the files of blocks into that of a level, strip by strip."""
    files = {block: job.block(i, j) for i, row in enumerate(blocks) for j, block in enumerate(row)}
    with open_artifact(job.grid) as grid:
        target = large_level(grid, job.params, known=_UNREAD).target
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
        level.setncatts(first.attrs)
        for name, axis in zip(target.dims, (target.rows, target.columns), strict=True):
            level.createDimension(name, axis.size)
            _create(level, name, first)[...] = axis
        means = {}
        for name in map(str, first.data_vars):
            variable = _create(level, name, first)
            if variable.ndim:
                means[name] = _write_strips(variable, blocks, parts)
            else:
                variable[...] = first[name].values
        level.setncatts(mean_angles(*(means[f"ambient_{axis}"] for axis in _AXES)))


def _create(level: Any, name: str, like: xr.Dataset) -> Any:
    """A variable of a level as a block has it; every value will be written."""
    variable = level.createVariable(name, like[name].dtype, like[name].dims, fill_value=False)
    variable.setncatts(like[name].attrs)
    return variable


def _write_strips(
    variable: Any, blocks: Sequence[Sequence[Block]], parts: Mapping[Block, xr.Dataset]
) -> float:
    """Write a variable of a level, and give its mean."""

    def read(block: Block, rows: slice, columns: slice) -> NDArray[Any]:
        return np.asarray(parts[block][variable.name][rows, columns].values)

    total = 0.0
    for (first, last), strip in strips(blocks, variable.name, read):
        variable[first:last] = strip
        total += float(strip.sum(dtype=float))
    return total / float(variable.size)
