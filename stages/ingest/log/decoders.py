"""The decoder of a channel's messages, by their encoding and the schema that came with them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError
from magtiles.stages.ingest.log.bindings import check_layout
from magtiles.stages.ingest.log.cdr import CdrDecoder
from magtiles.stages.ingest.log.json_messages import JsonDecoder
from magtiles.stages.ingest.log.protobuf_messages import ProtobufDecoder
from magtiles.stages.ingest.log.rosmsg import Leaf, leaves

Decoder = Callable[
    [NDArray[np.uint8], NDArray[np.int64], NDArray[np.int64]], Mapping[str, NDArray[Any]]
]
"""From bytes and the limits of messages in them to columns by path."""


def decoder(channel: Channel, schema: Schema | None, paths: Collection[str], where: str) -> Decoder:
    """What decodes `paths` from a channel's messages.

    Raises FormatError for an encoding that is not understood, and for a schema that lacks a path
    or declares other fields than the type that it names.
    """
    if channel.message_encoding == "json":
        return JsonDecoder(paths, where)
    if schema is not None and channel.message_encoding == "cdr":
        return CdrDecoder(ros_layout(schema, where), paths, where)
    if schema is not None and channel.message_encoding == "protobuf":
        return ProtobufDecoder(schema.name, schema.data, paths, where)
    encoding = f"'{channel.message_encoding}'{'' if schema else ' without a schema'}"
    raise FormatError(
        f"the message encoding is {encoding}",
        where=where,
        expected="cdr, json or protobuf, with a schema",
    )


def ros_layout(schema: Schema, where: str) -> tuple[Leaf, ...]:
    """The fields that a ROS 2 schema declares. Raises FormatError; see `decoder`."""
    if schema.encoding != "ros2msg":
        raise FormatError(
            f"the schema encoding is '{schema.encoding}'", where=where, expected="ros2msg"
        )
    try:
        text = schema.data.decode("utf-8")
    except UnicodeDecodeError:
        raise FormatError("the schema is no text", where=where, expected="ros2msg") from None
    layout = leaves(schema.name, text, where=where)
    check_layout(schema.name, layout, where=where)
    return layout
