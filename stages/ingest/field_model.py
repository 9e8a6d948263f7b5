"""Field models by the name that a dataset or a parameter gives them, or from a file."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

from magtiles.catalog.models import FieldModel, load_igrf, read_model
from magtiles.schemas.errors import SourceError


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


def _generation(reference_field: str) -> int | None:
    found = re.fullmatch(r"IGRF[- ]?(\d{1,3})", reference_field.strip(), re.IGNORECASE)
    return None if found is None else int(found[1])
