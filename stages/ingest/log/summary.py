"""What a log holds, topic by topic, without making a track of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from mcap.records import Channel, Schema

from magtiles.schemas.errors import FormatError, MagtilesError
from magtiles.stages.ingest.log.bindings import Role, binding_of, role_of
from magtiles.stages.ingest.log.decoders import decoder, ros_layout
from magtiles.stages.ingest.log.mcap_file import McapFile
from magtiles.stages.ingest.log.rosmsg import FILLER, PRIMITIVES
from magtiles.stages.ingest.log.sniff import log_format
from magtiles.stages.ingest.log.ulog import read_datasets

_SHOWN = 3
"""So many numbers of a message whose meaning is not known."""
_UNITS: Mapping[Role, Mapping[str, str]] = {
    "magnetometer": {},
    "fix": {"latitude": "deg", "longitude": "deg", "height": "m"},
    "attitude": {f"q{axis}": "1" for axis in "wxyz"} | {f"rate_{axis}": "rad/s" for axis in "xyz"},
    "speed": dict.fromkeys("xyz", "m/s"),
}
_ULOG_UNITS = {
    "sensor_mag": dict.fromkeys("xyz", "gauss"),
    "vehicle_magnetometer": {f"magnetometer_ga[{axis}]": "gauss" for axis in range(3)},
    "sensor_combined": {f"magnetometer_ga[{axis}]": "gauss" for axis in range(3)},
    "vehicle_gps_position": {"lat": "1e-7 deg", "lon": "1e-7 deg", "alt": "mm"},
    "sensor_gps": {"lat": "1e-7 deg", "lon": "1e-7 deg", "alt": "mm"},
    "vehicle_attitude": {f"q[{part}]": "1" for part in range(4)},
}


@dataclass(frozen=True)
class Value:
    """A number of a topic's first message, with its unit where the format says."""

    name: str
    value: float
    unit: str | None


@dataclass(frozen=True)
class TopicSummary:
    """A topic: what it is, how often and when it was recorded, and its first values.

    `start` and `end` are times of recording: ISO text, or seconds since boot. `problem` says why
    a type that has a role cannot be read.
    """

    topic: str
    schema: str
    encoding: str
    role: str | None
    messages: int
    rate_hz: float | None
    start: str | float | None
    end: str | float | None
    first: tuple[Value, ...] = ()
    problem: str | None = None


@dataclass(frozen=True)
class LogSummary:
    """A log: its format, whether it is whole, and its topics by name."""

    format: str
    clock: str
    truncated_at_byte: int | None
    topics: tuple[TopicSummary, ...]


def summarize_log(path: Path) -> LogSummary:
    """Read a log through, CRCs and all, and say what it holds. Raises FormatError."""
    kind = log_format(path)
    if kind not in _SUMMARIES:
        raise FormatError(
            f"is a table ({kind}), without topics",
            where=path,
            expected="MCAP or ULog",
            remedy="list its datasets with ncdump or h5dump"
            if kind == "hdf5"
            else "look at it with a text editor, and name its columns in a source TOML",
        )
    return _SUMMARIES[kind](path)


@dataclass
class _Seen:
    """What passed by of a channel."""

    messages: int = 0
    start: int = 0
    end: int = 0
    first: bytes = field(default=b"", repr=False)


def _summarize_mcap(path: Path) -> LogSummary:
    file = McapFile(path)
    seen: dict[int, _Seen] = {}
    for batch in file.batches():
        for number in map(int, np.unique(batch.channel)):
            rows = np.flatnonzero(batch.channel == number)
            times = batch.log_time[rows]
            one = seen.get(number)
            if one is None:
                begin, end = batch.start[rows[0]], batch.stop[rows[0]]
                first = batch.data[begin:end].tobytes()
                one = seen[number] = _Seen(0, int(times[0]), int(times[0]), first)
            one.messages += rows.size
            one.start = min(one.start, int(times.min()))
            one.end = max(one.end, int(times.max()))
    topics = [
        _mcap_topic(channel, file.schemas.get(channel.schema_id), seen.get(number), path)
        for number, channel in file.channels.items()
    ]
    ordered = tuple(sorted(topics, key=lambda topic: topic.topic))
    return LogSummary("mcap", "recording", file.truncated, ordered)


