"""IAGA-2002 files of given numbers, written plainly: what the reader is tested against."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

STATION = {
    "Format": "IAGA-2002",
    "Source of Data": "Nobody",
    "Station Name": "Boulder",
    "IAGA CODE": "BOU",
    "Geodetic Latitude": "40.137",
    "Geodetic Longitude": "254.764",
    "Elevation": "1682",
    "Reported": "XYZF",
    "Sensor Orientation": "XYZ",
    "Digital Sampling": "1 second",
    "Data Interval Type": "1-minute",
    "Data Type": "variation",
}

# What the core field is at Boulder in 2016, nT.
LEVEL = (20573.0, 3111.0, 48048.0, 52360.0)


def header(elements: str = "XYZF", comments: tuple[str, ...] = (), **changes: str) -> list[str]:
    """Lines of a header; `changes` by label, blanks for underscores, "" to leave one out."""
    said = STATION | {"Reported": elements}
    said |= {label.replace("_", " "): text for label, text in changes.items()}
    lines = [f" {label:<23}{text:<45}|" for label, text in said.items() if text]
    lines += [f" {'# ' + comment:<68}|" for comment in comments]
    names = "".join(f"{said['IAGA CODE'] + e:<10}" for e in elements)
    return [*lines, f"{'DATE       TIME         DOY     ' + names:<69}|"]


def rows(time: NDArray[np.datetime64], values: NDArray[np.float64]) -> list[str]:
    """Lines of values (elements, rows); NaN as 99999.00."""
    stamps = np.datetime_as_string(time, unit="ms")
    day = (time.astype("M8[D]") - time.astype("M8[Y]")).astype(int) + 1
    filled = np.where(np.isnan(values), 99999.0, values)
    return [
        f"{s[:10]} {s[11:]} {d:03d}   " + "".join(f" {v:9.2f}" for v in row)
        for s, d, row in zip(stamps.tolist(), day.tolist(), filled.T.tolist(), strict=True)
    ]


def write(path: Path, lines: list[str], end: str = "\n") -> Path:
    """A file of lines."""
    path.write_bytes((end.join(lines) + end).encode())
    return path


def minutes(start: str = "2016-01-01", count: int = 1440, step_s: int = 60) -> Any:
    """Times, ns."""
    begin = np.datetime64(start, "ns")
    return begin + np.arange(count) * np.timedelta64(step_s, "s")


def field(count: int = 1440, seed: int = 0) -> NDArray[np.float64]:
    """A quiet record (4, count) at Boulder, F that of the vector, rounded to 0.01 nT."""
    rng = np.random.default_rng(seed)
    vector = np.array(LEVEL[:3])[:, None] + 0.1 * rng.standard_normal((3, count)).cumsum(axis=1)
    vector = np.round(vector, 2)
    return np.vstack([vector, np.round(np.linalg.norm(vector, axis=0), 2)])
