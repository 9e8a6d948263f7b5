"""An observatory's record as baselines and statistics use it: four elements, unfit samples out."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.flags import UNFIT_RECORD
from magtiles.schemas.errors import ContractError

Real = NDArray[np.float64]

ELEMENTS = ("north", "east", "down", "total")
"""In the order of dimension `element` of a temporal model."""

TOTAL = ELEMENTS.index("total")


def fit_elements(series: xr.Dataset) -> Real:
    """North, east, down and total (element, time), nT; NaN where missing or unfit for use.

    Unfit is what `check-observatory` flagged as spiked, stuck or contradicting itself. A
    record without any total field gets the magnitude of its vector.
    """
    rows = [series[f"field_{name}"].values for name in ELEMENTS]
    values = np.array(rows, np.float64)
    if not np.isfinite(values[TOTAL]).any():
        values[TOTAL] = np.linalg.norm(values[:TOTAL], axis=0)
    values[:, (series["quality_flag"].values & int(UNFIT_RECORD)) != 0] = np.nan
    return values


def check_ascending(dataset: xr.Dataset) -> None:
    """Raise ContractError, naming the sample, where time stands still or goes backwards."""
    time = dataset["time"].values
    bad = np.flatnonzero(np.diff(time) <= np.timedelta64(0))
    if bad.size:
        at = int(bad[0]) + 1
        raise ContractError(
            f"{time[at]} does not come after {time[at - 1]}",
            where=f"{dataset.attrs.get('source', '')} time[{at}]".strip(),
            expected="times in ascending order, each once",
            remedy="ingest the files again: overlaps are resolved there",
        )
