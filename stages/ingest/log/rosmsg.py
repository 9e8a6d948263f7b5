"""ROS 2 message definitions (``ros2msg`` text) as flat lists of primitive fields."""

from __future__ import annotations

import re
from dataclasses import dataclass

from magtiles.schemas.errors import FormatError

PRIMITIVES = {
    "bool": "u1", "byte": "u1", "char": "u1", "int8": "i1", "uint8": "u1",
    "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
"""ROS types of fixed size, and how NumPy calls them without the order of bytes."""

FILLER = "structure_needs_at_least_one_member"
"""What the wire format puts into a message of no fields."""

_MOST_FIELDS = 10_000
_DEEPEST = 32
_RULE = re.compile(r"^={20,}\s*$", re.M)
_LINE = re.compile(
    r"(?P<type>[\w/]+)(?:<=\d+)?(?P<array>\[(?P<bound><=)?(?P<count>\d*)\])?\s+"
    r"(?P<name>\w+)(?P<constant>\s*=(?!=))?"
)


@dataclass(frozen=True)
class Leaf:
    """A field that is no message itself.

    Attributes
    ----------
    path : names joined by dots.
    type : a key of `PRIMITIVES`, or ``string``.
    count : 1, the length of an array, or None for a sequence of any length.
    sequence_of_messages : a sequence of whole messages, which has no fixed layout.
    """

    path: str
    type: str
    count: int | None = 1
    sequence_of_messages: bool = False

    def __str__(self) -> str:
        size = "" if self.count == 1 else f"[{'' if self.count is None else self.count}]"
        return f"{self.type}{size} {self.path}"


_Field = tuple[str, str, int | None, bool]  # type, name, count, is an array


def leaves(name: str, text: str, *, where: str) -> tuple[Leaf, ...]:
    """The fields of the message type `name` in the order of its bytes.

    Raises FormatError, beginning with `where`, for a definition that is empty, incomplete,
    endless or not understood.
    """
    first, *rest = _RULE.split(text)
    types = {_short(name): first}
    for part in rest:
        head, _, body = part.strip().partition("\n")
        if not head.startswith("MSG:"):
            raise FormatError(
                f"the schema's part starts with '{head[:40]}'", where=where, expected="MSG: type"
            )
        types[_short(head.removeprefix("MSG:").strip())] = body
    parsed = {known: _fields(body, where) for known, body in types.items()}
    out: list[Leaf] = []
    _flatten(_short(name), "", parsed, out, where, depth=0)
    return tuple(out)


def _short(name: str) -> str:
    """``sensor_msgs/MagneticField`` for ``sensor_msgs/msg/MagneticField``."""
    return name.replace("/msg/", "/")


def _fields(body: str, where: str) -> list[_Field]:
    fields: list[_Field] = []
    for line in body.splitlines():
        line = line.partition("#")[0].strip()
        if not line:
            continue
        match = _LINE.match(line)
        if match is None:
            raise FormatError(
                f"the schema has the line '{line[:60]}'", where=where, expected="TYPE NAME"
            )
        if match["constant"]:
            continue
        is_array = match["array"] is not None
        count = 1 if not is_array else int(match["count"]) if match["count"] else None
        fields.append((match["type"], match["name"], None if match["bound"] else count, is_array))
    return fields


def _flatten(
    name: str,
    prefix: str,
    types: dict[str, list[_Field]],
    out: list[Leaf],
    where: str,
    *,
    depth: int,
) -> None:
    if depth > _DEEPEST or len(out) > _MOST_FIELDS:
        raise FormatError("the schema nests without end", where=where)
    if not types[name]:
        out.append(Leaf(prefix + FILLER, "uint8"))
    for kind, field, count, is_array in types[name]:
        path = prefix + field
        if kind in PRIMITIVES or kind in ("string", "wstring"):
            out.append(Leaf(path, kind, count))
            continue
        inner = _resolve(kind, name, types, where)
        if count is None:
            out.append(Leaf(path, inner, None, sequence_of_messages=True))
            continue
        for item in range(count):
            inside = f"{path}.{item}." if is_array else f"{path}."
            _flatten(inner, inside, types, out, where, depth=depth + 1)


def _resolve(kind: str, user: str, types: dict[str, list[_Field]], where: str) -> str:
    package = user.partition("/")[0]
    for candidate in (_short(kind), f"{package}/{kind}", f"std_msgs/{kind}"):
        if candidate in types:
            return candidate
    raise FormatError(
        f"the schema uses the type '{kind}' and does not define it",
        where=where,
        expected=f"one of {', '.join((*PRIMITIVES, *types))}",
    )
