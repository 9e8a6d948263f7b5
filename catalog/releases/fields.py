"""Reading an untrusted JSON document field by field."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from typing import Any

from magtiles.schemas.errors import IntegrityError

REMEDY = "fetch or build the release again"


def parse_json(data: bytes, where: object) -> Fields:
    """The object in a JSON file; duplicate keys, NaN and anything else raise IntegrityError."""
    try:
        document = json.loads(
            data.decode("utf-8"), object_pairs_hook=_unique, parse_constant=_no_constant
        )
    except (ValueError, RecursionError) as caught:
        raise IntegrityError(f"not a JSON document: {caught}", where=where, remedy=REMEDY) from None
    return Fields(document, str(where), "")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    document = dict(pairs)
    if len(document) != len(pairs):
        raise ValueError("a key stands twice in one object")
    return document


def _no_constant(name: str) -> Any:
    raise ValueError(f"{name} is no JSON number")


class Fields:
    """An object of an untrusted document; every getter checks type and range.

    Errors are IntegrityError with the file and the path of the key.
    """

    def __init__(self, document: Any, where: str, path: str) -> None:
        self.where = where
        self.path = path
        if not isinstance(document, dict):
            raise self.problem("", f"is {_kind(document)}", "an object")
        self.document: dict[str, Any] = document

    def problem(self, key: str, what: str, expected: str) -> IntegrityError:
        """The error that `key` breaks the contract."""
        place = ".".join(part for part in (self.path, key) if part) or "document"
        return IntegrityError(f"{place} {what}", where=self.where, expected=expected, remedy=REMEDY)

    def only(self, *known: str) -> None:
        """Refuse keys other than `known`."""
        for key in self.document:
            if key not in known:
                raise self.problem(key, "is unknown", f"only {', '.join(known)}")

    def _get(self, key: str, kinds: type | tuple[type, ...], expected: str) -> Any:
        if key not in self.document:
            raise self.problem(key, "is missing", expected)
        value = self.document[key]
        if not isinstance(value, kinds) or isinstance(value, bool):
            raise self.problem(key, f"is {_kind(value)}", expected)
        return value

    def text(self, key: str, pattern: str = r"[^\x00-\x1f]{1,4096}") -> str:
        """A string that matches `pattern` whole."""
        value = str(self._get(key, str, "a string"))
        if not re.fullmatch(pattern, value):
            raise self.problem(key, f"is {value[:80]!r}", f"a string like {pattern}")
        return value

    def integer(self, key: str, low: int, high: int) -> int:
        """An integer in [low, high]."""
        value = int(self._get(key, int, "an integer"))
        if not low <= value <= high:
            raise self.problem(key, f"is {value}", f"an integer from {low} to {high}")
        return value

    def number(self, key: str, low: float, high: float) -> float:
        """A finite number in [low, high]."""
        return self._number(key, self._get(key, (int, float), "a number"), low, high)

    def numbers(self, key: str, low: float, high: float, count: tuple[int, int]) -> list[float]:
        """A list of `count[0]` to `count[1]` finite numbers in [low, high]."""
        values = self._get(key, list, "a list of numbers")
        if not count[0] <= len(values) <= count[1]:
            raise self.problem(key, f"has {len(values)} items", f"{count[0]} to {count[1]}")
        for value in values:
            if not isinstance(value, (int, float)) or isinstance(value, bool):
                raise self.problem(key, f"holds {_kind(value)}", "numbers")
        return [self._number(key, value, low, high) for value in values]

    def _number(self, key: str, value: float, low: float, high: float) -> float:
        # The comparison comes first: an integer too long for a float stays out of range.
        if not low <= value <= high or not math.isfinite(value):
            raise self.problem(key, f"is {value!r:.40}", f"a number from {low:g} to {high:g}")
        return float(value)

    def inner(self, key: str) -> Fields:
        """The object under `key`."""
        return Fields(self._get(key, dict, "an object"), self.where, self._path(key))

    def items(self, key: str, most: int) -> Iterator[Fields]:
        """The objects of the list under `key`, at most `most`."""
        values = self._get(key, list, "a list of objects")
        if len(values) > most:
            raise self.problem(key, f"has {len(values)} items", f"at most {most}")
        for i, value in enumerate(values):
            yield Fields(value, self.where, self._path(f"{key}[{i}]"))

    def plain(self) -> Mapping[str, Any]:
        """The object itself, where its keys are free."""
        return self.document

    def _path(self, key: str) -> str:
        return f"{self.path}.{key}" if self.path else key


def _kind(value: Any) -> str:
    names = {dict: "an object", list: "a list", str: "a string", type(None): "null"}
    return names.get(type(value), f"{value!r:.40}")
