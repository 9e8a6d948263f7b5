"""Foreign netCDF and HDF5 files, parsed by a child process of limited means.

The C libraries were not made for hostile files. A child checks the file (see `hdf5_checks`),
limits its own memory, time and files, reads the arrays and hands them over a pipe; whatever
happens to it, the parent gets plain arrays or raises an error.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError
from magtiles.stages.ingest.hdf5_checks import MAX_ARRAY_BYTES

CHILD = "magtiles.stages.ingest.foreign_child"

_KINDS = "biufSU"
_LAST_WORDS_SECONDS = 5.0
_MAX_HEADER_BYTES = 64 << 20
_ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",  # each thread reserves memory that counts against the limit
    "HDF5_PLUGIN_PRELOAD": "::",  # HDF5 loads no plug-ins
    "HDF5_USE_FILE_LOCKING": "FALSE",
}


@dataclass(frozen=True)
class Variable:
    """An array of a foreign file with its dimensions' names and its attributes, as stored.

    `values` is None where it was not asked for.
    """

    dims: tuple[str, ...]
    values: NDArray[Any] | None
    attrs: Mapping[str, Any]


@dataclass(frozen=True)
class ForeignFile:
    """Variables by name (of HDF5 by path, without the first slash), and the file's attributes."""

    variables: Mapping[str, Variable]
    attrs: Mapping[str, Any]


def read_foreign(path: Path, names: Sequence[str] | None = None) -> ForeignFile:
    """Read a netCDF file (classic or netCDF-4), or the datasets `names` of any HDF5 file.

    Raises FormatError where the file is damaged, points to other files, needs filters that are
    not of HDF5, declares too much, or takes its reader more memory or time than files of its
    size may.
    """
    command = [sys.executable, "-P", "-m", CHILD, str(path.absolute())]
    asked = json.dumps(None if names is None else list(names)).encode()
    with tempfile.TemporaryFile() as said:
        with subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=said,
            env=os.environ | _ENVIRONMENT,
        ) as child:
            assert child.stdin is not None
            assert child.stdout is not None
            try:
                child.stdin.write(asked)
                child.stdin.close()
                return _received(child.stdout, path)
            except (EOFError, BrokenPipeError):
                child.stdout.close()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    child.wait(_LAST_WORDS_SECONDS)  # how it died, its status tells
            finally:
                child.kill()
        said.seek(0)
        raise _died(child.returncode, said.read().decode("utf-8", "replace"), path)


def _received(stream: IO[bytes], path: Path) -> ForeignFile:
    variables: dict[str, Variable] = {}
    left = MAX_ARRAY_BYTES
    for header in _headers(stream):
        if "problem" in header:
            told = {k: v for k, v in header["problem"].items() if v is not None}
            where = told.pop("where", str(path)).replace(str(path.absolute()), str(path))
            raise FormatError(told.pop("what"), where=where, **told)
        if "attrs" in header and "name" not in header:
            return ForeignFile(variables, _attributes(header["attrs"]))
        values = None
        if header["dtype"] is not None:
            dtype, shape = np.dtype(header["dtype"]), tuple(int(n) for n in header["shape"])
            left -= dtype.itemsize * math.prod(shape)
            if dtype.kind not in _KINDS or min(shape, default=0) < 0 or left < 0:
                raise EOFError
            values = np.empty(shape, dtype)
            _fill(stream, values)
        variables[header["name"]] = Variable(
            tuple(header["dims"]), values, _attributes(header["attrs"])
        )
    raise EOFError


def _headers(stream: IO[bytes]) -> Iterator[dict[str, Any]]:
    while True:
        size = int.from_bytes(_exactly(stream, 8), "little")
        if size > _MAX_HEADER_BYTES:
            raise EOFError
        yield json.loads(_exactly(stream, size))


def _exactly(stream: IO[bytes], size: int) -> bytes:
    data = stream.read(size)
    if len(data) != size:
        raise EOFError
    return data


def _fill(stream: IO[bytes], values: NDArray[Any]) -> None:
    done = 0
    while done < values.nbytes:
        rest = values.reshape(-1).view(np.uint8)[done:].data
        got = stream.readinto(rest)  # type: ignore[attr-defined]
        if not got:
            raise EOFError
        done += got


def _attributes(encoded: Mapping[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in encoded.items():
        if isinstance(value, dict):
            array = np.asarray(value["data"], dtype=value["dtype"])
            found[name] = array[()] if array.ndim == 0 else array
        else:
            found[name] = value
    return found


def _died(status: int, said: str, path: Path) -> FormatError:
    """The error that a child died without a word of its own."""
    last = said.strip().rpartition("\n")[2][:200]
    if status in (-getattr(signal, "SIGXCPU", 0), -signal.SIGTERM, -getattr(signal, "SIGKILL", 0)):
        what = "took too long, or too much memory, to read"
    elif status < 0:
        what = f"made its reader crash ({signal.Signals(-status).name})"
    else:
        what = f"could not be read: {last or f'status {status}'}"
    return FormatError(what, where=path, expected="a whole netCDF file", remedy="fetch it again")
