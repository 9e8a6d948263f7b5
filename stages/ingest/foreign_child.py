"""The child of `read_foreign`: reads one file with limited means and writes it to a pipe.

For each variable a header (8 bytes of length, then JSON) and its bytes, last a header with the
attributes of the file, or with what is wrong with it. Not to be imported: it limits its process.
"""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import h5py
import netCDF4
import numpy as np
from numpy.typing import NDArray
from scipy.io import netcdf_file

from magtiles.schemas.errors import FormatError
from magtiles.stages.ingest.hdf5_checks import MAX_ARRAY_BYTES, check_declared, check_hdf5

_DEFLATE_LIMIT = 1032
_BASE_BYTES = 2 << 30
"""Address space for the interpreter and the libraries."""
_BASE_SECONDS, _BYTES_PER_SECOND = 60, 1 << 20


def limit_means(size: int) -> None:
    """Limit memory and time to what a file of `size` bytes may need; allow no file, no core."""
    try:
        import resource
    except ImportError:  # Windows has none
        return
    arrays = min(size * _DEFLATE_LIMIT, MAX_ARRAY_BYTES)
    for kind, most in (
        ("RLIMIT_AS", _BASE_BYTES + 3 * arrays),
        ("RLIMIT_CPU", _BASE_SECONDS + size // _BYTES_PER_SECOND),
        ("RLIMIT_CORE", 0),
        ("RLIMIT_FSIZE", 0),
    ):
        # macOS knows a limit of the address space but refuses to set it.
        with contextlib.suppress(AttributeError, OSError, ValueError):
            resource.setrlimit(getattr(resource, kind), (most, most))


class Sender:
    """Writes variables and the end, or a problem, to a pipe."""

    def __init__(self, out: BinaryIO) -> None:
        self._out = out

    def header(self, **content: Any) -> None:
        """One header."""
        data = json.dumps(content).encode()
        self._out.write(len(data).to_bytes(8, "little") + data)

    def variable(
        self, name: str, dims: Sequence[str], values: NDArray[Any] | None, attrs: Mapping[str, Any]
    ) -> None:
        """A variable; without values only its name and attributes."""
        if values is None:
            self.header(name=name, dims=[], dtype=None, shape=[], attrs=encoded(attrs))
            return
        if values.dtype.kind == "O":
            values = np.asarray(values, dtype=np.str_)
        plain = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("="))
        shape = list(values.shape)
        self.header(
            name=name, dims=list(dims), dtype=plain.dtype.str, shape=shape, attrs=encoded(attrs)
        )
        if plain.size:
            self._out.write(plain.reshape(-1).view(np.uint8).data)


def encoded(attrs: Mapping[str, Any]) -> dict[str, Any]:
    """Attributes for JSON: text, lists of text, and numbers with their dtype; others are left."""
    found: dict[str, Any] = {}
    for name, value in attrs.items():
        if isinstance(value, bytes):
            value = value.decode("utf-8", "replace")
        array = np.asarray(value)
        if isinstance(value, str) or array.dtype.kind in "OU":
            if all(isinstance(one, str) for one in array.ravel().tolist()):
                found[name] = value if isinstance(value, str) else array.tolist()
        elif array.dtype.kind in "biuf":
            native = array.astype(array.dtype.newbyteorder("="))
            found[name] = {"dtype": native.dtype.str, "data": native.tolist()}
    return found


def send_classic(path: Path, send: Sender) -> None:
    """A classic file, by SciPy: the netCDF library fills what one lacks with zeros."""
    # Mapped, so that nothing is read before its size is known to be true.
    file = netcdf_file(path, "r", mmap=True, maskandscale=False)
    check_declared(sum(int(v.data.nbytes) for v in file.variables.values()), path)
    for name, variable in file.variables.items():
        send.variable(name, variable.dimensions, np.array(variable.data), variable._attributes)
    send.header(attrs=encoded(file._attributes))


def send_netcdf4(path: Path, send: Sender) -> None:
    """The root group of a netCDF-4 file."""
    check_declared(check_hdf5(path, kind="netCDF"), path)
    with netCDF4.Dataset(str(path)) as file:
        file.set_auto_maskandscale(False)
        file.set_auto_chartostring(False)
        for name, variable in file.variables.items():
            if variable.dtype is str or variable.dtype.kind in "biufS":
                attrs = {key: variable.getncattr(key) for key in variable.ncattrs()}
                send.variable(name, variable.dimensions, np.asarray(variable[...]), attrs)
        send.header(attrs=encoded({key: file.getncattr(key) for key in file.ncattrs()}))


def send_hdf5(path: Path, names: Sequence[str], send: Sender) -> None:
    """The datasets `names` of an HDF5 file, and the names of all others."""
    check_declared(check_hdf5(path), path)
    with h5py.File(path, "r") as file:
        for name, dataset in _datasets(file):
            values = _values(dataset) if name in names else None
            send.variable(name, [""] * dataset.ndim, values, dict(dataset.attrs))
        send.header(attrs=encoded(dict(file.attrs)))


def _datasets(group: h5py.Group) -> Iterator[tuple[str, h5py.Dataset]]:
    """Every dataset by each of its names; the file is known to hold no ring of groups."""
    for name, item in group.items():
        if isinstance(item, h5py.Group):
            yield from ((f"{name}/{inner}", found) for inner, found in _datasets(item))
        elif isinstance(item, h5py.Dataset):
            yield name, item


def _values(dataset: h5py.Dataset) -> NDArray[Any]:
    if h5py.check_string_dtype(dataset.dtype) is not None:
        return np.asarray(dataset.asstr()[()], dtype=np.str_)
    if dataset.dtype.kind not in "biuf":
        raise FormatError(
            f"is of type {dataset.dtype}",
            where=f"dataset '{dataset.name.lstrip('/')}'",
            expected="numbers or text",
        )
    return np.asarray(dataset[()])


def main(path: Path, names: Sequence[str] | None, out: BinaryIO) -> None:
    """Send the file, or what is wrong with it."""
    send = Sender(out)
    try:
        limit_means(path.stat().st_size)
        with path.open("rb") as file:
            classic = file.read(3) == b"CDF"
        if names is not None:
            send_hdf5(path, names, send)
        elif classic:
            send_classic(path, send)
        else:
            send_netcdf4(path, send)
    except FormatError as problem:
        send.header(
            problem={k: getattr(problem, k) for k in ("what", "where", "expected", "remedy")}
        )
    except MemoryError:
        send.header(problem={"what": "takes more memory to read than a file of its size may"})
    except (OSError, RuntimeError, ValueError, TypeError, LookupError, AttributeError) as caught:
        what = f"is not a whole netCDF file: {str(caught).replace(str(path), path.name)[:200]}"
        send.header(problem={"what": what, "remedy": "fetch it again"})
    out.flush()


if __name__ == "__main__":
    main(Path(sys.argv[1]), json.load(sys.stdin), sys.stdout.buffer)
