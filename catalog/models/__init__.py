"""Spherical-harmonic models of the Earth's magnetic field: reading and evaluating them."""

from magtiles.catalog.models.cof import cof_text
from magtiles.catalog.models.dates import decimal_year
from magtiles.catalog.models.evaluate import evaluate
from magtiles.catalog.models.grid import evaluate_grid
from magtiles.catalog.models.igrf import igrf_files, load_igrf
from magtiles.catalog.models.model import FieldModel
from magtiles.catalog.models.read import parse_model, read_model, read_model_files
from magtiles.catalog.models.shc import shc_text
from magtiles.catalog.models.spectrum import power_spectrum

__all__ = [
    "FieldModel",
    "cof_text",
    "decimal_year",
    "evaluate",
    "evaluate_grid",
    "igrf_files",
    "load_igrf",
    "parse_model",
    "power_spectrum",
    "read_model",
    "read_model_files",
    "shc_text",
]
