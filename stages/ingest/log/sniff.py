"""Which format a log has, by its first bytes."""

from __future__ import annotations

from pathlib import Path

from magtiles.schemas.errors import FormatError
from magtiles.stages.ingest.first_bytes import first_bytes
from magtiles.stages.ingest.log.trackline import is_mgd77

_MAGIC = {
    b"\x89MCAP0\r\n": "mcap",
    b"ULog\x01\x125": "ulog",
    b"\x89HDF\r\n\x1a\n": "hdf5",
}
_KNOWN_OTHERS = {
    b"\x28\xb5\x2f\xfd": "zstd-compressed",
    b"\x04\x22\x4d\x18": "lz4-compressed",
    b"\x1f\x8b": "gzip-compressed",
    b"PK\x03\x04": "a zip archive",
    b"SQLite format 3": "an SQLite database, as older ROS 2 bags are",
    b"#ROSBAG": "a ROS 1 bag",
}
_HEAD_BYTES = 4096


def log_format(path: Path) -> str:
    """The name of the format. Raises FormatError for what is no log, empty or unreadable."""
    head = first_bytes(path, _HEAD_BYTES, "a log file")
    for magic, name in _MAGIC.items():
        if head.startswith(magic):
            return name
    other = next((text for magic, text in _KNOWN_OTHERS.items() if head.startswith(magic)), None)
    if other is None and b"\x00" not in head:
        return _table_format(head, path)
    raise FormatError(
        f"is {other}" if other else f"starts with {head[:8]!r}",
        where=f"{path} byte 0",
        expected="MCAP, ULog, HDF5 or a table of text",
        remedy="unpack or convert it first",
    )


def _table_format(head: bytes, path: Path) -> str:
    lines = [line for line in head.splitlines() if line.strip()]
    first = next((line for line in lines if not line.startswith(b"#")), b"")
    words = {word.strip() for word in first.replace(b"\t", b",").split(b",")}
    if first.lstrip()[:9].lower() in (b"<!doctype", b"<html>") or b"<html" in head.lower():
        what, remedy = "is an HTML page", "fetch the file itself"
    elif any(is_mgd77(line) for line in lines):
        return "mgd77"
    elif {b"LAT", b"LON", b"MAG_TOT"} <= words:
        return "mgd77t" if b"\t" in first else "trackline"
    elif first.upper().startswith(b"DEFN"):
        what, remedy = "is an ASEG-GDF2 definition", "name its data file beside it"
    elif any(mark in first for mark in (b",", b"\t", b";")):
        return "csv"
    else:
        what = "is text of an unknown kind"
        remedy = "an ASEG-GDF2 data file needs its .dfn file: name both"
    raise FormatError(
        what,
        where=f"{path} byte 0",
        expected="MCAP, ULog, HDF5, MGD77, ASEG-GDF2 or CSV",
        remedy=remedy,
    )
