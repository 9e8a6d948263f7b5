"""Building a product: its stages in order, then the release published."""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from magtiles.catalog.kernels.bspline import HALO
from magtiles.catalog.releases.lattice import Lattice
from magtiles.pipeline import receipts
from magtiles.pipeline.artifacts import open_artifact
from magtiles.pipeline.cutting import cutting
from magtiles.pipeline.product import Product, load_product
from magtiles.pipeline.progress import Progress, silent
from magtiles.pipeline.runner import StageResult, run_stage
from magtiles.schemas.errors import CoverageError, MagtilesError, ParameterError
from magtiles.stages.declare import Stage
from magtiles.stages.field import components, crop, voids
from magtiles.stages.field.direction import reference_coefficients
from magtiles.stages.field.extent import data_bounds
from magtiles.stages.field.geometry import true_spacing
from magtiles.stages.ingest import grid as ingest
from magtiles.stages.release.plan import Bounds, plan_lattice
from magtiles.stages.release.publish import PublishResult, publish_release
from magtiles.stages.release.records import MeasuredTile

_log = logging.getLogger(__name__)

_MARGIN_HEIGHTS = 20.0
_MARGIN_CELLS = 64
_LEAST_GAP_M = 1.0


@dataclass(frozen=True)
class Survey:
    """A survey ready to be continued: where its grid lies, its surface and its cell (m)."""

    grid: Path
    height_m: float
    cell_m: float
    bounds: Bounds


def build_product(
    product: Path,
    *,
    store: Path,
    work: Path,
    data: Path | None = None,
    progress: Progress = silent,
) -> PublishResult:
    """Build the release of a product TOML and publish it in `store`.

    Parameters
    ----------
    store : the folder of all releases.
    work : where intermediate artifacts and their receipts are kept; a later build makes only
        what has changed.
    data : folder of local copies of the source's files; default beside the source TOML.
    progress : told of each step.

    Raises MagtilesError subclasses for bad sources, data, parameters and versions.
    """
    wanted = load_product(product)
    for folder in (store, work):
        _check_writable(folder)
    with _asked_by(product):
        return _build(wanted, store, work, data, progress)


def _check_writable(folder: Path) -> None:
    """Raise MagtilesError, before the work and not after it, where nothing can be written."""
    above = next(p for p in (folder.absolute(), *folder.absolute().parents) if p.exists())
    if not (above.is_dir() and os.access(above, os.W_OK | os.X_OK)):
        raise MagtilesError(
            "cannot be written to" if above.is_dir() else f"{above} is no folder",
            where=folder,
            expected="a folder, or a place to make one",
            remedy="choose another, or change its permissions",
        )


@contextlib.contextmanager
def _asked_by(product: Path) -> Iterator[None]:
    """Name the product in errors about what it asks for."""
    try:
        yield
    except (ParameterError, CoverageError) as error:
        where = f"{product} {error.where or ''}".rstrip()
        raise type(error)(
            error.what, where=where, expected=error.expected, remedy=error.remedy
        ) from error


def _build(
    wanted: Product, store: Path, work: Path, data: Path | None, progress: Progress
) -> PublishResult:
    folder = work / wanted.product.name
    steps = _Steps(progress, total=4 + len(wanted.anomaly.heights_m))
    survey = _survey(wanted, folder, data, steps)
    heights = _heights(wanted, survey.height_m)
    spacing = wanted.anomaly.spacing_m or _default_spacing(survey, heights)
    lattice = plan_lattice(survey.bounds, spacing, wanted.anomaly.tile_deg)
    with cutting(lattice, len(heights)) as cutter:
        levels, pictures = [], []
        for height in heights:
            levels.append(_level(wanted, survey, lattice, height, folder, steps))
            pictures.append(folder / "preview" / f"{height:.12g}m.png")
            cutter.draw(levels[-1], pictures[-1], wanted.product.name, wanted.product.version)
        cut = cutter.cut(levels, folder / "tiles", progress)
        cutter.finish_drawing()
    return _publish(wanted, store, folder, data, cut, levels, pictures, steps)


def _survey(wanted: Product, folder: Path, data: Path | None, steps: _Steps) -> Survey:
    """Ingest, crop and fill."""
    files = [wanted.source_path, *data_files(wanted, data)]
    grid = steps.run(ingest.STAGE, {"files": files}, folder / "survey.nc", {})
    with open_artifact(grid) as opened:
        height, cell = float(np.mean(opened["height"])), min(true_spacing(opened))
    region = wanted.anomaly.region
    if region is not None:
        gain = max(abs(h - height) for h in wanted.anomaly.heights_m)
        margin = max(_MARGIN_HEIGHTS * gain, _MARGIN_CELLS * cell)
        limits = {"latitude": region.latitude, "longitude": region.longitude, "margin_m": margin}
        grid = steps.run(crop.STAGE, {"grid": grid}, folder / "cropped.nc", limits)
        (south, north), (west, east) = region.latitude, region.longitude
        bounds = south, north, west, west + ((east - west) % 360.0 or 360.0)
    else:
        with open_artifact(grid) as opened:
            bounds = data_bounds(opened)
    filled = steps.run(voids.STAGE, {"grid": grid}, folder / "filled.nc", {})
    return Survey(filled, height, cell, bounds)


