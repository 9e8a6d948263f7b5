"""Columns from JSON messages, by paths such as ``position.latitude`` or ``field.0``."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError


class JsonDecoder:
    """Decodes the values at `paths`; `where` is what messages of errors begin with."""

    def __init__(self, paths: Collection[str], where: str) -> None:
        self._paths = {path: path.split(".") for path in paths}
        self._where = where

    def __call__(
        self, data: NDArray[np.uint8], start: NDArray[np.int64], stop: NDArray[np.int64]
    ) -> Mapping[str, NDArray[Any]]:
        """Columns of the messages at [start, stop) of `data`: numbers, or text; null is NaN.

        Raises FormatError naming the first message that is no JSON or lacks a path.
        """
        whole = data.tobytes()
        found: dict[str, list[Any]] = {path: [] for path in self._paths}
        for row, (first, last) in enumerate(zip(start.tolist(), stop.tolist(), strict=True)):
            where = f"{self._where} message {row} of its chunk"
            try:
                message = json.loads(whole[first:last])
            except (ValueError, RecursionError) as caught:
                raise FormatError(f"is no JSON ({caught})", where=where) from None
            for path, parts in self._paths.items():
                found[path].append(_value(message, path, parts, where))
        return {path: column(values, f"{self._where} '{path}'") for path, values in found.items()}


def _value(message: Any, path: str, parts: list[str], where: str) -> Any:
    value = message
    for part in parts:
        try:
            value = value[int(part)] if isinstance(value, list) else value[part]
        except (KeyError, IndexError, TypeError, ValueError):
            keys = ", ".join(map(str, message)) if isinstance(message, dict) else "nothing"
            raise FormatError(
                f"the message has no field '{path}'", where=where, expected=f"under {keys}"
            ) from None
    return value


def column(values: list[Any], where: str) -> NDArray[Any]:
    """Values of messages as an array of numbers or text; lists are filled with NaN to one length.

    Raises FormatError for others.
    """
    plain: list[Any] = [np.nan if value is None else value for value in values]
    if any(isinstance(value, list) for value in plain):
        lists = [value if isinstance(value, list) else [] for value in plain]
        width = max(map(len, lists))
        plain = [[*value, *[np.nan] * (width - len(value))] for value in lists]
    try:
        array = np.array(plain)
    except (ValueError, OverflowError):  # lists in lists
        array = np.array(None)
    if array.dtype.kind not in "biufU" or array.ndim == 0:
        odd = next((v for v in values if not isinstance(v, int | float | None)), values[0])
        raise FormatError(f"holds {odd!r}"[:120], where=where, expected="a number")
    return array
