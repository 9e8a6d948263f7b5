"""The temporal part of a product: observatories to quiet-day curves and FOGM statistics."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pydantic
import xarray as xr

from magtiles.catalog.releases.temporal_table import PATH as TEMPORAL_PATH
from magtiles.catalog.releases.temporal_table import TEMPORAL_VARIABLES
from magtiles.pipeline.artifacts import open_artifact
from magtiles.pipeline.source_paths import data_files, find_source, manifest_inputs
from magtiles.pipeline.steps import PartResult, Steps
from magtiles.pipeline.temporal_plots import StationData, draw_station
from magtiles.schemas.errors import CoverageError, SourceError
from magtiles.stages.declare import Params, quantity
from magtiles.stages.ingest import index as ingest_index
from magtiles.stages.ingest.index import ACTIVITY_INDEX
from magtiles.stages.ingest.observatory import stage as ingest_observatory
from magtiles.stages.ingest.observatory.stage import OBSERVATORY_SERIES
from magtiles.stages.ingest.source import P, Source, SourceKind, load_source, locate_all
from magtiles.stages.release.temporal_file import write_temporal
from magtiles.stages.temporal import assemble, baseline, check, fit_fogm

_STAGES_PER_STATION = 4


def _months(months: tuple[str, ...]) -> tuple[str, ...]:
    if not months or len(set(months)) < len(months):
        raise ValueError("months such as 2016-01, each once")
    if not all(re.fullmatch(r"[12]\d{3}-(0[1-9]|1[0-2])", month) for month in months):
        raise ValueError("months such as 2016-01")
    return tuple(sorted(months))


class TemporalTable(Params):
    """[temporal]: observatories, and the months to learn from."""

    observatories: tuple[str, ...] = quantity(
        "1", min_length=1, doc="Source TOMLs of observatories, or ids in the catalog."
    )
    months: Annotated[tuple[str, ...], pydantic.AfterValidator(_months)] = quantity(
        "1", doc="Months that the release is to hold, such as 2016-01."
    )
    indices: tuple[str, ...] = quantity(
        "1", default=(), doc="Source TOMLs of Kp and quiet days; without, the records decide."
    )


@dataclass(frozen=True)
class TemporalSources:
    """What a [temporal] table asks for, its sources found and read."""

    table: TemporalTable
    observatories: tuple[Source[Any], ...]
    indices: tuple[Source[Any], ...]

    @property
    def steps(self) -> int:
        """How many steps it takes."""
        return _STAGES_PER_STATION * len(self.observatories) + bool(self.indices) + 2


def load_temporal(table: TemporalTable, product: Path) -> TemporalSources:
    """Find and read the sources of a [temporal] table. SourceError naming file and key."""
    return TemporalSources(
        table,
        _load(table.observatories, product, "temporal.observatories", OBSERVATORY_SERIES),
        _load(table.indices, product, "temporal.indices", ACTIVITY_INDEX),
    )


def _load(
    names: Sequence[str], product: Path, key: str, kind: SourceKind[P]
) -> tuple[Source[P], ...]:
    sources = tuple(load_source(find_source(name, product, key), kind) for name in names)
    ids = [source.source.id for source in sources]
    for source_id in ids:
        if ids.count(source_id) > 1:
            raise SourceError(
                f"two sources have the id '{source_id}'", where=f"{product} {key}",
                expected="each source once",
            )  # fmt: skip
    return sources


def build_temporal(
    wanted: TemporalSources, folder: Path, data: Path | None, steps: Steps
) -> PartResult:
    """Run every stage from records and indices to temporal.nc and its pictures in `folder`.

    `data` is a folder of local copies of the sources' files, as of `build_product`. Pooled
    statistics are of whole records; curves and segments are kept of the months asked for.

    Raises CoverageError for a month that no record has.
    """
    inputs = [
        item
        for role, sources in (("observatory", wanted.observatories), ("index", wanted.indices))
        for source in sources
        for item in manifest_inputs(source, data_files(source, data), role)
    ]
    activity = _index(wanted, folder, data, steps)
    made = [_station(s, activity, folder, data, steps) for s in wanted.observatories]
    models = [path for station in made for path in (station.baseline, station.fits)]
    whole = steps.run(assemble.STAGE, {"models": models}, folder / "temporal-whole.nc", {})
    steps.report("drawing observatories")
    path = folder / "temporal.nc"
    with open_artifact(whole) as opened:
        write_temporal(_of_months(opened, wanted.table.months).load(), path)
    pictures = {
        f"preview/{name}": picture
        for station in made
        for name, picture in draw_station(station, folder / "preview").items()
    }
    records = [p for s in made for p in (s.record, s.series, s.baseline, s.fits)]
    artifacts = [*([activity] if activity else []), *records, whole]
    return PartResult({TEMPORAL_PATH: path, **pictures}, artifacts, inputs)


def _index(wanted: TemporalSources, folder: Path, data: Path | None, steps: Steps) -> Path | None:
    """All indices as one artifact; their files are ingested together."""
    if not wanted.indices:
        return None
    files = [
        file
        for source in wanted.indices
        for file in locate_all([source.path, *data_files(source, data)], ACTIVITY_INDEX)[0]
    ]
    return steps.run(ingest_index.STAGE, {"files": files}, folder / "index.nc", {})


def _station(
    source: Source[Any], activity: Path | None, folder: Path, data: Path | None, steps: Steps
) -> StationData:
    name = source.source.id
    files = [source.path, *data_files(source, data)]
    record = steps.run(ingest_observatory.STAGE, {"files": files}, folder / f"{name}-record.nc", {})
    series = steps.run(check.STAGE, {"series": record}, folder / f"{name}-series.nc", {})
    of_activity = {} if activity is None else {"index": activity}
    curves = steps.run(
        baseline.STAGE, {"series": series, **of_activity}, folder / f"{name}-baseline.nc", {}
    )
    fits = steps.run(
        fit_fogm.STAGE,
        {"series": series, "baseline": curves, **of_activity},
        folder / f"{name}-fogm.nc",
        {},
    )
    return StationData(record, series, curves, fits)


def _of_months(model: xr.Dataset, months: Sequence[str]) -> xr.Dataset:
    """The variables and months of a release. CoverageError for a month that is not there."""
    wanted = np.array(months, "datetime64[M]")
    held = model["month"].values.astype("datetime64[M]")
    missing = np.setdiff1d(wanted, held)
    if missing.size:
        raise CoverageError(
            f"no observatory has a record of {missing[0]}",
            where="temporal.months",
            expected=f"months from {held[0]} to {held[-1]}",
            remedy="leave it out, or add files to a source",
        )
    kept = model[[name for name in model.variables if name in TEMPORAL_VARIABLES]]
    segments = kept["segment_start"].values.astype("datetime64[M]")
    return kept.isel(
        month=np.flatnonzero(np.isin(held, wanted)),
        segment=np.flatnonzero(np.isin(segments, wanted)),
    )
