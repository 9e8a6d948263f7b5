"""The bytes of a record's file, unpacked where gzipped, and what format they are in."""

from __future__ import annotations

import gzip
import zlib
from pathlib import Path

from magtiles.schemas.errors import FormatError
from magtiles.stages.ingest.first_bytes import first_bytes

_MOST_BYTES = 4 << 30
"""More than a year of one-second records in IAGA-2002; a file that unpacks to more is refused."""

_GZIP = b"\x1f\x8b"
_FOREIGN = {
    b"PK\x03\x04": "a zip archive",
    b"\xfd7zXZ": "xz-compressed",
    b"BZh": "bzip2-compressed",
    b"%PDF": "a PDF document",
    b"\x89PNG": "a PNG picture",
    b"\x89HDF": "HDF5 or netCDF-4",
}


def read_content(path: Path) -> bytes:
    """The bytes of a file, unpacked where it is gzipped.

    Raises FormatError for a missing, empty, truncated or unreasonably large file, and for one
    that is by its first bytes an archive, a picture or an HTML page.
    """
    content = first_bytes(path, -1, "an observatory's record")
    if content.startswith(_GZIP):
        content = _unpacked(path)
    _refuse_foreign(content, path)
    return content


def _unpacked(path: Path) -> bytes:
    try:
        with gzip.open(path) as file:
            content = file.read(_MOST_BYTES + 1)
    except (EOFError, OSError, zlib.error) as caught:
        raise FormatError(
            f"cannot be unpacked: {caught}",
            where=path,
            remedy="the file is truncated or damaged: fetch it again",
        ) from None
    if len(content) > _MOST_BYTES:
        raise FormatError(
            f"unpacks to more than {_MOST_BYTES >> 30} GB",
            where=path,
            remedy="split the record into files of a year or less",
        )
    return content


def _refuse_foreign(content: bytes, path: Path) -> None:
    if not content[:512].strip() and not content.strip():  # the second copies the content
        raise FormatError("the file is empty", where=path, remedy="fetch it again")
    start = content[:512].lstrip().lower()
    if start.startswith((b"<!doctype html", b"<html", b"<?xml")):
        raise FormatError(
            "is an HTML page",
            where=f"{path} line 1",
            expected="data",
            remedy="the server answered with a page, often for an unknown file: fetch it again",
        )
    for magic, name in _FOREIGN.items():
        if content.startswith(magic):
            raise FormatError(
                f"is {name}", where=f"{path} byte 0", remedy="unpack or convert it first"
            )
