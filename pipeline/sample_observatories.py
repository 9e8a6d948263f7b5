"""The sample's observatories, Kp and quiet days, in the formats of INTERMAGNET and GFZ."""

from __future__ import annotations

import gzip
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtiles.pipeline.synthetic_observatories import (
    Station,
    StationSpec,
    TemporalSample,
    truth_dataset,
)
from magtiles.stages.release.atomic import atomic_path

_MISSING = 99999.0
_GFZ_START = np.datetime64("1932-01-01")
_MONTHS = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")
_LICENCE = "CC0-1.0"


def write_observatories(folder: Path, name: str, sample: TemporalSample) -> list[Path]:
    """Write the records of all stations, the indices and their source TOMLs.

    Returns the source TOMLs ``<name>-<code>.toml`` of the stations, then that of the indices,
    ``<name>-indices.toml``, then the data files. The same sample gives the same bytes.
    """
    folder.mkdir(parents=True, exist_ok=True)
    tomls, data = [], []
    for number, spec in enumerate(sample.spec.stations):
        files = _write_records(folder, sample, sample.station(number))
        tomls.append(_write_toml(folder, f"{name}-{spec.code.lower()}", spec.name, files))
        data += files
    kp, days = folder / f"{name}-kp.txt", folder / f"{name}-quiet-days.txt"
    _write(kp, _kp_table(sample).encode())
    _write(days, _day_list(sample).encode())
    about = "Synthetic Kp, and the days it calls quiet and disturbed"
    indices = _write_toml(folder, f"{name}-indices", about, [kp, days], kind="activity-index")
    return [*tomls, indices, *data, kp, days]


def write_record(
    folder: Path, stem: str, spec: StationSpec, time: NDArray[np.datetime64], columns: Any
) -> list[Path]:
    """A station's record as ``<stem>.min.gz`` and its ``<stem>.toml``; columns as reported."""
    path = folder / f"{stem}.min.gz"
    text = _iaga_header(spec) + "".join(_iaga_rows(time, columns))
    _write(path, gzip.compress(text.encode("ascii"), mtime=0))
    return [_write_toml(folder, stem, spec.name, [path]), path]


def write_truth(path: Path, sample: TemporalSample) -> None:
    """Write what the records are made of: see `truth_dataset`."""
    dataset = truth_dataset(sample)
    encoding: dict[Any, Any] = {
        name: {"zlib": True, "complevel": 4} if variable.size > 1000 else {"_FillValue": None}
        for name, variable in dataset.variables.items()
    }
    with atomic_path(path) as temporary:
        dataset.to_netcdf(temporary, engine="netcdf4", format="NETCDF4", encoding=encoding)


def temporal_table(name: str, sample: TemporalSample) -> list[str]:
    """Lines of the product's [temporal] table."""
    stations = ", ".join(f'"{name}-{s.code.lower()}.toml"' for s in sample.spec.stations)
    months = ", ".join(f'"{month}"' for month in sample.spec.months)
    return [
        "",
        "[temporal]",
        f"observatories = [{stations}]",
        f"months = [{months}]",
        f'indices = ["{name}-indices.toml"]',
    ]


def _write_records(folder: Path, sample: TemporalSample, station: Station) -> list[Path]:
    """One gzipped IAGA-2002 file a month."""
    paths = []
    columns = _columns(station)
    for month in sample.months:
        inside = sample.time.astype("datetime64[M]") == month
        text = _iaga_header(station.spec) + "".join(
            _iaga_rows(sample.time[inside], columns[inside])
        )
        stamp = str(month).replace("-", "")
        paths.append(folder / f"{station.spec.code.lower()}{stamp}dmin.min.gz")
        _write(paths[-1], gzip.compress(text.encode("ascii"), mtime=0))
    return paths


def _columns(station: Station) -> NDArray[np.float64]:
    """Reported elements (minute, 4), nT, or arc minutes for D; 99999 where missing."""
    north, east, down = station.record.T
    total = np.sqrt(north**2 + east**2 + down**2)
    vector = {
        "XYZF": (north, east),
        "HDZF": (np.hypot(north, east), 60.0 * np.degrees(np.arctan2(east, north))),
    }[station.spec.reported]
    values = np.stack([*vector, down, total], axis=-1)
    return np.where(np.isnan(values), _MISSING, values)


