"""MCAP files as batches of message records: framing, bounds, compression and CRCs.

Record layouts are those of the package mcap (specification: mcap.dev/spec). Only what a batch
needs is taken apart here; message payloads stay bytes until `mcap_log` decodes whole columns.
"""

from __future__ import annotations

import contextlib
import io
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import IO, Any, BinaryIO, cast

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Footer, Message, Schema
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError
from magtiles.stages.ingest.log.mcap_walk import count_records, walk_messages

_MAGIC_BYTES = 8
_FILLED = 0  # no opcode: space that a crash left unwritten
_MESSAGE_HEADER_BYTES = 22  # channel, sequence, log time, publish time
_ALWAYS_BYTES = 64 << 20
_EXPANSION = 100
_MOST_BYTES = 2 << 30
"""A chunk may declare 64 MiB, or a hundredfold of what it holds up to 2 GiB; more is no log."""
_LOOSE_BYTES = 1 << 20
"""Messages outside chunks are gathered up to this size."""


@dataclass(frozen=True)
class Batch:
    """The messages of one chunk, as positions in its bytes.

    Attributes
    ----------
    data : (bytes,) uint8.
    channel : (n,) channel ids.
    log_time : (n,) int64 ns.
    start, stop : (n,) limits of each payload in `data`.
    where : the place in the file, for messages.
    """

    data: NDArray[np.uint8]
    channel: NDArray[np.uint16]
    log_time: NDArray[np.int64]
    start: NDArray[np.int64]
    stop: NDArray[np.int64]
    where: str


@dataclass
class McapFile:
    """One pass over an MCAP file; schemas and channels fill up as they are met.

    Attributes
    ----------
    truncated : after the pass, at which byte the last whole record ends, where more should follow.
    """

    path: Path
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    truncated: int | None = None

    def batches(self) -> Iterator[Batch]:
        """Every message, chunk by chunk in the file's order.

        Raises
        ------
        FormatError : a CRC, a size, a compression or a record is wrong; it names the byte. The
            end of a truncated file is not an error: see `truncated`.
        """
        with self.path.open("rb") as file:
            loose = _Loose(str(self.path))
            for offset, opcode, payload, in_data in self._records(file):
                where = f"{self.path} byte {offset}"
                if not in_data:
                    # Nothing rests on the summary: it adds the names of topics without messages.
                    with contextlib.suppress(FormatError):
                        self._register(opcode, payload, where)
                elif opcode == Opcode.CHUNK:
                    yield from loose.flush()
                    yield self._unpacked(_parse(Chunk.read, payload, where), where)
                elif opcode == Opcode.MESSAGE:
                    loose.add(_parse(partial(Message.read, length=len(payload)), payload, where))
                    if loose.size > _LOOSE_BYTES:
                        yield from loose.flush()
                else:
                    self._register(opcode, payload, where)
            yield from loose.flush()

    def _records(self, file: BinaryIO) -> Iterator[tuple[int, int, bytes, bool]]:
        """Offset, opcode and content of each record, and whether it stands before the summary."""
        size = self.path.stat().st_size
        stream = ReadDataStream(cast(IO[bytes], _Exact(file, size)), calculate_crc=True)
        offset, in_data = 0, True
        try:
            stream.read(_MAGIC_BYTES)
            while True:
                offset, crc = stream.count, stream.checksum()
                opcode, length = stream.read1(), stream.read8()
                if opcode == _FILLED:
                    raise EndOfFile
                payload = stream.read(length)
                if opcode == Opcode.DATA_END:
                    self._check_data(_parse(DataEnd.read, payload, f"byte {offset}"), crc, offset)
                    in_data = False
                if opcode == Opcode.FOOTER:
                    _parse(Footer.read, payload, f"{self.path} byte {offset}")
                    stream.read(_MAGIC_BYTES)
                    return
                yield offset, opcode, payload, in_data
        except EndOfFile:
            self.truncated = offset

    def _check_data(self, end: DataEnd, crc: int, offset: int) -> None:
        if end.data_section_crc not in (0, crc):
            raise FormatError(
                f"the data section's CRC is {crc:#010x}",
                where=f"{self.path} bytes 0 to {offset}",
                expected=f"{end.data_section_crc:#010x} as its end states",
                remedy="the file is damaged outside its chunks: copy it again",
            )

    def _register(self, opcode: int, payload: bytes, where: str) -> None:
        if opcode == Opcode.SCHEMA:
            schema = _parse(Schema.read, payload, where)
            if self.schemas.setdefault(schema.id, schema) != schema:
                raise FormatError(f"schema {schema.id} is defined twice, differently", where=where)
        elif opcode == Opcode.CHANNEL:
            channel = _parse(Channel.read, payload, where)
            if self.channels.setdefault(channel.id, channel) != channel:
                raise FormatError(
                    f"channel {channel.id} is defined twice, differently", where=where
                )

    def _unpacked(self, chunk: Chunk, where: str) -> Batch:
        data = _decompressed(chunk, where)
        if chunk.uncompressed_crc not in (0, found := zlib.crc32(data)):
            raise FormatError(
                f"the chunk's CRC is {found:#010x}",
                where=where,
                expected=f"{chunk.uncompressed_crc:#010x} as it states",
                remedy="the chunk is damaged: copy the file again",
            )
        values = np.frombuffer(data, dtype=np.uint8)
        messages, others, bad = count_records(values)
        if bad >= 0:
            raise FormatError(
                f"the record at byte {bad} of the chunk leads past its end",
                where=where,
                remedy="the file was not written as MCAP says",
            )
        channel, log_time, start, stop, other = walk_messages(values, messages, others)
        for at, opcode, length in other:
            self._register(opcode, data[at : at + length], where)
        return Batch(values, channel, log_time, start, stop, where)


