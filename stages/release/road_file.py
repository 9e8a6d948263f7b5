"""Writing roads/*.nc: netCDF-4 with CF-1.11 metadata, the same bytes for the same dataset."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from magtiles.catalog.releases.digest import array_digest, sha256
from magtiles.catalog.releases.road_file import RoadData, read_road
from magtiles.catalog.releases.road_table import CONTRACT, TABLE, road_name
from magtiles.stages.release.record_file import write_record

_CHUNK = 65_536
"""Most points of a chunk."""
_HISTORY = "merged by magtiles from passes of vehicles; how is in provenance.json"


def road_path(dataset: xr.Dataset) -> str:
    """Where a road map lies in a release, by the name of its road and its direction."""
    name = road_name(str(dataset.attrs["road"]), str(dataset.attrs["direction"]))
    return f"roads/{name}.nc"


def write_road(dataset: xr.Dataset, path: Path) -> None:
    """Write a dataset of contract road-map/1, which appears whole or not at all.

    Raises ContractError for a dataset that is none, or with variables that a release has no
    place for.
    """
    told = {"title": f"magnetic map of road {dataset.attrs.get('road')}", "history": _HISTORY}
    write_record(dataset, path, TABLE, told, _chunks)


def measure_road(path: Path, place: str) -> dict[str, Any]:
    """The manifest's record of a road's file at `place`, read back as a reader would.

    Raises IntegrityError for a file that a reader would refuse.
    """
    data = path.read_bytes()
    road = read_road(data, path)
    return {
        "path": place,
        "role": "road",
        "contract": CONTRACT,
        "size": len(data),
        "sha256": sha256(data),
        "array_digest": array_digest(road.variables),
        "bounds": _bounds(road),
        "length_m": float(np.ptp(road.variables["distance"])),
        "spacing_m": float(road.attributes["spacing_m"]),
    }


def _bounds(road: RoadData) -> dict[str, list[float]]:
    """South and north, west and east; a road over the date line has east beyond 180."""
    latitude, longitude = road.variables["latitude"], road.variables["longitude"]
    east = np.unwrap(longitude, period=360.0)
    west = float(east.min())
    shift = 360.0 * np.floor((west + 180.0) / 360.0)
    return {
        "latitude": [float(latitude.min()), float(latitude.max())],
        "longitude": [west - shift, float(east.max()) - shift],
    }


def _chunks(dims: tuple[str, ...], sizes: Mapping[Any, int]) -> list[int]:
    return [min(sizes[d], _CHUNK) if d != "vehicle" else 1 for d in dims]
