"""The map of a survey: ingested, cropped, filled, and continued to every level."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from magtiles.catalog.releases.lattice import Lattice
from magtiles.pipeline.artifacts import open_artifact
from magtiles.pipeline.large_levels import LevelJob, LevelTasks, begin
from magtiles.pipeline.product import AnomalyTable, SurveyMap
from magtiles.pipeline.source_paths import data_files, manifest_inputs
from magtiles.pipeline.steps import MapPlan, Steps, node_axes
from magtiles.pipeline.tasks import Tasks
from magtiles.schemas.errors import CoverageError, ParameterError
from magtiles.stages.field import components, crop, voids
from magtiles.stages.field.extent import data_bounds
from magtiles.stages.field.geometry import true_spacing
from magtiles.stages.ingest import grid as ingest
from magtiles.stages.ingest.field_model import igrf_coefficients
from magtiles.stages.release.plan import Bounds, plan_lattice

_MARGIN_HEIGHTS = 20.0
_MARGIN_CELLS = 64
_MARGIN_CELLS_M = 500e3
"""No cells are kept for their number alone farther off: there the plane's scale is another."""
_LEAST_GAP_M = 1.0


@dataclass(frozen=True)
class Survey:
    """A survey ready to be continued: where its grid lies, its surface and its cell (m)."""

    grid: Path
    height_m: float
    cell_m: float
    bounds: Bounds
    reference_field: str


def plan_survey_map(source: SurveyMap, folder: Path, data: Path | None, steps: Steps) -> MapPlan:
    """Make the survey ready and plan its lattice and levels.

    Raises SourceError, FormatError and ContractError for bad data; CoverageError for levels
    below the survey or too close.
    """
    wanted, files = source.table, data_files(source.source, data)
    survey = _survey(wanted, [source.path, *files], folder, steps)
    heights = _heights(wanted, survey.height_m)
    spacing = wanted.spacing_m or _default_spacing(survey, heights)
    lattice = plan_lattice(survey.bounds, spacing, wanted.tile_deg)
    inputs = manifest_inputs(source.source, files, "survey")
    surface: list[Path] = []
    if source.surface is not None:
        surface = source.surface.lay(survey.grid, lattice, folder, data, steps)
        inputs += source.surface.inputs(data)
    names = ["survey.nc", *(["cropped.nc"] if wanted.region is not None else []), "filled.nc"]
    levels = Levels(wanted, survey, lattice, folder, steps)
    return MapPlan(
        lattice=lattice,
        heights=heights,
        level=levels.make,
        artifacts=[*(folder / name for name in names), *surface],
        inputs=inputs,
        source=source.path,
        core_field=igrf_coefficients(survey.reference_field),
        surface=surface[-1] if surface else None,
        begin=(lambda tasks: levels.begin(tasks, heights)) if levels.are_large else None,
    )


def _survey(wanted: AnomalyTable, files: Sequence[Path], folder: Path, steps: Steps) -> Survey:
    """Ingest, crop and fill."""
    grid = steps.run(ingest.STAGE, {"files": files}, folder / "survey.nc", {})
    with open_artifact(grid) as opened:
        height, cell = float(np.mean(opened["height"])), min(true_spacing(opened))
        reference_field = str(opened.attrs["reference_field"])
        _check_reference(wanted, str(opened.attrs["height_reference"]))
    region = wanted.region
    if region is not None:
        gain = max(abs(h - height) for h in wanted.heights_m)
        margin = max(_MARGIN_HEIGHTS * gain, min(_MARGIN_CELLS * cell, _MARGIN_CELLS_M))
        limits = {"latitude": region.latitude, "longitude": region.longitude, "margin_m": margin}
        grid = steps.run(crop.STAGE, {"grid": grid}, folder / "cropped.nc", limits)
        bounds = region.bounds
    else:
        with open_artifact(grid) as opened:
            bounds = data_bounds(opened)
    filled = steps.run(voids.STAGE, {"grid": grid}, folder / "filled.nc", {})
    return Survey(filled, height, cell, bounds, reference_field)