def _mcap_topic(
    channel: Channel, schema: Schema | None, seen: _Seen | None, path: Path
) -> TopicSummary:
    name = "" if schema is None else schema.name
    role = role_of(name)
    found: tuple[Value, ...] = ()
    problem = None
    if seen is not None:
        try:
            found = _first_values(channel, schema, role, seen.first, str(path))
        except MagtilesError as caught:
            if role is not None:
                problem = str(caught).removeprefix(f"{caught.where}: ")
    return TopicSummary(
        channel.topic,
        name,
        channel.message_encoding,
        role,
        0 if seen is None else seen.messages,
        None if seen is None else _rate(seen.messages, (seen.end - seen.start) * 1e-9),
        None if seen is None else str(np.datetime64(seen.start, "ns")),
        None if seen is None else str(np.datetime64(seen.end, "ns")),
        found,
        problem,
    )


def _first_values(
    channel: Channel, schema: Schema | None, role: Role | None, message: bytes, where: str
) -> tuple[Value, ...]:
    units: dict[str, str | None]
    if role is not None and schema is not None:
        binding = binding_of(schema.name, channel.message_encoding, role, None, where=where)
        known = dict.fromkeys("xyz", binding.unit) if role == "magnetometer" else _UNITS[role]
        units = {path: known[n] for n, path in binding.columns.items() if n in known}
    elif schema is not None and channel.message_encoding == "cdr":
        leaves = ros_layout(schema, where)
        numbers = [leaf.path for leaf in leaves if leaf.type in PRIMITIVES and leaf.count == 1]
        told = [n for n in numbers if not n.startswith(("header.", FILLER))]
        units = dict.fromkeys(told[:_SHOWN])
    else:
        return ()
    decode = decoder(channel, schema, list(units), where)
    data = np.frombuffer(message, dtype=np.uint8)
    columns = decode(data, np.array([0]), np.array([data.size]))
    return tuple(Value(path, float(columns[path][0]), unit) for path, unit in units.items())


def _summarize_ulog(path: Path) -> LogSummary:
    topics = []
    for dataset in read_datasets(path, None):
        boot = dataset.columns["timestamp"].astype(np.int64) * 1e-6
        name = dataset.topic.partition("/")[0]
        units: Mapping[str, str | None] = _ULOG_UNITS.get(name) or dict.fromkeys(
            [n for n in dataset.columns if not n.startswith("timestamp")][:_SHOWN]
        )
        first = tuple(
            Value(column, float(dataset.columns[column][0]), unit)
            for column, unit in units.items()
            if column in dataset.columns
        )
        rate = _rate(boot.size, float(boot[-1] - boot[0]))
        role = _ULOG_ROLES.get(name) if name in _ULOG_UNITS and first else None
        topics.append(
            TopicSummary(
                dataset.topic, name, "ulog", role, boot.size, rate,
                float(boot[0]), float(boot[-1]), first,
            )
        )  # fmt: skip
    return LogSummary("ulog", "boot", None, tuple(topics))


_ULOG_ROLES: Mapping[str, Role] = {
    "sensor_mag": "magnetometer",
    "vehicle_magnetometer": "magnetometer",
    "sensor_combined": "magnetometer",
    "vehicle_gps_position": "fix",
    "sensor_gps": "fix",
    "vehicle_attitude": "attitude",
}


def _rate(messages: int, span_s: float) -> float | None:
    return (messages - 1) / span_s if span_s > 0 else None


_SUMMARIES: dict[str, Callable[[Path], LogSummary]] = {
    "mcap": _summarize_mcap,
    "ulog": _summarize_ulog,
}


def shown(values: tuple[Value, ...]) -> str:
    """First values as one line of text, without the part of their names that all share."""
    units = {value.unit for value in values}
    common = len(units) == 1
    parents = {value.name.rpartition(".")[0] for value in values}
    start = len(parents.pop()) + 1 if len(parents) == 1 and "" not in parents else 0
    parts = [
        f"{value.name[start:]} {value.value:.9g}"
        + ("" if common or value.unit in (None, "1") else f" {value.unit}")
        for value in values
    ]
    unit = next(iter(units)) if common else None
    return ", ".join(parts) + (f" {unit}" if unit not in (None, "1") else "")