def data_files(wanted: Product, data: Path | None) -> list[Path]:
    """The source's data files: in `data` where it is given, else beside the source TOML."""
    if data is None:
        return list(wanted.source.files)
    return [data / file.name for file in wanted.source.files]


def _heights(wanted: Product, survey_height: float) -> list[float]:
    """The levels, ascending, the survey's own surface among them."""
    below = [h for h in wanted.anomaly.heights_m if h < survey_height]
    if below and not wanted.anomaly.allow_downward_continuation:
        raise CoverageError(
            f"heights_m holds {min(below):g}, below the survey at {survey_height:g} m",
            where="anomaly",
            expected=f"heights of {survey_height:g} m and more",
            remedy="raise it, or set allow_downward_continuation = true (flagged, noisier)",
        )
    heights = sorted({survey_height, *wanted.anomaly.heights_m})
    for lower, upper in itertools.pairwise(heights):
        if upper - lower < _LEAST_GAP_M:
            raise CoverageError(
                f"levels at {lower:.12g} and {upper:.12g} m are too close to interpolate between",
                where="anomaly heights_m",
                expected=f"levels {_LEAST_GAP_M:g} m apart or more, the survey's own among them",
                remedy="leave one out",
            )
    return heights


def _default_spacing(survey: Survey, heights: Sequence[float]) -> float:
    """The smaller of the source's cell and half the lowest gain above zero."""
    gains = [h - survey.height_m for h in heights if h > survey.height_m]
    return min([survey.cell_m, *(g / 2 for g in gains)])


def _level(
    wanted: Product, survey: Survey, lattice: Lattice, height: float, folder: Path, steps: _Steps
) -> Path:
    """The component grid of one level on every node of the lattice, halo included."""
    params: dict[str, Any] = {
        "height_m": height - survey.height_m,
        "allow_downward_continuation": wanted.anomaly.allow_downward_continuation,
        "latitude": (
            lattice.south - HALO * lattice.latitude_spacing,
            lattice.latitude_spacing,
            lattice.rows + 1 + 2 * HALO,
        ),
        "longitude": (
            lattice.west - HALO * lattice.longitude_spacing,
            lattice.longitude_spacing,
            lattice.columns + 1 + 2 * HALO,
        ),
    }
    for angle in ("inclination_deg", "declination_deg"):
        if (value := getattr(wanted.anomaly, angle)) is not None:
            params[angle] = value
    out = folder / f"level-{height:.12g}m.nc"
    return steps.run(components.STAGE, {"grid": survey.grid}, out, params)


def _publish(
    wanted: Product,
    store: Path,
    folder: Path,
    data: Path | None,
    cut: Sequence[MeasuredTile],
    levels: Sequence[Path],
    pictures: Sequence[Path],
    steps: _Steps,
) -> PublishResult:
    extra = {f"preview/{picture.name}": picture for picture in pictures}
    with open_artifact(levels[0]) as lowest:
        coefficients = reference_coefficients(str(lowest.attrs["reference_field"]))
    if coefficients is not None:
        extra["core_field.shc"] = coefficients
    steps.report("publishing")
    source = wanted.source.source
    return publish_release(
        store,
        product=wanted.product.name,
        version=wanted.product.version,
        tiles=cut,
        identity={},
        inputs=[
            {
                "id": f"{source.id}/{file.name}" if len(wanted.source.files) > 1 else source.id,
                "sha256": receipts.digest(file),
                "licence": source.licence,
                "role": "survey",
            }
            for file in data_files(wanted, data)
        ],
        provenance=_provenance(wanted, folder, levels),
        extra_files=extra,
    )


def _provenance(wanted: Product, folder: Path, levels: Sequence[Path]) -> dict[str, Any]:
    """How the release was made: every artifact with its stage, parameters and inputs."""
    names = ["survey.nc", "filled.nc"]
    if wanted.anomaly.region is not None:
        names.insert(1, "cropped.nc")
    steps = []
    for artifact in [*(folder / name for name in names), *levels]:
        if (receipt := receipts.read_receipt(artifact)) is not None:
            kept = {k: receipt[k] for k in ("stage", "version", "params", "inputs")}
            steps.append({"artifact": artifact.name, **kept})
    return {
        "product": {"file": wanted.path.name, "sha256": receipts.digest(wanted.path)},
        "source": {"file": wanted.source_path.name, "sha256": receipts.digest(wanted.source_path)},
        "steps": steps,
        "packages": receipts.package_versions(),
        "code": receipts.code_digest(),
    }


class _Steps:
    """Runs stages one after another and says so."""

    def __init__(self, progress: Progress, total: int) -> None:
        self._progress, self._done, self._total = progress, 0, total

    def report(self, what: str) -> None:
        """Tell that one more step begins."""
        self._progress(what, self._done, self._total)
        self._done += 1

    def run(
        self, stage: Stage, inputs: Mapping[str, Any], out: Path, params: Mapping[str, Any]
    ) -> Path:
        """Run a stage on files and give back its artifact."""
        self.report(stage.name)
        result: StageResult = run_stage(stage, inputs, out, params)
        return result.out
