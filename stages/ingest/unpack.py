"""Files inside gzip, xz and zip, unpacked beside nothing: into a folder that is removed after."""

from __future__ import annotations

import contextlib
import gzip
import lzma
import shutil
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path, PurePosixPath
from typing import Protocol

from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages.release.atomic import writing


class _Readable(Protocol):
    def read(self, size: int, /) -> bytes: ...


scratch: ContextVar[Path | None] = ContextVar("scratch", default=None)
"""Where to unpack; default where the system keeps temporary files. A build names a folder of its
own, so that the next one removes what one that was killed left there."""

_LIMIT_BYTES = 16 << 30
_BLOCK_BYTES = 1 << 20
_PACKED = {b"\x1f\x8b": "gzip", b"\xfd7zXZ\x00": "xz", b"PK\x03\x04": "zip"}
_SUFFIX = {"gzip": ".gz", "xz": ".xz"}


@contextlib.contextmanager
def unpacked(path: Path, member: str | None = None) -> Iterator[Path]:
    """The file itself, or what the gzip, xz or zip file at `path` holds, for as long as it is used.

    Parameters
    ----------
    member : which file of a zip archive of several, by its name or its whole path there; files
        that belong to it (a data file beside its header) are unpacked with it.

    Raises FormatError for a damaged archive or one that unpacks to more than 16 GiB;
    SourceError where the member is not clear; MagtilesError where it cannot be written.
    """
    kind = _kind(path)
    if kind is None:
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="magtiles-", dir=scratch.get()) as name:
        yield _unpack(kind, path, Path(name), member)


def _unpack(kind: str, path: Path, folder: Path, member: str | None) -> Path:
    try:
        return _unzip(path, folder, member) if kind == "zip" else _expand(kind, path, folder)
    except (
        OSError,
        EOFError,
        zlib.error,
        lzma.LZMAError,
        zipfile.BadZipFile,
        RuntimeError,
    ) as caught:
        raise FormatError(
            f"is not a whole {kind} file: {caught}", where=path, remedy="fetch it again"
        ) from None


def _kind(path: Path) -> str | None:
    try:
        with path.open("rb") as file:
            head = file.read(6)
    except OSError:
        return None  # whoever reads it says what is wrong
    return next((kind for magic, kind in _PACKED.items() if head.startswith(magic)), None)


def _expand(kind: str, path: Path, folder: Path) -> Path:
    out = folder / (path.stem if path.suffix.lower() == _SUFFIX[kind] else path.name)
    with gzip.open(path) if kind == "gzip" else lzma.open(path) as packed:
        _copy(packed, out, path)
    return out


def _unzip(path: Path, folder: Path, member: str | None) -> Path:
    with zipfile.ZipFile(path) as archive:
        found = [
            PurePosixPath(i.filename)
            for i in archive.infolist()
            if not i.is_dir() and "__MACOSX" not in i.filename
        ]
        wanted = _choose(found, path, member)
        for one in found:
            if one.parent == wanted.parent and one.stem == wanted.stem:
                with archive.open(str(one)) as packed:
                    _copy(packed, folder / one.name, path)
    return folder / wanted.name


def _choose(found: list[PurePosixPath], path: Path, member: str | None) -> PurePosixPath:
    """The file of the archive that `member` names, alone or with its folders."""
    names = ", ".join(sorted(map(str, found))) or "none"
    if member is not None:
        meant = [one for one in found if member in (str(one), one.name)]
        if len(meant) != 1:
            raise SourceError(
                f"key 'member' is '{member}'" + (f", {len(meant)} times there" if meant else ""),
                where=path,
                expected=f"one of {names}",
            )
        return meant[0]
    if len(found) != 1:
        raise SourceError(
            f"the archive holds {len(found)} files: {names}",
            where=path,
            expected="one",
            remedy="choose one with the key 'member'",
        )
    return found[0]


def _copy(packed: _Readable, out: Path, path: Path) -> None:
    written = 0
    # Without a buffer, which would be written once more, and fail again, where it is closed.
    with out.open("wb", buffering=0) as file:
        while block := packed.read(_BLOCK_BYTES):
            written += len(block)
            if written > min(_LIMIT_BYTES, shutil.disk_usage(out.parent).free + written):
                raise FormatError(
                    f"unpacks to more than {_LIMIT_BYTES >> 30} GiB, or than there is room for",
                    where=path,
                )
            with writing(out):
                while block:
                    block = block[file.write(block) :]
