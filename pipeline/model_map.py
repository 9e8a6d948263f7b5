"""The map of a field model: its core apart, its crust on every level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from magtiles.catalog.models import shc_text
from magtiles.pipeline import receipts
from magtiles.pipeline.harmonic_lattice import GLOBE, check_halo, harmonic_spacing
from magtiles.pipeline.product import ModelMap
from magtiles.pipeline.steps import MapPlan, Steps, node_axes
from magtiles.pipeline.survey_map import check_gaps
from magtiles.schemas.errors import SourceError
from magtiles.stages.field import model_components
from magtiles.stages.field.model_components import ModelPartsParams, model_parts
from magtiles.stages.field.model_parts import ModelParts
from magtiles.stages.release.atomic import write_bytes
from magtiles.stages.release.plan import plan_lattice


@dataclass(frozen=True)
class _Files:
    """A model's data files, with the TOML that describes them where there is one."""

    toml: tuple[Path, ...]
    data: tuple[Path, ...]


def plan_model_map(source: ModelMap, folder: Path, data: Path | None, steps: Steps) -> MapPlan:
    """Read the model, write its core field and plan the lattice and its levels.

    Raises SourceError for coefficient files that are not there, FormatError for bad ones,
    ParameterError for degrees, epochs, spacings and uncertainties that will not do.
    """
    wanted, files = source.table, _files(source, data)
    steps.report("reading coefficients")
    chosen: dict[str, Any] = {
        "reference_epoch": wanted.epoch,
        "core_degree": wanted.core_degree,
        "crust_degree": wanted.crust_degree,
        "highest_degree": wanted.highest_degree,
    }
    inputs = [*files.toml, *files.data]
    parts, _ = model_parts(inputs, source.core, ModelPartsParams(**chosen))
    bounds = GLOBE if wanted.region is None else wanted.region.bounds
    spacing = harmonic_spacing(wanted.spacing_m, parts.crust.n_max, bounds, "model")
    lattice = plan_lattice(bounds, spacing, wanted.tile_deg, table="model")
    check_halo(lattice, "model")
    heights = sorted(wanted.heights_m)
    check_gaps(heights, "model.heights_m")
    core_field = folder / "core_field.shc"
    write_bytes(core_field, _core_text(parts).encode())
    params = {**chosen, **node_axes(lattice), "uncertainty_nt": wanted.uncertainty_nt}
    return MapPlan(
        lattice=lattice,
        heights=heights,
        level=lambda height: _level(inputs, source.core, params, height, folder, steps),
        artifacts=[],
        inputs=_inputs(source, files.data),
        source=source.path,
        core_field=core_field,
    )


def _level(
    inputs: Sequence[Path],
    core: Path | None,
    params: dict[str, Any],
    height: float,
    folder: Path,
    steps: Steps,
) -> Path:
    """The component grid of one level on every node of the lattice, halo included."""
    roles: dict[str, Any] = {"model": inputs, **({} if core is None else {"core": core})}
    stated = {k: v for k, v in params.items() if v is not None}
    out = folder / f"level-{height:.12g}m.nc"
    return steps.run(model_components.STAGE, roles, out, {**stated, "height_m": height})


def _files(source: ModelMap, data: Path | None) -> _Files:
    """The coefficient files: in `data` where it is given, else where the product says."""
    files = source.files if data is None else tuple(data / file.name for file in source.files)
    if not files:
        raise SourceError("holds no coefficient files", where=source.path, expected="*.COF")
    missing = [file for file in files if not file.is_file()]
    if missing:
        raise SourceError(
            f"{len(missing)} of the {len(files)} coefficient files of '{source.id}' are missing, "
            f"first {missing[0].name}",
            where=missing[0].parent,
            remedy="fetch them" + (f" from {source.url}" if source.url else "")
            + ", and name their folder with --from",
        )  # fmt: skip
    return _Files((source.path,) if source.path.suffix == ".toml" else (), files)


def _inputs(source: ModelMap, files: Sequence[Path]) -> list[dict[str, str]]:
    inputs = [
        {
            "id": f"{source.id}/{file.name}" if len(files) > 1 else source.id,
            "sha256": receipts.digest(file),
            "licence": source.licence,
            "role": "field model",
        }
        for file in files
    ]
    if source.core is not None:
        digest = receipts.digest(source.core)
        core = {"id": source.core.stem, "sha256": digest, "licence": "not stated"}
        inputs.append({**core, "role": "core field"})
    return inputs


def _core_text(parts: ModelParts) -> str:
    return shc_text(
        parts.core,
        f"{parts.core.name}, degrees {parts.core.n_min} to {parts.core.n_max}: the core field "
        "that this release's anomaly counts from",
    )
