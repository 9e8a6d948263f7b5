"""What an HDF5 file may not do to its reader: point elsewhere, run code, or declare the absurd.

HDF5 follows external storage, external links and virtual datasets into other files without a
word, loads plug-ins for filters that it does not know, and lets 8 kB declare 64 TB.
"""

from __future__ import annotations

from pathlib import Path

import h5py

from magtiles.schemas.errors import FormatError

MAX_ARRAY_BYTES = 8 << 30
"""The most that a foreign file's arrays may take in memory."""

_DEFLATE_LIMIT = 1032  # the most zlib can expand: a file that declares more holds none of it
_MAX_OBJECTS = 10_000
_BUILT_IN_FILTERS = {
    h5py.h5z.FILTER_DEFLATE,
    h5py.h5z.FILTER_SHUFFLE,
    h5py.h5z.FILTER_FLETCHER32,
    h5py.h5z.FILTER_SZIP,
    h5py.h5z.FILTER_NBIT,
    h5py.h5z.FILTER_SCALEOFFSET,
}


def check_hdf5(path: Path, *, kind: str = "HDF5") -> int:
    """Raise FormatError unless everything in an HDF5 file lies in the file itself.

    Refused are external storage, virtual datasets, links other than hard ones, filters that are
    not part of HDF5, and arrays larger than the file can hold. No array is read. `kind` is what
    messages call the file.

    Returns
    -------
    The bytes that all arrays declare.
    """
    try:
        with h5py.File(path, "r") as file:
            declared = _walk(file, path)
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as caught:
        raise FormatError(
            f"is not a whole {kind} file: truncated or damaged "
            f"({str(caught).replace(str(path), path.name)[:200]})",
            where=path,
            remedy="fetch it again",
        ) from None
    if declared > path.stat().st_size * _DEFLATE_LIMIT:
        raise FormatError(
            f"declares {declared} bytes of arrays, more than a file of its size can hold",
            where=path,
            remedy="fetch it again",
        )
    return declared


def check_declared(declared: int, where: object) -> None:
    """Raise FormatError where the arrays of a foreign file are larger than `MAX_ARRAY_BYTES`."""
    if declared > MAX_ARRAY_BYTES:
        raise FormatError(
            f"declares {declared} bytes of arrays",
            where=where,
            expected=f"at most {MAX_ARRAY_BYTES}",
            remedy="cut it into parts",
        )


def _walk(file: h5py.File, where: object) -> int:
    """Check every object once, and give the bytes that all datasets declare."""
    root = file["/"]
    declared, seen, waiting = 0, {h5py.h5o.get_info(root.id).addr}, [root]
    while waiting:
        group = waiting.pop()
        for name in group:
            item = _own(group, name, where)
            address = h5py.h5o.get_info(item.id).addr
            if address in seen:
                if isinstance(item, h5py.Group):  # the netCDF library walks a ring for ever
                    raise _refused(group, name, where, "is a group that has another name, too")
                continue
            seen.add(address)
            if len(seen) > _MAX_OBJECTS:
                raise FormatError(f"has more than {_MAX_OBJECTS} objects", where=where)
            if isinstance(item, h5py.Group):
                waiting.append(item)
            elif isinstance(item, h5py.Dataset):
                if (problem := _elsewhere(item)) is not None:
                    raise _refused(group, name, where, problem)
                declared += _bytes(item)
    return declared


def _own(group: h5py.Group, name: str, where: object) -> h5py.HLObject:
    """A member of a group that lies in the same file, by a hard link."""
    link = group.get(name, getlink=True)
    if isinstance(link, h5py.HardLink):
        return group[name]
    if isinstance(link, h5py.ExternalLink):
        raise _refused(group, name, where, f"is a link to another file, {link.filename}")
    raise _refused(group, name, where, "is a link and no object")


def _elsewhere(dataset: h5py.Dataset) -> str | None:
    """Why a dataset needs more than its own file; None where it does not."""
    if dataset.external:
        return f"lies in other files: its values are in {dataset.external[0][0]}"
    if dataset.is_virtual:
        return "lies in other files: it is a virtual dataset"
    plan = dataset.id.get_create_plist()
    filters = [plan.get_filter(i)[0] for i in range(plan.get_nfilters())]
    unknown = [number for number in filters if number not in _BUILT_IN_FILTERS]
    return f"is packed by filter {unknown[0]}, which is not of HDF5" if unknown else None


def _bytes(dataset: h5py.Dataset) -> int:
    """What a dataset declares; netCDF keeps a dimension without values as one that has none."""
    if bytes(dataset.attrs.get("NAME", b"")).startswith(b"This is a netCDF dimension but not"):
        return 0
    return int(dataset.size or 0) * int(dataset.dtype.itemsize)


def _refused(group: h5py.Group, name: str, where: object, what: str) -> FormatError:
    return FormatError(
        f"'{group.name.rstrip('/')}/{name}' {what}",
        where=where,
        expected="objects that lie in the file itself, packed by HDF5's own filters",
        remedy="copy the data into a plain file, such as by h5repack or nccopy",
    )
