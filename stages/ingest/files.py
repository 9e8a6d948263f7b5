"""What a foreign file is, by its first bytes, before any library parses it."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

from magtiles.schemas.errors import FormatError
from magtiles.stages.ingest.first_bytes import first_bytes
from magtiles.stages.ingest.geosoft import is_geosoft
from magtiles.stages.ingest.xyz import is_xyz, odd_line

_MAGIC = {
    b"II*\x00": "geotiff",
    b"MM\x00*": "geotiff",
    b"II+\x00": "geotiff",
    b"MM\x00+": "geotiff",
    b"\x89HDF": "netcdf",
    b"CDF\x01": "netcdf",
    b"CDF\x02": "netcdf",
    b"DSAA": "surfer-6-text",
    b"DSBB": "surfer-6",
    b"DSRB": "surfer-7",
}
_KNOWN_OTHERS = {
    b"PK\x03\x04": "a zip archive inside another archive",
    b"\x1f\x8b": "gzip-compressed once more",
    b"\xfd7zXZ": "xz-compressed",
    b"%PDF": "a PDF document",
    b"\x89PNG": "a PNG picture",
    b"CDF\x05": "a netCDF file of format CDF-5, which nccopy -k nc4 converts",
    b"\xff\xfe": "text in UTF-16",
    b"\xfe\xff": "text in UTF-16",
}
_HEAD_BYTES = 65536


def sniff(path: Path) -> str:
    """What kind of grid a file is, by content: ``geotiff``, ``gxf``, ``netcdf``, ``geosoft``, ...

    Raises FormatError for a missing, empty or unreadable file, a folder, and other formats.
    """
    head = first_bytes(path, _HEAD_BYTES, "a grid file")
    for magic, kind in _MAGIC.items():
        if head.startswith(magic):
            return kind
    if any(line.strip().upper().startswith(b"#GRID") for line in head.splitlines()) or (
        b"#POINTS" in head.upper()
    ):
        return "gxf"
    if head.lstrip().startswith(b"DatasetHeader Begin"):
        return "er-mapper"
    if head[:64].split()[:1] and head.split(maxsplit=1)[0].lower() in (b"ncols", b"nrows"):
        return "esri-ascii"
    if is_geosoft(head):
        return "geosoft"
    if is_xyz(head):
        return "xyz"
    raise FormatError(
        f"is {_describe(head)}",
        where=f"{path} byte 0",
        expected="GeoTIFF, GXF, netCDF, Geosoft, Surfer, ER Mapper, ESRI ASCII, or rows of x, y "
        "and value",
        remedy="convert it first",
    )


def check_tiff_directories(path: Path) -> None:
    """Raise FormatError unless every tag of a TIFF lies inside the file.

    A truncated TIFF otherwise loses its void mark or CRS with no more than a warning.
    """
    size = path.stat().st_size
    try:
        with path.open("rb") as file:
            _walk_directories(file, size)
    except (struct.error, OverflowError):
        raise FormatError(
            f"a TIFF directory points past the end of the file ({size} bytes)",
            where=path,
            remedy="the file is truncated: fetch it again",
        ) from None


_TYPE_BYTES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8}
_TYPE_BYTES |= {13: 4, 16: 8, 17: 8, 18: 8}  # IFD and the 64-bit types of BigTIFF


def _walk_directories(file: BinaryIO, size: int) -> None:
    head = file.read(16)
    order = "<" if head[:2] == b"II" else ">"
    (version,) = struct.unpack_from(order + "H", head, 2)
    # Classic TIFF counts in 32 bits, BigTIFF in 64.
    count, entry, pointer = (
        (struct.Struct(order + code) for code in ("Q", "HHQQ", "Q"))
        if version == 43
        else (struct.Struct(order + code) for code in ("H", "HHLL", "L"))
    )
    (offset,) = pointer.unpack_from(head, 8 if version == 43 else 4)
    seen: set[int] = set()
    while offset and offset not in seen:
        seen.add(offset)
        file.seek(offset)
        (entries,) = count.unpack(file.read(count.size))
        for _ in range(entries):
            _, kind, values, place = entry.unpack(file.read(entry.size))
            length = _TYPE_BYTES.get(kind, 1) * values
            if length > pointer.size and place + length > size:
                raise struct.error("a tag's values lie outside the file")
        (offset,) = pointer.unpack(file.read(pointer.size))


def _describe(head: bytes) -> str:
    for magic, name in _KNOWN_OTHERS.items():
        if head.startswith(magic):
            return name
    start = head[:512].lstrip().lower()
    if start.startswith((b"<!doctype html", b"<html")):
        return "an HTML page"
    if b"\x00" in head[:512]:
        return "binary data of an unknown kind"
    number, line = odd_line(head) or (1, head)
    said = line.decode("latin-1").strip()[:50]
    return f"text of an unknown kind: line {number}, '{said}', is no row of x, y and value"