class _Exact:
    """Reads exactly what is asked for, or says that the end has come; never allocates more.

    It has all of a file that the package mcap uses.
    """

    def __init__(self, stream: BinaryIO, size: int) -> None:
        self._stream, self._left = stream, size

    def read(self, length: int) -> bytes:
        if length > self._left:
            raise EndOfFile
        self._left -= length
        return self._stream.read(length)


def _parse(read: Callable[[ReadDataStream], Any], payload: bytes, where: str) -> Any:
    try:
        exact = cast(IO[bytes], _Exact(io.BytesIO(payload), len(payload)))
        return read(ReadDataStream(exact))
    except (EndOfFile, ValueError) as caught:
        raise FormatError(
            f"the record cannot be read ({type(caught).__name__})",
            where=where,
            remedy="the file is damaged: copy it again",
        ) from None


class _Loose:
    """Messages that stand outside chunks, gathered to batches."""

    def __init__(self, where: str) -> None:
        self._where = where
        self._messages: list[Message] = []
        self.size = 0

    def add(self, message: Message) -> None:
        self._messages.append(message)
        self.size += len(message.data) + _MESSAGE_HEADER_BYTES

    def flush(self) -> Iterator[Batch]:
        messages, self._messages, self.size = self._messages, [], 0
        if not messages:
            return
        stop = np.cumsum([len(m.data) for m in messages], dtype=np.int64)
        yield Batch(
            np.frombuffer(b"".join(m.data for m in messages), dtype=np.uint8),
            np.array([m.channel_id for m in messages], dtype=np.uint16),
            np.array([m.log_time for m in messages], dtype=np.uint64).view(np.int64),
            np.concatenate([np.zeros(1, np.int64), stop[:-1]]),
            stop,
            self._where,
        )


def _decompressed(chunk: Chunk, where: str) -> bytes:
    """The chunk's records, never more than it declares. Raises FormatError."""
    declared, held = chunk.uncompressed_size, len(chunk.data)
    limit = min(max(_ALWAYS_BYTES, _EXPANSION * held), _MOST_BYTES)
    if declared > limit:
        raise FormatError(
            f"the chunk declares {declared} bytes in {held}",
            where=where,
            expected=f"at most {limit}",
            remedy="it would fill the memory: the file is damaged or hostile",
        )
    if chunk.compression not in _DECOMPRESS:
        raise FormatError(
            f"the chunk's compression is '{chunk.compression}'",
            where=where,
            expected="zstd, lz4 or none",
        )
    try:
        data = _DECOMPRESS[chunk.compression](chunk.data, declared)
    except (zstandard.ZstdError, RuntimeError, EOFError) as caught:
        raise FormatError(
            f"the chunk does not decompress ({caught})",
            where=where,
            remedy="it is damaged: copy the file again",
        ) from None
    if len(data) != declared:
        more = "more than " if len(data) > declared else ""
        raise FormatError(
            f"the chunk holds {more}{min(len(data), declared)} bytes",
            where=where,
            expected=f"{declared} as it declares",
        )
    return data


def _zstd(data: bytes, size: int) -> bytes:
    with zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True) as stream:
        return bytes(stream.read(size + 1))


def _lz4(data: bytes, size: int) -> bytes:
    return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1))


_DECOMPRESS: dict[str, Callable[[bytes, int], bytes]] = {
    "": lambda data, size: data,
    "zstd": _zstd,
    "lz4": _lz4,
}
