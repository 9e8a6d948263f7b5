"""Building a product: its stages in order, then the release published."""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from magtiles.catalog.releases.manifest import MANIFEST_NAME
from magtiles.pipeline import receipts
from magtiles.pipeline.cutting import Cutter, worth_processes
from magtiles.pipeline.model_map import plan_model_map
from magtiles.pipeline.product import ModelMap, Product, SurveyMap, load_product
from magtiles.pipeline.progress import Progress, silent
from magtiles.pipeline.roads_part import build_roads
from magtiles.pipeline.source_paths import check_there
from magtiles.pipeline.steps import MapPlan, PartResult, Steps
from magtiles.pipeline.survey_map import plan_survey_map
from magtiles.pipeline.tasks import SCRATCH, Tasks, Workplace, working
from magtiles.pipeline.temporal_part import build_temporal
from magtiles.schemas.errors import (
    CoverageError,
    MagtilesError,
    MissingInputError,
    ParameterError,
    SourceError,
)
from magtiles.stages.ingest.source import load_toml
from magtiles.stages.ingest.unpack import scratch
from magtiles.stages.release.atomic import remove_temporaries, writing
from magtiles.stages.release.lock import locked
from magtiles.stages.release.provenance import resource, slsa_predicate
from magtiles.stages.release.publish import PublishResult, publish_release
from magtiles.stages.release.records import MeasuredTile

_LOCK_NAME = ".build.lock"


def build_product(
    product: Path,
    *,
    store: Path,
    work: Path,
    data: Path | None = None,
    progress: Progress = silent,
    scheduler: str | None = None,
) -> PublishResult:
    """Build the release of a product TOML and publish it in `store`.

    Parameters
    ----------
    store : the folder of all releases.
    work : where intermediate artifacts and their receipts are kept; a later build makes only
        what has changed.
    data : folder of local copies of the source's files; default beside the source TOML.
    progress : told of each step.
    scheduler : address of a dask scheduler whose workers see `store` and `work`; default a
        local cluster where the work is worth it. What comes out is the same.

    Raises MagtilesError subclasses for bad sources, data, parameters and versions.
    """
    _refuse_workers(product)
    with _told_of_release(product, store):
        wanted = load_product(product)
        for source in wanted.sources:
            check_there(source, data)
    folder = work / wanted.product.name
    for written in (store / wanted.product.name, folder):
        _check_writable(written)
    with _asked_by(product), _alone_in(folder):
        return _build(wanted, store, folder, data, progress, scheduler)


def _refuse_workers(product: Path) -> None:
    """A worker that starts runs the script that builds: it would wait for its own parent."""
    starting = sys.modules.get("__mp_main__")
    if starting is not None and sys.modules["__main__"] is not starting:
        raise MagtilesError(
            "a worker of this very build was about to build it",
            where=product,
            expected="a script that a worker can import",
            remedy="put what builds below if __name__ == '__main__':",
        )


@contextlib.contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """One build at a time in a folder, without what those leave that die."""
    with locked(folder, _LOCK_NAME, doing="building"):
        _sweep(folder)
        with _unpacking_in(folder / SCRATCH):
            yield
        _sweep(folder)
        for blocks in folder.glob("*.blocks"):  # of a build that was killed when it had them all
            shutil.rmtree(blocks, ignore_errors=True)


@contextlib.contextmanager
def _unpacking_in(folder: Path) -> Iterator[None]:
    with writing(folder):
        folder.mkdir(exist_ok=True)
    before = scratch.set(folder)
    try:
        yield
    finally:
        scratch.reset(before)
        shutil.rmtree(folder, ignore_errors=True)


def _sweep(folder: Path) -> None:
    """Remove temporary files of builds that died, and of this one's workers."""
    for inner, _, _ in os.walk(folder):
        remove_temporaries(Path(inner))
    shutil.rmtree(folder / SCRATCH, ignore_errors=True)


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


@contextlib.contextmanager
def _told_of_release(product: Path, store: Path) -> Iterator[None]:
    """Say of inputs that are not there which release was once built from them, and stays."""
    try:
        yield
    except MissingInputError as error:
        release = _release_of(product, store)
        if release is None:
            raise
        what = f"{error.what}; {release}, built from it, stays as it is and may be stale"
        raise MissingInputError(
            what, where=error.where, expected=error.expected, remedy=error.remedy
        ) from error


def _release_of(product: Path, store: Path) -> Path | None:
    """The release of a product TOML, if there are both; the rest of the TOML may be wrong."""
    try:
        table = load_toml(product, lists=("roads",))["product"]
        release = store / str(table["name"]) / str(table["version"])
    except (SourceError, KeyError):
        return None
    return release if (release / MANIFEST_NAME).is_file() else None


