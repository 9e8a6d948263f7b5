"""A PX4 ULog file as a raw log: gauss, boot clock, body axes forward, right, down (PX4's own)."""

from __future__ import annotations

import contextlib
import io
import logging
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pyulog import ULog
from pyulog.exceptions import ULogException

from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages.ingest.log.boot_clock import BootClock, fit_boot_clock
from magtiles.stages.ingest.log.messages import turned
from magtiles.stages.ingest.log.raw import FieldSamples, RawLog, Speeds, rising
from magtiles.stages.ingest.log.source import IngestLogParams, rotation
from magtiles.stages.vehicle.positions import Attitudes, Fixes, Real, Times, interpolated

_LOG = logging.getLogger(__name__)

_HEADER_BYTES = 16
_NO_OFFSET = 2**31 - 1  # sensor_combined: no magnetometer sample belongs to this row
_FIRST_UTC_US = 1_000_000_000_000_000  # 2001: receivers without an almanac say less
_BODY = ("magnetometer_ga[0]", "magnetometer_ga[1]", "magnetometer_ga[2]")
_MAGNETOMETERS: Mapping[str, tuple[str, str, str]] = {
    "sensor_mag": ("x", "y", "z"),
    "vehicle_magnetometer": _BODY,
    "sensor_combined": _BODY,
}
"""Topics that hold a field, in gauss, and its components."""
_RECEIVERS = ("vehicle_gps_position", "sensor_gps")
"""The first is what PX4 itself navigated by."""
_ATTITUDE = "vehicle_attitude"
_STATUS = np.array([-1, -1, 0, 0, 2, 2, 2, -1, -1], dtype=np.int8)
"""By `fix_type`: none twice, 2-D, 3-D, differential, RTK float and fixed, unused, extrapolated."""


class _Columns(dict[str, NDArray[Any]]):
    """Columns of a topic; one that it lacks is a FormatError that names both."""

    def __init__(self, columns: Mapping[str, NDArray[Any]], where: str) -> None:
        super().__init__(columns)
        self._where = where

    def __missing__(self, name: str) -> NDArray[Any]:
        raise FormatError(
            f"messages have no field '{name}'",
            where=self._where,
            expected=f"it among {', '.join(self)}",
            remedy="it is another topic under a known name",
        )


@dataclass(frozen=True)
class Dataset:
    """One instance of a logged topic: its columns, with `timestamp` in microseconds since boot."""

    topic: str
    columns: Mapping[str, NDArray[Any]]


def read_ulog(path: Path, params: IngestLogParams) -> RawLog:
    """The streams of a PX4 log that `params` choose, or that alone can be meant.

    Raises
    ------
    FormatError : the file is no ULog that can be read.
    SourceError : no magnetometer, or several could be meant; it lists what there is.
    """
    wanted = [*_MAGNETOMETERS, *_RECEIVERS, _ATTITUDE]
    sets = read_datasets(path, wanted)
    magnetic = [d for d in sets if _components(d) is not None]
    field = _choose(magnetic, "magnetometer_topic", params, path)
    if field is None:
        everything = ", ".join(d.topic for d in read_datasets(path, None)) or "none"
        raise SourceError(
            "no topic is a magnetometer's",
            where=path,
            expected=f"sensor_mag or vehicle_magnetometer; the log has {everything}",
        )
    receiver = _receiver(sets, params, path)
    clock = None if receiver is None else _clock(receiver)
    attitude = _choose([d for d in sets if _name(d) == _ATTITUDE], "attitude_topic", params, path)
    rate = next((d for d in sets if _name(d) == "sensor_combined"), None)
    heights = None if receiver is None else _heights(receiver, params)
    return RawLog(
        _field(field, clock),
        fixes=None if receiver is None or heights is None else _fixes(receiver, heights[0], clock),
        attitudes=None if attitude is None else _attitudes(attitude, rate, clock, params),
        speeds=None if receiver is None else _speeds(receiver, clock),
        clock="boot" if clock is None else "utc",
        height_reference=None if heights is None else heights[1],
        attrs=_notes(receiver, attitude, clock),
    )


