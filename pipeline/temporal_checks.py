"""What validation asks of a release's temporal model: its contract, and that it is possible."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.models import evaluate
from magtiles.catalog.models.dates import decimal_year
from magtiles.catalog.releases.digest import array_digest
from magtiles.catalog.releases.expected import core_field
from magtiles.catalog.releases.reader import Release
from magtiles.pipeline.artifacts import check_artifact
from magtiles.schemas.errors import MagtilesError

Arrays = Mapping[str, NDArray[Any]]

MIDNIGHT_NT = 2.0
"""By how much a curve may miss zero around local midnight, beyond three standard errors."""
DIP_LATITUDE_DEG = 0.5
_MIDNIGHT_MIN = 60.0


@dataclass(frozen=True)
class Finding:
    """What one check measured, its bound, and words for it."""

    name: str
    passed: bool
    measured: float
    bound: float
    unit: str
    where: str


def check_temporal(release: Release) -> Iterator[Finding]:
    """Every finding on the temporal model of a release that has one. Raises MagtilesError."""
    record = release.manifest.temporal
    assert record is not None
    variables = release.temporal.variables
    yield _contract(release.path / record.path, str(record.contract))
    same = array_digest(variables) == record.array_digest
    yield _count("temporal arrays", 0 if same else 1, "files", "differ from the manifest's digest")
    if "sigma" in variables:
        yield _bounds(variables)
    if "baseline" in variables:
        yield _midnight(variables)
    yield _dip_latitude(release)


def _contract(path: Path, contract: str) -> Finding:
    try:
        check_artifact(path, contract, role="temporal")
    except MagtilesError as problem:
        return _count("temporal contract", 1, "files", str(problem))
    return _count("temporal contract", 0, "files", f"keeps {contract}")


def _bounds(variables: Arrays) -> Finding:
    """Estimates that are not positive, or not between their bounds."""
    wrong = 0
    for name in ("sigma", "tau", "class_sigma", "class_tau"):
        middle = variables[name]
        known = ~np.isnan(middle)
        # tau may be 0: a segment of white noise.
        least = middle > 0 if name.endswith("sigma") else middle >= 0
        wrong += int(np.count_nonzero(known & ~least))
        if f"{name}_low" in variables:
            low, high = (variables[f"{name}_{end}"] for end in ("low", "high"))
            wrong += int(np.count_nonzero(known & ((low > middle) | (high < middle))))
    where = "of sigma and tau that are not positive, or outside their own bounds"
    return _count("temporal bounds", wrong, "values", where)


def _midnight(variables: Arrays) -> Finding:
    """Largest mean of a curve within an hour of local midnight, over what is allowed."""
    minute = variables["minute"]
    near = (minute <= _MIDNIGHT_MIN) | (minute >= 1440.0 - _MIDNIGHT_MIN)
    level, error = (
        np.nan_to_num(_mean(variables[name][..., near]))
        for name in ("baseline", "baseline_standard_error")
    )
    ratio = np.abs(level) / (MIDNIGHT_NT + 3.0 * error)
    worst = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
    code = variables["iaga_code"][worst[0]]
    return Finding(
        "temporal midnight", bool(ratio[worst] <= 1.0), float(ratio[worst]), 1.0, "of bound",
        f"{code} {variables['element'][worst[1]]}: {level[worst]:.2g} nT around local midnight",
    )  # fmt: skip


def _mean(values: NDArray[Any]) -> NDArray[np.float64]:
    """Mean along the last axis of what is there; NaN where nothing is."""
    there = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        mean: NDArray[np.float64] = np.where(there, values, 0.0).sum(-1) / there.sum(-1)
    return mean


def _dip_latitude(release: Release) -> Finding:
    """Largest difference of dip latitudes from those of the release's own core field."""
    model = release.temporal
    variables = release.temporal.variables
    middle = model.months[model.months.size // 2] if model.months.size else None
    if middle is None:
        start = variables["segment_start"]
        middle = start[start.size // 2].astype("datetime64[s]")
    date = decimal_year(np.datetime64(middle, "us"))
    field = evaluate(
        core_field(release.manifest, release.file),
        variables["latitude"], variables["longitude"], variables["elevation"], date,
        allow_extrapolated=True,
    )  # fmt: skip
    dip = np.degrees(np.arctan2(field[:, 2], 2.0 * np.hypot(field[:, 0], field[:, 1])))
    off = np.abs(dip - variables["dip_latitude"])
    worst = int(np.argmax(off))
    return Finding(
        "temporal dip latitude", bool(off[worst] <= DIP_LATITUDE_DEG), float(off[worst]),
        DIP_LATITUDE_DEG, "degrees",
        f"{variables['iaga_code'][worst]}, from the release's core field",
    )  # fmt: skip


def _count(name: str, found: int, unit: str, where: str) -> Finding:
    return Finding(name, found == 0, float(found), 0.0, unit, where)
