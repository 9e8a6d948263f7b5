"""A release's road maps as GeoJSON (RFC 7946): a collection of features for each road."""

from __future__ import annotations

import itertools
import json
import os
import secrets
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from magtiles.catalog import open_release
from magtiles.catalog.flags import RoadFlag
from magtiles.catalog.releases.road import Road
from magtiles.schemas.errors import UsageError

_AXES = ("forward", "right", "down")
_DECIMALS = 8
"""Of degrees: a millimetre."""

Position = list[float]


def export_geojson(folder: Path, out: Path) -> list[tuple[Path, int]]:
    """Write ``<road>.geojson`` for each road of a release, to a new folder.

    Returns each file with its number of features. Raises IntegrityError for a folder that is no
    whole release, UsageError where `out` exists or the release has no roads.
    """
    release = open_release(folder)
    if not release.manifest.roads:
        raise UsageError(
            "the release has no roads", where=folder, expected="one built with [[roads]]"
        )
    if os.path.lexists(out):
        raise UsageError("exists already", where=out, remedy="remove it, or choose another folder")
    staging = out.with_name(f".{out.name}.{secrets.token_hex(4)}.tmp")
    staging.mkdir(parents=True)
    try:
        written = []
        for name, road in release.roads.items():
            made = road_collection(road)
            text = json.dumps(made, allow_nan=False, separators=(",", ":"))
            (staging / f"{name}.geojson").write_text(text, encoding="utf-8")
            written.append((out / f"{name}.geojson", len(made["features"])))
        staging.rename(out)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    return written


def road_collection(road: Road) -> dict[str, Any]:
    """The road as a line, each of its points, and the stretches of its magnetic features.

    The property `kind` is "road", "point" or "feature"; unknown values are null. Lines across
    the date line are cut there (RFC 7946, section 3.1.9).
    """
    latitude = road.variables["latitude"]
    longitude = np.unwrap(road.variables["longitude"], period=360.0)
    way = slice(None, None, -1 if road.direction == "backward" else 1)
    points = np.column_stack([longitude, latitude])
    return {
        "type": "FeatureCollection",
        "bbox": _box(longitude, latitude),
        "features": [
            _feature(line_geometry(points[way]), _summary(road)),
            *(
                _feature(_point(point), about)
                for point, about in zip(points[way], list(_of_points(road))[way], strict=True)
            ),
            *_stretches(road, points),
        ],
    }


def _summary(road: Road) -> dict[str, Any]:
    return {
        "kind": "road",
        "name": road.name,
        "direction": road.direction,
        "calibrated": road.calibrated,
        "spacing_m": road.spacing_m,
        "length_m": road.length_m,
        "vehicles": list(road.vehicles),
        "matchability": road.matchability,
    }


def _of_points(road: Road) -> Iterator[dict[str, Any]]:
    """What is known of each point, in the order of the map; fields in nT."""
    v = road.variables
    columns = {
        "distance_m": v["distance"],
        "height_m": v["height"],
        "heading_deg": v["heading"],
        "field_magnitude": np.linalg.norm(v["field_body"].astype(np.float64), axis=1),
        **{f"field_{a}": v["field_body"][:, i] for i, a in enumerate(_AXES)},
        **{f"uncertainty_{a}": v["field_body_uncertainty"][:, i] for i, a in enumerate(_AXES)},
    }
    if "matchability" in v:
        columns["matchability"] = v["matchability"]
    rows = zip(*(_rounded(column) for column in columns.values()), strict=True)
    for row, passes, flag in zip(rows, v["passes"].tolist(), v["quality_flag"], strict=True):
        flags = [known.name.lower() for known in RoadFlag if known.name and int(flag) & known]
        yield {
            "kind": "point",
            **dict(zip(columns, row, strict=True)),
            "passes": passes,
            "flags": flags,
        }


def _stretches(road: Road, points: Any) -> Iterator[dict[str, Any]]:
    for found in road.features:
        ends = np.rint((np.array([found.start, found.end]) - road.distance[0]) / road.spacing_m)
        inside = points[int(ends[0]) : int(ends[1]) + 1]
        about = {
            "kind": "feature",
            "start_m": found.start,
            "end_m": found.end,
            "peak_m": found.peak,
            "axis": _AXES[found.axis],
            "amplitude": round(found.amplitude, 1),
        }
        yield _feature(line_geometry(inside) if len(inside) > 1 else _point(inside[0]), about)


def _feature(geometry: dict[str, Any], properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _point(point: Sequence[float]) -> dict[str, Any]:
    return {"type": "Point", "coordinates": _position(point)}


def line_geometry(points: Any) -> dict[str, Any]:
    """A line through points (n, 2) of unwrapped longitude and latitude, n at least 2."""
    turn = np.floor((points[:, 0] + 180.0) / 360.0)
    pieces: list[list[Position]] = [[_position(points[0])]]
    for before, after in itertools.pairwise(range(len(points))):
        if turn[before] != turn[after]:
            edge = 360.0 * max(turn[before], turn[after]) - 180.0
            a, b = points[before], points[after]
            latitude = float(a[1] + (b[1] - a[1]) * (edge - a[0]) / (b[0] - a[0]))
            side = 180.0 if turn[after] > turn[before] else -180.0
            pieces[-1].append([side, round(latitude, _DECIMALS)])
            pieces.append([[-side, round(latitude, _DECIMALS)]])
        pieces[-1].append(_position(points[after]))
    if len(pieces) == 1:
        return {"type": "LineString", "coordinates": pieces[0]}
    return {"type": "MultiLineString", "coordinates": pieces}


def _position(point: Sequence[float]) -> Position:
    """Longitude within -180 to 180, then latitude."""
    east = (float(point[0]) + 180.0) % 360.0 - 180.0
    return [round(east, _DECIMALS), round(float(point[1]), _DECIMALS)]


def _box(longitude: Any, latitude: Any) -> list[float]:
    """West, south, east, north; west is greater than east across the date line."""
    corners = (longitude.min(), latitude.min()), (longitude.max(), latitude.max())
    return [value for corner in corners for value in _position(corner)]


def _rounded(values: Any) -> list[float | None]:
    return [round(v, 3) if np.isfinite(v) else None for v in values.astype(np.float64).tolist()]
