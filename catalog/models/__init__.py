"""Spherical-harmonic models of the Earth's magnetic field: reading and evaluating them."""

from magtiles.catalog.models.dates import decimal_year
from magtiles.catalog.models.evaluate import evaluate
from magtiles.catalog.models.grid import evaluate_grid
from magtiles.catalog.models.igrf import load_igrf
from magtiles.catalog.models.model import FieldModel
from magtiles.catalog.models.read import parse_model, read_model

__all__ = [
    "FieldModel",
    "decimal_year",
    "evaluate",
    "evaluate_grid",
    "load_igrf",
    "parse_model",
    "read_model",
]
