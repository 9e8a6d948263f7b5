"""A large map laid on its plane, once for all its levels: ``filled.nc.plane.nc`` of ``filled.nc``.

Every level reads the map twice, in blocks that reach into each other; to resample it as often
would cost as much as what is made of it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import netCDF4
import xarray as xr

from magtiles.pipeline import receipts
from magtiles.pipeline.artifacts import create_variable, open_artifact
from magtiles.stages.field.laid import lay_on_plane
from magtiles.stages.field.plane import choose_plane
from magtiles.stages.field.windows import MapWindows
from magtiles.stages.release.atomic import atomic_path


def lay(grid: Path, made_from: Mapping[str, Any]) -> None:
    """Lay a filled grid on its plane, unless it is there or lies on that by itself.

    `made_from` is the identity of any level of it. Raises ContractError for voids, MagtilesError
    where the file cannot be written.
    """
    out, identity = _file(grid), {**made_from, "stage": "lay on plane", "params": {}}
    with open_artifact(grid, cache=False) as opened:
        if choose_plane(opened).is_source or receipts.why_stale(out, identity) is None:
            return
        with atomic_path(out) as temporary:
            _write(MapWindows.of(opened), temporary)
    receipts.write_receipt(out, identity, "none")


@contextlib.contextmanager
def opened_map(grid: Path) -> Iterator[tuple[xr.Dataset, xr.Dataset | None]]:
    """A grid and, unless it lies on its plane by itself, what `lay` made of it."""
    with contextlib.ExitStack() as stack:
        opened = stack.enter_context(open_artifact(grid, cache=False))
        laid = None
        if not choose_plane(opened).is_source:
            laid = stack.enter_context(open_artifact(_file(grid), cache=False))
        yield opened, laid


def _file(grid: Path) -> Path:
    return grid.with_name(f"{grid.name}.plane.nc")


def _write(windows: MapWindows, path: Path) -> None:
    """Write strip after strip; no more than one is in memory."""
    first = 0
    with netCDF4.Dataset(path, "w", format="NETCDF4") as opened:
        file: Any = opened
        for name, size in zip(("y", "x"), windows.shape, strict=True):
            file.createDimension(name, size)
        for strip in lay_on_plane(windows):
            for name in map(str, strip.variables):
                values = strip.variables[name]
                if name not in file.variables:
                    create_variable(file, name, values)
                rows = slice(first, first + strip.sizes["y"])
                place = rows if "y" in values.dims else slice(None)
                file[name][place] = values.values
            first += strip.sizes["y"]
