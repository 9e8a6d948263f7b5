"""Field models by the name that a dataset or a parameter gives them, or from a file."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path

from magtiles.catalog.models import (
    FieldModel,
    igrf_files,
    load_igrf,
    read_model,
    read_model_files,
)
from magtiles.schemas.errors import SourceError
from magtiles.stages.declare import Params, quantity
from magtiles.stages.ingest.source import SourceKind, locate_all


def named_model(reference_field: str, file: Path | None, *, role: str) -> FieldModel:
    """The model in `file` where one is given, else the IGRF generation of that name.

    Raises SourceError for another name without a file, naming the `role` that takes one;
    what `read_model` raises for a bad file.
    """
    if file is not None:
        return read_model(file)
    generation = _generation(reference_field)
    if generation is None:
        raise SourceError(
            f"the coefficients of '{reference_field}' are not known",
            where="reference_field",
            expected="a generation of the IGRF, such as IGRF-14",
            remedy=f"give its coefficient file: --in {role}=FILE",
        )
    return igrf(generation)


def igrf(generation: int = 14) -> FieldModel:
    """A generation of the IGRF, under the name that datasets give it, such as ``IGRF-14``."""
    return dataclasses.replace(load_igrf(generation), name=f"IGRF-{generation}")


def igrf_coefficients(reference_field: str) -> Path | None:
    """The file of an IGRF generation that is at hand; None for any other field."""
    generation = _generation(reference_field)
    return None if generation is None else igrf_files().get(generation)


def _generation(reference_field: str) -> int | None:
    found = re.fullmatch(r"IGRF[- ]?(\d{1,3})", reference_field.strip(), re.IGNORECASE)
    return None if found is None else int(found[1])


class CoefficientsParams(Params):
    """The [coefficients] keys of a source: what a model's files do not say themselves."""

    uncertainty_nt: float | None = quantity(
        "nT", default=None, gt=0, doc="1 sigma of a component of the crustal field, at sea level."
    )


FIELD_MODEL = SourceKind("field-model", "coefficients", CoefficientsParams)


def read_coefficients(files: Sequence[Path]) -> tuple[FieldModel, float | None]:
    """The model in coefficient files or those of a source TOML, and its stated 1 sigma, nT.

    Raises SourceError and IntegrityError as `locate_all`, FormatError naming file and line.
    """
    found, source = locate_all(files, FIELD_MODEL)
    stated = None if source is None else source.params.uncertainty_nt
    return read_model_files(found), stated


def model_files(path: Path) -> list[Path]:
    """The files of a model given as a file, or as the folder of an EMM set."""
    if path.is_dir():
        return sorted(file for file in path.iterdir() if file.suffix.lower() == ".cof")
    pair = [path, path.with_name(path.name + ".cof")]
    return pair if path.suffix == ".wmm" and pair[1].is_file() else [path]
