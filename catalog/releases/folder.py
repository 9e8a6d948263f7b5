"""The files of a release: reading them within caps, and finding what is missing or foreign."""

from __future__ import annotations

import os
import stat
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

from magtiles.catalog.releases.digest import sha256
from magtiles.schemas.errors import IntegrityError

_REMEDY = "fetch or build the release again"


def read_bytes(path: Path, *, limit: int) -> bytes:
    """A regular file's bytes, at most `limit`; a link or anything else raises IntegrityError."""
    try:
        with open(path, "rb", buffering=0, opener=_open_without_following) as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise IntegrityError("is no regular file", where=path, remedy=_REMEDY)
            size = status.st_size
            data = file.readall() if size <= limit else b""
    except OSError as caught:
        raise IntegrityError(
            f"cannot be read: {caught.strerror}", where=path, remedy=_REMEDY
        ) from None
    if size > limit or len(data) > limit:
        raise IntegrityError(
            f"is {size} bytes", where=path, expected=f"at most {limit}", remedy=_REMEDY
        )
    return data


def _open_without_following(path: str, flags: int) -> int:
    # Not blocking, so that a pipe put in a file's place is refused and not waited for.
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))


def read_verified(path: Path, *, size: int, digest: str) -> bytes:
    """The bytes of a file that must have this size and sha256; IntegrityError otherwise."""
    data = read_bytes(path, limit=size)
    if len(data) != size:
        raise IntegrityError(
            f"is {len(data)} bytes", where=path, expected=f"{size}", remedy=_REMEDY
        )
    found = sha256(data)
    if found != digest:
        raise IntegrityError(
            f"its content changed: sha256 is {found}",
            where=path,
            expected=f"{digest} as in manifest.json",
            remedy=_REMEDY,
        )
    return data


def check_folder(folder: Path, sizes: Mapping[str, int], allowed: Collection[str]) -> None:
    """Raise IntegrityError unless `folder` holds exactly the files of `sizes` and `allowed`.

    Only names and sizes are looked at; contents are verified when a file is read.
    """
    folders = {path[:i] for path in sizes for i, c in enumerate(path) if c == "/"}
    seen = set()
    for relative, entry in _walk(folder, ""):
        if entry.is_symlink() or not (entry.is_file() or entry.is_dir()):
            raise _foreign(folder / relative, "is a link or special file")
        if entry.is_dir():
            if relative not in folders:
                raise _foreign(folder / relative, "is a foreign folder")
            continue
        if relative not in sizes and relative not in allowed:
            raise _foreign(folder / relative, "is a foreign file, not listed in manifest.json")
        size = entry.stat().st_size
        if relative in sizes and size != sizes[relative]:
            raise IntegrityError(
                f"is {size} bytes",
                where=folder / relative,
                expected=f"{sizes[relative]} as in manifest.json",
                remedy=_REMEDY,
            )
        seen.add(relative)
    missing = sorted(set(sizes) - seen)
    if missing:
        raise IntegrityError("is missing", where=folder / missing[0], remedy=_REMEDY)


def _walk(folder: Path, prefix: str) -> Iterator[tuple[str, os.DirEntry[str]]]:
    with os.scandir(folder) as entries:
        for entry in sorted(entries, key=lambda e: e.name):
            relative = prefix + entry.name
            yield relative, entry
            if entry.is_dir(follow_symlinks=False) and prefix.count("/") < 4:
                yield from _walk(Path(entry.path), relative + "/")


def _foreign(path: Path, what: str) -> IntegrityError:
    return IntegrityError(what, where=path, remedy=f"remove it, or {_REMEDY}")
