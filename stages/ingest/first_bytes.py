"""The first bytes of a file that someone named."""

from __future__ import annotations

from pathlib import Path

from magtiles.schemas.errors import FormatError


def first_bytes(path: Path, count: int, expected: str) -> bytes:
    """At most `count` bytes (all for -1), and at least one, of what ought to be `expected`.

    Raises FormatError for a missing, empty or unreadable file, and a folder.
    """
    if path.is_dir():
        raise FormatError("is a folder", where=path, expected=expected)
    try:
        with path.open("rb") as file:
            head = file.read(count)
    except FileNotFoundError:
        raise FormatError(
            "the file does not exist", where=path, remedy="fetch it or correct the path"
        ) from None
    except OSError as caught:
        raise FormatError(f"cannot be read: {caught.strerror}", where=path) from None
    if not head:
        raise FormatError("the file is empty", where=path, remedy="fetch it again")
    return head
