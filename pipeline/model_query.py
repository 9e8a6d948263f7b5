"""What ``magtiles query --model`` answers: the field of a model at positions and dates."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.models import FieldModel, decimal_year, evaluate, load_igrf, read_model
from magtiles.pipeline.output import print_table
from magtiles.schemas.errors import UsageError

_IGRF = re.compile(r"igrf-?(\d+)", re.IGNORECASE)


def find_model(id_or_file: str) -> FieldModel:
    """The model of an id (igrf13, igrf14) or in a file or folder; UsageError for neither."""
    if match := _IGRF.fullmatch(id_or_file):
        return load_igrf(int(match[1]))
    path = Path(id_or_file)
    if not path.exists():
        raise UsageError(
            f"no model '{id_or_file}'", where="--model", expected="igrf13, igrf14 or a file"
        )
    return read_model(path)


def answer(
    model: FieldModel,
    positions: NDArray[np.float64],
    dates: Sequence[str],
    *,
    allow_extrapolated: bool,
) -> list[dict[str, Any]]:
    """The elements of the field at positions (n, 3), at one date or one for each.

    nT and degrees; `extrapolated` where the date is beyond the model's validity.
    """
    years = np.broadcast_to(decimal_year(np.array(dates)), len(positions))
    lat, lon, h = positions.T
    field = evaluate(model, lat, lon, h, years, allow_extrapolated=allow_extrapolated)
    north, east, down = field.T
    horizontal = np.hypot(north, east)
    columns: dict[str, NDArray[Any]] = {
        **dict(zip(("latitude", "longitude", "height"), (lat, lon, h), strict=True)),
        "decimal_year": years,
        "north": north,
        "east": east,
        "down": down,
        "horizontal": horizontal,
        "total": np.hypot(horizontal, down),
        "declination": np.degrees(np.arctan2(east, north)),
        "inclination": np.degrees(np.arctan2(down, horizontal)),
        "extrapolated": ~model.covers(years),
    }
    rows = zip(*(values.tolist() for values in columns.values()), strict=True)
    return [{"model": model.name, **dict(zip(columns, row, strict=True))} for row in rows]


def print_answers(answers: list[dict[str, Any]]) -> None:
    """Print a table of `answer`."""
    formats = {
        "latitude": "{:.6f}",
        "longitude": "{:.6f}",
        "height": "{:.1f}",
        "decimal_year": "{:.4f}",
        "north": "{:.2f}",
        "east": "{:.2f}",
        "down": "{:.2f}",
        "horizontal": "{:.2f}",
        "total": "{:.2f}",
        "declination": "{:.4f}",
        "inclination": "{:.4f}",
    }
    header = [
        "latitude", "longitude", "height m", "year", "north nT", "east", "down", "horizontal",
        "total", "declination deg", "inclination", "note",
    ]  # fmt: skip
    rows = [
        [f.format(a[key]) for key, f in formats.items()]
        + ["extrapolated" if a["extrapolated"] else "-"]
        for a in answers
    ]
    print_table(header, rows)
