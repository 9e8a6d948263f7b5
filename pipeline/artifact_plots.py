"""The picture of an artifact: which figure shows what a file of a contract holds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import xarray as xr

from magtiles.pipeline.artifacts import check_artifact, open_artifact
from magtiles.pipeline.calibration_plots import calibration_figure
from magtiles.pipeline.compensation_plots import compensation_figure
from magtiles.pipeline.road_plots import road_figure
from magtiles.pipeline.track_plots import track_figure
from magtiles.schemas.errors import UsageError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def _draw_track(track: xr.Dataset) -> Figure:
    return compensation_figure(track) if "field_total_raw" in track else track_figure(track)


def _draw_road(road: xr.Dataset) -> Figure:
    return road_figure(road, "field")


_FIGURES: dict[str, Callable[[xr.Dataset], Figure]] = {
    "track": _draw_track,
    "track-anomaly": track_figure,
    "road-map": _draw_road,
}
"""Contract, without its version, to what draws it."""


def artifact_figure(path: Path, track: Path | None = None) -> Figure:
    """Draw the artifact at `path` by its contract; a calibration with the track it is of.

    Raises UsageError for a contract that has no picture by itself, FormatError for what is no
    artifact, ContractError where `track` is given and the two are no calibration and track.
    """
    if track is not None:
        return _draw_calibration(path, track)
    with open_artifact(path) as dataset:
        contract = str(dataset.attrs.get("contract", "none"))
        draw = _FIGURES.get(contract.split("/")[0])
        if draw is None:
            raise UsageError(
                f"has contract '{contract}'",
                where=path,
                expected=f"a release's folder, or a file of {', '.join(_FIGURES)}",
                remedy="a calibration is drawn with --track, the track that it was made from",
            )
        return draw(dataset)


def _draw_calibration(path: Path, track: Path) -> Figure:
    check_artifact(path, "sensor-calibration/1", role="calibration")
    check_artifact(track, "track/1", role="track")
    with open_artifact(path) as calibration, open_artifact(track) as readings:
        return calibration_figure(readings, calibration)