def _build(
    wanted: Product,
    store: Path,
    folder: Path,
    data: Path | None,
    progress: Progress,
    scheduler: str | None,
) -> PublishResult:
    more = 0 if wanted.temporal is None else wanted.temporal.steps
    if isinstance(wanted.map, SurveyMap) and wanted.map.surface is not None:
        more += wanted.map.surface.steps
    more += sum(roads.steps for roads in wanted.roads)
    steps = Steps(progress, total=4 + len(wanted.map.table.heights_m) + more)
    with working(scheduler, [folder, store / wanted.product.name]) as place:
        plan = _plan(wanted, folder, data, steps)
        parts = []
        if wanted.temporal is not None:
            _require_core_field(plan)
            parts.append(build_temporal(wanted.temporal, folder, data, steps))
        if wanted.roads:
            parts.append(build_roads(wanted.roads, folder, data, steps))
        levels, pictures, cut = _make_tiles(wanted, plan, folder, progress, place)
        steps.report("publishing")
        return _publish(wanted, store, plan, cut, levels, pictures, parts, place.tasks)


def _make_tiles(
    wanted: Product, plan: MapPlan, folder: Path, progress: Progress, place: Workplace
) -> tuple[list[Path], list[Path], list[MeasuredTile]]:
    """All levels, their pictures, and the tiles cut from them."""
    levels, pictures = [], []
    cutter = Cutter(plan.lattice, place.tasks)
    if plan.begin is not None or worth_processes(plan.lattice, len(plan.heights)):
        place.expand()
    if plan.begin is not None:
        plan.begin(place.tasks)
    for height in plan.heights:
        levels.append(plan.level(height))
        pictures.append(folder / "preview" / f"{height:.12g}m.png")
        cutter.draw(levels[-1], pictures[-1], wanted.product.name, wanted.product.version)
    cut = cutter.cut(levels, plan.surface, folder / "tiles", progress)
    cutter.finish_drawing()
    return levels, pictures, cut


def _plan(wanted: Product, folder: Path, data: Path | None, steps: Steps) -> MapPlan:
    if isinstance(wanted.map, ModelMap):
        return plan_model_map(wanted.map, folder, data, steps)
    return plan_survey_map(wanted.map, folder, data, steps)


def _require_core_field(plan: MapPlan) -> None:
    """Raise SourceError, before the work, where a reader could not use a temporal part."""
    if plan.core_field is None:
        raise SourceError(
            "there is a [temporal] table, but no core field at hand to tell dip latitude by",
            where=plan.source,
            expected="a reference field whose coefficients are at hand, such as IGRF-14",
            remedy="leave [temporal] out, or re-reference the survey",
        )


def _publish(
    wanted: Product,
    store: Path,
    plan: MapPlan,
    cut: Sequence[MeasuredTile],
    levels: Sequence[Path],
    pictures: Sequence[Path],
    parts: Sequence[PartResult],
    tasks: Tasks,
) -> PublishResult:
    extra = {f"preview/{picture.name}": picture for picture in pictures}
    if plan.core_field is not None:
        extra["core_field.shc"] = plan.core_field
    inputs, artifacts = list(plan.inputs), [*plan.artifacts, *levels]
    for part in parts:
        extra |= part.files
        inputs += part.inputs
        artifacts += part.artifacts
    return publish_release(
        store,
        product=wanted.product.name,
        version=wanted.product.version,
        tiles=cut,
        identity={},
        inputs=inputs,
        provenance=_provenance(wanted, plan, inputs, artifacts),
        extra_files=extra,
        spread=tasks.map if tasks.in_cluster else None,
    )


def _provenance(
    wanted: Product,
    plan: MapPlan,
    inputs: Sequence[Mapping[str, str]],
    artifacts: Sequence[Path],
) -> dict[str, Any]:
    """How the release was made: what was asked for, its inputs, every artifact with its stage."""
    sources = [plan.source]
    if wanted.temporal is not None:
        sources += [s.path for s in (*wanted.temporal.observatories, *wanted.temporal.indices)]
    sources += list(dict.fromkeys(s.path for roads in wanted.roads for s in roads.sources))
    return slsa_predicate(
        parameters={
            "product": _described(wanted.path),
            "sources": [_described(source) for source in sources],
        },
        internal={"code": receipts.code_digest()},
        inputs=inputs,
        packages=receipts.package_versions(),
        byproducts=[
            resource(
                artifact.name,
                receipt["output"]["sha256"],
                **{key: receipt[key] for key in ("stage", "version", "params", "inputs")},
            )
            for artifact in artifacts
            if (receipt := receipts.read_receipt(artifact)) is not None
        ],
    )


def _described(file: Path) -> dict[str, Any]:
    return resource(file.name, receipts.digest(file) if file.is_file() else None)