def read_datasets(path: Path, names: Sequence[str] | None) -> list[Dataset]:
    """The logged topics of `names`, or all. Instances are named ``topic/0``, ``topic/1``, ...

    What could be read of a damaged or truncated log is kept, with a warning. Raises FormatError
    where nothing could.
    """
    said = io.StringIO()
    try:
        with path.open("rb") as file, contextlib.redirect_stdout(said):
            log = ULog(file, None if names is None else list(names))
    except (ULogException, LookupError, OSError, struct.error, TypeError, ValueError) as caught:
        raise FormatError(
            f"cannot be read as ULog ({type(caught).__name__}: {caught})",
            where=path,
            remedy="the file is damaged: copy it again",
        ) from None
    _warn_damaged(path, log)
    repeated = {d.name for d in log.data_list if d.multi_id > 0}
    sets = []
    for data in log.data_list:
        topic = f"{data.name}/{data.multi_id}" if data.name in repeated else data.name
        if len(data.data.get("timestamp", ())):
            sets.append(Dataset(topic, _Columns(data.data, f"{path} topic {topic}")))
    return sets


def _warn_damaged(path: Path, log: ULog) -> None:
    until = (log.last_timestamp - log.start_timestamp) * 1e-6
    if log.file_corruption:
        _LOG.warning("%s: damaged; kept what could be read, %.1f s in all", path, until)
    elif not log.has_data_appended:
        data = np.fromfile(path, dtype=np.uint8)
        end = int(_last_whole(data))
        if end < data.size:
            _LOG.warning("%s: truncated after byte %d; kept %.1f s", path, end, until)
    if log.dropouts:
        lost = sum(d.duration for d in log.dropouts)
        _LOG.info("%s: %d dropouts, %d ms in all", path, len(log.dropouts), lost)


@njit(cache=True, nogil=True)
def _last_whole(data: NDArray[np.uint8]) -> int:
    """Where the last whole message ends: each is a size u2, a type u1 and `size` bytes."""
    at = _HEADER_BYTES
    while at + 3 <= data.size:
        size = np.int64(data[at]) | np.int64(data[at + 1]) << 8
        if at + 3 + size > data.size:
            break
        at += 3 + int(size)
    return at


def _name(dataset: Dataset) -> str:
    return dataset.topic.partition("/")[0]


def _components(dataset: Dataset) -> tuple[str, str, str] | None:
    """Columns of the field, where the topic has them."""
    names = _MAGNETOMETERS.get(_name(dataset))
    return names if names is not None and names[0] in dataset.columns else None


def _choose(sets: list[Dataset], key: str, params: IngestLogParams, path: Path) -> Dataset | None:
    """The one that is named or that alone can be meant. Raises SourceError that asks which."""
    named = getattr(params, key)
    names = ", ".join(d.topic for d in sets) or "none"
    if named is not None:
        for dataset in sets:
            if dataset.topic == named:
                return dataset
        raise SourceError(
            f"no topic '{named}' of that kind", where=path, expected=f"one of: {names}"
        )
    if len(sets) > 1:
        raise SourceError(
            f"{len(sets)} topics could be meant: {names}",
            where=path,
            remedy=f"say which with '{key}'",
        )
    return sets[0] if sets else None


def _receiver(sets: list[Dataset], params: IngestLogParams, path: Path) -> Dataset | None:
    every = [d for d in sets if _name(d) in _RECEIVERS]
    own = [d for d in every if _name(d) == _RECEIVERS[0]]
    candidates = every if params.fix_topic is not None else own or every
    return _choose(candidates, "fix_topic", params, path)


def _clock(receiver: Dataset) -> BootClock | None:
    """What UTC the boot clock showed, by the receiver's fixes; None where none had UTC."""
    columns = receiver.columns
    boot = columns["timestamp"].astype(np.int64)
    if "timestamp_time_relative" in columns:
        boot = boot + columns["timestamp_time_relative"]
    utc = columns["time_utc_usec"]
    good = (columns["fix_type"] >= 3) & (utc > _FIRST_UTC_US)
    if not good.any():
        return None
    clock = fit_boot_clock(boot[good], utc[good])
    _LOG.info(
        "%s: UTC from %d fixes to %.1f ms (1 sigma), drift %.1f ppm",
        receiver.topic, clock.fixes, 1e3 * clock.residual_s, 1e6 * clock.drift,
    )  # fmt: skip
    return clock


def _times(boot_us: NDArray[Any], clock: BootClock | None) -> Times:
    if clock is not None:
        return clock.utc(boot_us)
    return np.asarray((boot_us.astype(np.int64) * 1000).astype("datetime64[ns]"))


