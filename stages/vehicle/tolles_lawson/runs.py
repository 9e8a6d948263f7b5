"""Runs: stretches of a track without a gap, evenly sampled, that can be filtered as they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.flags import TrackFlag
from magtiles.schemas.errors import ContractError

UNFIT = TrackFlag.FIELD_GAP | TrackFlag.FIELD_SPIKE | TrackFlag.CLOCK_STEP
"""Samples that carry one of these break a run."""

_GAP = 1.5  # steps
_JITTER = 0.2  # steps, rms: a filter takes samples as even


@dataclass(frozen=True)
class Run:
    """Rows of a track that follow each other every `step_s` seconds."""

    start: int
    stop: int
    step_s: float

    @property
    def rows(self) -> slice:
        """The rows, to index with."""
        return slice(self.start, self.stop)

    def __len__(self) -> int:
        return self.stop - self.start


def find_runs(track: xr.Dataset, usable: NDArray[np.bool_], shortest: int) -> list[Run]:
    """Runs of at least `shortest` samples that are `usable` (time,) and carry no flag of `UNFIT`.

    Raises ContractError where times are too uneven to be filtered.
    """
    if "quality_flag" in track:
        usable = usable & ((track["quality_flag"].values & np.uint16(UNFIT)) == 0)
    rows = np.flatnonzero(usable)
    if rows.size < 2:
        return []
    seconds = 1e-9 * np.diff(track["time"].values[rows]).astype(np.float64)
    adjacent = np.diff(rows) == 1
    step = float(np.median(seconds[adjacent])) if adjacent.any() else np.inf
    broken = ~adjacent | (seconds > _GAP * step) | (seconds <= 0.0)
    jitter = float(np.sqrt(np.mean((seconds[~broken] / step - 1.0) ** 2))) if step > 0 else np.inf
    if jitter > _JITTER:
        raise ContractError(
            f"samples are {step:g} s apart, give or take {jitter * step:.2g} s",
            where=f"{track.attrs.get('source')}: time",
            expected=f"even sampling, within {_JITTER:.0%} of a step",
            remedy="run align-log, or resample the log",
        )
    cuts = np.flatnonzero(broken) + 1
    parts = [part for part in np.split(rows, cuts) if part.size >= max(shortest, 2)]
    return [_run(track, part) for part in parts]


def _run(track: xr.Dataset, rows: NDArray[np.intp]) -> Run:
    first, last = int(rows[0]), int(rows[-1])
    span = 1e-9 * float(track["time"].values[last] - track["time"].values[first])
    return Run(first, last + 1, span / (rows.size - 1))
