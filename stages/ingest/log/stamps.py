"""Times of messages: their own stamps before those of their recording, and what clock they show."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError

CREDIBLE = np.datetime64("1980-01-06", "ns")
"""GPS time begins; a clock before it shows no date."""

_NS_PER = {"day": 86400 * 10**9, "h": 3600 * 10**9, "min": 60 * 10**9}
_NS_PER |= {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}


def stamps(
    columns: Mapping[str, NDArray[Any]], paths: tuple[str, ...], unit: str, where: str
) -> NDArray[np.int64]:
    """Nanoseconds since 1970 from seconds and nanoseconds, or from the one column of `paths`."""
    values = [columns[path] for path in paths]
    if len(values) == 2:
        for value in values:
            if value.dtype.kind not in "iuf" or not np.isfinite(value).all():
                raise FormatError("a stamp is not a number", where=where)
        seconds, nanoseconds = (value.astype(np.int64) for value in values)
        return np.asarray(seconds * 10**9 + nanoseconds, dtype=np.int64)
    return instants(values[0], unit, where)


def instants(values: NDArray[Any], unit: str, where: str) -> NDArray[np.int64]:
    """Nanoseconds since 1970 from numbers of `unit` or ISO text (UTC where it names no zone).

    Raises FormatError naming the first value that is no time.
    """
    if values.dtype.kind == "U":
        return np.array([_iso(str(value), where) for value in values], dtype=np.int64)
    if values.dtype.kind not in "iuf":
        raise FormatError(f"times are {values.dtype}", where=where, expected="numbers or text")
    scale = _NS_PER[unit]
    if values.dtype.kind in "iu":
        return np.asarray(values.astype(np.int64) * scale, dtype=np.int64)
    if not np.isfinite(values).all():
        raise FormatError(f"row {int(np.argmin(np.isfinite(values)))} has no time", where=where)
    whole = np.floor(values)  # split, since nanoseconds of today do not fit a float
    rest = np.round((values - whole) * scale).astype(np.int64)
    return np.asarray(whole.astype(np.int64) * scale + rest, dtype=np.int64)


def _iso(text: str, where: str) -> int:
    try:
        when = datetime.datetime.fromisoformat(text)
    except ValueError:
        raise FormatError(f"'{text[:40]}' is no time", where=where, expected="ISO 8601") from None
    if when.tzinfo is not None:
        when = when.astimezone(datetime.UTC).replace(tzinfo=None)
    return int(np.datetime64(when, "ns").astype(np.int64))
