"""The road maps of a release, by name."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np

from magtiles.catalog.releases.manifest import Manifest
from magtiles.catalog.releases.road import Road
from magtiles.catalog.releases.road_file import RoadData, read_road
from magtiles.catalog.releases.road_table import road_name
from magtiles.schemas.errors import IntegrityError, QueryError


class NoSuchRoadError(QueryError, KeyError):
    """A name that no road of the release has."""


class Roads(Mapping[str, Road]):
    """The road maps of a release by name; each is verified when it is first asked for.

    Another name raises QueryError, a file that is not what the manifest says IntegrityError.
    """

    def __init__(self, folder: Path, manifest: Manifest, read: Callable[[str], bytes]) -> None:
        self._folder, self._manifest, self._read = folder, manifest, read
        self._lock = threading.RLock()
        self._open: dict[str, Road] = {}

    def __getitem__(self, name: str) -> Road:
        record = self._manifest.roads.get(name)
        if record is None:
            raise NoSuchRoadError(
                f"has no road {name!r}",
                where=f"release {self._manifest.product} {self._manifest.version}",
                expected=f"one of {', '.join(self)}",
            )
        with self._lock:
            if name not in self._open:
                where = self._folder / record.path
                data = read_road(self._read(record.path), where)
                _check_record(data, name, record.spacing_m, record.length_m, where)
                self._open[name] = Road(name, data)
            return self._open[name]

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(self._manifest.roads))

    def __len__(self) -> int:
        return len(self._manifest.roads)


def _check_record(
    data: RoadData, name: str, spacing_m: float, length_m: float, where: Path
) -> None:
    """The file is the road that the manifest says."""
    attributes, distance = data.attributes, data.variables["distance"]
    own = road_name(attributes["road"], attributes["direction"])
    found = own, float(attributes["spacing_m"]), float(np.ptp(distance))
    if found != (name, spacing_m, length_m):
        raise IntegrityError(
            "is road {} of spacing {:g} m and length {:g} m".format(*found),
            where=where,
            expected=f"{name}, {spacing_m:g} m and {length_m:g} m as in manifest.json",
            remedy="fetch or build the release again",
        )
