"""The IGRF, from the package that carries its official coefficients."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from magtiles.catalog.models.model import FieldModel
from magtiles.catalog.models.read import read_model
from magtiles.schemas.errors import QueryError, SourceError


def load_igrf(generation: int = 14) -> FieldModel:
    """The IGRF of a generation whose coefficients ppigrf carries (13 and 14).

    Raises SourceError where ppigrf is not installed, QueryError for another generation.
    """
    found = igrf_files()
    if generation not in found:
        raise QueryError(
            f"no IGRF of generation {generation}",
            where="ppigrf",
            expected=" or ".join(map(str, sorted(found))),
        )
    return read_model(found[generation])


def igrf_files() -> dict[int, Path]:
    """The coefficient file of each generation that ppigrf carries.

    Raises SourceError where ppigrf is not installed.
    """
    package = importlib.util.find_spec("ppigrf")  # finds it without importing it, and pandas
    if package is None or package.origin is None:
        raise SourceError(
            "the coefficients of the IGRF are not installed",
            expected="the package ppigrf",
            remedy="pip install 'magtiles[pipeline]'",
        )
    files = Path(package.origin).parent.glob("IGRF*.shc")
    return {int(file.stem[4:]): file for file in files if file.stem[4:].isdigit()}
