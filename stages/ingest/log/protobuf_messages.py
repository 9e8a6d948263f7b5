"""Columns from protobuf messages, whose types the log itself describes."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from operator import attrgetter
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError
from magtiles.stages.ingest.log.json_messages import column


class ProtobufDecoder:
    """Decodes the fields at `paths` of messages of the type `name`.

    Parameters
    ----------
    schema : a serialized FileDescriptorSet with the type and all that it uses.
    where : what messages of errors begin with.

    Raises
    ------
    FormatError : the schema is none, or lacks the type or a path.
    """

    def __init__(self, name: str, schema: bytes, paths: Collection[str], where: str) -> None:
        self._where = where
        try:
            files = descriptor_pb2.FileDescriptorSet.FromString(schema)
            pool = descriptor_pool.DescriptorPool()
            for file in files.file:
                pool.Add(file)
            descriptor = pool.FindMessageTypeByName(name)
        except (DecodeError, TypeError, KeyError) as caught:
            raise FormatError(
                f"the schema does not describe '{name}' ({str(caught)[:80]})", where=where
            ) from None
        for path in paths:
            _check_path(descriptor, path, where)
        self._type = message_factory.GetMessageClass(descriptor)
        self._paths = {path: attrgetter(path) for path in paths}

    def __call__(
        self, data: NDArray[np.uint8], start: NDArray[np.int64], stop: NDArray[np.int64]
    ) -> Mapping[str, NDArray[Any]]:
        """Columns of the messages at [start, stop) of `data`; repeated fields are (n, length).

        Raises FormatError naming the first message that does not parse.
        """
        whole = data.tobytes()
        found: dict[str, list[Any]] = {path: [] for path in self._paths}
        for row, (first, last) in enumerate(zip(start.tolist(), stop.tolist(), strict=True)):
            try:
                message = self._type.FromString(whole[first:last])
            except DecodeError:
                raise FormatError(
                    f"does not parse as '{self._type.DESCRIPTOR.full_name}'",
                    where=f"{self._where} message {row} of its chunk",
                    remedy="the schema does not describe what was recorded",
                ) from None
            for path, get in self._paths.items():
                value = get(message)
                found[path].append(value if isinstance(value, int | float | str) else list(value))
        return {path: column(values, f"{self._where} '{path}'") for path, values in found.items()}


def _check_path(descriptor: Any, path: str, where: str) -> None:
    *parents, leaf = path.split(".")
    for part in parents:
        field = None if descriptor is None else descriptor.fields_by_name.get(part)
        descriptor = None if field is None else field.message_type
    field = None if descriptor is None else descriptor.fields_by_name.get(leaf)
    if field is None or field.message_type is not None:
        raise FormatError(
            f"messages have no field '{path}' that is a number",
            where=where,
            remedy="the schema is not of the type that it is named after",
        )
