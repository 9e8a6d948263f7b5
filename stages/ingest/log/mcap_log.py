"""An MCAP file as a raw log: topics found by schema, messages decoded in bulk, one pass."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError, MagtilesError, SourceError
from magtiles.stages.ingest.log.bindings import ROLES, Binding, Role, binding_of, role_of
from magtiles.stages.ingest.log.decoders import Decoder, decoder
from magtiles.stages.ingest.log.mcap_file import Batch, McapFile
from magtiles.stages.ingest.log.messages import BUILD, REDUCE
from magtiles.stages.ingest.log.raw import FieldSamples, RawLog
from magtiles.stages.ingest.log.source import IngestLogParams
from magtiles.stages.ingest.log.stamps import CREDIBLE, stamps

_LOG = logging.getLogger(__name__)

_NECESSARY: tuple[Role, ...] = ("magnetometer", "fix")
"""Roles that ask which, where several topics could play them."""


def read_mcap(path: Path, params: IngestLogParams) -> RawLog:
    """The streams of an MCAP file that `params` choose, or that alone can be meant.

    Raises
    ------
    FormatError : the file or a chosen topic's messages are damaged or not as their schema says.
    SourceError : no magnetometer, or several topics could be meant; it lists what there is.
    """
    file = McapFile(path)
    cast = _Cast(file, params)
    until = 0
    for batch in file.batches():
        cast.take(batch)
        until = max(until, int(batch.log_time.max(initial=0)))
    _warn_truncated(file, cast.messages, until)
    chosen = {role: cast.choose(role) for role in ROLES}
    built: dict[str, Any] = {}
    for role, topic in chosen.items():
        if topic is not None:
            columns = topic.columns()
            _check_stamps(columns, f"{path} topic {topic.name}")
            built[role] = BUILD[role](columns, topic.binding, params, topic.name)
    samples: FieldSamples = built["magnetometer"]
    _check_clock(samples.time, f"{path} topic {samples.topic}", params)
    fix = chosen["fix"]
    return RawLog(
        samples,
        fixes=built.get("fix"),
        attitudes=built.get("attitude"),
        speeds=built.get("speed"),
        clock="boot" if samples.time[0] < CREDIBLE else "utc",
        height_reference=None if fix is None else fix.binding.height_reference,
        attrs={
            f"{role}_topic": topic.name
            for role, topic in chosen.items()
            if topic is not None and role != "magnetometer"
        },
    )


@dataclass
class _Topic:
    """A topic that may play a role, and what its messages held so far."""

    name: str
    role: Role
    binding: Binding
    parts: dict[str, list[NDArray[Any]]] = field(default_factory=dict)
    failed: MagtilesError | None = None

    def add(self, columns: dict[str, NDArray[Any]]) -> None:
        for name, values in columns.items():
            self.parts.setdefault(name, []).append(values)

    def columns(self) -> dict[str, NDArray[Any]]:
        """All of it, in order of recording; the parts are given up as they are joined."""
        return {name: np.concatenate(self.parts.pop(name)) for name in list(self.parts)}


class _Cast:
    """Topics and the roles they may play. What is wrong with a topic matters once it is chosen."""

    def __init__(self, file: McapFile, params: IngestLogParams) -> None:
        self._file, self._params = file, params
        self._topics: dict[tuple[Role, str], _Topic] = {}
        self._decoders: dict[tuple[Role, int], Decoder] = {}
        self._counts: dict[int, int] = {}

    @property
    def messages(self) -> int:
        return sum(self._counts.values())

    def take(self, batch: Batch) -> None:
        ids = [int(number) for number in np.unique(batch.channel)]
        for number in ids:
            rows = np.flatnonzero(batch.channel == number) if len(ids) > 1 else slice(None)
            self._counts[number] = self._counts.get(number, 0) + batch.start[rows].size
            channel = self._file.channels.get(number)
            if channel is None:
                raise FormatError(
                    f"a message belongs to channel {number}, which is not defined before it",
                    where=batch.where,
                )
            for role in ROLES:
                if self._may_play(channel, role):
                    self._decode(channel, role, batch, rows)

    def _may_play(self, channel: Channel, role: Role) -> bool:
        named = getattr(self._params, f"{role}_topic")
        if named is not None:
            return bool(channel.topic == named)
        schema = self._file.schemas.get(channel.schema_id)
        return schema is not None and role_of(schema.name) == role

    def _decode(
        self, channel: Channel, role: Role, batch: Batch, rows: NDArray[np.intp] | slice
    ) -> None:
        where = f"{self._file.path} topic {channel.topic}"
        topic = self._topics.get((role, channel.topic))
        try:
            if topic is None:
                topic = _Topic(channel.topic, role, self._binding(channel, role, where))
                self._topics[role, channel.topic] = topic
            if topic.failed is not None:
                return
            decode = self._decoder(channel, topic, where)
            columns = decode(batch.data, batch.start[rows], batch.stop[rows])
            quantities = {n: columns[p] for n, p in topic.binding.columns.items()}
            _check_quantities(quantities, topic.binding, where)
            with np.errstate(over="ignore", invalid="ignore"):  # damaged values are told later
                reduced = REDUCE[role](quantities)
            topic.add(reduced | self._times(topic, columns, batch.log_time[rows], where))
        except MagtilesError as caught:
            if topic is None:
                topic = _Topic(channel.topic, role, Binding({}))
                self._topics[role, channel.topic] = topic
            place = str(caught.where).removeprefix(where)
            topic.failed = type(caught)(
                caught.what,
                where=f"{batch.where} topic {channel.topic}{place}",
                expected=caught.expected,
                remedy=caught.remedy,
            )

    def _binding(self, channel: Channel, role: Role, where: str) -> Binding:
        schema = self._file.schemas.get(channel.schema_id)
        name = "" if schema is None else schema.name
        return binding_of(name, channel.message_encoding, role, self._params.columns, where=where)

    def _decoder(self, channel: Channel, topic: _Topic, where: str) -> Decoder:
        key = (topic.role, channel.id)
        if key not in self._decoders:
            schema = self._file.schemas.get(channel.schema_id)
            self._decoders[key] = decoder(channel, schema, topic.binding.paths, where)
        return self._decoders[key]

    def _times(
        self,
        topic: _Topic,
        columns: Any,
        log_time: NDArray[np.int64],
        where: str,
    ) -> dict[str, NDArray[Any]]:
        """Own stamps; those before 1980 give way to log times, unless a boot clock is expected."""
        recorded = log_time.astype("datetime64[ns]")
        if self._params.time_source == "log" or not topic.binding.stamp:
            return {"time": recorded, "restamped": np.zeros(recorded.size, dtype=bool)}
        own = stamps(columns, topic.binding.stamp, self._params.time_unit, where)
        own = own.astype("datetime64[ns]")
        undated = np.asarray((own < CREDIBLE) & (self._params.start_time is None))
        return {"time": np.where(undated, recorded, own), "restamped": undated}

    def choose(self, role: Role) -> _Topic | None:
        """The topic that plays `role`, or None where none need. Raises SourceError."""
        key = f"{role}_topic"
        named = getattr(self._params, key)
        topics = [topic for (part, _), topic in self._topics.items() if part == role]
        where = str(self._file.path)
        if not topics and (named is not None or role == "magnetometer"):
            what = f"topic '{named}' has no messages" if named else "no topic is a magnetometer's"
            raise SourceError(
                what,
                where=where,
                expected=f"one of: {self._listing()}",
                remedy=f"name one with '{key}'",
            )
        if len(topics) > 1 and role in _NECESSARY:
            names = ", ".join(sorted(topic.name for topic in topics))
            raise SourceError(
                f"{len(topics)} topics could be the {role}: {names}",
                where=where,
                remedy=f"say which with '{key}'",
            )
        if len(topics) > 1:
            names = ", ".join(sorted(topic.name for topic in topics))
            _LOG.warning("%s: %s leaves out %s: several topics (%s)", where, key, role, names)
        if len(topics) != 1:
            return None
        if topics[0].failed is not None:
            raise topics[0].failed
        return topics[0]

    def _listing(self) -> str:
        rows = []
        for channel in sorted(self._file.channels.values(), key=lambda c: str(c.topic)):
            schema = self._file.schemas.get(channel.schema_id)
            name = "no schema" if schema is None else schema.name
            rows.append(f"{channel.topic} ({name}, {self._counts.get(channel.id, 0)} messages)")
        return "; ".join(rows) or "none, the file has no topics"


def _check_quantities(quantities: dict[str, NDArray[Any]], binding: Binding, where: str) -> None:
    for name, values in quantities.items():
        if values.dtype.kind == "U":
            raise FormatError(
                f"field '{binding.columns[name]}' holds text: '{values.flat[0][:40]}'",
                where=where,
                expected="numbers",
            )
        if values.ndim > 1 and "covariance" not in name:
            raise FormatError(
                f"field '{binding.columns[name]}' holds {values.shape[1]} numbers a message",
                where=where,
                expected="one",
            )


def _warn_truncated(file: McapFile, messages: int, until: int) -> None:
    if file.truncated is None:
        return
    if not messages:
        raise FormatError(
            f"truncated after byte {file.truncated}, before its first whole chunk",
            where=file.path,
            remedy="fetch it again; nothing can be recovered",
        )
    _LOG.warning(
        "%s: truncated after byte %d; kept its whole chunks: %d messages, recorded until %s",
        file.path,
        file.truncated,
        messages,
        np.datetime64(until, "ns"),
    )


def _check_stamps(columns: dict[str, NDArray[Any]], where: str) -> None:
    """Raise SourceError where more than a few headers carry no date."""
    undated = columns["restamped"]
    if 2 * int(undated.sum()) > undated.size:
        raise SourceError(
            f"the headers of {int(undated.sum())} of {undated.size} messages are stamped before "
            "1980",
            where=where,
            expected="UTC",
            remedy="set time_source = 'log', or start_time where the clock counts from boot",
        )


def _check_clock(time: NDArray[np.datetime64], where: str, params: IngestLogParams) -> None:
    undated = time < CREDIBLE
    if not undated.any() or params.start_time is not None:
        return
    raise SourceError(
        f"{int(undated.sum())} of {time.size} messages are dated before 1980, the first {time[0]}",
        where=where,
        expected="UTC",
        remedy="state the UTC of the first one with the key 'start_time'",
    )
