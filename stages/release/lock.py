"""One writer of a folder at a time, among processes and machines."""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Iterator
from pathlib import Path

from magtiles.stages.release.atomic import writing

_log = logging.getLogger(__name__)


@contextlib.contextmanager
def locked(folder: Path, name: str, *, doing: str) -> Iterator[None]:
    """Hold the lock file `name` of a folder, which is made; waits for whoever holds it.

    The system frees the lock of a process that dies, and the next one removes its file. Where the
    file system has no locks this only warns. Raises MagtilesError where nothing can be written.
    """
    path = folder / name
    with writing(path):
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = _lock(path, doing)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            path.unlink()  # while it is held: nobody else can have made it anew
        os.close(descriptor)


def _lock(path: Path, doing: str) -> int:
    """A descriptor of the file at `path`, locked."""
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            _wait(descriptor, path, doing)
            if _is_at(path, descriptor):
                return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)  # its holder removed it: there may be another


def _wait(descriptor: int, path: Path, doing: str) -> None:
    try:
        import fcntl
    except ImportError:  # Windows has none
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        _log.warning("another process is %s in %s: waiting for it", doing, path.parent)
        fcntl.flock(descriptor, fcntl.LOCK_EX)
    except OSError as caught:
        _log.warning(
            "%s cannot be locked (%s): let nothing else be %s there",
            path.parent, caught.strerror, doing,
        )  # fmt: skip


def _is_at(path: Path, descriptor: int) -> bool:
    try:
        there = path.stat()
    except FileNotFoundError:
        return False
    return os.path.samestat(there, os.fstat(descriptor))
