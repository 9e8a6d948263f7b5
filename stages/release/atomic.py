"""Files that are either whole or not there."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from magtiles.schemas.errors import MagtilesError

_TEMPORARY = ".{name}.{token}.tmp"


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary path in the folder of `path` that replaces it when the block succeeds.

    The bytes are on disk (fsync) before the rename; when the block fails nothing is left. Raises
    MagtilesError, as `writing` does, where the file cannot be written.
    """
    temporary = path.with_name(_TEMPORARY.format(name=path.name, token=secrets.token_hex(4)))
    try:
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            yield temporary
            sync(temporary)
            temporary.replace(path)
            sync(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn what a system says that cannot write `path` (full, read-only...) into MagtilesError."""
    try:
        yield
    except (OSError, RuntimeError) as caught:
        if not _is_of_writing(caught, path):
            raise
        reason = getattr(caught, "strerror", None) or caught
        raise MagtilesError(
            f"cannot be written ({reason})",
            where=path,
            remedy="check free space, the limit of file sizes (ulimit -f) and permissions",
        ) from caught


def _is_of_writing(caught: Exception, path: Path) -> bool:
    if not isinstance(caught, OSError):
        return str(caught).startswith("NetCDF: ")  # all that the library says of a full disk
    if caught.errno is None:  # not the system's: of a download, or a format
        return False
    if caught.filename is None:
        return True
    named = Path(caught.filename)
    return named.is_relative_to(path.parent) or path.is_relative_to(named)


def remove_temporaries(folder: Path) -> None:
    """Remove what processes that died in `atomic_path` left in a folder."""
    for file in folder.glob(_TEMPORARY.format(name="*", token="*")):
        file.unlink(missing_ok=True)


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` to `path`, which then holds all of it or what it held before."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def sync(path: Path) -> None:
    """Force a file or folder to the disk."""
    if path.is_dir():
        if os.name != "posix":  # Windows cannot open a folder
            return
        flags = os.O_RDONLY
    else:  # Windows syncs only what is open for writing, POSIX either
        flags = os.O_RDONLY if os.name == "posix" else os.O_RDWR
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
