"""Stage ``ingest-index``: files of geomagnetic indices become one activity-index/1."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError
from magtiles.stages.declare import FILES, Params, Stage
from magtiles.stages.ingest.index_days import is_day_list, read_day_list
from magtiles.stages.ingest.index_dst import is_dst_wdc, read_dst_wdc
from magtiles.stages.ingest.index_kp import (
    is_kp_csv,
    is_kp_days,
    is_kp_intervals,
    is_kp_wdc,
    read_kp_csv,
    read_kp_days,
    read_kp_intervals,
    read_kp_wdc,
)
from magtiles.stages.ingest.index_values import Values
from magtiles.stages.ingest.observatory.content import read_content
from magtiles.stages.ingest.source import SourceKind, locate_all

_LOG = logging.getLogger(__name__)

_READERS: dict[Callable[[str], bool], Callable[[str, str], list[Values]]] = {
    is_kp_csv: read_kp_csv,
    is_kp_intervals: read_kp_intervals,
    is_kp_days: read_kp_days,
    is_dst_wdc: read_dst_wdc,
    is_day_list: read_day_list,
    is_kp_wdc: read_kp_wdc,
}


class IngestIndexParams(Params):
    """The [index] keys of a source: none, since every format says all."""


ACTIVITY_INDEX = SourceKind("activity-index", "index", IngestIndexParams)

_ATTRIBUTES: dict[str, dict[str, Any]] = {
    "kp": {"units": "1", "long_name": "planetary index Kp, exact thirds"},
    "ap": {"units": "nT", "long_name": "equivalent amplitude ap, in units of 2 nT"},
    "dst": {"units": "nT", "long_name": "disturbance storm-time index"},
    "quiet_rank": {"long_name": "rank of the UTC day among the month's ten quietest, 0 none"},
    "disturbed_rank": {"long_name": "rank among the month's five most disturbed, 0 none"},
    "day_mark": {
        "long_name": "why a listed day is not really quiet or disturbed",
        "flag_values": np.arange(4, dtype=np.int8),
        "flag_meanings": "none not_quiet_ap_above_6 not_quiet_by_kp not_disturbed_ap_below_20",
    },
}
_RANKS = ("quiet_rank", "disturbed_rank", "day_mark")


def ingest_index(files: Sequence[Path], *, params: IngestIndexParams) -> xr.Dataset:
    """Kp, ap, Dst and ranks of days as one activity-index/1.

    A value holds for the interval that begins at its time: three hours, or one where Dst is among
    the files. Where two files differ, that named last stands, and the number of such values is in
    the attribute `overlaps_resolved`.

    Parameters
    ----------
    files : GFZ tables of Kp and ap, by interval or day; a CSV of Kp; the WDC formats of Kp and
        of Dst; GFZ lists of quiet and disturbed days; each plain or gzipped; or a source TOML.

    Raises
    ------
    FormatError : a file is missing, truncated, HTML, of another format, or gives a day twice.
    SourceError, IntegrityError : as of the source TOML.
    """
    paths, source = locate_all([Path(f) for f in files], ACTIVITY_INDEX)
    found = [values for path in paths for values in _read(path)]
    hours = 1 if any(values.name == "dst" for values in found) else 3
    begin = min(values.time[0] for values in found)
    end = max(values.time[-1] + np.timedelta64(values.hours, "h") for values in found)
    time = np.arange(begin, end, np.timedelta64(hours, "h"))
    data, resolved = {}, 0
    for name in _ATTRIBUTES:
        given = [values for values in found if values.name == name]
        if given:
            data[name], differing = _merged(given, time, hours)
            resolved += differing
    return xr.Dataset(
        {k: ("time", _typed(k, v), _ATTRIBUTES[k]) for k, v in data.items()},
        coords={"time": ("time", time.astype("datetime64[ns]"), {"standard_name": "time"})},
        attrs={
            "Conventions": "CF-1.11",
            "cadence_s": hours * 3600.0,
            "source": paths[0].name if source is None else source.source.id,
            "overlaps_resolved": resolved,
        },
    )


STAGE = Stage(
    name="ingest-index",
    version=1,
    params=IngestIndexParams,
    inputs={"files": FILES},
    output="activity-index/1",
    run=ingest_index,
)


def _read(path: Path) -> list[Values]:
    text = read_content(path).decode("utf-8", errors="replace")
    for knows, read in _READERS.items():
        if knows(text):
            return read(text, str(path))
    raise FormatError(
        f"is of an unknown format: it begins with '{text[:60].splitlines()[0]}'",
        where=f"{path} line 1",
        expected="a GFZ, WDC or CSV file of Kp, WDC Dst, or a GFZ list of quiet days",
    )


def _merged(
    given: list[Values], time: NDArray[np.datetime64], hours: int
) -> tuple[NDArray[np.float64], int]:
    """Values on the grid, NaN where unknown, and how many were given differently."""
    merged, resolved = np.full(time.size, np.nan), 0
    for values in given:
        at = ((values.time - time[0]) // np.timedelta64(hours, "h")).astype(np.int64)
        each = values.hours // hours
        at = (at[:, None] + np.arange(each)).ravel()
        new = np.repeat(values.values, each)
        old = merged[at]
        differs = np.isfinite(old) & np.isfinite(new) & (old != new)
        if differs.any():
            resolved += int(differs.sum())
            _LOG.warning(
                "%s: %d values of %s differ from another file's, the first at %s: these stand",
                values.where,
                int(differs.sum()),
                values.name,
                time[at[int(np.argmax(differs))]],
            )
        merged[at] = np.where(np.isnan(new), old, new)
    return merged, resolved


def _typed(name: str, values: NDArray[np.float64]) -> NDArray[Any]:
    return np.nan_to_num(values).astype(np.int8) if name in _RANKS else values
