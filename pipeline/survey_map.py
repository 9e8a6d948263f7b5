"""The map of a survey: ingested, cropped, filled, and continued to every level.

One that goes all around the globe is neither cropped nor filled: its harmonics are fitted to what
was measured.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from magtiles.catalog.releases.lattice import Lattice
from magtiles.pipeline.artifacts import open_artifact
from magtiles.pipeline.harmonic_lattice import GLOBE, check_halo, harmonic_spacing
from magtiles.pipeline.large_levels import LevelJob, begin
from magtiles.pipeline.product import AnomalyTable, SurveyMap
from magtiles.pipeline.source_paths import data_files, manifest_inputs
from magtiles.pipeline.steps import MapPlan, Steps, node_axes
from magtiles.pipeline.tasks import Task, Tasks
from magtiles.schemas.errors import CoverageError, ParameterError
from magtiles.stages.field import components, crop, sphere, voids
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
    """A survey ready to be continued: where its grid lies, its surface and its cell (m).

    `artifacts` were made on the way. `degree` is the highest harmonic of a survey that goes all
    around the globe, none of others.
    """

    artifacts: Sequence[Path]
    height_m: float
    cell_m: float
    bounds: Bounds
    reference_field: str
    degree: int | None = None

    @property
    def grid(self) -> Path:
        """The last of the artifacts."""
        return self.artifacts[-1]


def plan_survey_map(source: SurveyMap, folder: Path, data: Path | None, steps: Steps) -> MapPlan:
    """Make the survey ready and plan its lattice and levels.

    Raises SourceError, FormatError and ContractError for bad data; CoverageError for levels
    below the survey or too close.
    """
    wanted, files = source.table, data_files(source.source, data)
    survey = _survey(wanted, [source.path, *files], folder, steps)
    heights = _heights(wanted, survey.height_m)
    lattice = _lattice(wanted, survey, heights)
    inputs = manifest_inputs(source.source, files, "survey")
    surface: list[Path] = []
    if source.surface is not None:
        surface = source.surface.lay(survey.grid, lattice, folder, data, steps)
        inputs += source.surface.inputs(data)
    levels = Levels(wanted, survey, lattice, folder, steps)
    return MapPlan(
        lattice=lattice,
        heights=heights,
        level=levels.make,
        artifacts=[*survey.artifacts, *surface],
        inputs=inputs,
        source=source.path,
        core_field=igrf_coefficients(survey.reference_field),
        surface=surface[-1] if surface else None,
        begin=(lambda tasks: levels.begin(tasks, heights)) if levels.are_large else None,
    )


def _survey(wanted: AnomalyTable, files: Sequence[Path], folder: Path, steps: Steps) -> Survey:
    """Ingest, crop and fill; a survey of the globe is ingested only."""
    grid = steps.run(ingest.STAGE, {"files": files}, folder / "survey.nc", {})
    artifacts = [grid]
    region = wanted.region
    around = region is None or region.bounds[3] - region.bounds[2] >= 360.0
    with open_artifact(grid) as opened:
        height, cell = float(np.mean(opened["height"])), min(true_spacing(opened))
        reference_field = str(opened.attrs["reference_field"])
        _check_reference(wanted, str(opened.attrs["height_reference"]))
        if around and sphere.is_globe(opened):
            bounds = _data_parallels(opened) if region is None else region.bounds
            degree = sphere.resolved_degree(opened)
            return Survey(artifacts, height, cell, bounds, reference_field, degree)
    if region is not None:
        gain = max(abs(h - height) for h in wanted.heights_m)
        margin = max(_MARGIN_HEIGHTS * gain, min(_MARGIN_CELLS * cell, _MARGIN_CELLS_M))
        limits = {"latitude": region.latitude, "longitude": region.longitude, "margin_m": margin}
        grid = steps.run(crop.STAGE, {"grid": grid}, folder / "cropped.nc", limits)
        artifacts.append(grid)
        bounds = region.bounds
    else:
        with open_artifact(grid) as opened:
            bounds = data_bounds(opened)
    artifacts.append(steps.run(voids.STAGE, {"grid": grid}, folder / "filled.nc", {}))
    return Survey(artifacts, height, cell, bounds, reference_field)


def _data_parallels(globe: xr.Dataset) -> Bounds:
    """The globe between its outermost parallels with data, or 85 degrees."""
    known = np.isfinite(globe["magnetic_anomaly"].values).any(axis=1)
    latitude = globe["latitude"].values[known]
    south, north, west, east = GLOBE
    if not latitude.size:
        return GLOBE
    return max(south, float(latitude[0])), min(north, float(latitude[-1])), west, east


def _lattice(wanted: AnomalyTable, survey: Survey, heights: Sequence[float]) -> Lattice:
    """Where the nodes of the release are."""
    if survey.degree is None:
        spacing = wanted.spacing_m or _default_spacing(survey, heights)
        return plan_lattice(survey.bounds, spacing, wanted.tile_deg)
    spacing = harmonic_spacing(wanted.spacing_m, survey.degree, survey.bounds, "anomaly")
    lattice = plan_lattice(survey.bounds, spacing, wanted.tile_deg)
    check_halo(lattice, "anomaly")
    return lattice


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
        self._begun: dict[float, list[Task[None]]] = {}
        self._tasks = Tasks()

    @property
    def are_large(self) -> bool:
        """Whether they are made block by block."""
        return self._survey.degree is None and self._job(self._survey.height_m).is_large

    def begin(self, tasks: Tasks, heights: Sequence[float]) -> None:
        """Ask for the blocks of all levels, lowest first: none waits while one is put together."""
        self._tasks = tasks
        begun = begin(tasks, [self._job(height) for height in heights])
        self._begun = dict(zip(heights, begun, strict=True))

    def make(self, height: float) -> Path:
        """The level of one height."""
        if self._survey.degree is not None:
            globe = {"globe": self._survey.grid}
            params = {k: v for k, v in self._params(height).items() if k != "block_nodes"}
            return self._steps.run(sphere.STAGE, globe, self._out(height), params)
        job = self._job(height)
        if height not in self._begun:
            return self._steps.run(
                components.STAGE, {"grid": job.grid}, job.out, self._params(height)
            )
        self._steps.report(components.STAGE.name)
        begun = self._begun.pop(height)
        tell = self._steps.within(f"blocks of {job.out.stem}")
        self._tasks.results(begun, lambda done: tell(done, len(begun)))
        return job.out

    def _job(self, height: float) -> LevelJob:
        return LevelJob.of(self._survey.grid, self._params(height), self._out(height))

    def _out(self, height: float) -> Path:
        return self._folder / f"level-{height:.12g}m.nc"

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
