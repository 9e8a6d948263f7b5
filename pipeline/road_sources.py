"""The [[roads]] tables of a product TOML: drives, their vehicles, and what calibrates these."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic

from magtiles.pipeline.source_paths import find_source
from magtiles.schemas.errors import MissingInputError, SourceError
from magtiles.stages.declare import Params, quantity
from magtiles.stages.ingest.log.source import TRACK
from magtiles.stages.ingest.source import Source, load_source


def _named(logs: dict[str, tuple[str, ...]]) -> dict[str, tuple[str, ...]]:
    if not logs or not all(vehicle and names for vehicle, names in logs.items()):
        raise ValueError("a list of logs for each vehicle, by its name")
    return logs


class RoadsTable(Params):
    """[[roads]]: drives along one road, or through several."""

    name: str = quantity(
        "1", pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$", doc="Name of the road, or of all."
    )
    logs: Annotated[dict[str, tuple[str, ...]], pydantic.AfterValidator(_named)] = quantity(
        "1", doc="By vehicle: source TOMLs of its drives. The first lays down the points."
    )
    maps: tuple[str, ...] = quantity(
        "1", default=(), doc="Maps of earlier releases that the drives are added to, with no logs."
    )
    calibration: dict[str, str] = quantity(
        "1", default={}, doc="By vehicle: source TOML of the drive that calibrates it."
    )
    calibration_method: Literal[
        "swinging", "strict-ellipse", "modified-ellipsoid", "ellipsoid", "attitude"
    ] = quantity("1", default="modified-ellipsoid", doc="Method of calibrate-vector.")
    attitude_lag_s: float | None = quantity(
        "s", default=None, doc="Of align-log: lag of the attitude; default estimated."
    )
    fix_lag_s: float | None = quantity(
        "s", default=None, doc="Of align-log: lag of the fixes; default zero."
    )
    spacing_m: float = quantity("m", default=1.0, gt=0, doc="Distance between the map's points.")
    split: bool = quantity(
        "1", default=True, doc="Split the drives into roads at junctions, U-turns and gaps."
    )

    @property
    def lags(self) -> dict[str, float]:
        """The lags that are stated, as align-log takes them."""
        stated = {"attitude_lag_s": self.attitude_lag_s, "fix_lag_s": self.fix_lag_s}
        return {name: lag for name, lag in stated.items() if lag is not None}


@dataclass(frozen=True)
class RoadSources:
    """What a [[roads]] table asks for, its logs found and read, by vehicle."""

    table: RoadsTable
    maps: Sequence[Path]
    logs: Mapping[str, Sequence[Source[Any]]]
    calibration: Mapping[str, Source[Any]]

    @property
    def steps(self) -> int:
        """How many steps its tracks take; its roads are known only when the first is made."""
        return 3 * len(self.sources)

    @property
    def sources(self) -> list[Source[Any]]:
        """Every log, those of calibration last."""
        return [*(s for logs in self.logs.values() for s in logs), *self.calibration.values()]


def load_roads(tables: Sequence[RoadsTable], product: Path) -> tuple[RoadSources, ...]:
    """Find and read the logs of all [[roads]] tables. SourceError naming file and key."""
    found = tuple(_load(table, product, f"roads[{i}]") for i, table in enumerate(tables))
    paths: dict[str, Path] = {}
    for source in (source for roads in found for source in roads.sources):
        if paths.setdefault(source.source.id, source.path) != source.path:
            raise SourceError(
                f"two sources have the id '{source.source.id}'",
                where=f"{product} roads",
                expected="an id of its own for each, as in "
                f"{paths[source.source.id].name} and {source.path.name}",
            )
    return found


def _load(table: RoadsTable, product: Path, key: str) -> RoadSources:
    _check_calibration(table, product, key)
    logs: dict[str, list[Source[Any]]] = {}
    seen: set[str] = set()
    for vehicle, names in table.logs.items():
        where = f"{key}.logs.{vehicle}"
        logs[vehicle] = [load_source(find_source(name, product, where), TRACK) for name in names]
        for source in logs[vehicle]:
            if source.source.id in seen:
                raise SourceError(
                    f"log '{source.source.id}' is named twice",
                    where=f"{product} {where}",
                    expected="each drive once",
                )
            seen.add(source.source.id)
    calibration = {
        vehicle: load_source(find_source(name, product, f"{key}.calibration.{vehicle}"), TRACK)
        for vehicle, name in table.calibration.items()
    }
    return RoadSources(table, _earlier(table, product, key), logs, calibration)


def _earlier(table: RoadsTable, product: Path, key: str) -> list[Path]:
    """Paths of the maps that the drives are added to."""
    found = [product.parent / name for name in table.maps]
    for path in found:
        if not path.is_file():
            raise MissingInputError(
                f"map '{path}' does not exist",
                where=f"{product} {key}.maps",
                expected="a file of roads/ in an earlier release, by its path from the product",
            )
    return found


def _check_calibration(table: RoadsTable, product: Path, key: str) -> None:
    """Refuse what merge-passes would, before the work: fields that do not compare."""
    where = f"{product} {key}.calibration"
    for vehicle in table.calibration:
        if vehicle not in table.logs:
            raise SourceError(
                f"vehicle '{vehicle}' has no logs",
                where=where,
                expected=f"one of {', '.join(table.logs)}",
            )
    bare = [vehicle for vehicle in table.logs if vehicle not in table.calibration]
    if bare and len(table.logs) > 1:
        raise SourceError(
            f"vehicle '{bare[0]}' is not calibrated",
            where=where,
            expected="a calibration for each of several vehicles",
            remedy="add one, or make a product of that vehicle alone",
        )
