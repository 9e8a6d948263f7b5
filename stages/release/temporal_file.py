"""Writing temporal.nc: netCDF-4 with CF-1.11 metadata, the same bytes for the same dataset."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import xarray as xr

from magtiles.catalog.releases.digest import array_digest, sha256
from magtiles.catalog.releases.temporal_file import read_temporal
from magtiles.catalog.releases.temporal_table import CONTRACT, PATH, TABLE
from magtiles.stages.release.record_file import write_record

_CHUNK = 4096
"""Most values of a chunk along its last dimension."""
_TOLD = {
    "title": "quiet-day variations of the magnetic field, and statistics of what they leave",
    "history": "fitted by magtiles to observatory records; how is in provenance.json",
}


def write_temporal(dataset: xr.Dataset, path: Path) -> None:
    """Write a dataset of contract temporal-model/1, which appears whole or not at all.

    Raises ContractError for a dataset that is none, or with variables that a release has no
    place for.
    """
    write_record(dataset, path, TABLE, _TOLD, _chunks)


def measure_temporal(path: Path) -> dict[str, Any]:
    """The manifest's record of a temporal.nc, which is read back as a reader would.

    Raises IntegrityError for a file that a reader would refuse.
    """
    data = path.read_bytes()
    return {
        "path": PATH,
        "role": "temporal",
        "contract": CONTRACT,
        "size": len(data),
        "sha256": sha256(data),
        "array_digest": array_digest(read_temporal(data, path).variables),
    }


def _chunks(dims: tuple[str, ...], sizes: Mapping[Any, int]) -> list[int]:
    return [min(sizes[d], _CHUNK) if d == dims[-1] else 1 for d in dims]