def _check_reference(wanted: AnomalyTable, of_survey: str) -> None:
    """Raise ParameterError where the survey's own file counts heights from something else."""
    if wanted.height_reference != of_survey:
        raise ParameterError(
            f"height_reference is '{wanted.height_reference}'",
            where="anomaly",
            expected=f"'{of_survey}', which the survey's file states",
            remedy="give heights above the survey's own reference",
        )


def _heights(wanted: AnomalyTable, survey_height: float) -> list[float]:
    """The levels, ascending, the survey's own surface among them."""
    below = [h for h in wanted.heights_m if h < survey_height]
    if below and not wanted.allow_downward_continuation:
        raise CoverageError(
            f"heights_m holds {min(below):g}, below the survey at {survey_height:g} m",
            where="anomaly",
            expected=f"heights of {survey_height:g} m and more",
            remedy="raise it, or set allow_downward_continuation = true (flagged, noisier)",
        )
    heights = sorted({survey_height, *wanted.heights_m})
    check_gaps(heights, "anomaly heights_m", ", the survey's own among them")
    return heights


def check_gaps(heights: Sequence[float], where: str, note: str = "") -> None:
    """Raise CoverageError for ascending levels that are too close to interpolate between."""
    for lower, upper in itertools.pairwise(heights):
        if upper - lower < _LEAST_GAP_M:
            raise CoverageError(
                f"levels at {lower:.12g} and {upper:.12g} m are too close to interpolate between",
                where=where,
                expected=f"levels {_LEAST_GAP_M:g} m apart or more{note}",
                remedy="leave one out",
            )


def _default_spacing(survey: Survey, heights: Sequence[float]) -> float:
    """The smaller of the source's cell and half the lowest gain above zero."""
    gains = [h - survey.height_m for h in heights if h > survey.height_m]
    return min([survey.cell_m, *(g / 2 for g in gains)])


class Levels:
    """Makes the component grids of levels, on every node of a lattice with its halo."""

    def __init__(
        self, wanted: AnomalyTable, survey: Survey, lattice: Lattice, folder: Path, steps: Steps
    ) -> None:
        self._wanted, self._survey, self._lattice = wanted, survey, lattice
        self._folder, self._steps = folder, steps
        self._begun: dict[float, LevelTasks] = {}
        self._tasks = Tasks()

    @property
    def are_large(self) -> bool:
        """Whether they are made block by block."""
        return self._job(self._survey.height_m).is_large

    def begin(self, tasks: Tasks, heights: Sequence[float]) -> None:
        """Ask for the blocks of all levels, lowest first: none waits while one is put together."""
        self._tasks = tasks
        self._begun = {height: begin(tasks, self._job(height)) for height in heights}

    def make(self, height: float) -> Path:
        """The level of one height."""
        job = self._job(height)
        if height not in self._begun:
            return self._steps.run(
                components.STAGE, {"grid": job.grid}, job.out, self._params(height)
            )
        self._steps.report(components.STAGE.name)
        begun = self._begun.pop(height)
        tell = self._steps.within(f"blocks of {job.out.stem}")
        self._tasks.results(begun.tasks, lambda done: tell(done, len(begun.tasks)))
        return job.out

    def _job(self, height: float) -> LevelJob:
        out = self._folder / f"level-{height:.12g}m.nc"
        return LevelJob.of(self._survey.grid, self._params(height), out)

    def _params(self, height: float) -> dict[str, Any]:
        params: dict[str, Any] = {
            "height_m": height - self._survey.height_m,
            "allow_downward_continuation": self._wanted.allow_downward_continuation,
            **node_axes(self._lattice),
        }
        for name in ("inclination_deg", "declination_deg", "block_nodes"):
            if (value := getattr(self._wanted, name)) is not None:
                params[name] = value
        return params
