"""Stage ``reduce-track``: from the measured total field to the anomaly, levelled and judged."""

from __future__ import annotations

import dataclasses
import json
import logging
from pathlib import Path
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.stages.declare import OPTIONAL_FILE, Stage, quantity
from magtiles.stages.field.core_field import RemoveCoreFieldParams, remove_from_track
from magtiles.stages.vehicle.crossings import UNPLACED, find_crossings
from magtiles.stages.vehicle.levels import Misfit, crossover_levels, misfit
from magtiles.stages.vehicle.lines import line_names, line_numbers, line_statistics, plain

_LOG = logging.getLogger(__name__)

Real = NDArray[np.float64]


class ReduceTrackParams(RemoveCoreFieldParams):
    """Parameters of reduce-track."""

    level: Literal["none", "median", "line-median", "crossovers"] = quantity(
        "1",
        default="none",
        doc="Level that comes off: the track's median, each line's, or what fits lines best "
        "where they cross.",
    )
    level_nt: float = quantity("nT", default=0.0, doc="Constant that comes off besides.")
    crossings_apart_s: float = quantity(
        "s", default=60.0, gt=0, doc="Passes of one line closer in time are no crossing."
    )


def reduce_track(
    track: xr.Dataset, *, params: ReduceTrackParams, model: Path | None = None
) -> xr.Dataset:
    """The anomaly (time,) along a track, nT, with its level and what speaks for it.

    As remove-core-field: |F| - |F_core| of each sample's place and date, less `diurnal` where
    the track has one. Less `level` (time,), which stays beside it. Flags are kept; levels are of
    unflagged samples. Attributes, as JSON: `line_statistics` (count, mean, standard deviation
    and fourth-difference noise of each line) and `crossover_misfit` (count, rms, median and
    robust sigma in nT where the track crosses itself, before and after levelling).

    Raises ContractError as remove-core-field.
    """
    core = RemoveCoreFieldParams(
        reference_field=params.reference_field, allow_extrapolated=params.allow_extrapolated
    )
    reduced = remove_from_track(track, params=core, model=model)
    anomaly = reduced["magnetic_anomaly"].values.astype(np.float64)
    crossings = find_crossings(reduced, apart_s=params.crossings_apart_s)
    differences = crossings.difference(anomaly)
    lines = line_numbers(reduced)
    if params.level == "crossovers":
        by_line = crossover_levels(crossings, differences, int(lines.max()) + 1)
        _warn_uncrossed(reduced, by_line)
        level = np.nan_to_num(by_line)[lines]
    else:
        level = _medians(reduced, anomaly, params.level, lines)
    level = level + params.level_nt
    levelled = _with_level(reduced, anomaly - level, level, params)
    after = misfit(crossings.difference(anomaly - level))
    if after.count:
        _LOG.info(
            "%d crossings: rms %.2f nT before levelling, %.2f after",
            after.count, misfit(differences).rms, after.rms,
        )  # fmt: skip
    return levelled.assign_attrs(
        line_statistics=json.dumps([plain(line) for line in line_statistics(levelled)]),
        crossover_misfit=json.dumps(
            {"before": _plain(misfit(differences)), "after": _plain(after)}
        ),
    )


def _medians(track: xr.Dataset, anomaly: Real, kind: str, lines: NDArray[np.int64]) -> Real:
    """The median (time,) of the track, or of each sample's line; zero for none."""
    level = np.zeros(anomaly.size)
    if kind == "none":
        return level
    good = np.isfinite(anomaly)
    if "quality_flag" in track:
        good &= (track["quality_flag"].values & int(UNPLACED)) == 0
    groups = lines if kind == "line-median" else np.zeros_like(lines)
    for number in np.unique(groups):
        rows = groups == number
        if (rows & good).any():
            level[rows] = np.median(anomaly[rows & good])
    return level


def _with_level(
    track: xr.Dataset, anomaly: Real, level: Real, params: ReduceTrackParams
) -> xr.Dataset:
    if params.level == "none" and params.level_nt == 0.0:
        return track
    words = {
        "none": "a constant",
        "median": "its median",
        "line-median": "the median of each line",
        "crossovers": "a level of each line from crossings",
    }[params.level]
    attributes = {"units": "nT", "long_name": f"level taken off the anomaly: {words}"}
    definition = f"{track.attrs['anomaly_definition']}, less {words}"
    return track.assign(
        magnetic_anomaly=("time", anomaly, track["magnetic_anomaly"].attrs),
        level=("time", level, attributes),
    ).assign_attrs(anomaly_definition=definition)


def _warn_uncrossed(track: xr.Dataset, by_line: Real) -> None:
    lost = np.flatnonzero(np.isnan(by_line))
    if lost.size:
        names = line_names(track)
        _LOG.warning(
            "%d of %d lines cross no other and keep their level: %s",
            lost.size, by_line.size, ", ".join(names[i] for i in lost[:5]),
        )  # fmt: skip


def _plain(found: Misfit) -> dict[str, Any]:
    return {
        name: None if np.isnan(value) else round(value, 3)
        for name, value in dataclasses.asdict(found).items()
    }


STAGE = Stage(
    name="reduce-track",
    version=1,
    params=ReduceTrackParams,
    inputs={"track": "track/1", "model": OPTIONAL_FILE},
    output="track-anomaly/1",
    run=reduce_track,
)
