"""Records with a known daily curve, indices, and a small reading of real ones."""

from __future__ import annotations

import gzip
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.signal import lfilter

from magtiles.catalog.flags import RecordFlag, flag_attributes
from magtiles.catalog.kernels.local_time import solar_minute

Floats = NDArray[np.float64]
Times = NDArray[np.datetime64]
NAMES = ("field_north", "field_east", "field_down", "field_total")

MEAN_FIELD = np.array([21_000.0, 3_000.0, 47_000.0])


def times(start: str, end: str, cadence_s: float = 60.0) -> Times:
    """Centres of means: of hours, half past."""
    half = np.timedelta64(round(cadence_s / 2), "s") if cadence_s >= 3600.0 else 0
    step = np.timedelta64(round(cadence_s * 1e3), "ms")
    return np.arange(np.datetime64(start, "ns"), np.datetime64(end, "ns"), step) + half


def record(
    time: Times,
    vector: Floats,
    *,
    total: Floats | None = None,
    longitude: float = -105.237,
    latitude: float = 40.137,
    code: str = "BOU",
    cadence_s: float = 60.0,
    flag: NDArray[np.uint8] | None = None,
) -> xr.Dataset:
    """observatory-series/1 of north, east, down (3, time), nT."""
    total = np.linalg.norm(vector, axis=0) if total is None else total
    values = dict(zip(NAMES, [*vector, total], strict=True))
    units = {"units": "nT"}
    flags = np.zeros(time.size, np.uint8) if flag is None else flag
    return xr.Dataset(
        {k: ("time", v, units) for k, v in values.items()}
        | {"quality_flag": ("time", flags, flag_attributes(RecordFlag))},
        coords={"time": time},
        attrs={
            "iaga_code": code, "latitude": latitude, "longitude": longitude, "elevation": 1682.0,
            "cadence_s": cadence_s, "data_type": "definitive", "reported_elements": "XYZF",
            "source": f"{code} of tests",
        },
    )  # fmt: skip


_COS = np.array([[-12.0, 9.0, -4.0], [5.0, -8.0, 6.0], [8.0, -6.0, 2.0]])
_SIN = np.array([[3.0, 1.0, 0.5], [10.0, -7.0, 3.0], [2.0, 1.0, -1.0]])
_WAVE = 2 * np.pi * np.arange(1, 4) / 1440.0


def quiet_curve(minute: Floats) -> Floats:
    """A day of north, east, down (3, n), nT: three waves, from the level of its midnight.

    That level is the mean over an hour to either side, of each cosine sin(w T) / (w T).
    """
    phase = _WAVE[:, None] * minute
    level = _COS @ (np.sin(60.0 * _WAVE) / (60.0 * _WAVE))
    return np.asarray(_COS @ np.cos(phase) + _SIN @ np.sin(phase) - level[:, None])


def gauss_markov(rng: np.random.Generator, n: int, dt: float, sigma: float, tau: float) -> Floats:
    """Exact samples of a first-order Gauss-Markov process."""
    phi = np.exp(-dt / tau)
    drive = rng.standard_normal(n) * sigma * np.sqrt(1 - phi**2)
    drive[0] = rng.standard_normal() * sigma
    return np.asarray(lfilter([1.0], [1.0, -phi], drive))


def quiet_list(ranks: Mapping[str, Sequence[int]]) -> xr.Dataset:
    """activity-index/1 of days, from month to the days of month in order of rank."""
    months = [np.datetime64(m, "M") for m in ranks]
    date = np.arange(min(months), max(months) + 1, dtype="datetime64[D]")
    rank = np.zeros(date.size, np.int8)
    for month, days in ranks.items():
        first = np.datetime64(month, "M").astype("datetime64[D]")
        for number, day in enumerate(days, start=1):
            rank[date == first + (day - 1)] = number
    return _index(date.astype("datetime64[ns]"), 86400.0, quiet_rank=("time", rank))


def kp_index(start: str, kp: Floats) -> xr.Dataset:
    """activity-index/1 of Kp (day, 8)."""
    time = times(start, str(np.datetime64(start, "D") + len(kp)), 10800.0 - 1)[:0]
    time = np.datetime64(start, "ns") + np.arange(kp.size) * np.timedelta64(3, "h")
    return _index(time, 10800.0, kp=("time", kp.ravel(), {"units": "1"}))


def _index(time: Times, cadence_s: float, **variables: Any) -> xr.Dataset:
    attrs = {"cadence_s": cadence_s, "source": "index of tests"}
    return xr.Dataset(variables, coords={"time": time}, attrs=attrs)


def listed(real_data: Path) -> dict[str, list[int]]:
    """Month to its ten quietest days, from the lists of GFZ that cover 2000 to 2019."""
    months = {}
    for name in ("qd200009.txt", "qd201019.txt"):
        for line in (real_data / "indices/gfz_quiet_days" / name).read_text("latin-1").splitlines():
            words = line.split()
            if len(words) >= 17 and words[1].isdigit():
                month = f"{int(words[1])}-{_MONTHS.index(words[0]) + 1:02d}"
                months[month] = [int(w.rstrip("AK*")) for w in words[2:12]]
    return months


_MONTHS = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")


def wdc_hourly(real_data: Path, code: str, longitude: float, latitude: float) -> xr.Dataset:
    """A year of hourly means of an observatory that reports X, Y, Z (and F)."""
    folder = real_data / "observatory_wdc_hourly/2013"
    plain, packed = folder / f"{code}2013.wdc", folder / f"{code}2013.wdc.gz"
    text = (plain.read_bytes() if plain.exists() else gzip.decompress(packed.read_bytes())).decode()
    time = times("2013-01-01", "2014-01-01", 3600.0)
    values = dict.fromkeys("XYZF") | {k: np.full(time.size, np.nan) for k in "XYZF"}
    for line in text.splitlines():
        day = np.datetime64(f"2013-{line[5:7]}-{line[8:10]}") - np.datetime64("2013-01-01")
        at = int(day.astype(int)) * 24
        cells = np.array([float(line[20 + 4 * n : 24 + 4 * n]) for n in range(24)])
        value = np.where(cells == 9999.0, np.nan, cells + 100.0 * float(line[16:20]))
        values[line[7]][at : at + 24] = value
    vector = np.array([values[k] for k in "XYZ"])
    return record(
        time, vector, total=values["F"], longitude=longitude, latitude=latitude,
        code=code.upper(), cadence_s=3600.0,
    )  # fmt: skip


def iaga_minutes(path: Path) -> tuple[Times, Floats]:
    """Times and the four columns (4, time) of an IAGA-2002 file of one month."""
    lines = path.read_text().splitlines()
    rows = [line.split() for line in lines if line[:2] == "20"]
    time = np.array([f"{row[0]}T{row[1]}" for row in rows], "datetime64[ns]")
    values = np.array([[float(word) for word in row[3:7]] for row in rows]).T
    return time, np.where(values >= 88888.0, np.nan, values)


def daily(time: Times, longitude: float) -> Floats:
    """`quiet_curve` at instants (3, n)."""
    return quiet_curve(solar_minute(time, longitude))