def _field(dataset: Dataset, clock: BootClock | None) -> FieldSamples:
    columns = dataset.columns
    boot = columns["timestamp"].astype(np.int64)
    rows = np.arange(boot.size)
    if "timestamp_sample" in columns and columns["timestamp_sample"].all():
        boot = columns["timestamp_sample"].astype(np.int64)
    elif "magnetometer_timestamp_relative" in columns:
        ahead = columns["magnetometer_timestamp_relative"].astype(np.int64)
        boot, rows = boot + ahead, rows[ahead != _NO_OFFSET]
        # The faster gyroscope's rows repeat the field until there is a new one.
        rows = rows[np.concatenate([[True], np.diff(boot[rows]) != 0])] if rows.size else rows
    names = _components(dataset)
    assert names is not None
    values = np.stack([columns[name][rows] for name in names], axis=1).astype(np.float64)
    return FieldSamples(_times(boot[rows], clock), values, "gauss", dataset.topic)


def _heights(receiver: Dataset, params: IngestLogParams) -> tuple[Real, str]:
    """Heights and what they count from: the ellipsoid where the receiver and the TOML allow."""
    columns = receiver.columns
    if "altitude_msl_m" in columns:
        sea, ellipsoid = columns["altitude_msl_m"], columns["altitude_ellipsoid_m"]
    else:
        sea = columns["alt"] * 1e-3
        ellipsoid = columns.get("alt_ellipsoid", np.zeros(sea.size)) * 1e-3
    if params.height_reference == "mean_sea_level" or not ellipsoid.any():
        return sea.astype(np.float64), "mean_sea_level"
    return ellipsoid.astype(np.float64), "ellipsoid"


def _fixes(receiver: Dataset, height: Real, clock: BootClock | None) -> Fixes:
    columns = receiver.columns
    time = _times(columns["timestamp"], clock)
    order = rising(time)
    kind = np.clip(np.nan_to_num(columns["fix_type"]).astype(np.int64), 0, _STATUS.size - 1)
    if "latitude_deg" in columns:
        latitude, longitude = columns["latitude_deg"], columns["longitude_deg"]
    else:
        latitude, longitude = columns["lat"] * 1e-7, columns["lon"] * 1e-7
    level = np.where(kind == 2, np.nan, height)  # a 2-D fix has an assumed height
    return Fixes(
        time[order],
        latitude[order].astype(np.float64),
        longitude[order].astype(np.float64),
        level[order],
        _STATUS[kind][order],
        columns["eph"][order].astype(np.float64),
        columns["epv"][order].astype(np.float64),
    )


def _attitudes(
    dataset: Dataset, rate: Dataset | None, clock: BootClock | None, params: IngestLogParams
) -> Attitudes:
    columns = dataset.columns
    time = _times(columns["timestamp"], clock)
    order = rising(time)
    quaternion = np.stack([columns[f"q[{i}]"][order] for i in range(4)], axis=1).astype(np.float64)
    known = np.isfinite(quaternion).all(axis=1) & (np.linalg.norm(quaternion, axis=1) > 0.5)
    quaternion[~known] = np.nan
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)  # stored in single precision
    turns = np.full((order.size, 3), np.nan)
    if rate is not None:
        at = _times(rate.columns["timestamp"], clock)
        first = rising(at)
        for axis in range(3):
            spins = rate.columns[f"gyro_rad[{axis}]"][first].astype(np.float64)
            turns[:, axis] = interpolated(time[order], at[first], spins, max_gap_s=params.max_gap_s)
    to_body = rotation(params.imu_to_body)
    if to_body is not None:
        quaternion[known] = turned(quaternion[known], np.eye(3), to_body)
        turns = turns @ to_body.T
    return Attitudes(time[order], quaternion, turns)


def _speeds(receiver: Dataset, clock: BootClock | None) -> Speeds:
    time = _times(receiver.columns["timestamp"], clock)
    order = rising(time)
    return Speeds(time[order], receiver.columns["vel_m_s"][order].astype(np.float64))


def _notes(
    receiver: Dataset | None, attitude: Dataset | None, clock: BootClock | None
) -> dict[str, Any]:
    notes: dict[str, Any] = {}
    if receiver is not None:
        notes["fix_topic"] = receiver.topic
    if attitude is not None:
        notes["attitude_topic"] = attitude.topic
    if clock is not None:
        notes |= {
            "clock_drift": clock.drift,
            "clock_residual_s": clock.residual_s,
            "clock_fixes": clock.fixes,
        }
    return notes