def _iaga_header(spec: StationSpec) -> str:
    fields = {
        "Format": "IAGA-2002",
        "Source of Data": "magtiles, synthetic",
        "Station Name": spec.name,
        "IAGA CODE": spec.code,
        "Geodetic Latitude": f"{spec.latitude:.3f}",
        "Geodetic Longitude": f"{spec.longitude % 360.0:.3f}",
        "Elevation": f"{spec.elevation_m:g}",
        "Reported": spec.reported,
        "Sensor Orientation": spec.reported,
        "Digital Sampling": "1 second",
        "Data Interval Type": "filtered 1-minute (00:15-01:45)",
        "Data Type": "definitive",
    }
    lines = [f" {key:<23}{value:<45}|" for key, value in fields.items()]
    lines += [
        f" # {text:<66}|"
        for text in (
            "This record is synthetic: no instrument has measured it.",
            "It is in the public domain.",
        )
    ]
    heads = "".join(f"{spec.code + element:>10}" for element in spec.reported)
    lines.append(f"{'DATE       TIME         DOY  ' + heads:<69}|")
    return "\n".join(lines) + "\n"


def _iaga_rows(time: NDArray[np.datetime64], columns: NDArray[np.float64]) -> Iterator[str]:
    days = time.astype("datetime64[D]")
    of_year = (days - days.astype("datetime64[Y]")).astype(int) + 1
    stamps = np.datetime_as_string(time, unit="m").tolist()
    for stamp, doy, (a, b, c, d) in zip(stamps, of_year.tolist(), columns.tolist(), strict=True):
        date, clock = stamp.split("T")
        yield f"{date} {clock}:00.000 {doy:03d}    {a:9.2f} {b:9.2f} {c:9.2f} {d:9.2f}\n"


def _kp_table(sample: TemporalSample) -> str:
    """GFZ's table of three-hour intervals; ap, which nothing here asks for, is missing (-1)."""
    lines = [
        "# Synthetic Kp in the format of Kp_ap_since_1932.txt: no observatory has measured it.",
        "#YYY MM DD hh.h hh._m        days      days_m     Kp   ap D",
    ]
    for slot, kp in zip(sample.slots, sample.kp.tolist(), strict=True):
        stamp = str(slot)
        hour = float(stamp[11:13])
        days = (slot - _GFZ_START) / np.timedelta64(1, "D")
        lines.append(
            f"{stamp[:10].replace('-', ' ')} {hour:04.1f} {hour + 1.5:05.2f} {days:11.5f} "
            f"{days + 0.0625:11.5f} {kp:6.3f}   -1 1"
        )
    return "\n".join(lines) + "\n"


def _day_list(sample: TemporalSample) -> str:
    """GFZ's list of the ten quietest and five most disturbed days."""
    lines = [
        "                          Quietest Days                 Most Disturbed Days",
        "  Month",
        "            Q1  Q2  Q3  Q4  Q5    Q6  Q7  Q8  Q9  Q10   D1  D2  D3  D4  D5",
        "",
    ]
    for month in sample.months:
        quiet, disturbed = sample.ranked_days(month)
        year, number = str(month).split("-")
        groups = (quiet[:5], quiet[5:], disturbed)
        days = "  ".join("".join(f"{day:3d} " for day in group) for group in groups)
        lines.append(f" {_MONTHS[int(number) - 1]} {year}  {days}")
    return "\n".join(lines) + "\n"


def _write_toml(
    folder: Path, name: str, title: str, files: list[Path], kind: str = "observatory-series"
) -> Path:
    listed = ", ".join(f'"{file.name}"' for file in files)
    lines = [
        "[source]",
        f'id = "{name}"',
        f'kind = "{kind}"',
        f"files = [{listed}]",
        f'licence = "{_LICENCE}"',
        f'title = "{title}"',
    ]
    path = folder / f"{name}.toml"
    _write(path, ("\n".join(lines) + "\n").encode())
    return path


def _write(path: Path, content: bytes) -> None:
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)
